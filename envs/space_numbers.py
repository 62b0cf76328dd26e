"""The uniform numbers that attempts at scenes are made of.

A generator gives numbers for one attempt, then for two, four, eight and eight again, until one of them is good. A few
attempts take hardly longer than one, so those of several such groups are looked at together; then the generator is put
back to the end of the group that was needed, and what it gives next does not depend on how many were.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Index = NDArray[np.int64]

GROUPS = (1, 2, 4, *[8] * 400)
"""How many attempts follow one another: few are left after the first, but one in a hundred makes a tunnel."""
AHEAD = 32
"""Attempts of all scenes that are looked at together where one group of each makes fewer."""


class Numbers:
    """Numbers for attempts at N scenes."""

    def __init__(self, generators: Sequence[np.random.Generator], size: int) -> None:
        """From N generators, `size` numbers for each attempt; of a generator that several share none go ahead."""
        self._generators, self._size = generators, size
        self._apart = len({id(each.bit_generator) for each in generators}) == len(generators)
        self._group = 0
        self._groups: tuple[int, ...] = ()
        self._states: list[list[Any]] = []

    @property
    def made(self) -> int:
        """How many attempts at each scene there have been."""
        return sum(GROUPS[: self._group])

    def draw(self, scenes: Index) -> Float:
        """Of the next attempts at P scenes, shape (P, attempts, size); none after the last group."""
        self._groups = GROUPS[self._group :][:1]
        ahead = GROUPS[self._group + 1 :] if self._apart else ()
        for attempts in ahead:
            if len(scenes) * (sum(self._groups) + attempts) > AHEAD:
                break
            self._groups += (attempts,)
        self._group += len(self._groups)
        drawn = np.empty((len(scenes), sum(self._groups), self._size))
        self._states = [
            self._fill(self._generators[int(i)], each) for i, each in zip(scenes, drawn, strict=True)
        ]
        return drawn

    def put_back(self, scenes: Index, first: Index) -> None:
        """Have the generators of P scenes as the group of the first good attempt left them, shape (P,); -1 for none."""
        ends = np.cumsum(self._groups)
        for i, states, attempt in zip(scenes, self._states, first, strict=True):
            if 0 <= attempt < ends[-1] - self._groups[-1]:
                self._generators[int(i)].bit_generator.state = states[int((attempt >= ends).sum())]

    def _fill(self, generator: np.random.Generator, drawn: Float) -> list[Any]:
        """Fill the rows of each group; the states of the generator after all but the last."""
        states, begin = [], 0
        for attempts in self._groups:
            if begin:
                states.append(generator.bit_generator.state)
            generator.random(out=drawn[begin : begin + attempts])
            begin += attempts
        return states
