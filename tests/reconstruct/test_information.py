"""What pictures say of all cells, roughly, where it is known what they say."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from media import random_values
from torch import Tensor

from ddrecon.uncertainty.posterior import Information

SHAPE = (12, 12, 12)
AXES = (-3, -2, -1)


def blur(field: Tensor) -> Tensor:
    """`field` times 1/4, 1/2, 1/4 along each axis, going around."""
    for axis in AXES:
        field = (field.roll(1, axis) + 2 * field + field.roll(-1, axis)) / 4
    return field


class Blurred:
    """A curvature whose J blurs a field and multiplies a number by 3, seen by one picture each."""

    def __init__(self) -> None:
        self.values = {"density": torch.zeros(SHAPE), "g": torch.tensor(0.0)}
        self.images = {"field": torch.zeros(SHAPE), "number": torch.tensor(0.0)}
        self.weights = {"field": torch.full(SHAPE, 4.0), "number": torch.tensor(1.0)}
        self.parameters = [
            SimpleNamespace(name="density", is_field=True),
            SimpleNamespace(name="g", is_field=False),
        ]

    def join(self, parts: dict[str, Tensor]) -> Tensor:
        return torch.cat([parts[name].reshape(-1) for name in self.values])

    def split(self, vector: Tensor) -> dict[str, Tensor]:
        return {"density": vector[:-1].view(SHAPE), "g": vector[-1]}

    def adjoint(self, pictures: dict[str, Tensor]) -> Tensor:
        return self.join({"density": blur(pictures["field"]), "g": 3 * pictures["number"]})


def test_of_what_is_alike_everywhere_it_is_nearly_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ddrecon.uncertainty.posterior.PROBES", 100)
    fake: Any = Blurred()
    information = Information(fake, torch.Generator().manual_seed(0))
    vector = random_values(1729, dtype=torch.float32) - 0.5
    found = information.product(vector)
    parts = fake.split(vector)
    # J^T W J = 4 blur^2 of the field, and 9 of the number.
    exact = 4 * blur(blur(parts["density"]))
    assert float((fake.split(found)["density"] - exact).norm() / exact.norm()) < 0.25
    assert float(fake.split(found)["g"]) == pytest.approx(9 * float(parts["g"]))
    # The diagonal alone takes rough changes for told as well as smooth ones are.
    diagonal = fake.split(information.diagonal * vector)["density"]
    assert float((diagonal - exact).norm() / exact.norm()) > 0.5
