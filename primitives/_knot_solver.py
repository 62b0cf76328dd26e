"""The states at the knots that make a movement through given points least costly.

With the cost 1/2 sum_s s^T W s / h^(2m-1) of the segments, a zero gradient with respect to the unknown
derivatives at the knots is a symmetric positive definite system with a narrow band. The equations say that
the higher derivatives (snap and jerk for m = 3) are continuous there; the lower ones are by construction.

Nothing here knows how a batch lies in memory: the entries are arrays, or Python floats where all movements
share their durations, and every operation works element by element. So a batch gives bit for bit what each
item gives alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from ._hermite_tables import stiffness_table
from .array_api import FREE, Array

Entry: TypeAlias = Any
States: TypeAlias = list[list[Any]]
"""states[k][i - 1] = i-th time derivative at knot k: an array, None for zero, FREE for unknown."""


@dataclass(frozen=True)
class BandedFactor:
    """L D L^T of a symmetric positive definite matrix, by rows of the entries that can be nonzero."""

    pivots: list[Entry]
    upper: list[dict[int, Entry]]
    multipliers: list[dict[int, Entry]]

    def solve(self, right: Sequence[Array]) -> list[Array]:
        """Solve for one array per row; the entries broadcast against them."""
        work = list(right)
        for p, multipliers in enumerate(self.multipliers):
            for q, multiplier in multipliers.items():
                work[q] = work[q] - multiplier * work[p]
        for p in reversed(range(len(work))):
            for q, entry in self.upper[p].items():
                work[p] = work[p] - entry * work[q]
            work[p] = work[p] / self.pivots[p]
        return work


def factorise(upper: list[dict[int, Entry]]) -> BandedFactor:
    """Eliminate without pivoting; upper[p][q] is entry (p, q), q >= p, and is consumed."""
    multipliers: list[dict[int, Entry]] = []
    pivots: list[Entry] = []
    for p, row in enumerate(upper):
        pivot = row.pop(p)
        pivots.append(pivot)
        factors = {q: entry / pivot for q, entry in row.items()}
        for q, factor in factors.items():
            for r, entry in row.items():
                if r >= q:
                    below = upper[q].get(r)
                    upper[q][r] = -(factor * entry) if below is None else below - factor * entry
        multipliers.append(factors)
    return BandedFactor(pivots, upper, multipliers)


def solve_states(order: int, durations: Sequence[Entry], steps: Sequence[Array], states: States) -> States:
    """Fill in the FREE derivatives at the knots with their values of least cost.

    Args:
        order: m.
        durations: per segment, shapes that broadcast against the steps [s].
        steps: per segment, the difference of its two points [m].
        states: per knot, its m - 1 derivatives (see States).

    Returns:
        The same with every FREE replaced.
    """
    nodes: dict[tuple[int, int], int] = {}
    for k, state in enumerate(states):
        for i, value in enumerate(state):
            if value is FREE:
                nodes[k, i] = len(nodes)
    if not nodes:
        return states
    upper, right = assemble(order, durations, steps, states, nodes)
    solution = factorise(upper).solve(right)
    return [
        [solution[nodes[k, i]] if (k, i) in nodes else value for i, value in enumerate(s)]
        for k, s in enumerate(states)
    ]


def assemble(
    order: int,
    durations: Sequence[Entry],
    steps: Sequence[Array],
    states: States,
    nodes: dict[tuple[int, int], int],
) -> tuple[list[dict[int, Entry]], list[Array]]:
    """Return the upper half of the matrix and the right side of the zero-gradient equations of `nodes`."""
    table = stiffness_table(order)
    upper: list[dict[int, Entry]] = [{} for _ in nodes]
    right: list[Any] = [None] * len(nodes)
    for s, (duration, step) in enumerate(zip(durations, steps, strict=True)):
        powers = inverse_powers(duration, 2 * order - 2)
        local = [(s, i) for i in range(order - 1)] + [(s + 1, i) for i in range(order - 1)]
        for a, node in enumerate(local):
            p = nodes.get(node)
            if p is None:
                continue
            load = -table[a + 1][0] * powers[2 * order - 2 - node[1]] * step
            for b, other in enumerate(local):
                weight = table[a + 1][b + 1]
                q = nodes.get(other)
                if q is None:
                    value = states[other[0]][other[1]]
                    if value is not None:
                        load = load - weight * powers[2 * order - 3 - node[1] - other[1]] * value
                elif q >= p:
                    entry = weight * powers[2 * order - 3 - node[1] - other[1]]
                    upper[p][q] = upper[p][q] + entry if q in upper[p] else entry
            right[p] = load if right[p] is None else right[p] + load
    return upper, right


def inverse_powers(duration: Entry, highest: int) -> list[Entry]:
    """[1, 1/h, 1/h^2, ...]; index = exponent."""
    inverse = 1.0 / duration
    powers = [1.0, inverse]
    while len(powers) <= highest:
        powers.append(powers[-1] * inverse)
    return powers
