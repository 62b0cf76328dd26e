"""Many small minimisations side by side: damped Newton steps, every problem at its own pace.

The problems are the last axis of all arrays, and every operation works element by element, so the result of
one does not depend on which others share the batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

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
