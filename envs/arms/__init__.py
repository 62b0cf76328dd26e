"""Arms: a two-joint arm in the plane, serial arms with any number of hinges, and the registry of their names."""

from __future__ import annotations

from typing import Any

from viapoint.envs.arms.base import Arm
from viapoint.envs.arms.panda import PANDA
from viapoint.envs.arms.planar import ADULT

ARMS: dict[str, Arm] = {arm.name: arm for arm in (ADULT, PANDA)}
"""Registered arms by name."""

REGISTER_HINT = "viapoint.envs.register_arm registers an arm of your own under its name"
"""Hint of error messages about unknown arms."""


def register_arm(arm: Arm) -> None:
    """Register an arm under its name, so that environments, runs and models find it.

    Files of runs and models, and environment specs as JSON, store an arm's name only. Register the arm before you load
    one of them. Registering an equal arm again changes nothing.

    Raises:
        TypeError: The argument is not an arm.
        ValueError: A different arm is registered under that name.

    Example:
        >>> from viapoint.envs.arms import PANDA, register_arm
        >>> register_arm(PANDA)
    """
    _check_arm(arm)
    if ARMS.setdefault(arm.name, arm) != arm:
        raise ValueError(f"another arm is registered as {arm.name!r}; give this one another name")


def arm_of(arm: Any) -> Arm:
    """Return an arm itself, or the registered arm of a name.

    Raises:
        TypeError: The argument is neither an arm nor a string.
        ValueError: No arm of that name is registered.
    """
    if isinstance(arm, str):
        if arm not in ARMS:
            raise ValueError(f"arm must be an arm or one of {', '.join(ARMS)}, got {arm!r}; {REGISTER_HINT}")
        return ARMS[arm]
    _check_arm(arm)
    found: Arm = arm
    return found


def _check_arm(arm: Any) -> None:
    if not hasattr(arm, "reach_margin") or not isinstance(getattr(arm, "name", None), str):
        raise TypeError(
            f"arm must be an arm of viapoint.envs.arms, got {arm!r:.80}; files and JSON store an arm's name only: "
            f"{REGISTER_HINT}"
        )


__all__ = ["ADULT", "ARMS", "PANDA", "Arm", "arm_of", "register_arm"]
