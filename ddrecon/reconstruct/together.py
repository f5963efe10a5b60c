"""Several reconstructions that share their numbers: the frames of a film, one calibration.

Each has its own fields. All other parameters are shared, and move by the pictures of all (E10.2),
by the same step as in a single reconstruction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.errors import DivergenceError
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.log import Row
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.numbers import NumberSteps, units_of
from ddrecon.scene import Scene
from ddrecon.settings import AUTO


class Together:
    """Reconstructions, `runs`, of `scenes` that differ in their pictures, made side by side.

    One that would end by itself makes as many iterations as such a run plans for.
    """

    def __init__(self, scenes: Sequence[Scene]):
        asked = [scene.optimize.iterations if scene.optimize else AUTO for scene in scenes]
        planned = tuning.PLANNED if asked[0] == AUTO else None
        self.runs = [Reconstruction(scene, planned) for scene in scenes]
        first = self.runs[0]
        self.schedule = first.schedule
        self.before_step: dict[str, Any] | None = None
        self.shared = [parameter for parameter in first.parameters if not parameter.is_field]
        names = {parameter.name: parameter for parameter in self.shared}
        for run in self.runs:
            run.parameters = [names.get(parameter.name, parameter) for parameter in run.parameters]
            run.numbers = NumberSteps(run.problem.train, run.parameters, len(scenes))
            run.numbers.pending = first.numbers.pending

    @property
    def is_done(self) -> bool:
        """Whether all iterations have been made."""
        return self.runs[-1].is_done

    @property
    def iteration(self) -> int:
        """How many iterations have been made."""
        return self.runs[0].iteration

    def step(self) -> list[Row]:
        """One more iteration of each; the log's rows.

        Raises DivergenceError when one fails. The state of all is then that before the last step.
        """
        old = self.state()
        try:
            rows = [run.step() for run in self.runs]
        except DivergenceError:
            self.restore(self.before_step or old)
            raise
        self.before_step = old
        return rows

    def spread(self) -> dict[str, Tensor]:
        """The disagreement of the runs on each shared number, entry by entry, by name.

        It is the standard deviation over runs of the step that each would make alone.
        """
        alone = [run.undamped_changes() for run in self.runs]
        if len(alone) < 2:
            return {}
        return {
            p.name: torch.stack([change[p] * units_of(p) for change in alone]).std(0)
            for p in self.shared
            if p in alone[0]
        }

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"runs": [run.state() for run in self.runs]}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where those that made `state` stopped."""
        for run, of_run in zip(self.runs, state["runs"], strict=True):
            run.restore(of_run)
        self.runs[0].numbers.pending.clear()
