"""Whether iterations are replayed: where CUDA graphs are asked for, and they can be recorded.

What cannot, or whose first replays differ from a plain run, is computed plainly from then on, and a
line says why. Where a solve needed more iterations than were recorded, the iteration is computed
once more, plainly, and the next one recorded anew.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from ddrecon import engine
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.kernels.capture import NotFixedError, Record, record_graph
from ddrecon.ranks import rank_count
from ddrecon.reconstruct.gradients import Differentiated, differentiate
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.recording import Recording
from ddrecon.scene import Scene

LOG = logging.getLogger(engine.LOG)
_told: set[str] = set()
"""Why iterations run without graphs, as far as a line has said so."""


class Graphs:
    """The recording of a run at one resolution, if the engine is to use any."""

    def __init__(self, record: Record[Any] = record_graph):
        self.record = record
        self.recording: Recording | None = None
        self.is_first, self.is_off = True, not engine.has_graphs()

    def differentiate(
        self,
        scene: Scene,
        values: Mapping[str, Tensor],
        compared: Comparison,
        memory: SolveMemory,
    ) -> Differentiated:
        """As of `gradients.differentiate`, where `compared` compares the images of its views."""
        found = None
        # SSIM is looked at now and then only.
        if not self.is_off and not compared.has_similarity:
            try:
                found = self._replayed(scene, values, compared, memory)
            except (NotFixedError, RuntimeError) as error:
                self._turn_off(str(error).partition("\n")[0])
        if found is not None:
            return found
        names = [view.name for view in compared.views]
        return differentiate(scene, names, values, compared, memory)

    def _replayed(
        self,
        scene: Scene,
        values: Mapping[str, Tensor],
        compared: Comparison,
        memory: SolveMemory,
    ) -> Differentiated | None:
        """What a recording finds; None where a plain run is to tell how many iterations it takes.

        So is the first.
        """
        if self.is_first:
            self.is_first = False
            self._turn_off(_reason(scene, values))
            return None
        if self.recording is not None and not self.recording.fits(scene, memory):
            self.recording = None  # whose memory the next one needs
        if self.recording is None:
            self.recording = Recording(scene, values, memory, self.record)
        found = self.recording.replay(values, compared, memory)
        if found is None:
            self.recording = None
        return found

    def _turn_off(self, reason: str | None) -> None:
        if reason is not None:
            self.is_off, self.recording = True, None
            if reason not in _told:
                _told.add(reason)
                LOG.warning("iterations run without CUDA graphs: %s", reason)


def _reason(scene: Scene, values: Mapping[str, Tensor]) -> str | None:
    """Why iterations of `scene` cannot be recorded, as far as that is known before."""
    settings = scene.diffusion
    if any(value.device.type == "cpu" for value in values.values()):
        return "they need a GPU"
    if rank_count() > 1:
        return "several processes wait for each other"
    if settings.scheme == "printed" or settings.model == "flux_limited":
        return "this diffusion model looks at each of its iterations"
    if settings.solver != "multigrid" and settings.model != "none":
        return f"the solver {settings.solver} looks at its iterations"
    return None
