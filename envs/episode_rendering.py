"""Drawing episodes whose plans were revised: the present plan bright, those before it faded."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs._drawing import Pencil, in_space, resampled
from viapoint.envs._movement import Movement
from viapoint.envs._stage import SPACING, Stage
from viapoint.envs.courses import ChangingScenes
from viapoint.envs.execution import Rollout
from viapoint.envs.palette import PALETTE, Colour
from viapoint.envs.rendering import MovementRenderer
from viapoint.envs.revision import MovingPlan
from viapoint.envs.scenes import Scenes

Float = NDArray[np.float64]
History = list[tuple[float, MovingPlan]]

FADED: Colour = tuple(0.6 * a + 0.4 * b for a, b in zip(PALETTE.plan, PALETTE.table, strict=True))  # type: ignore[assignment]
"""Of a plan that was given up."""
GIVEN_UP = 0.0045
"""Radius of its path, [m]."""
POINTS = 60
"""Along a planned path."""


class ChangingStage(Stage):
    """Shows everything where it was at the time of a frame."""

    changing: ChangingScenes | None = None
    """One scene and what became of it."""
    history: History
    """Its plans and when they began, [s]."""

    def set(self, scene: Scenes, joints: Float, movement: Movement | None = None, step: int = 0) -> Any:
        """See :meth:`Stage.set`; of a movement, scene and plan are those of the time of the step."""
        if movement is None or self.changing is None:
            return super().set(scene, joints, movement, step)
        time = step * float(self.model.opt.timestep)
        begun = [plan for began, plan in self.history if began <= time + 1e-9] or [self.history[0][1]]
        current = begun[-1]
        movement = movement._replace(planned=_path(current), vias=current.waypoints[0, 1:-1])
        super().set(self.changing.at(np.array([time])), joints, movement, step)
        pencil = Pencil(self.scene)
        for plan in begun[:-1]:
            pencil.line(in_space(resampled(_path(plan), SPACING), self._floor + 0.001), GIVEN_UP, FADED)
        return self.scene


class EpisodeRenderer(MovementRenderer):
    """Draws what happened in one simulation in the course of its decisions."""

    stage_kind = ChangingStage

    def episode(self, sim: int, changing: ChangingScenes, history: History, rollout: Rollout) -> Any:
        """The episode so far."""
        stage = self._ready()
        assert isinstance(stage, ChangingStage)
        stage.changing, stage.history = changing, history
        touched = int(rollout.contact.argmax()) if rollout.contact.any() else len(rollout.time)
        scene = changing.at(np.array([touched * float(stage.model.opt.timestep)]))
        return self.movement(sim, scene, history[-1][1].plan, rollout)


def _path(plan: MovingPlan) -> Float:
    """Of one plan, shape (POINTS, D), [m]."""
    return np.asarray(plan.trajectory().sample(POINTS, 0)[0][0])
