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

With the states at the via-points eliminated, J(h) is the least sum of the segments' costs phi (Eq. 1 of
`_weighted_solver`). By the envelope theorem dJ/dh is the derivative of phi at fixed states: with r = q / h^2,

    h phi_h = sum_i w_i (r_i . p_i + 1/2 e_i |r_i|^2),   p = h dr/dh,   e = h w'(h) / w.             (2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._passage_one_via import SHORTEST, attach_root_gradient, nearer_fraction
from ._polynomial import mode_table
from ._weighted_solver import fit_modes, mode_weights
from .array_api import FREE, Array, Floats, Namespace, change_given, like, ordered_sum, to_numpy
from .trajectory import connect, duration_gradient

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


@dataclass(frozen=True)
class PassageCost:
    """Cost of N movements whose passage times are sought, in unit total time; movements are the last axis.

    Attributes:
        steps: (S, D, N) differences of the waypoints.
        ends: velocity and acceleration at start and goal in unit time: (D, N), None for zero, FREE (goal only).
        slack: (N,) tolerance of the waypoints, see `_weighted_solver`.
    """

    steps: Floats
    ends: list[Any]
    slack: Floats

    @classmethod
    def from_points(cls, points: Floats, ends: Sequence[Any], slack: Floats) -> PassageCost:
        """Return the cost of movements through points (N, S + 1, D) with four boundary values (N, D)."""
        rows = change_given(lambda value: np.ascontiguousarray(value.T), ends)
        steps = np.ascontiguousarray(np.diff(points, axis=1).transpose(1, 2, 0))
        return cls(steps, rows, slack)

    def chosen(self, items: Any) -> PassageCost:
        """Return the movements `items`, in that order."""
        ends = change_given(lambda value: value[:, items], self.ends)
        return PassageCost(self.steps[..., items], ends, self.slack[items])

    def reference(self) -> Floats:
        """Return (N,) a cost far below that of any real movement of this size, to keep logarithms finite."""
        total = ordered_sum(ordered_sum(self.steps * self.steps, -2))
        for value in self.ends:
            if isinstance(value, np.ndarray):
                total = total + ordered_sum(value * value)
        return 1e-3 * np.where(total > 0, total, 1.0)

    def derivatives(self, h: Floats) -> tuple[Floats, Floats]:
        """Return J (N,) and h dJ/dh (S, N) at durations h (S, N)."""
        states = [self.ends[:2], *([FREE, FREE] for _ in range(len(h) - 1)), self.ends[2:]]
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


def fractions_by_newton(
    cost: PassageCost, guess: Floats, bound: Floats, *, several: bool
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


def _starts(cost: PassageCost, guess: Floats, several: bool) -> list[Floats]:
    """Return durations to start from, each (S, N): the best of some guesses, and others."""
    segments, _, count = cost.steps.shape
    # Beside a large motion at the ends, waypoints may be so near to one another that their squared distances vanish.
    chord = np.maximum(np.sqrt(ordered_sum(cost.steps * cost.steps, 1)), SHORTEST)
    # A movement from rest covers the cube of the time; a smooth path is followed like a straight one.
    guesses = [np.cbrt(chord), _straight_durations(chord)]
    if not np.isnan(guess).all():
        guesses.append(guess)
    shares = np.stack([each / each.sum(axis=0) for each in guesses])
    costs = np.stack([cost.derivatives(each)[0] for each in shares])
    best = np.argmin(np.where(costs >= 0, costs, np.inf), axis=0)
    starts = [np.take_along_axis(shares, best[None, None], axis=0)[0]]
    if several and segments <= _MOST_SEGMENTS:
        starts.append(np.ones_like(chord))
        drawn = np.random.default_rng(0).dirichlet(np.ones(segments), _STARTS - 2)
        starts += [np.broadcast_to(0.02 + row[:, None], (segments, count)) for row in drawn]
    return [start / start.sum(axis=0) for start in starts]


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


def _log_cost(cost: PassageCost, z: Floats, reference: Floats) -> tuple[Floats, Floats, Floats]:
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


def _minimise(cost: PassageCost, start: Floats) -> tuple[Floats, Floats, Any]:
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


def _newton_step(cost: PassageCost, z: Floats, reference: Floats) -> tuple[Floats, Floats, Floats]:
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


def attach_gradient(
    fractions: Array, waypoints: Array, ends: list[Any], cost: PassageCost, xp: Namespace
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
    states: list[list[Any]] = [ends[:2], *([FREE, FREE] for _ in range(segments - 1)), ends[2:]]
    movement = connect(xp, 3, waypoints, safe, states)
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
