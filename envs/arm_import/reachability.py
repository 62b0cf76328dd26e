"""Reachable workspace, inverse-kinematics table and feasibility of an imported arm."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from viapoint.envs.arm_import.mjcf_reader import MAX_COORDINATE, ParsedMjcf
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.arms.ik_table import IKTable, fit_ik_table, hand_pose, solve_inverse_kinematics
from viapoint.envs.arms.kinematics import Chain, Constants
from viapoint.envs.arms.mjcf import as_box, grid
from viapoint.envs.arms.serial_arm import LIMIT_SHARE, LinkCapsule, SerialArm, capsule_pair_clearance
from viapoint.envs.common.types import Bool, Box, Float
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.sampler import SceneSampler

SPACING, SEARCH_RADIUS = 0.05, 0.45
"""Distance of the positions that are tried, and how far from home they lie, [m]."""
HAND_TOLERANCE, ORIENTATION_TOLERANCE = 2e-4, 0.35
"""Greatest error of the hand's position [m], and greatest rotation of the hand from home [rad]."""
JOINT_MARGIN = 0.05
"""Least distance of joints from the ends of their ranges, [rad]."""
LINK_MARGIN = 0.01
"""Least distance between links, and of links and hand from the table, [m]."""
FIRST_OFF_TABLE = 2
"""Index of the first joint whose link must not come near the table."""
MIN_LENGTH = 0.3
"""Least length of the reach along its longest axis, [m]: movements must fit in."""
TABLE_CHECKS, TABLE_SPACING = 16, 0.025
"""Least number of positions along each axis at which a table is checked, and their greatest distance, [m]."""
TABLE_MARGIN_FACTOR = 2.0
"""Factor by which margins may be smaller, and rotations greater, between the nodes of a table than at them."""
MAX_JOINT_SLOPE = 25.0
"""Greatest rotation of a joint per distance of the hand, [rad/m]: several times that of smooth solutions."""
BLOCK = 50_000
"""Distances between links that are computed at once, which fit into the cache."""
ROOM_SCENES = 64
"""Scenes that are sampled to check that movements fit into the workspace."""


class Feasibility:
    """Check of configurations and hand positions of an imported arm.

    A position is feasible if the inverse kinematics that starts at home finds a configuration that puts the hand there,
    oriented as at home, with all margins of this module. Links that may touch are not compared.
    """

    def __init__(
        self, chain: Chain, hand_offset: Constants, parsed: ParsedMjcf, capsules: list[LinkCapsule], hand_radius: float
    ) -> None:  # fmt: skip
        self.chain, self.hand_offset, self.home = chain, hand_offset, parsed.home
        self._parsed, self._capsules, self._hand_radius = parsed, capsules, hand_radius
        self.home_position, self._home_axes = hand_pose(chain, hand_offset, parsed.home)
        """Hand position at home, shape (3,), [m]."""
        pairs = [
            (i, j)
            for (i, first), (j, second) in itertools.combinations(enumerate(capsules), 2)
            if second.joint - first.joint >= 2
        ]
        near = self._clearance(parsed.home[None], pairs)[0] < LINK_MARGIN
        touching = {
            (capsules[i].joint, capsules[j].joint)
            for (i, j), close in zip(pairs, near, strict=False)
            if close
        }
        self.may_touch = sorted(touching)
        """Pairs of links, by their joints, that may touch because they come closer than LINK_MARGIN at home.

        Those of consecutive joints may touch, too."""
        self._pairs = [(i, j) for i, j in pairs if (capsules[i].joint, capsules[j].joint) not in touching]

    def reachable_box(self, workspace: Float | None) -> Box:
        """Return the largest box of feasible positions around home, or around a given workspace, shape (2, 3).

        The box lies on a grid of SPACING, and grows face by face.

        Raises:
            ValueError: A position of the workspace is infeasible, or the box is too small for movements.
        """
        low, high = (self.home_position, self.home_position) if workspace is None else workspace
        beyond = np.arange(1, round(SEARCH_RADIUS / SPACING) + 1) * SPACING
        inner = [
            np.linspace(a, b, int(np.ceil((b - a) / SPACING)) + 1) for a, b in zip(low, high, strict=True)
        ]
        axes = [np.concatenate((each[0] - beyond[::-1], each, each[-1] + beyond)) for each in inner]
        positions = grid(axes)
        flat = positions.reshape(-1, 3)
        joints = solve_inverse_kinematics(self.chain, self.hand_offset, self.home, flat)
        feasible = self.feasible(flat, joints).reshape(positions.shape[:3])
        first, last = [len(beyond)] * 3, [len(beyond) + len(each) - 1 for each in inner]
        inside = tuple(slice(b, e + 1) for b, e in zip(first, last, strict=True))
        if not feasible[inside].all():
            bad = positions[inside][~feasible[inside]][0]
            raise ValueError(
                f"the hand does not get to {_in_words([bad], 3)} m, oriented as at home: {self._reason(bad)}; give "
                "another home, origin or workspace"
            )
        first, last = _grown(feasible, first, last)
        corners = np.array([[axis[k] for axis, k in zip(axes, ks, strict=True)] for ks in (first, last)])
        _check_size(corners)
        return as_box(corners)

    def feasible(self, hand: Float, joints: Float, *, factor: float = 1.0) -> Bool:
        """Return True for configurations that put the hand at its position with all margins, shape (N,).

        Margins may be smaller, and rotations greater, by a `factor` of 1 or more.
        """
        blocks = max(math.ceil(len(hand) * len(self._pairs) / BLOCK), 1)
        parts = zip(np.array_split(hand, blocks), np.array_split(joints, blocks), strict=True)
        return np.concatenate([self._feasible(*part, factor) for part in parts])

    def _feasible(self, hand: Float, joints: Float, factor: float) -> Bool:
        (error, rotation), (inside, above, apart) = self._errors(hand, joints), self._margins(joints)
        good = (error < HAND_TOLERANCE) & (rotation < ORIENTATION_TOLERANCE * factor)
        good &= (inside > JOINT_MARGIN / factor).all(axis=-1) & (np.abs(hand).max(axis=-1) < MAX_COORDINATE)
        good &= hand[:, 2] > self._hand_radius + LINK_MARGIN / factor
        return np.asarray(
            good & (np.concatenate((above, apart), axis=-1) > LINK_MARGIN / factor).all(axis=-1)
        )

    def _errors(self, hand: Float, joints: Float) -> tuple[Float, Float]:
        """Return the hand's position error [m] and its rotation from home [rad], shape (N,) each."""
        position, axes = hand_pose(self.chain, self.hand_offset, joints)
        cosine = np.clip((np.einsum("nij,ij->n", axes, self._home_axes) - 1.0) / 2.0, -1.0, 1.0)
        return np.abs(position - hand).max(axis=-1), np.arccos(cosine)

    def _margins(self, joints: Float) -> tuple[Float, Float, Float]:
        """Return margins of joints in their ranges, (N, J) [rad], of links to the table and each other, (N, .) [m]."""
        low, high = self._parsed.joint_range.T
        ends = self._ends(joints)
        above = [
            ends[:, i, :, 2].min(axis=-1) - capsule.radius
            for i, capsule in enumerate(self._capsules)
            if capsule.joint >= FIRST_OFF_TABLE
        ]
        inside = np.minimum(joints - low, high - joints)
        return inside, np.stack(above, axis=-1), self._clearance(joints, self._pairs)

    def _reason(self, hand: Float) -> str:
        """Return the reason for which a position is infeasible."""
        if np.abs(hand).max() >= MAX_COORDINATE:
            return f"coordinates must be less than {MAX_COORDINATE} m, where observations end"
        joints = solve_inverse_kinematics(self.chain, self.hand_offset, self.home, hand[None])
        ((error,), (rotation,)) = self._errors(hand[None], joints)
        inside, above, apart = self._margins(joints)
        joint = self._parsed.joints[int(inside[0].argmin())]
        table = min(above.min(), hand[2] - self._hand_radius)
        return (
            f"the nearest configuration misses it by {error:.4f} m and {rotation:.2f} rad (at most "
            f"{HAND_TOLERANCE} m and {ORIENTATION_TOLERANCE} rad), has {joint} {inside.min():.2f} rad inside its "
            f"range (more than {JOINT_MARGIN} rad), parts {table:.3f} m above the table and links {apart.min():.3f} m "
            f"apart (more than {LINK_MARGIN} m)"
        )

    def _ends(self, joints: Float) -> Float:
        places = tuple((capsule.joint, end) for capsule in self._capsules for end in capsule.ends)
        return np.asarray(self.chain.points(joints, places)).reshape(len(joints), -1, 2, 3)

    def _clearance(self, joints: Float, pairs: list[tuple[int, int]]) -> Float:
        """Return the clearance of pairs of capsules, shape (N, pairs), [m]; one column of infinity without pairs."""
        if not pairs:
            return np.full((len(joints), 1), np.inf)
        radii = np.array([capsule.radius for capsule in self._capsules])
        return np.asarray(capsule_pair_clearance(self._ends(joints), radii, pairs))


def fit_feasible_table(check: Feasibility, box: Box, required: Float) -> IKTable:
    """Return an inverse-kinematics table that is feasible in its whole box, in a smaller box where necessary.

    Raises:
        ValueError: No box around the corners `required`, shape (2, 3), [m], has such a table.
    """
    while True:
        table = fit_ik_table(check.chain, check.hand_offset, check.home, box)
        bad = infeasible_positions(table, check)
        if not len(bad):
            return table
        box = _shrunk(box, bad, required)


def infeasible_positions(table: IKTable, check: Feasibility) -> Float:
    """Return hand positions of a grid at which a table is infeasible or turns a joint too fast, shape (M, 3), [m]."""
    sides = [
        (low, high, math.ceil((high - low) / TABLE_SPACING) + 1) for low, high in zip(*table.box, strict=True)
    ]
    axes = [np.linspace(low, high, max(number, TABLE_CHECKS)) for low, high, number in sides]
    positions = grid(axes)
    joints = np.asarray(table(positions))
    flat = joints.reshape(-1, joints.shape[-1])
    good = check.feasible(positions.reshape(-1, 3), flat, factor=TABLE_MARGIN_FACTOR).reshape(
        positions.shape[:3]
    )
    for axis in range(3):
        slope = np.abs(np.diff(joints, axis=axis)).max(axis=-1) / (axes[axis][1] - axes[axis][0])
        steep = np.moveaxis(slope > MAX_JOINT_SLOPE, axis, 0)
        smooth = np.moveaxis(good, axis, 0)
        smooth[:-1] &= ~steep
        smooth[1:] &= ~steep
    return np.asarray(positions[~good])


def check_strength(parsed: ParsedMjcf, chain: Chain, joints: Float, places: Sequence[str]) -> None:
    """Check that the joints can hold the arm against gravity in configurations (N, J), [rad], described by `places`.

    Raises:
        ValueError: A joint is too weak; the message names it with its limit and the torque that it needs.
    """
    weight = np.abs(chain.torques(joints, 0.0 * joints, 0.0 * joints)[1])
    lacking = weight - LIMIT_SHARE * parsed.torque_limit
    if (lacking >= 0.0).any():
        where, joint = (int(i) for i in np.unravel_index(lacking.argmax(), lacking.shape))
        raise ValueError(
            f"torque_limit of {parsed.joints[joint]} is {parsed.torque_limit[joint]:g} N m, of which {LIMIT_SHARE:.0%} "
            f"are used, but to hold the arm {places[where]} against gravity takes {weight[where, joint]:.4g} N m"
        )


def corner_configurations(arm: SerialArm) -> tuple[Float, list[str]]:
    """Return configurations with the hand in the workspace's corners, shape (8, J), [rad], and their descriptions."""
    corners = np.array(list(itertools.product(*zip(*arm.workspace, strict=True))))
    return np.asarray(arm.inverse_kinematics(corners)), [
        f"with its hand at {_in_words([each])} m" for each in corners
    ]


def check_room(arm: SerialArm, reach: Box) -> None:
    """Check that movements can be sampled in an arm's workspace.

    Raises:
        ValueError: The workspace is too small; the message has the workspace, the reach and the size of movements.
    """
    wanted = SpaceDistribution(n_obstacles=(0, 0))
    sampler = SceneSampler(CollisionModel(arm, whole_arm=True), wanted)
    try:
        sampler([np.random.default_rng(seed) for seed in range(ROOM_SCENES)])
    except RuntimeError:
        low, high = wanted.distance
        raise ValueError(
            f"workspace {_in_words(arm.workspace)} m, within a reach of {_in_words(reach)} m, is too small: start and "
            f"goal are {low:g} to {high:g} m apart, and a movement through one via-point beside the straight line must "
            "stay within reach; give another workspace or home"
        ) from None


def _grown(feasible: Bool, first: list[int], last: list[int]) -> tuple[list[int], list[int]]:
    """Return a box of feasible grid points, grown by one feasible layer at a time, along its shortest side first."""
    first, last = list(first), list(last)
    stuck: set[tuple[int, int]] = set()
    while len(stuck) < 6:
        free = [(axis, step) for axis in range(3) for step in (-1, 1) if (axis, step) not in stuck]
        axis, step = min(free, key=lambda face: last[face[0]] - first[face[0]])
        side = first if step < 0 else last
        following = side[axis] + step
        layer = [slice(b, e + 1) for b, e in zip(first, last, strict=True)]
        layer[axis] = slice(following, following + 1)
        if 0 <= following < feasible.shape[axis] and feasible[tuple(layer)].all():
            side[axis], stuck = following, set()
        else:
            stuck.add((axis, step))
    return first, last


def _shrunk(box: Box, bad: Float, required: Float) -> Box:
    """Return a box with one face moved inwards, so that as few bad positions as possible remain."""
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        corners = np.array(box)
        corners[side, axis] += SPACING if side == 0 else -SPACING
        if corners[0, axis] > required[0, axis] or corners[1, axis] < required[1, axis]:
            continue
        left = int(((bad >= corners[0]) & (bad <= corners[1])).all(axis=-1).sum())
        faces.append((left, -float(corners[1, axis] - corners[0, axis]), corners))
    if not faces:
        raise ValueError(
            f"configurations near {_in_words(bad[:1], 3)} m do not follow the hand smoothly from home; give another "
            "home or a smaller workspace"
        )
    _, _, corners = min(faces, key=lambda face: face[:2])
    _check_size(corners)
    return as_box(corners)


def _check_size(corners: Float) -> None:
    size = corners[1] - corners[0]
    if size.max() < MIN_LENGTH or size.min() < 2 * SPACING:
        raise ValueError(
            f"the hand reaches only a box of {np.round(size, 2)} m around its position at home, oriented as there; "
            "give another home"
        )


def _in_words(points: Any, digits: int = 2) -> str:
    """Return points as text."""
    return " to ".join(f"({', '.join(f'{x:.{digits}f}' for x in each)})" for each in points)
