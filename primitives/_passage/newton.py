"""Free passage times of any number of via-points: damped Newton steps on the log of the reduced jerk cost.

The durations are h_i = exp(z_i) / sum_j exp(z_j) in unit total time, positive by construction. The logarithm
of the cost spans few units where the cost spans decades. From rest to rest only one minimum was ever seen
(a conjecture, not a theorem). With moving ends there can be several, so the search starts from several points.

Many problems are solved side by side, each with its own steps. The problems are the last axis of all arrays,
and every operation works element by element, so that a result does not depend on the batch.

Gradients for torch follow from the implicit function theorem. At the optimum the gradient g of the reduced cost
with respect to the log-durations z vanishes. One more Newton step with a constant inverse Hessian,

    z(p) = z* - H^-1 g(z*, p),                                                                      (1)

has the value z* and the derivative dz/dp = -H^-1 dg/dp. So no iteration is unrolled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ..array_api import FREE, Array, Floats, Namespace, is_given, like, ordered_sum, to_numpy
from ..trajectory import connect
from .cost import PassageCost, duration_gradient
from .rest_to_rest import attach_root_gradient

Evaluate: TypeAlias = Callable[[Floats, Any], tuple[Floats, Floats, Floats]]
"""(z (n, M), items (M,)) -> value (M,), gradient (n, M), Hessian (n, n, M) of the problems `items` at z."""

_STARTS = 10
"""Starts with moving ends: even durations, durations by chord, eight from a flat Dirichlet distribution."""

_SHORT = 0.03
"""Fraction of the duration below which a segment's cost loses digits, like 1e-16 / h^2.

Movements with such a segment are finished in extended precision.
"""

_LARGEST = 1e3
"""Bound on the entries of the inverse Hessian of the log-cost: knots about to merge keep a finite gradient."""

_LONGEST_STEP = 1.5
_NOISE = 1e-13
_CONVERGED_STEP = 1e-8
_ITERATIONS = 80
_HALVINGS = 12


@dataclass(frozen=True)
class Minima:
    """Results of the iterations: z (n, N), value (N,), and True where one converged (N,)."""

    z: Floats
    value: Floats
    converged: Any


def fractions_by_newton(cost: PassageCost, *, several: bool) -> tuple[Floats, Any]:
    """Return fractions of the duration (N, S), from several starts if asked, and True where it converged (N,)."""
    first, *others = _starts(cost.steps, several)
    best = _minimise_cost(cost, first)
    for start in others:
        found = _minimise_cost(cost, start)
        # A later start must be better by more than rounding, or noise would decide ties.
        better = (found.value < best.value - 1e-9) & (found.converged | ~best.converged)
        pairs = ((found.z, best.z), (found.value, best.value), (found.converged, best.converged))
        best = Minima(*(np.where(better, new, old) for new, old in pairs))
    lost = ~np.isfinite(best.z).all(axis=0)
    h = np.where(lost, 1.0 / len(best.z), _softmax(np.where(lost, 0.0, best.z)))
    hard = np.flatnonzero(~best.converged | (h.min(axis=0) < _SHORT))
    if hard.size:
        refined = _minimise_cost(cost.chosen(hard, np.longdouble), h[:, hard].astype(np.longdouble))
        good = np.isfinite(refined.z).all(axis=0)
        h[:, hard[good]] = _softmax(refined.z[:, good])
        best.converged[hard] = refined.converged & good
    return np.ascontiguousarray(h.T), best.converged


def _starts(steps: Floats, several: bool) -> list[Floats]:
    """Return durations to start from, each (S, N): proportional to the cube root of the chord, and others."""
    chord = np.cbrt(np.sqrt(ordered_sum(steps * steps, 1)))
    starts = [np.maximum(chord / chord.max(axis=0), 1e-3)]
    if several:
        segments, count = chord.shape
        starts.append(np.ones_like(chord))
        drawn = np.random.default_rng(0).dirichlet(np.ones(segments), _STARTS - 2)
        starts += [np.broadcast_to(0.02 + row[:, None], (segments, count)) for row in drawn]
    return [start / start.sum(axis=0) for start in starts]


def _minimise_cost(cost: PassageCost, start: Floats) -> Minima:
    """Minimise log(J + reference) from durations (S, N)."""
    reference = cost.reference()

    def evaluate(z: Floats, items: Any) -> tuple[Floats, Floats, Floats]:
        return log_cost(cost.chosen(items), z, reference[items])

    return _minimise(evaluate, np.log(start))


def log_cost(cost: PassageCost, z: Floats, reference: Floats) -> tuple[Floats, Floats, Floats]:
    """Return log(J + reference), its gradient and its Hessian with respect to z.

    With c = 1 / (J + reference) and M = dh/dz = diag(h) - h h^T,

        gradient = c M J_h,   Hessian = c (M J_hh M + sum_i J_i d2h_i/dz2) - gradient gradient^T.

    The cost does not change if all z shift, so 1 1^T makes the Hessian regular and changes no step.
    """
    h = _softmax(z)
    j, first, second = cost.derivatives(h)
    scale = 1.0 / (j + reference)
    first = first * h * scale
    mean = ordered_sum(first)
    gradient = first - h * mean
    curved = scale * second * h * h[:, None]
    along = ordered_sum(curved)
    hessian = curved - _outer(h, along) - _outer(along, h) + ordered_sum(along) * _outer(h, h)
    hessian = hessian - _outer(h, first) - _outer(first, h) + 2.0 * mean * _outer(h, h)
    for i in range(len(h)):
        hessian[i, i] += first[i] - h[i] * mean
    return np.log(j + reference), gradient, hessian - _outer(gradient, gradient) + 1.0


def _outer(p: Floats, q: Floats) -> Floats:
    """Return the outer products (n, n, N) of vectors (n, N)."""
    return p[:, None] * q[None, :]


def _softmax(z: Floats) -> Floats:
    """Return the durations h (n, N) of z, without overflow of the exponential."""
    h = np.exp(z - z.max(axis=0))
    shares: Floats = h / ordered_sum(h)
    return shares


def _minimise(evaluate: Evaluate, z: Floats) -> Minima:
    """Return local minima from the starts z (n, N).

    A Newton step shorter than 1e-8 is the last one: by quadratic convergence its successor would be of the
    order of its square.
    """
    z = z.copy()
    active = np.arange(z.shape[1])
    value, gradient, hessian = evaluate(z, active)
    converged = np.zeros(z.shape[1], dtype=bool)
    result = value.copy()
    for _ in range(_ITERATIONS):
        step = _descent_step(gradient, hessian)
        last = np.abs(step).max(axis=0) < _CONVERGED_STEP
        z[:, active[last]] += step[:, last]
        converged[active[last]] = True
        keep = ~last
        active, step = active[keep], step[:, keep]
        if not active.size:
            break
        state = value[keep], gradient[:, keep], hessian[:, :, keep]
        moved, value, gradient, hessian = _search(evaluate, z[:, active], active, step, *state)
        z[:, active] = moved
        result[active] = value
    return Minima(z, result, converged)


def _search(
    evaluate: Evaluate, z: Floats, items: Any, step: Floats, value: Floats, gradient: Floats, hessian: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return z after a backtracking line search, with value, gradient and Hessian there.

    A step is accepted by the Armijo condition (Nocedal & Wright 2006, Eq. 3.4), up to rounding. A problem
    whose value cannot fall any more stays where it is.
    """
    slope = ordered_sum(gradient * step)
    z, value, gradient, hessian = z.copy(), value.copy(), gradient.copy(), hessian.copy()
    waiting = np.arange(len(items))
    length = 1.0
    origin, first = z.copy(), value.copy()
    for _ in range(_HALVINGS):
        trial = origin[:, waiting] + length * step[:, waiting]
        new_value, new_gradient, new_hessian = evaluate(trial, items[waiting])
        falls = new_value <= first[waiting] + 1e-4 * length * slope[waiting] + _NOISE
        accepted = waiting[falls]
        z[:, accepted], value[accepted] = trial[:, falls], new_value[falls]
        gradient[:, accepted], hessian[:, :, accepted] = new_gradient[:, falls], new_hessian[:, :, falls]
        waiting = waiting[~falls]
        if not waiting.size:
            break
        length *= 0.4
    return z, value, gradient, hessian


def _descent_step(gradient: Floats, hessian: Floats) -> Floats:
    """Return the modified Newton step -H^-1 g, shortened so that no component is longer than 1.5."""
    step = -solve_positive(hessian, gradient)
    longest = np.abs(step).max(axis=0)
    shortened: Floats = step * (_LONGEST_STEP / np.maximum(longest, _LONGEST_STEP))
    return shortened


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Solve L |D| L^T x = right, where the matrix is L D L^T.

    The absolute pivots give a descent direction where the cost is not convex (modified factorisation, Nocedal
    & Wright 2006, section 3.4).
    """
    size = len(matrix)
    work, solution = matrix.copy(), right.copy()
    scale = np.abs(np.stack([matrix[i, i] for i in range(size)])).max(axis=0)
    pivots = []
    for j in range(size):
        pivot = np.maximum(np.abs(work[j, j]), 1e-10 * scale + 1e-300)
        pivots.append(pivot)
        for i in range(j + 1, size):
            factor = work[i, j] / pivot
            work[i, j + 1 :] -= factor * work[j, j + 1 :]
            solution[i] -= factor * solution[j]
    for j in reversed(range(size)):
        for i in range(j + 1, size):
            solution[j] -= work[j, i] * solution[i]
        solution[j] /= pivots[j]
    return solution


def attach_gradient(fractions: Array, waypoints: Array, ends: list[Any], xp: Namespace) -> Array:
    """Return the fractions (..., S), differentiable with respect to waypoints and boundary values.

    Movements with a dropped via-point get the gradient zero. `ends` are the four boundary values in unit time,
    (..., D) each, None or FREE.
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
