"""The posture of any chain of hinges as a function of the hand's place.

Postures are solved for at the nodes of a box: the hand there, turned as it is at home, the joints as near their home as
that allows. Chebyshev polynomials run between the nodes, and a few Newton steps put the hand exactly where it belongs.
So the map is smooth and quick, and the same in NumPy and torch.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from viapoint.envs.arms.kinematics import Chain, Constants
from viapoint.envs.common.arrays import clamp
from viapoint.envs.common.types import Box, Float
from viapoint.primitives.array_api import Array, namespace_of

DEGREE = 5
"""Of the polynomials along each axis."""
NEWTON = 3
"""Steps that put the hand where it belongs."""
TURN_WEIGHT, HOME_WEIGHT = 0.3, 0.02
"""What turning the hand by 1 rad and moving a joint from home by 1 rad count, against 1 m of the hand's place over
:data:`PLACE_SCALE`."""
PLACE_SCALE = 0.01
DAMPING = 1e-6


@dataclass(frozen=True, kw_only=True)
class PostureMap:
    """See :class:`~viapoint.envs.arms.serial_arm.Posture`."""

    chain: Chain
    hand_at: Constants
    """The hand in the last joint's frame, [m]."""
    box: Box
    """Where the postures were solved for, and so the reach, [m]."""
    coefficients: tuple[tuple[float, ...], ...]
    """Of the polynomials, shape ((DEGREE + 1)^3, J)."""

    def __call__(self, hand: Array) -> Array:
        """Joint angles, shape (..., J), [rad], for hand positions of shape (..., 3), [m]."""
        xp = namespace_of(hand)
        low, high = (xp.asarray(corner, dtype=hand.dtype) for corner in self.box)
        inside = xp.minimum(xp.maximum(hand, low), high)
        joints = xp.asarray(self._table, dtype=hand.dtype)  # of shape (DEGREE + 1,) * 3 + (J,) to begin with
        for i in range(3):
            terms = _chebyshev(inside[..., i], self.box[0][i], self.box[1][i])
            # Term by term: the order of a matrix product, and so its last bit, depends on the size of the batch.
            rest = (None,) * (3 - i)
            parts = [
                joints[k] if i == 0 else joints[..., k, *[slice(None)] * (3 - i)] for k in range(DEGREE + 1)
            ]
            joints = terms[0][(..., *rest)] * parts[0]
            for term, part in zip(terms[1:], parts[1:], strict=True):
                joints = joints + term[(..., *rest)] * part
        for _ in range(NEWTON):
            joints = joints + self._step(joints, inside)
        return joints

    def margin(self, hand: Array) -> Array:
        """Distance to the nearest face of the box."""
        xp = namespace_of(hand)
        low, high = (xp.asarray(corner, dtype=hand.dtype) for corner in self.box)
        return xp.min(xp.minimum(hand - low, high - hand), axis=-1)

    @functools.cached_property
    def _table(self) -> Float:
        return np.array(self.coefficients).reshape((DEGREE + 1,) * 3 + (-1,))

    def _step(self, joints: Array, hand: Array) -> Array:
        """The least change of the joints that brings the hand nearer, as if it moved in proportion."""
        xp = namespace_of(joints)
        frames = self.chain.frames(joints)
        tip = frames[-1].place(self.hand_at)
        lack = [hand[..., i] - tip[i] for i in range(3)]
        columns = []
        for frame in frames:
            arm = [tip[i] - frame.origin[i] for i in range(3)]
            z = frame.z
            columns.append(
                [z[1] * arm[2] - z[2] * arm[1], z[2] * arm[0] - z[0] * arm[2], z[0] * arm[1] - z[1] * arm[0]]
            )
        gram = [[sum(c[i] * c[j] for c in columns) + DAMPING * (i == j) for j in range(3)] for i in range(3)]
        force = _solved(gram, lack)
        return xp.stack([sum(c[i] * force[i] for i in range(3)) for c in columns], axis=-1)


def solve_map(chain: Chain, hand_at: Constants, home: Float, box: Box) -> PostureMap:
    """The map of a chain in a box."""
    nodes = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = (np.array(corner) for corner in box)
    joints = solve_postures(chain, hand_at, home, low + 0.5 * (grid + 1.0) * (high - low))
    vander = np.polynomial.chebyshev.chebvander3d(grid[:, 0], grid[:, 1], grid[:, 2], (DEGREE,) * 3)
    table = np.linalg.solve(vander, joints)
    coefficients = tuple(tuple(float(value) for value in row) for row in table)
    return PostureMap(chain=chain, hand_at=hand_at, box=box, coefficients=coefficients)


def solve_postures(chain: Chain, hand_at: Constants, home: Float, places: Float, steps: int = 12) -> Float:
    """Postures with the hand at places, shape (N, J), [rad], followed from home along straight lines.

    Args:
        chain: Of J hinges.
        hand_at: The hand in the last joint's frame, [m].
        home: Angles, shape (J,), [rad].
        places: Shape (N, 3), [m].
        steps: From home to the places.
    """
    start, turn = hand_pose(chain, hand_at, home)
    joints = np.broadcast_to(home, (len(places), len(home))).copy()
    for share in [*np.linspace(1.0 / steps, 1.0, steps), *([1.0] * 12)]:
        joints = joints + _improvement(chain, hand_at, (home, turn), joints, start + share * (places - start))
    return joints


def hand_pose(chain: Chain, hand_at: Constants, joints: Float) -> tuple[Float, Float]:
    """Place (..., 3) [m] and axes, as columns (..., 3, 3), of the hand."""
    last = chain.frames(joints)[-1]
    zero = 0.0 * joints[..., 0]
    place = np.stack([part + zero for part in last.place(hand_at)], axis=-1)
    axes = [np.stack([part + zero for part in axis], axis=-1) for axis in last[:3]]
    return place, np.stack(axes, axis=-1)


def _improvement(
    chain: Chain, hand_at: Constants, home: tuple[Float, Float], joints: Float, places: Float
) -> Float:
    """One Gauss-Newton step, no longer than half a radian, towards places, the home's turn of the hand, and home."""
    place, turn = hand_pose(chain, hand_at, joints)
    frames, zero = chain.frames(joints), 0.0 * joints[..., 0]
    axes = np.stack([np.stack([part + zero for part in frame.z], axis=-1) for frame in frames], axis=-1)
    origins = np.stack([np.stack([p + zero for p in frame.origin], axis=-1) for frame in frames], axis=-1)
    moving = np.cross(axes, place[..., None] - origins, axis=-2)
    # The columns of the two turns differ by about the cross product with the small turn between them.
    turned = 0.5 * np.cross(turn, home[1], axis=-2).sum(axis=-1)
    number = joints.shape[-1]
    identity = np.broadcast_to(HOME_WEIGHT * np.eye(number), (len(joints), number, number))
    jacobian = np.concatenate((moving / PLACE_SCALE, TURN_WEIGHT * axes, identity), axis=1)
    residual = np.concatenate(
        ((places - place) / PLACE_SCALE, TURN_WEIGHT * turned, HOME_WEIGHT * (home[0] - joints)), axis=-1
    )
    transposed = np.swapaxes(jacobian, 1, 2)
    step: Any = np.linalg.solve(transposed @ jacobian, (transposed @ residual[..., None]))[..., 0]
    return np.asarray(step * np.minimum(1.0, 0.5 / np.maximum(np.abs(step).max(axis=-1), 1e-9))[..., None])


def _chebyshev(values: Array, low: float, high: float) -> list[Array]:
    """Chebyshev polynomials of degree 0 to DEGREE over an interval."""
    xp = namespace_of(values)
    x = clamp((values - low) * (2.0 / (high - low)) - 1.0, -1.0, 1.0)
    terms = [xp.ones_like(x), x]
    while len(terms) <= DEGREE:
        terms.append(2.0 * x * terms[-1] - terms[-2])
    return terms


def _solved(m: list[list[Array]], v: list[Array]) -> list[Array]:
    """The solution of symmetric three by three equations, by cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = m
    rows = [[d * f - e * e, c * e - b * f, b * e - c * d], [c * e - b * f, a * f - c * c, b * c - a * e]]
    rows.append([b * e - c * d, b * c - a * e, a * d - b * b])
    scale = 1.0 / (a * rows[0][0] + b * rows[0][1] + c * rows[0][2])
    return [scale * sum(row[i] * v[i] for i in range(3)) for row in rows]
