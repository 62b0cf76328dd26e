"""Inverse kinematics of any serial arm as a table: one smooth configuration for each position of the hand.

A solver finds configurations at the nodes of a box: the hand at the node, oriented as at home, the joints as near their
home as that allows. A tensor-product Chebyshev polynomial interpolates them, and a few Newton steps remove the hand's
remaining error. The result is smooth and fast.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from viapoint.envs.arms.kinematics import Chain, Constants
from viapoint.envs.arms.mjcf import grid
from viapoint.envs.common.types import Array, Box, Float

DEGREE = 5
"""Degree of the polynomials along each axis."""
NEWTON_STEPS = 3
"""Newton steps after the interpolation."""
NEWTON_DAMPING = 1e-6
"""Regularisation of a Newton step (damped least squares), [m^2]."""
POSITION_SCALE = 0.01
"""Error of the hand's position that counts as 1 in the solver's cost, [m]."""
ORIENTATION_WEIGHT, HOME_WEIGHT = 0.3, 0.02
"""Costs of a rotation of the hand by 1 rad and of a joint 1 rad from home, as square roots."""
PATH_STEPS, FINAL_STEPS = 12, 12
"""Steps of the solver along the straight line from home, and at its end."""
LONGEST_STEP = 0.5
"""Greatest change of a joint in one step of the solver, [rad]."""


@dataclass(frozen=True, kw_only=True)
class IKTable:
    """Inverse kinematics as a polynomial over a box; see :class:`~viapoint.envs.arms.serial_arm.InverseKinematics`."""

    chain: Chain
    hand_offset: Constants
    """Hand in the last joint's frame, [m]."""
    box: Box
    """Box of the hand positions that were solved, which is the arm's reach, [m]."""
    coefficients: tuple[tuple[float, ...], ...]
    """Coefficients of the polynomials, shape ((DEGREE + 1)^3, J)."""

    def __call__(self, hand: Array) -> Array:
        """Return joint angles, shape (..., J), [rad], for hand positions of shape (..., 3), [m]."""
        low, high = (np.asarray(corner, dtype=hand.dtype) for corner in self.box)
        inside = np.minimum(np.maximum(hand, low), high)
        joints = np.asarray(self._table, dtype=hand.dtype)
        for i in range(3):
            terms = _chebyshev(inside[..., i], self.box[0][i], self.box[1][i])
            parts = np.moveaxis(joints, i - 4, 0)  # one for each term
            rest = tuple(range(i - 3, 0))
            # Terms are added one by one: a matrix product's last bit would depend on the size of the batch.
            joints = np.expand_dims(terms[0], rest) * parts[0]
            for term, part in zip(terms[1:], parts[1:], strict=True):
                joints = joints + np.expand_dims(term, rest) * part
        for _ in range(NEWTON_STEPS):
            joints = joints + self._newton_step(joints, inside)
        return joints

    def margin(self, hand: Array) -> Any:
        """Return the distance of the hand from the nearest face of the box, shape (...,), [m], positive inside."""
        low, high = (np.asarray(corner, dtype=hand.dtype) for corner in self.box)
        return np.min(np.minimum(hand - low, high - hand), axis=-1)

    @functools.cached_property
    def _table(self) -> Float:
        return np.array(self.coefficients).reshape((DEGREE + 1,) * 3 + (-1,))

    def _newton_step(self, joints: Array, hand: Array) -> Array:
        """Return the least change of the joints that moves the hand to its position, to first order.

        With the Jacobian J of the hand's position and its error e the step is J^T (J J^T + damping)^-1 e.
        """
        frames = self.chain.frames(joints)
        tip = frames[-1].transform(self.hand_offset)
        error = [hand[..., i] - tip[i] for i in range(3)]
        columns = []  # of the Jacobian: the joint's axis x (tip - joint)
        for frame in frames:
            arm = [tip[i] - frame.origin[i] for i in range(3)]
            z = frame.z
            columns.append(
                [z[1] * arm[2] - z[2] * arm[1], z[2] * arm[0] - z[0] * arm[2], z[0] * arm[1] - z[1] * arm[0]]
            )
        gram = [
            [sum(c[i] * c[j] for c in columns) + NEWTON_DAMPING * (i == j) for j in range(3)]
            for i in range(3)
        ]
        force = _solve_symmetric(gram, error)
        return np.stack([sum(c[i] * force[i] for i in range(3)) for c in columns], axis=-1)


def fit_ik_table(chain: Chain, hand_offset: Constants, home: Float, box: Box) -> IKTable:
    """Return the table of a chain in a box; see :func:`solve_inverse_kinematics` for the arguments."""
    nodes = np.cos(
        np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1)
    )  # roots of the next Chebyshev polynomial
    points = grid((nodes, nodes, nodes)).reshape(-1, 3)
    low, high = (np.array(corner) for corner in box)
    hand = low + 0.5 * (points + 1.0) * (high - low)
    joints = solve_inverse_kinematics(chain, hand_offset, home, hand)
    vander = np.polynomial.chebyshev.chebvander3d(points[:, 0], points[:, 1], points[:, 2], (DEGREE,) * 3)
    table = np.linalg.solve(vander, joints)
    coefficients = tuple(tuple(float(value) for value in row) for row in table)
    return IKTable(chain=chain, hand_offset=hand_offset, box=box, coefficients=coefficients)


def solve_inverse_kinematics(chain: Chain, hand_offset: Constants, home: Float, hand: Float) -> Float:
    """Return joint angles with the hand at given positions, shape (N, J), [rad], by continuation from home.

    The hand moves along straight lines in PATH_STEPS steps, each followed by one step of Gauss-Newton, so that all
    solutions belong to the branch of the home configuration.

    Args:
        chain: Chain of J hinges.
        hand_offset: Hand in the last joint's frame, [m].
        home: Home configuration, shape (J,), [rad].
        hand: Hand positions, shape (N, 3), [m].
    """
    start, turn = hand_pose(chain, hand_offset, home)
    joints = np.broadcast_to(home, (len(hand), len(home))).copy()
    for share in [*np.linspace(1.0 / PATH_STEPS, 1.0, PATH_STEPS), *([1.0] * FINAL_STEPS)]:
        target = start + share * (hand - start)
        joints = joints + _gauss_newton_step(chain, hand_offset, (home, turn), joints, target)
    return joints


def hand_pose(chain: Chain, hand_offset: Constants, joints: Float) -> tuple[Float, Float]:
    """Return the hand's position, shape (..., 3), [m], and its axes as columns, shape (..., 3, 3)."""
    last, zero = chain.frames(joints)[-1], 0.0 * joints[..., 0]
    axes = [_stacked(axis, zero) for axis in last[:3]]
    return _stacked(last.transform(hand_offset), zero), np.stack(axes, axis=-1)


def _stacked(vector: Any, zero: Float) -> Float:
    """Return components, of which some may lack the batch's shape, along a new last axis."""
    return np.stack([part + zero for part in vector], axis=-1)


def _gauss_newton_step(
    chain: Chain, hand_offset: Constants, home: tuple[Float, Float], joints: Float, hand: Float
) -> Float:
    """Return one Gauss-Newton step of the solver's cost, shape (N, J), [rad], limited to LONGEST_STEP.

    The residuals are the hand's error over POSITION_SCALE, its rotation from home, and the joints' distance from home.
    """
    position, turn = hand_pose(chain, hand_offset, joints)
    frames, zero = chain.frames(joints), 0.0 * joints[..., 0]
    axes = np.stack([_stacked(frame.z, zero) for frame in frames], axis=-1)
    origins = np.stack([_stacked(frame.origin, zero) for frame in frames], axis=-1)
    moving = np.cross(axes, position[..., None] - origins, axis=-2)
    # Half the sum of the cross products of corresponding axes: the rotation vector, to first order.
    rotation = 0.5 * np.cross(turn, home[1], axis=-2).sum(axis=-1)
    number = joints.shape[-1]
    identity = np.broadcast_to(HOME_WEIGHT * np.eye(number), (len(joints), number, number))
    jacobian = np.concatenate((moving / POSITION_SCALE, ORIENTATION_WEIGHT * axes, identity), axis=1)
    errors = (
        (hand - position) / POSITION_SCALE,
        ORIENTATION_WEIGHT * rotation,
        HOME_WEIGHT * (home[0] - joints),
    )
    transposed, residual = np.swapaxes(jacobian, 1, 2), np.concatenate(errors, axis=-1)
    step: Any = np.linalg.solve(transposed @ jacobian, (transposed @ residual[..., None]))[..., 0]
    longest = np.maximum(np.abs(step).max(axis=-1), 1e-9)
    return np.asarray(step * np.minimum(1.0, LONGEST_STEP / longest)[..., None])


def _chebyshev(values: Array, low: float, high: float) -> list[Array]:
    """Return the Chebyshev polynomials of degree 0 to DEGREE over [low, high], by their three-term recurrence."""
    x = ((values - low) * (2.0 / (high - low)) - 1.0).clip(-1.0, 1.0)
    terms = [np.ones_like(x), x]
    while len(terms) <= DEGREE:
        terms.append(2.0 * x * terms[-1] - terms[-2])
    return terms


def _solve_symmetric(m: list[list[Array]], v: list[Array]) -> list[Array]:
    """Return the solution of a batch of symmetric 3 x 3 systems, by cofactors: faster than a general solver."""
    (a, b, c), (_, d, e), (_, _, f) = m
    rows = [[d * f - e * e, c * e - b * f, b * e - c * d], [c * e - b * f, a * f - c * c, b * c - a * e]]
    rows.append([b * e - c * d, b * c - a * e, a * d - b * b])
    scale = 1.0 / (a * rows[0][0] + b * rows[0][1] + c * rows[0][2])
    return [scale * sum(row[i] * v[i] for i in range(3)) for row in rows]
