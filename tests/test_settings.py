"""What a scene can ask for is what there is."""

from collections.abc import Iterable
from dataclasses import fields

import pytest

from ddrecon.diffusion.closures import CLOSURES
from ddrecon.losses import LOSSES
from ddrecon.scene_file.view_schema import FisheyeSection, OpencvSection
from ddrecon.settings import LENSES, DiffusionSettings, OptimizeSettings
from ddrecon.transport.sweep import DIRECTIONS


@pytest.mark.parametrize(
    ("record", "key", "table"),
    [
        (DiffusionSettings, "closure", CLOSURES),
        (DiffusionSettings, "degree", DIRECTIONS),
        (OptimizeSettings, "loss", LOSSES),
    ],
)
def test_a_scene_may_ask_for_whatever_is_in_a_table(
    record: type, key: str, table: Iterable[object]
) -> None:
    choices = {field.name: field.metadata.get("choices") for field in fields(record)}
    assert list(choices[key]) == list(table)


@pytest.mark.parametrize("section", [OpencvSection, FisheyeSection])
def test_a_lens_has_its_coefficients_in_order(section: type) -> None:
    assert LENSES[section.type] == tuple(field.name for field in fields(section))
