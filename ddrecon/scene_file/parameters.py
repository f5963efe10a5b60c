"""What can be wrong with the parameters that a scene optimizes: names, limits, pairs."""

from __future__ import annotations

from pathlib import Path

from ddrecon.scene_file.nodes import Node
from ddrecon.scene_file.problems import Problems, suggestion
from ddrecon.settings import ParameterSettings
from ddrecon.variables.kinds import (
    CROSS_SECTIONS,
    EXTINCTION_AND_ALBEDO,
    KINDS,
    kind_of,
    pattern_of,
    split_name,
)


def require_parameters(
    node: Node, parameters: dict[str, ParameterSettings], folder: Path
) -> dict[str, ParameterSettings]:
    """`parameters` of `node`, by names of variables, of one pair of cross sections at most.

    Raises SceneError with all that is wrong with them.
    """
    problems, entries = Problems(), node.entries()
    if not parameters:
        raise node.refused(f"names no parameter; known: {', '.join(KINDS)}")
    for name, settings in parameters.items():
        if pattern_of(name) not in KINDS:
            near = suggestion(pattern_of(name), KINDS)
            problems.note(entries[name].key_refused(f"unknown parameter{near}"))
            continue
        own = entries[name].entries()
        for key, what in _illegal(name, settings):
            problems.note(own[key].refused(what))
        medium, last = split_name(name)
        others = [medium + other for other in CROSS_SECTIONS if medium + other in parameters]
        if last in EXTINCTION_AND_ALBEDO and others:
            problems.note(
                entries[name].key_refused(
                    f"cannot be optimized beside {others[0]}:"
                    " take sigma_a and sigma_s, or sigma_t and albedo"
                )
            )
    problems.raise_any()
    return parameters


def _illegal(name: str, settings: ParameterSettings) -> list[tuple[str, str]]:
    """What keys of the parameter `name` may not say, as keys and what is wrong."""
    kind, wrong = kind_of(name), list[tuple[str, str]]()
    if settings.support is not None and name != "density":
        wrong.append(("support", f"{settings.support!r} is for density alone"))
    for key in ("min", "max", "init"):
        value = getattr(settings, key)
        numbers = value if isinstance(value, tuple) else (value,)
        for number in numbers:
            if isinstance(number, float) and not kind.low <= number <= kind.high:
                limits = f"at least {kind.low:g} and at most {kind.high:g}"
                wrong.append((key, f"must be {limits}, found {number:g}"))
                break
    if not kind.is_cellwise:
        keys = [key for key in ("field", "tv") if getattr(settings, key)]
        wrong += [(key, "it is not a field, so it has none") for key in keys]
    return wrong
