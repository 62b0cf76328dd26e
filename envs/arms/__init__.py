"""The arms: one record each."""

from __future__ import annotations

from typing import Any

from viapoint.envs.arms.base import Arm
from viapoint.envs.arms.panda import PANDA
from viapoint.envs.arms.planar import ADULT

ARMS: dict[str, Arm] = {arm.name: arm for arm in (ADULT, PANDA)}
"""Every known arm by its name."""

OF_ONES_OWN = "viapoint.envs.arms.register_arm makes an arm of your own known by its name"
"""What to do where an arm is not known."""


def register_arm(arm: Arm) -> None:
    """Make an arm of one's own known by its name, so that environments, runs and models find it.

    Files of runs and models hold no more of an arm than its name: whoever loads one makes the arm known first.

    Raises:
        TypeError: It is no record of an arm.
        ValueError: Another arm is known by that name.
    """
    _check_record(arm)
    if ARMS.setdefault(arm.name, arm) != arm:
        raise ValueError(f"another arm is known as {arm.name!r}; give this one another name")


def arm_of(arm: Any) -> Arm:
    """An arm itself, or the one with that name.

    Raises:
        TypeError: It is neither.
        ValueError: There is none of that name.
    """
    if isinstance(arm, str):
        if arm not in ARMS:
            raise ValueError(f"arm must be a record or one of {', '.join(ARMS)}, got {arm!r}; {OF_ONES_OWN}")
        return ARMS[arm]
    _check_record(arm)
    found: Arm = arm
    return found


def _check_record(arm: Any) -> None:
    if not hasattr(arm, "reach_margin") or not isinstance(getattr(arm, "name", None), str):
        raise TypeError(
            f"arm must be a record of viapoint.envs.arms, got {arm!r:.80}; files and JSON know arms by "
            f"their names: {OF_ONES_OWN}"
        )


__all__ = ["ADULT", "ARMS", "PANDA", "Arm", "arm_of", "register_arm"]
