"""The arms: one record each."""

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.planar import ADULT

ARMS: dict[str, Arm] = {arm.name: arm for arm in (ADULT,)}
"""Every arm by its name."""

__all__ = ["ADULT", "ARMS", "Arm"]
