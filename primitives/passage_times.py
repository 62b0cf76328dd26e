"""Passage times at which the minimum-jerk movement passes its via-points if they are left free.

Closed forms hold for one via-point (`_passage_one_via`). Any number needs damped Newton steps on the logarithm of the
reduced jerk cost: the cost spans decades, its logarithm few units. The durations are h_i = exp(z_i) / sum_j exp(z_j) in
unit total time, positive by construction. From rest to rest only one minimum was ever seen (a conjecture, not a
theorem). With moving ends there can be several, so the search starts from several points.

Many problems are solved side by side, each with its own steps. The problems are the last axis of all arrays,
and every operation works element by element, so that a result does not depend on the batch.

Gradients for torch follow from the implicit function theorem. At the optimum the gradient g of the reduced cost
with respect to the log-durations z vanishes. One more Newton step with a constant inverse Hessian,

    z(p) = z* - H^-1 g(z*, p),                                                                      (1)

has the value z* and the derivative dz/dp = -H^-1 dg/dp. So no iteration is unrolled.

With the states at the via-points eliminated, J(h) is the least sum of the segments' costs phi (Eq. 2 of
`_knot_solver`). By the envelope theorem dJ/dh is the derivative of phi at fixed states: with r = q / h^2,

    h phi_h = sum_i w_i (r_i . p_i + 1/2 e_i |r_i|^2),   p = h dr/dh,   e = h w'(h) / w.             (2)
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from ._knot_solver import fit_modes, is_extreme, knot_states, mode_weights, rounding_slack
from ._passage_one_via import (
    SHORTEST,
    attach_root_gradient,
    fractions_at_rest,
    fractions_moving,
    nearer_fraction,
)
from ._polynomial import differentiate, evaluate, mode_table
from .array_api import (
    FREE,
    Array,
    Boundary,
    Floats,
    Namespace,
    broadcast_batch,
    broadcast_to,
    change_given,
    check_durations,
    flat_batch,
    like,
    ordered_sum,
    read_arguments,
    to_numpy,
    unit_factors,
    unit_time_ends,
    waypoint_shapes,
)
from .trajectory import Trajectory, connect, duration_gradient

# Fraction of the duration below which a segment is dropped in lower than double precision, which it would overflow.
_LEAST_FRACTION = 1e-7
# Distance of a via-point from the one before, relative to the longest, below which it is left out at first.
_NEAR = 1e-2
_LEVEL_STEPS = 5
# Entries of the Hessians of the movements that are solved at a time.
_ENTRIES = 50_000
# Starts with moving ends: even durations, durations by chord, eight from a flat Dirichlet distribution.
_STARTS = 10
# Number of segments up to which several starts are tried.
_MOST_SEGMENTS = 16
# Bound on the entries of the inverse Hessian of the log-cost: knots about to merge keep a finite gradient.
_LARGEST = 1e3
# Step of the log-durations for difference quotients of the gradient.
_DIFFERENCE = 1e-8
_LONGEST_STEP = 1.5
# Relative error of a cost.
_NOISE = 1e-13
# Newton step that is the last: by quadratic convergence its successor would be of the order of its square.
_CONVERGED_STEP = 1e-8
# Gain of the logarithm of the cost that counts as none, if rounding forbids it or only a large step would make it.
_SMALL_GAIN, _LARGE_STEP = 1e-8, 1e-2
# Distance from a lower bound of the logarithm of the cost that is close enough.
_REACHED = 1e-6
# Part of a step below which it is not shortened any more.
_LEAST_LENGTH = 2e-5
_ITERATIONS = 160


def passage_durations(
    waypoints: Array,
    duration: Array,
    *,
    start_velocity: Array | None = None,
    start_acceleration: Array | None = None,
    goal_velocity: Boundary = None,
    goal_acceleration: Boundary = None,
) -> Array:
    """Return the segment durations with the least jerk cost, for a given total duration.

    They satisfy Flash & Hogan's condition pi . v(t_k) = 0 at every via-point (1985, Eq. C16). With one via-point they
    are the global minimum; with several, local minima cannot be excluded. The computation runs in NumPy and double
    precision for every input. torch gradients follow from the implicit function theorem and are clipped where a
    via-point meets its neighbour.

    Args:
        waypoints: (..., K + 2, D) start, via-points, goal [m].
        duration: (...,) total [s].
        start_velocity: (..., D) [m/s]; None = zero.
        start_acceleration: (..., D) [m/s^2]; None = zero.
        goal_velocity: (..., D) [m/s]; None = zero, FREE = the value of least cost (natural boundary).
        goal_acceleration: (..., D) [m/s^2]; likewise.

    Returns:
        (..., K + 1) [s], adding up to `duration`. A via-point that equals its neighbour gets duration 0;
        `through` then drops it.

    Raises:
        ValueError: an argument is not finite or has a wrong shape, or duration <= 0 (0 is allowed for a movement
            from rest to rest through equal waypoints).

    Warns:
        RuntimeWarning: the iteration did not converge for some movements; their durations are the best found.

    Example:
        >>> from viapoint.primitives import passage_durations
        >>> passage_durations([[0.0, 0.0], [0.35, 0.30], [1.0, 0.0]], 1.0).round(3).tolist()
        [0.448, 0.552]
    """
    xp, (waypoints, duration), ends = read_arguments(
        (start_velocity, start_acceleration, goal_velocity, goal_acceleration),
        waypoints=waypoints,
        duration=duration,
    )
    batch = broadcast_batch(**waypoint_shapes(waypoints, ends), duration=tuple(duration.shape))
    waypoints = broadcast_to(xp, waypoints, (*batch, *waypoints.shape[-2:]))
    check_durations("duration", duration[..., None], waypoints, ends)
    flat_ends = change_given(lambda value: _flat(value, batch, 1), ends.values())
    unit_ends = unit_time_ends(flat_ends, _flat(duration, batch, 0))
    points, dtype = _flat(waypoints, batch, 2), waypoints.dtype
    eps = float(xp.finfo(dtype).eps)
    numbers = _fractions(points, unit_ends, eps)
    if eps > _LEAST_FRACTION:
        numbers[numbers < _LEAST_FRACTION] = 0.0
    numbers = numbers.reshape(*batch, waypoints.shape[-2] - 1)
    recorded = any(getattr(value, "requires_grad", False) for value in (waypoints, duration, *ends.values()))
    if not recorded:
        return like(xp, numbers, waypoints) * duration[..., None]
    cost = _cost_of(points, unit_ends)
    given = change_given(lambda value: xp.astype(value, xp.float64), ends.values())
    waypoints = xp.astype(waypoints, xp.float64)
    time = xp.astype(duration, xp.float64)
    moving = unit_time_ends(given, time)
    fractions = _attach_gradient(like(xp, numbers, waypoints), waypoints, moving, cost, xp)
    return xp.astype(fractions * time[..., None], dtype)


def _flat(array: Array, batch: tuple[int, ...], own: int) -> Any:
    """Return NumPy float64 with the full batch in one axis; the last `own` axes stay."""
    return flat_batch(np, to_numpy(array).astype(np.float64, copy=False), batch, own)


def _fractions(points: Any, ends: list[Any], eps: float) -> Any:
    """Return fractions of the duration (N, S).

    Movements with the same distinct waypoints, and with or without motion at the ends, are solved together.
    """
    count, knots, _ = points.shape
    if knots == 2 or not count:
        return np.ones((count, knots - 1))
    gaps = np.abs(np.diff(points, axis=1)).max(axis=-1)
    # The closed forms for one via-point hold at any distance.
    rounding = eps * np.abs(points).max(axis=(1, 2)) if knots > 3 else np.zeros(count)
    distinct = gaps > rounding[:, None]
    moving = np.zeros(count, dtype=bool)
    for value in ends:
        if value is not None:
            moving = moving | (True if value is FREE else (value != 0).any(axis=-1))
    if not moving.any() and distinct.all():
        return _solve(points, [None] * 4)
    kinds = np.concatenate([distinct, moving[:, None]], axis=1)
    result = np.zeros((count, knots - 1))
    for kind in np.unique(kinds, axis=0):
        where = np.flatnonzero((kinds == kind).all(axis=1))
        full = np.flatnonzero(kind[:-1])
        if not full.size:
            result[where, -1] = 1.0  # all waypoints are equal
            continue
        kept = points[where][:, [*full, knots - 1]]
        chosen = change_given(itemgetter(where), ends) if kind[-1] else [None] * 4
        result[np.ix_(where, full)] = _solve(kept, chosen)
    return result


def _solve(points: Any, ends: list[Any]) -> Any:
    """Return fractions (N, S) where neighbouring waypoints differ; the ends are all None from rest to rest."""
    count, knots, _ = points.shape
    if knots == 2:
        return np.ones((count, 1))
    # A size of about 1, by a power of two, is exact, and no square under- or overflows.
    size = np.abs(points - points[:, :1]).max(axis=(1, 2))
    for value in ends:
        if isinstance(value, np.ndarray):
            size = np.maximum(size, np.abs(value).max(axis=1))
    factors = unit_factors(np, size[:, None])
    points = points * factors[..., None]
    ends = change_given(lambda value: value * factors, ends)
    moving = any(value is not None for value in ends)
    if knots == 3 and not moving:
        return fractions_at_rest(points)
    cost = _cost_of(points, ends)
    if knots == 3:
        return fractions_moving(points, ends, cost.slack)
    guess, bound = _from_fewer_points(points, ends, moving)
    fractions = np.empty((count, knots - 1))
    converged = np.empty(count, dtype=bool)
    size = max(1, _ENTRIES // knots**2)
    for first in range(0, count, size):
        rows = slice(first, first + size)
        found = _fractions_by_newton(cost.chosen(rows), guess[rows].T, bound[rows], several=moving)
        fractions[rows], converged[rows] = found
        # Where `connect` would miss a waypoint by too much, it passes it exactly: seek that movement instead.
        near = first + np.flatnonzero(is_extreme(fractions[rows], 2.0**-52))
        if not near.size:
            continue
        soft, _ = cost.chosen(near).derivatives(np.ascontiguousarray(fractions[near].T))
        real = _movement(points, ends, fractions[near], near).cost()
        far, real = near[real > 1.001 * soft], real[real > 1.001 * soft]
        if far.size:
            exact = replace(cost.chosen(far), slack=np.zeros(far.size))
            again, ok = _fractions_by_newton(exact, guess[far].T, bound[far], several=moving)
            cheaper = _movement(points, ends, again, far).cost() < real
            fractions[far[cheaper]], converged[far[cheaper]] = again[cheaper], ok[cheaper]
    if not converged.all():
        warnings.warn(
            f"the passage times of {np.sum(~converged)} of {count} movements did not converge; the best found are "
            "returned",
            RuntimeWarning,
            stacklevel=4,
        )
    return fractions


def _movement(points: Any, ends: list[Any], fractions: Any, items: Any) -> Trajectory:
    """Return n of the movements through points (N, S + 1, D) with durations (n, S) in unit total time."""
    states = knot_states(3, change_given(itemgetter(items), ends), points.shape[1] - 2)
    return connect(np, 3, points[items], fractions, states)


def _from_fewer_points(points: Any, ends: list[Any], moving: bool) -> tuple[Any, Any]:
    """Return fractions (N, S) of the best movement without via-points very close to the one before, and its cost (N,).

    The via-points left out get the time when the movement comes level with them. No movement through all points
    costs less, and this one is the best of all if it passes them anyway. Both are NaN where there is none.
    """
    count, knots, _ = points.shape
    chord = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    left_out = np.zeros((count, knots), dtype=bool)
    left_out[:, 1:-1] = chord[:, :-1] < _NEAR * chord.max(axis=1, keepdims=True)
    if not moving:
        left_out[:, 1] = False  # where a movement from rest begins, it is not level with anything
    result = np.full((count, knots - 1), np.nan)
    cost = np.full(count, np.nan)
    for pattern in np.unique(left_out[left_out.any(axis=1)], axis=0):
        where = np.flatnonzero((left_out == pattern).all(axis=1))
        kept = np.flatnonzero(~pattern)
        chosen = change_given(itemgetter(where), ends)
        fewer = points[where][:, kept]
        fractions = _solve(fewer, chosen)
        movement = connect(np, 3, fewer, fractions, knot_states(3, chosen, len(kept) - 2))
        coefficients, cost[where] = movement.coefficients, movement.cost()
        for i, (first, last) in enumerate(pairwise(kept)):
            times = [np.zeros(len(where))]
            for k in range(first + 1, last):
                step = points[where, k] - points[where, first]
                times.append(_level_time(coefficients[:, :, i], step) * fractions[:, i])
            durations = np.diff([*times, fractions[:, i]], axis=0).T
            result[where, first:last] = durations
    result[~(result > 0).all(axis=1)] = np.nan
    return result, cost


def _level_time(coefficients: Any, step: Any) -> Any:
    """Return the unit time u (N,) at which (x(u) - x(0)) . d = d . d, for segments (N, 6, D) and steps d (N, D)."""
    along = ordered_sum(coefficients * step[:, None], -1)
    along[:, 0] = -ordered_sum(step * step, -1)
    with np.errstate(all="ignore"):
        target = -along[:, 0]
        slope = along[:, 1]
        curve = along[:, 2]
        u = 2.0 * target / (slope + np.sqrt(slope * slope + 4.0 * curve * target))
        for _ in range(_LEVEL_STEPS):
            u = u - evaluate(along, u) / evaluate(differentiate(along), u)
    return u


@dataclass(frozen=True)
class _PassageCost:
    """Cost of N movements whose passage times are sought, in unit total time; movements are the last axis.

    Attributes:
        steps: (S, D, N) differences of the waypoints.
        ends: velocity and acceleration at start and goal in unit time: (D, N), None for zero, FREE (goal only).
        slack: (N,) tolerance of the waypoints, see `_knot_solver`.
    """

    steps: Floats
    ends: list[Any]
    slack: Floats

    def chosen(self, items: Any) -> _PassageCost:
        """Return the movements `items`, in that order."""
        ends = change_given(lambda value: value[:, items], self.ends)
        return _PassageCost(self.steps[..., items], ends, self.slack[items])

    def reference(self) -> Floats:
        """Return (N,) a cost far below that of any real movement of this size, to keep logarithms finite."""
        total = ordered_sum(ordered_sum(self.steps * self.steps, -2))
        for value in self.ends:
            if isinstance(value, np.ndarray):
                total = total + ordered_sum(value * value)
        return 1e-3 * np.where(total > 0, total, 1.0)

    def derivatives(self, h: Floats) -> tuple[Floats, Floats]:
        """Return J (N,) and h dJ/dh (S, N) at durations h (S, N)."""
        states = knot_states(3, self.ends, len(h) - 1)
        solved, fitted = fit_modes(np, 3, h, self.steps, states, self.slack)
        weights = mode_weights(3, h, self.slack)
        # The weights are inverse durations, but that of the step, which the slack bounds.
        rates = [-1.0, -1.0, 4.0 - weights[2] * h]
        mean = self.steps / h[:, None]
        velocity = np.stack([0.0 * mean[0] if state[0] is None else state[0] for state in solved])
        total, slope = np.zeros_like(h), np.zeros_like(h)
        for i, (row, weight, rate) in enumerate(zip(mode_table(3), weights, rates, strict=True)):
            mode = np.stack([modes[i] for modes in fitted])
            square = ordered_sum(mode * mode, 1)
            # p of Eq. 2: r depends on h by its step and its velocities.
            change = -(2.0 * row[0] * mean + row[1] * velocity[:-1] + row[3] * velocity[1:]) / h[:, None]
            slope += weight * (ordered_sum(mode * change, 1) + 0.5 * rate * square)
            total += 0.5 * weight * square
        return ordered_sum(total), slope


def _cost_of(points: Floats, ends: list[Any]) -> _PassageCost:
    """Return the cost of movements through points (N, S + 1, D) with four boundary values (N, D)."""
    rows = change_given(lambda value: np.ascontiguousarray(value.T), ends)
    steps = np.ascontiguousarray(np.diff(points, axis=1).transpose(1, 2, 0))
    return _PassageCost(steps, rows, rounding_slack(points, (ends[:2], ends[2:])))


def _fractions_by_newton(
    cost: _PassageCost, guess: Floats, bound: Floats, *, several: bool
) -> tuple[Floats, Any]:
    """Return fractions of the duration (N, S), from several starts if asked, and True where it converged (N,).

    A guess (S, N) of the durations and a lower bound (N,) of the cost are NaN for none.
    """
    first, *others = _starts(cost, guess, several)
    z, value, converged = _minimise(cost, first)
    for start in others:
        other, other_value, other_converged = _minimise(cost, start)
        # A later start must be better by more than rounding, or noise would decide ties.
        better = (other_value < value - 1e-9) & (other_converged | ~converged)
        z = np.where(better, other, z)
        value = np.where(better, other_value, value)
        converged = np.where(better, other_converged, converged)
    reached = value < np.log(bound + cost.reference()) + _REACHED
    return np.ascontiguousarray(_softmax(z).T), converged | reached


def _starts(cost: _PassageCost, guess: Floats, several: bool) -> list[Floats]:
    """Return durations to start from, each (S, N): the best of some guesses, and others."""
    segments, _, count = cost.steps.shape
    # Beside a large motion at the ends, waypoints may be so near to one another that their squared distances vanish.
    chord = np.maximum(np.sqrt(ordered_sum(cost.steps * cost.steps, 1)), SHORTEST)
    # A movement from rest covers the cube of the time; a smooth path is followed like a straight one.
    guesses = [np.cbrt(chord), _straight_durations(chord)]
    if not np.isnan(guess).all():
        guesses.append(guess)
    shares = np.stack([each / ordered_sum(each) for each in guesses])
    costs = np.stack([cost.derivatives(each)[0] for each in shares])
    best = np.argmin(np.where(costs >= 0, costs, np.inf), axis=0)
    starts = [np.take_along_axis(shares, best[None, None], axis=0)[0]]
    if several and segments <= _MOST_SEGMENTS:
        starts.append(np.ones_like(chord))
        drawn = np.random.default_rng(0).dirichlet(np.ones(segments), _STARTS - 2)
        starts += [np.broadcast_to(0.02 + row[:, None], (segments, count)) for row in drawn]
    return [start / ordered_sum(start) for start in starts]


def _straight_durations(chord: Floats) -> Floats:
    """Return the durations (S, N) in which a straight movement from rest to rest covers the lengths of the chords."""
    total = ordered_sum(chord)
    covered = np.cumsum(chord, axis=0)[:-1] / total
    left = np.cumsum(chord[::-1], axis=0)[-2::-1] / total
    nearer = np.minimum(covered, left)
    time = nearer_fraction(nearer, np.ones_like(nearer), nearer * nearer)
    times = np.where(covered <= left, time, 1.0 - time)
    durations = np.diff(times, axis=0, prepend=0.0, append=1.0)
    # No segment is passed faster than at the peak speed 15/8: a very short one keeps a positive duration.
    positive: Floats = np.maximum(durations, chord / (1.875 * total))
    return positive


def _log_cost(cost: _PassageCost, z: Floats, reference: Floats) -> tuple[Floats, Floats, Floats]:
    """Return log(J + reference), its gradient and its Hessian with respect to z.

    The Hessian consists of difference quotients of the gradient, all computed at once. The cost does not change if all
    z shift: that gives the last row, and 1 1^T, which makes the Hessian regular, changes no step.
    """
    size, count = z.shape
    columns = [z]
    for i in range(size - 1):
        moved = z.copy()
        moved[i] += _DIFFERENCE
        columns.append(moved)
    h = _softmax(np.concatenate(columns, axis=1))
    items = np.tile(np.arange(count), size)
    j, first = cost.chosen(items).derivatives(h)
    scale = 1.0 / (j + reference[items])
    gradients = (scale * (first - h * ordered_sum(first))).reshape(size, size, count)
    gradient = gradients[:, 0]
    hessian = np.empty((size, size, count))
    hessian[:-1] = ((gradients[:, 1:] - gradient[:, None]) / _DIFFERENCE).swapaxes(0, 1)
    hessian[-1] = -ordered_sum(hessian[:-1])
    value: Floats = np.log(j[:count] + reference)
    return value, gradient, 0.5 * (hessian + hessian.swapaxes(0, 1)) + 1.0


def _softmax(z: Floats) -> Floats:
    """Return the durations h (n, N) of z, without overflow of the exponential."""
    h = np.exp(z - z.max(axis=0))
    shares: Floats = h / ordered_sum(h)
    return shares


def _minimise(cost: _PassageCost, start: Floats) -> tuple[Floats, Floats, Any]:
    """Return local minima of log(J + reference) from durations (S, N): z (S, N), value and convergence (N,).

    A step is accepted by the Armijo condition (Nocedal & Wright 2006, Eq. 3.4), up to rounding, and else shortened.
    """
    z, reference = np.log(start), cost.reference()
    value, step, gain = _newton_step(cost, z, reference)
    length = np.ones_like(value)
    converged = np.zeros(len(value), dtype=bool)
    active = np.arange(len(value))
    for _ in range(_ITERATIONS):
        size = np.abs(step[:, active]).max(axis=0)
        last = size < _CONVERGED_STEP
        z[:, active[last]] += step[:, active[last]]
        # Where waypoints are equal within their tolerance the cost is flat: no step counts.
        flat = (gain[active] < _SMALL_GAIN) & ((size > _LARGE_STEP) | (length[active] < _LEAST_LENGTH))
        converged[active[last | flat]] = True
        active = active[~(last | flat) & (length[active] >= _LEAST_LENGTH)]
        if not active.size:
            break
        trial = z[:, active] + length[active] * step[:, active]
        found = _newton_step(cost.chosen(active), trial, reference[active])
        falls = found[0] <= value[active] - 1e-4 * length[active] * gain[active] + _NOISE
        length[active] = np.where(falls, 1.0, 0.4 * length[active])
        for kept, new in zip((z, value, step, gain), (trial, *found), strict=True):
            kept[..., active[falls]] = new[..., falls]
    return z, value, converged


def _newton_step(cost: _PassageCost, z: Floats, reference: Floats) -> tuple[Floats, Floats, Floats]:
    """Return log(J + reference) (N,), the modified Newton step (S, N) -H^-1 g and the gain (N,) it promises.

    The step is shortened so that no component is longer than 1.5.
    """
    value, gradient, hessian = _log_cost(cost, z, reference)
    step = -_solve_positive(hessian, gradient[:, None])[:, 0]
    longest = np.abs(step).max(axis=0)
    step = step * (_LONGEST_STEP / np.maximum(longest, _LONGEST_STEP))
    return value, step, -ordered_sum(gradient * step)


def _solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Solve H x = b for symmetric matrices (n, n, N) and right sides (n, m, N).

    Where H is not positive definite its eigenvalues are replaced by their absolute values (Nocedal & Wright 2006,
    section 3.4), which gives a descent direction.
    """
    size = len(matrix)
    work, solution = matrix.copy(), right.copy()
    with np.errstate(all="ignore"):
        for j in range(size):
            factor = work[j + 1 :, j] / work[j, j]
            work[j + 1 :, j:] -= factor[:, None] * work[j, j:]
            solution[j + 1 :] -= factor[:, None] * solution[j]
        for j in reversed(range(size)):
            solution[j] /= work[j, j]
            solution[:j] -= work[:j, j, None] * solution[j]
    pivots = work[range(size), range(size)]
    other = np.flatnonzero(~((pivots > 0).all(axis=0) & np.isfinite(solution).all(axis=(0, 1))))
    for item in other:
        values, vectors = np.linalg.eigh(np.nan_to_num(matrix[..., item]))
        size_of = np.abs(values)
        inverse = 1.0 / np.maximum(size_of, 1e-10 * size_of.max())
        solution[..., item] = vectors @ (inverse[:, None] * (vectors.T @ right[..., item]))
    return solution


def _attach_gradient(
    fractions: Array, waypoints: Array, ends: list[Any], cost: _PassageCost, xp: Namespace
) -> Array:
    """Return the fractions (..., S), differentiable with respect to waypoints and boundary values in unit time.

    Movements with a dropped via-point get the gradient zero.
    """
    segments = fractions.shape[-1]
    if segments == 1:
        return fractions
    if segments == 2 and all(value is None for value in ends):
        return attach_root_gradient(fractions, waypoints, xp)
    whole = xp.all(fractions > 0, axis=-1)[..., None]
    safe = xp.where(whole, fractions, xp.ones_like(fractions) / segments)
    movement = connect(xp, 3, waypoints, safe, knot_states(3, ends, segments - 1))
    # Chain rule of h_i = exp(z_i) / sum_j exp(z_j): dJ/dz_i = h_i (dJ/dh_i - sum_j h_j dJ/dh_j).
    first = safe * duration_gradient(movement.coefficients, movement.rates)
    gradient = first - safe * first.sum(-1)[..., None]
    # The inverse Hessian of the log-cost, divided by the cost.
    h = np.ascontiguousarray(to_numpy(safe).reshape(-1, segments).T)
    value, _, hessian = _log_cost(cost, np.log(h), cost.reference())
    identity = np.repeat(np.eye(segments)[:, :, None], h.shape[1], axis=2)
    inverse = np.clip(_solve_positive(hessian, identity), -_LARGEST, _LARGEST) / np.exp(value)
    inverse = np.moveaxis(inverse, -1, 0).reshape(*safe.shape, segments)
    step = -xp.matmul(like(xp, inverse, fractions), gradient[..., None])[..., 0]  # Eq. 1
    step = step - (safe * step).sum(-1)[..., None]
    step = xp.where(whole, fractions * step, xp.zeros_like(step))
    return fractions + (step - step.detach())
