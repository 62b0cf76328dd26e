"""Search for scenes: draw, estimate, measure and certify until there are enough, of each difficulty or of any."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from scene_sets.difficulty import planned_share, solution_share
from viapoint.envs.common.types import Float, Int
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.planning.cma_planner import Planner, PlannerBudget
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.planning.search import GeometrySearch

SPARE, SAFE = 1.2, 1.1
"""Factors on the number of scenes that are taken by their estimated share, and on this estimate, as it errs."""
AT_ONCE = 64
"""Scenes that are measured at once."""
QUICK = PlannerBudget(generations=4)
"""Budget of the planner in space, where simulation takes longer."""
SECOND_CHANCE = 4096
"""Candidate plans of scenes that the planner does not solve."""
MOST_DRAWN, MOST_ROUNDS = 1 << 18, 20
"""Limits of the scenes drawn and of the rounds of measuring or planning."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Source of scenes."""

    draw: Callable[[int], Scenes]
    """Function that returns the next scenes, given their number."""
    block: int
    """Number of scenes that are drawn at once."""
    levels: tuple[tuple[float, int], ...] = ()
    """Pairs (share, plans): shares estimated below the first number are estimated again from so many plans."""


@dataclass(frozen=True, kw_only=True)
class Kinds:
    """Kinds of scenes to search for."""

    of_share: Callable[[Float], Int]
    """Function that returns the kind of each share, -1 for none, shape (N,)."""
    names: tuple[str, ...]
    quota: int
    """Number of scenes of each kind."""


class Found(NamedTuple):
    """N certified scenes."""

    scenes: Scenes
    share: Float
    """Solution shares, shape (N,)."""
    solution: Float
    """Actions that the planner found, shape (N, m)."""
    number: Int
    """Numbers among the drawn scenes, shape (N,)."""


def search(
    simulation: SceneSimulation,
    source: Source,
    kinds: Kinds,
    *,
    seed: int,
    label: str,
    most_drawn: int = MOST_DRAWN,
) -> Found:
    """Return the first scenes of each kind that random actions and the planner solve.

    Args:
        simulation: Simulation.
        source: Source of the scenes; the result depends on it and the seed alone.
        kinds: Kinds to search for.
        seed: Seed of the random actions.
        label: Text beside the progress bar.
        most_drawn: Greatest number of scenes to draw.

    Raises:
        RuntimeError: One kind is too rare.
    """
    pool = _Pool(simulation, source, kinds, most_drawn)
    scenes, share, number = pool.empty, np.zeros(0), np.zeros(0, dtype=np.int64)
    solution, tried, failed = np.zeros((0, simulation.task.action.size)), np.zeros(0, bool), np.zeros(0, bool)
    for _ in range(MOST_ROUNDS):
        good = np.where((share > 0.0) & ~failed, kinds.of_share(share), -1)
        chosen = _first(good, kinds)
        untried = chosen[~tried[chosen]]
        if len(chosen) == kinds.quota * len(kinds.names):
            if not len(untried):
                return Found(scenes.take(chosen), share[chosen], solution[chosen], number[chosen])
            tried[untried] = True
            solution[untried], solved = _planned(simulation, scenes.take(untried), label)
            failed[untried] = ~solved
            continue
        more, numbers = pool.more(kinds.quota - _counts(good, kinds))
        scenes, number = _joined(scenes, more), np.concatenate((number, numbers))
        share = np.concatenate((share, measured(simulation, more, seed, label)))
        solution = np.concatenate((solution, np.zeros((len(more.start), solution.shape[1]))))
        tried, failed = (np.concatenate((each, np.zeros(len(more.start), bool))) for each in (tried, failed))
    missing = kinds.quota - _counts(good, kinds)
    raise RuntimeError(
        f"{label}: after {MOST_ROUNDS} rounds there still lack {_named(missing, kinds)} scenes"
    )


def first_solved(simulation: SceneSimulation, source: Source, number: int, label: str) -> Found:
    """Return the first scenes that have a known solution; their solution shares are not measured.

    The planner looks for solutions with its usual budget. Where it finds none, the best of SECOND_CHANCE plans by
    computed geometry is simulated.

    Args:
        simulation: Simulation.
        source: Source of the scenes.
        number: Number of scenes, N.
        label: Text beside the progress bar.
    """
    planner, geometry = Planner(simulation), GeometrySearch(simulation.task, SECOND_CHANCE, refinements=4)
    kept: list[tuple[Scenes, Float, Int]] = []
    drawn = 0
    while sum(len(numbers) for *_, numbers in kept) < number:
        scenes = source.draw(source.block)
        for rows in _lots(scenes, f"{label}: planner"):
            some, numbers = scenes.take(rows), drawn + np.arange(source.block)[rows]
            planned = planner(some)
            action, solved = planned.action, planned.success.copy()
            left = np.flatnonzero(~solved)
            if left.size:
                action[left] = geometry.decide(simulation.observe(some.take(left)))
                solved[left] = simulation(some.take(left), action[left]).success
            kept.append((some.take(solved), action[solved], numbers[solved]))
        drawn += source.block
    scenes = Scenes(*(np.concatenate(f)[:number] for f in zip(*(each for each, *_ in kept), strict=True)))
    solution, numbers = (np.concatenate([each[i] for each in kept])[:number] for i in (1, 2))
    return Found(scenes, np.full(number, np.nan), solution, numbers)


def redrawn(source: Source, number: Int) -> Scenes:
    """Return the scenes of given numbers, drawn again."""
    kept = []
    for first in range(0, int(number.max()) + 1, source.block):
        block, rows = source.draw(source.block), number - first
        here = (rows >= 0) & (rows < source.block)
        kept.append((np.flatnonzero(here), block.take(rows[here])))
    order = np.argsort(np.concatenate([rows for rows, _ in kept]))
    scenes = Scenes(*(np.concatenate(f) for f in zip(*(block for _, block in kept), strict=True)))
    return scenes.take(order)


class _Pool:
    """Pool of scenes that are drawn but not measured, with their estimated kinds."""

    def __init__(self, simulation: SceneSimulation, source: Source, kinds: Kinds, most_drawn: int) -> None:
        self._simulation, self._source, self._kinds, self._most_drawn = simulation, source, kinds, most_drawn
        self._scenes = self.empty = source.draw(0)
        self._kind = self._number = np.zeros(0, dtype=np.int64)
        self._drawn = 0

    def more(self, missing: Int) -> tuple[Scenes, Int]:
        """Remove scenes of each missing kind, by the estimate, from the pool, and return them and their numbers."""
        wanted = np.ceil(SPARE * missing).astype(np.int64)
        while (_counts(self._kind, self._kinds) < wanted).any():
            if self._drawn >= self._most_drawn:
                lacking = _named(wanted - _counts(self._kind, self._kinds), self._kinds)
                raise RuntimeError(f"there lack {lacking} scenes by estimate after {self._drawn} drawn")
            block = self._source.draw(self._source.block)
            numbers = self._drawn + np.arange(self._source.block)
            self._drawn += self._source.block
            kind = self._kinds.of_share(SAFE * self._estimate(block))
            self._scenes, self._kind = _joined(self._scenes, block), np.concatenate((self._kind, kind))
            self._number = np.concatenate((self._number, numbers))
        rank = _ranks(self._kind, self._kinds)
        taken = np.flatnonzero((self._kind >= 0) & (rank < wanted[self._kind]))
        taken = taken[np.lexsort((-self._kind[taken], rank[taken]))]
        some = self._scenes.take(taken), self._number[taken]
        rest = np.setdiff1d(np.flatnonzero(self._kind >= 0), taken)
        self._scenes, self._kind, self._number = self._scenes.take(rest), self._kind[rest], self._number[rest]
        return some

    def _estimate(self, scenes: Scenes) -> Float:
        """Return planned shares, more exact where they are small, shape (N,)."""
        share = planned_share(self._simulation, scenes, draws=256)
        for below, draws in self._source.levels:
            for row in np.flatnonzero(share < below):
                share[row] = planned_share(self._simulation, scenes.take([row]), seed=draws, draws=draws)[0]
        return share


def measured(simulation: SceneSimulation, scenes: Scenes, seed: int, label: str) -> Float:
    """Return solution shares, shape (N,)."""
    return np.concatenate(
        [
            solution_share(simulation, scenes.take(rows), seed=seed)
            for rows in _lots(scenes, f"{label}: shares")
        ]
    )


def _planned(simulation: SceneSimulation, scenes: Scenes, label: str) -> tuple[Float, NDArray[np.bool_]]:
    """Return the planner's actions, and which of them are solutions."""
    planner = Planner(simulation, budget=QUICK if simulation.task.arm.dimension == 3 else None)
    planned = [planner(scenes.take(rows)) for rows in _lots(scenes, f"{label}: planner")]
    return np.concatenate([p.action for p in planned]), np.concatenate([p.success for p in planned])


def _lots(scenes: Scenes, label: str) -> tqdm[slice]:
    lots = [slice(i, i + AT_ONCE) for i in range(0, len(scenes.start), AT_ONCE)]
    return tqdm(lots, desc=label, unit=f"x{AT_ONCE} scenes", file=sys.stderr, leave=False)


def _first(kind: Int, kinds: Kinds) -> Int:
    """Return the indices of the first scenes of each kind."""
    return np.flatnonzero((kind >= 0) & (_ranks(kind, kinds) < kinds.quota))


def _ranks(kind: Int, kinds: Kinds) -> Int:
    """Return the number of scenes of the same kind before each scene."""
    rank = np.zeros(len(kind), dtype=np.int64)
    for index in range(len(kinds.names)):
        rank[kind == index] = np.arange((kind == index).sum())
    return rank


def _counts(kind: Int, kinds: Kinds) -> Int:
    return np.bincount(kind[kind >= 0], minlength=len(kinds.names))


def _joined(first: Scenes, second: Scenes) -> Scenes:
    return Scenes(*(np.concatenate(fields) for fields in zip(first, second, strict=True)))


def _named(missing: Int, kinds: Kinds) -> str:
    return ", ".join(
        f"{number} {name}" for number, name in zip(missing, kinds.names, strict=True) if number > 0
    )
