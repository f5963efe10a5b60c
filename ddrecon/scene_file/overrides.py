"""`-D key.path=value`: values from the command line, put into a scene before it is validated."""

from __future__ import annotations

from ddrecon.errors import SceneError
from ddrecon.scene_file.nodes import MAX_DEPTH, Node, describe_found, parse
from ddrecon.scene_file.problems import Problems, suggestion
from ddrecon.variables.kinds import KINDS, pattern_of

PARAMETERS = "optimize.parameters"
"""Where keys are the names of variables, dots and all."""


def override(root: Node, text: str, problems: Problems) -> None:
    """Puts the value of `text` (`key.path=value`, in YAML) into the tree under `root`.

    Mappings are made as needed.

    A list is entered by index. Where keys themselves have dots, as those of parameters do, the
    longest one present or legal is taken. Raises SceneError.
    """
    where = f"-D {text}"
    key, separator, value = text.partition("=")
    if not separator or not all(key.split(".")):
        raise SceneError(f"{where}: expected key.path=value")
    if key.count(".") > MAX_DEPTH:
        raise SceneError(f"{where}: nested more than {MAX_DEPTH} deep")
    parent, path = root, key
    while True:
        name, path = _step(parent, path, where)
        if not path:
            _put(parent, name, _value(value, parent.child_key(name), where, problems))
            return
        parent = _enter(parent, name, where)


def _step(parent: Node, path: str, where: str) -> tuple[str, str]:
    """The part of `path` that leads to a child of `parent`, and what is left of it."""
    parts = path.split(".")
    if isinstance(parent.value, dict):
        for count in range(len(parts), 0, -1):
            name = ".".join(parts[:count])
            if name in parent.value or (parent.key == PARAMETERS and pattern_of(name) in KINDS):
                return name, ".".join(parts[count:])
    elif isinstance(parent.value, list):
        if not (parts[0].isascii() and parts[0].isdigit() and int(parts[0]) < len(parent.value)):
            raise SceneError(
                f"{where}: {parent.child_key(parts[0])}: no such entry:"
                f" {parent.key} is {describe_found(parent)}, counted from 0"
            )
    else:
        raise SceneError(
            f"{where}: {parent.child_key(parts[0])}: {parent.key or 'the scene'} is"
            f" {describe_found(parent)}, not a mapping or list"
        )
    return parts[0], ".".join(parts[1:])


def _enter(parent: Node, name: str, where: str) -> Node:
    """The child `name` of `parent`, a mapping that is added where there is none."""
    if isinstance(parent.value, list):
        return parent.value[int(name)]
    if not isinstance(parent.value, dict):
        raise parent.refused(
            f"expected a mapping, found {describe_found(parent)}{suggestion(name, ())}"
        )
    return parent.value.setdefault(name, Node(parent.child_key(name), where, where, {}))


def _put(parent: Node, name: str, child: Node) -> None:
    if isinstance(parent.value, list):
        parent.value[int(name)] = child
    elif isinstance(parent.value, dict):
        parent.value[name] = child


def _value(text: str, key: str, where: str, problems: Problems) -> Node:
    if not text.strip():
        return Node(key, where, where, None)
    return parse(text, lambda line, column: where, problems, key)
