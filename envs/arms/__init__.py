"""The arms: one record each."""

from __future__ import annotations

from typing import Any

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.panda import PANDA
from viapoint.envs.arms.planar import ADULT

ARMS: dict[str, Arm] = {arm.name: arm for arm in (ADULT, PANDA)}
"""Every arm by its name."""


def arm_of(arm: Any) -> Arm:
    """An arm itself, or the one with that name.

    Raises:
        TypeError: It is neither.
        ValueError: There is none of that name.
    """
    if isinstance(arm, str):
        if arm not in ARMS:
            raise ValueError(f"arm must be a record or one of {', '.join(ARMS)}, got {arm!r}")
        return ARMS[arm]
    if not hasattr(arm, "reach_margin"):
        raise TypeError(f"arm must be a record of viapoint.envs.arms, got {arm!r}")
    found: Arm = arm
    return found


__all__ = ["ADULT", "ARMS", "PANDA", "Arm", "arm_of"]
