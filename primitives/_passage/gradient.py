"""Gradients of the free passage times by the implicit function theorem: one Newton step that changes nothing.

At the optimum the gradient of the reduced cost with respect to the durations vanishes. One more Newton step,
with the inverse Hessian as a constant and the gradient as a function of waypoints and boundary values, has
the value of the optimum and its derivative; no iteration is unrolled.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .._boundary import connect
from ..array_api import FREE, Array, Boundary, Namespace, detach, like, to_numpy
from ..gradients import duration_gradient
from .cost import PassageCost
from .newton import log_cost, solve_positive
from .rest_to_rest import attach_gradient

_LARGEST = 1e3
"""Bound on the entries of the inverse Hessian of the log-cost, so that nearly merging knots keep a finite
gradient."""


def attach(
    fractions: Array, waypoints: Array, duration: Array, boundary: dict[str, Boundary], xp: Namespace
) -> Array:
    """Return the same fractions (..., S), differentiable with respect to the other arguments.

    Movements with a dropped via-point get the gradient zero.
    """
    if fractions.shape[-1] == 1:
        return fractions
    if fractions.shape[-1] == 2 and all(value is None for value in boundary.values()):
        return attach_gradient(fractions, waypoints, xp)
    fractions = detach(fractions)
    whole = xp.all(fractions > 0, axis=-1)[..., None]
    safe = xp.where(whole, fractions, xp.ones_like(fractions) / fractions.shape[-1])
    ends = _unit_time(boundary, duration)
    states: list[list[Any]] = [ends[:2], *([FREE, FREE] for _ in range(fractions.shape[-1] - 1)), ends[2:]]
    movement = connect(xp, 3, waypoints, safe, states)
    first = safe * duration_gradient(movement.coefficients, movement.rates)
    gradient = first - safe * first.sum(-1)[..., None]
    inverse = like(xp, _inverse_hessian(waypoints, ends, safe), fractions)
    step = -xp.matmul(inverse, gradient[..., None])[..., 0]
    step = step - (safe * step).sum(-1)[..., None]
    step = xp.where(whole, fractions * step, xp.zeros_like(step))
    return fractions + (step - detach(step))


def _unit_time(boundary: dict[str, Boundary], duration: Array) -> list[Boundary]:
    """Start and goal velocity and acceleration in unit time: V = v T, A = a T^2."""
    time = duration[..., None]
    scaled: list[Any] = []
    for name, value in boundary.items():
        given = value is not None and value is not FREE
        scaled.append(value * (time if "velocity" in name else time * time) if given else value)
    return scaled


def _inverse_hessian(waypoints: Array, ends: list[Any], fractions: Array) -> Any:
    """(..., S, S) inverse Hessian of the log-cost with respect to log-durations, divided by the cost."""
    batch, segments = tuple(fractions.shape[:-1]), fractions.shape[-1]
    points = to_numpy(waypoints).astype(np.float64).reshape(-1, *waypoints.shape[-2:])
    rows = []
    for value in ends:
        if value is not None and value is not FREE:
            full = np.broadcast_to(to_numpy(value).astype(np.float64), (*batch, value.shape[-1]))
            value = np.ascontiguousarray(full.reshape(-1, value.shape[-1]).T)
        rows.append(value)
    steps = np.ascontiguousarray(np.diff(points, axis=1).transpose(1, 2, 0))
    cost = PassageCost(steps, rows[:2], rows[2:])
    reference = 1e-3 * cost.scale()
    h = np.ascontiguousarray(to_numpy(fractions).astype(np.float64).reshape(-1, segments).T)
    value, _, hessian = log_cost(cost, np.log(h), reference)
    identity = np.repeat(np.eye(segments)[:, :, None], h.shape[1], axis=2)
    inverse = np.clip(solve_positive(hessian, identity), -_LARGEST, _LARGEST) / np.exp(value)
    return np.moveaxis(inverse, -1, 0).reshape(*batch, segments, segments)
