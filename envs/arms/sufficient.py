"""Whether an arm of one's own is strong enough to hold itself, and has room for the movements that are asked of it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.chain import Chain
from viapoint.envs.arms.foreign import Foreign
from viapoint.envs.arms.posture_map import Box
from viapoint.envs.arms.serial import RESERVE, SerialArm
from viapoint.envs.space_distribution import SpaceDistribution
from viapoint.envs.space_sampling import SpaceSampler

Float = NDArray[np.float64]

SCENES = 64
"""That are drawn to see whether there is room."""


def check_strength(foreign: Foreign, chain: Chain, joints: Float, places: Sequence[str]) -> None:
    """Refuse an arm that cannot hold itself.

    Args:
        foreign: With its limits.
        chain: With its masses.
        joints: Some postures, shape (N, J), [rad].
        places: Words for where the hand is then, N of them.

    Raises:
        ValueError: With the joint, its limit and what it would need.
    """
    weight = np.abs(chain.torques(joints, 0.0 * joints, 0.0 * joints)[1])
    lacking = weight - RESERVE * foreign.torque_limit
    if (lacking >= 0.0).any():
        where, joint = np.unravel_index(lacking.argmax(), lacking.shape)
        raise ValueError(
            f"torque_limit of {foreign.joints[joint]} is {foreign.torque_limit[joint]:g} N m, of which {RESERVE:.0%} "
            f"are used, but to hold the arm {places[where]} against gravity takes {weight[where, joint]:.4g} N m"
        )


def postures_at_corners(arm: SerialArm) -> tuple[Float, list[str]]:
    """Postures with the hand in the corners of the workspace, shape (8, J), [rad], and words for these places."""
    corners = np.array(list(itertools.product(*zip(*arm.workspace, strict=True))))
    return np.asarray(arm.posture(corners)), [f"with its hand at {_shown((each,))} m" for each in corners]


def check_room(arm: SerialArm, box: Box) -> None:
    """Refuse an arm in whose workspace no movements can be drawn.

    Args:
        arm: With its workspace.
        box: Its reach.

    Raises:
        ValueError: With the workspace, the reach around it, and what must have room.
    """
    wanted = SpaceDistribution(n_obstacles=(0, 0))
    try:
        SpaceSampler(arm, wanted, whole_arm=True)([np.random.default_rng(seed) for seed in range(SCENES)])
    except RuntimeError:
        low, high = wanted.distance
        raise ValueError(
            f"workspace {_shown(arm.workspace)} m, within a reach of {_shown(box)} m, is too small: start and goal are "
            f"{low:g} to {high:g} m apart, and a movement through one via-point beside the straight line must stay "
            "within reach; give another workspace or home"
        ) from None


def _shown(corners: Iterable[Iterable[float]]) -> str:
    return " to ".join(f"({', '.join(f'{x:.2f}' for x in corner)})" for corner in corners)
