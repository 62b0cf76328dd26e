"""Gradients of the free passage times by the implicit function theorem, for torch.

At the optimum the gradient g of the reduced cost with respect to the log-durations z vanishes. One more
Newton step with a constant inverse Hessian,

    z(p) = z* - H^-1 g(z*, p),                                                                      (1)

has the value z* and the derivative dz/dp = -H^-1 dg/dp. So no iteration is unrolled.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .._knot_solver import connect
from ..array_api import FREE, Array, Namespace, is_given, like, to_numpy
from ..gradients import duration_gradient
from .cost import PassageCost
from .newton import log_cost, solve_positive
from .rest_to_rest import attach_root_gradient

_LARGEST = 1e3
"""Bound on the entries of the inverse Hessian of the log-cost: knots about to merge keep a finite gradient."""


def attach_gradient(fractions: Array, waypoints: Array, ends: list[Any], xp: Namespace) -> Array:
    """Return the fractions (..., S), differentiable with respect to waypoints and boundary values.

    Movements with a dropped via-point get the gradient zero.

    Args:
        fractions: (..., S) fractions of the duration.
        waypoints: (..., S + 1, D).
        ends: start velocity and acceleration, goal velocity and acceleration in unit time: (..., D), None or
            FREE.
        xp: namespace.
    """
    segments = fractions.shape[-1]
    if segments == 1:
        return fractions
    if segments == 2 and all(value is None for value in ends):
        return attach_root_gradient(fractions, waypoints, xp)
    fractions = fractions.detach()
    whole = xp.all(fractions > 0, axis=-1)[..., None]
    safe = xp.where(whole, fractions, xp.ones_like(fractions) / segments)
    states: list[list[Any]] = [ends[:2], *([FREE, FREE] for _ in range(segments - 1)), ends[2:]]
    movement = connect(xp, 3, waypoints, safe, states)
    # Chain rule of h_i = exp(z_i) / sum_j exp(z_j): dJ/dz_i = h_i (dJ/dh_i - sum_j h_j dJ/dh_j).
    first = safe * duration_gradient(movement.coefficients, movement.rates)
    gradient = first - safe * first.sum(-1)[..., None]
    inverse = like(xp, _inverse_hessian(waypoints, ends, safe), fractions)
    step = -xp.matmul(inverse, gradient[..., None])[..., 0]  # Eq. 1
    step = step - (safe * step).sum(-1)[..., None]
    step = xp.where(whole, fractions * step, xp.zeros_like(step))
    return fractions + (step - step.detach())


def _inverse_hessian(waypoints: Array, ends: list[Any], fractions: Array) -> Any:
    """Return (..., S, S) inverse Hessian of the log-cost with respect to log-durations, divided by the cost."""
    batch, segments = tuple(fractions.shape[:-1]), fractions.shape[-1]
    points = to_numpy(waypoints).astype(np.float64).reshape(-1, *waypoints.shape[-2:])
    rows = []
    for value in ends:
        if is_given(value):
            full = np.broadcast_to(to_numpy(value).astype(np.float64), (*batch, value.shape[-1]))
            value = full.reshape(-1, value.shape[-1])
        rows.append(value)
    cost = PassageCost.from_points(points, rows)
    h = np.ascontiguousarray(to_numpy(fractions).astype(np.float64).reshape(-1, segments).T)
    value, _, hessian = log_cost(cost, np.log(h), cost.reference())
    identity = np.repeat(np.eye(segments)[:, :, None], h.shape[1], axis=2)
    inverse = np.clip(solve_positive(hessian, identity), -_LARGEST, _LARGEST) / np.exp(value)
    return np.moveaxis(inverse, -1, 0).reshape(*batch, segments, segments)
