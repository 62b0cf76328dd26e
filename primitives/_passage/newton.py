"""Free passage times of any number of via-points: damped Newton on the logarithm of the reduced jerk cost.

The durations are h_i = exp(z_i) / sum_j exp(z_j) in unit total time, positive by construction; the logarithm
of the cost spans few units where the cost spans decades. Rest to rest only one minimum has ever been seen;
with moving ends there can be several, so that case starts from several points and compares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from .cost import PassageCost

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]
Evaluate: TypeAlias = Callable[[Floats, Any], tuple[Floats, Floats, Floats]]
"""(z (n, M), items (M,)) -> value (M,), gradient (n, M), Hessian (n, n, M) of the problems `items` at z."""

_LONGEST_STEP = 1.5
_NOISE = 1e-13
_CONVERGED_STEP = 1e-8
_ITERATIONS = 80
_HALVINGS = 12


@dataclass(frozen=True)
class Minima:
    """Where the iterations ended: z (n, N), value (N,), and whether each converged (N,)."""

    z: Floats
    value: Floats
    converged: Any


def minimise(evaluate: Evaluate, z: Floats) -> Minima:
    """Local minima from the given starts.

    A step of the Newton iteration whose length is below 1e-8 is taken and is the last one: its successor
    would be of the order of its square.
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
    """Halve each step until its value falls enough; a problem that cannot fall any more stays where it is."""
    slope = _sum(gradient * step)
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
    """-H^-1 g with the pivots of L D L^T made positive, and no component longer than 1.5."""
    step = -solve_positive(hessian, gradient)
    longest = np.abs(step).max(axis=0)
    shortened: Floats = step * (_LONGEST_STEP / np.maximum(longest, _LONGEST_STEP))
    return shortened


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Solve with L |D| L^T instead of L D L^T: a descent direction even where the cost is not convex."""
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


def _sum(array: Floats) -> Floats:
    """Sum over the first axis in its order, whatever the memory layout."""
    total: Floats = array[0].copy()
    for row in array[1:]:
        total += row
    return total


_STARTS = 10
"""Starts with moving ends: even, by chord, and eight drawn from the flat Dirichlet distribution with a fixed
seed."""

_SHORT = 0.03
"""Fraction of the duration below which a segment's cost suffers from cancellation, like 1e-16 / h^2:
movements with such a segment are finished in extended precision."""


def fractions_by_newton(cost: PassageCost, *, several: bool) -> tuple[Floats, Any]:
    """Fractions of the duration per segment, (N, S), and whether the iteration converged, (N,)."""
    first, *others = _starts(cost.steps, several)
    best = _from_start(cost, first)
    for start in others:
        found = _from_start(cost, start)
        # A later start must be better by more than rounding, else ties would be decided by noise.
        better = (found.value < best.value - 1e-9) & (found.converged | ~best.converged)
        pairs = ((found.z, best.z), (found.value, best.value), (found.converged, best.converged))
        best = Minima(*(np.where(better, new, old) for new, old in pairs))
    lost = ~np.isfinite(best.z).all(axis=0)
    h = np.where(lost, 1.0 / len(best.z), _softmax(np.where(lost, 0.0, best.z)))
    hard = np.flatnonzero(~best.converged | (h.min(axis=0) < _SHORT))
    if hard.size:
        refined = _from_start(cost.refined(hard), h[:, hard].astype(np.longdouble))
        good = np.isfinite(refined.z).all(axis=0)
        h[:, hard[good]] = _softmax(refined.z[:, good])
        best.converged[hard] = refined.converged & good
    return np.ascontiguousarray(h.T), best.converged


def _from_start(cost: PassageCost, start: Floats) -> Minima:
    reference = 1e-3 * cost.scale()

    def evaluate(z: Floats, items: Any) -> tuple[Floats, Floats, Floats]:
        return log_cost(cost.chosen(items), z, reference[items])

    return minimise(evaluate, np.log(start))


def log_cost(cost: PassageCost, z: Floats, reference: Floats) -> tuple[Floats, Floats, Floats]:
    """Return log(J + reference), gradient and Hessian with respect to z."""
    h = _softmax(z)
    j, first, second = cost.derivatives(h)
    scale = 1.0 / (j + reference)
    first = first * h * scale
    mean = first[0]
    for row in first[1:]:
        mean = mean + row
    gradient = first - h * mean
    # d2J/dz2 = M^T J_hh M + sum_i J_i d2h_i/dz2 with M = diag(h) - h h^T, written out.
    curved = scale * second * h * h[:, None]
    along = curved[0]
    for row in curved[1:]:
        along = along + row
    both = along[0]
    for entry in along[1:]:
        both = both + entry
    hessian = curved - _outer(h, along) - _outer(along, h) + both * _outer(h, h)
    hessian = hessian - _outer(h, first) - _outer(first, h) + 2.0 * mean * _outer(h, h)
    for i in range(len(h)):
        hessian[i, i] += first[i] - h[i] * mean
    return np.log(j + reference), gradient, hessian - _outer(gradient, gradient) + 1.0


def _outer(p: Floats, q: Floats) -> Floats:
    return p[:, None] * q[None, :]


def _softmax(z: Floats) -> Floats:
    largest = z.max(axis=0)
    h = np.exp(z - largest)
    total: Floats = h[0]
    for row in h[1:]:
        total = total + row
    shares: Floats = h / total
    return shares


def _starts(steps: Floats, several: bool) -> list[Floats]:
    """Durations to start from, each (S, N)."""
    square = steps[:, 0] * steps[:, 0]
    for d in range(1, steps.shape[1]):
        square = square + steps[:, d] * steps[:, d]
    chord = np.cbrt(np.sqrt(square))
    starts = [np.maximum(chord / chord.max(axis=0), 1e-3)]
    if several:
        segments, count = chord.shape
        starts.append(np.ones_like(chord))
        drawn = np.random.default_rng(0).dirichlet(np.ones(segments), _STARTS - 2)
        starts += [np.broadcast_to(0.02 + row[:, None], (segments, count)) for row in drawn]
    return [start / start.sum(axis=0) for start in starts]
