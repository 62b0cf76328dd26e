"""Drawing movements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from viapoint.envs.action import Plan
from viapoint.envs.execution import Rollout
from viapoint.envs.scenes import Scenes
from viapoint.envs.simulator import Simulator


def check_render_mode(mode: str | None, known: Sequence[str]) -> str | None:
    """A render mode that there is."""
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode must be None or one of {', '.join(known)}, got {mode!r}")
    return mode


class MovementRenderer:
    """Draws what happened in one simulation."""

    def __init__(self, simulator: Simulator, mode: str | None, width: int, height: int, fps: int) -> None:
        self._simulator = simulator
        self.mode = mode

    def still(self, sim: int, scene: Scenes) -> Any:
        """The scene before the movement."""

    def movement(self, sim: int, scene: Scenes, plan: Plan, rollout: Rollout) -> Any:
        """The movement."""

    def close(self) -> None:
        """Let windows go."""
