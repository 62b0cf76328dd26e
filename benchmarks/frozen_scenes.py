"""Frozen sets of scenes of every task, made anew.

    python benchmarks/frozen_scenes.py                       # all sets; those that exist are left as they are
    python benchmarks/frozen_scenes.py --env viapoint/PlanarObstacles-v0 --sets test hard
    python benchmarks/frozen_scenes.py --check               # make them in memory, and compare them

Scenes are drawn one after the other, each with a generator of its own. The solution share of a scene is the share of
random actions whose plan is clear. A scene is kept where its band of shares is still wanted, and where the search finds
a movement that is clear by geometry, if all is decided at the beginning, and succeeds in physics. The spheres of an arm
are a little larger than the arm, so that success in physics alone could be luck.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.spatial import cKDTree

from viapoint.envs.common.arrays import Bool, Float
from viapoint.envs.registration import TASKS
from viapoint.envs.scenes.families_registry import scene_families
from viapoint.envs.scenes.sampler import is_planar
from viapoint.envs.scenes.scene import Scenes, check_scenes
from viapoint.envs.task import Task
from viapoint.training.planning.problem import Problem
from viapoint.training.planning.search import (
    CLEARANCE_MARGIN,
    GeometrySearch,
    plan_clearances,
    registered_task,
)
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import (
    BANDS,
    DRAWN,
    OBSTACLE_PARTS,
    SCENE_PARTS,
    SETS,
    FrozenScenes,
    load,
    save_sets,
    shipped_path,
)

SEEDS = {"validation": 11, "test": 12, "hard": 13, "uniform": 14}  # First part of seeds
SENSED = 100  # Added for tasks with a sensor, whose scenes are those of no other task
NUMBERS = {"validation": 500, "test": 1000, "hard": 300, "uniform": 500}  # Scenes of a set
FEWER = {"validation": 200, "test": 250}  # Of tasks without obstacles at rest
MOST_DRAWN = 40  # Greatest number of drawn scenes for each one that is wanted
TOGETHER = 250  # Scenes that are drawn together
RANDOM_ACTIONS = 512  # Number of random actions for the solution share
CLOSE = 1e-6  # Greatest difference of numbers of two scenes that count as equal, [m], [rad] or [s]
# Least share of scenes that are as they ship: since then, a finer arm or a better search may solve others
SAME = 0.98
HARD_SHARE = 0.01  # Solution share below which scenes are hard


class Maker:
    """Maker of the sets of one environment."""

    def __init__(self, env_id: str) -> None:
        self.env_id = env_id
        # Shares and solutions are those of plans through one via-point of the usual range, whatever an environment has.
        usual = {"n_via": 1, "via_range": 1.0}
        self.task = registered_task(env_id, **usual)
        self._simulation = SceneSimulation(env_id, TOGETHER, **usual)
        self._search = GeometrySearch(self.task, 2048, refinements=4, per_round=128)

    def numbers(self) -> dict[str, int]:
        """Return the number of scenes by the names of the sets that the task has."""
        return NUMBERS if self.task.whole_movement and self.task.n_obstacles[1] else FEWER

    def make(self, name: str) -> FrozenScenes:
        """Return a set."""
        number = self.numbers()[name]
        if name == "hard":
            kept = self._hard(number)
        elif name == "uniform" or not self.task.n_obstacles[1]:
            kept = self._first(name, number)
        else:
            kept = self._by_band(name, number)
        return together(kept)

    def _first(self, name: str, number: int) -> list[FrozenScenes]:
        """Return the first scenes that are solved."""
        kept, found = [], 0
        for drawn in self._drawn(name, self.task, DRAWN, number):
            solved = np.flatnonzero(self._solved(drawn))
            kept.append(drawn.take(solved[: number - found]))
            found += len(kept[-1].share)
            if found == number:
                break
        return kept

    def _by_band(self, name: str, number: int) -> list[FrozenScenes]:
        """Return as many solved scenes from each band of the solution share, as far as there are."""
        wanted = np.full(len(BANDS), number // len(BANDS))
        kept, spare = [], []
        for drawn in self._drawn(name, self.task, DRAWN, number):
            rank = np.zeros(len(drawn.share), np.int64)
            band = drawn.band
            solved = self._solved(drawn, wanted[band] > 0)
            for each in range(len(BANDS)):
                rows = np.flatnonzero(solved & (band == each))
                rank[rows] = np.arange(len(rows))
            fits = solved & (rank < wanted[band])
            kept.append(drawn.take(fits))
            spare.append(drawn.take(solved & ~fits))
            wanted -= np.bincount(band[fits], minlength=len(BANDS))
            if not wanted.any():
                break
        # Where a band has too few scenes, the hardest of the others stand in.
        missing = int(wanted.sum())
        if missing:
            kept.append(_hardest(spare, missing))
        return kept

    def _hard(self, number: int) -> list[FrozenScenes]:
        """Return solved scenes with the least shares, as many of each family."""
        plane = is_planar(self.task.arm)
        families = [
            name
            for name, family in scene_families(plane).items()
            if set(family.kinds) <= set(self.task.shapes) and family.n_obstacles <= self.task.n_obstacles[1]
        ]
        kept = []
        for place, name in enumerate(families):
            share = number * (place + 1) // len(families) - number * place // len(families)
            task = dataclasses.replace(self.task, families=(name,))
            found: list[FrozenScenes] = []
            for drawn in self._drawn("hard", task, name, share):
                found.append(drawn.take(self._solved(drawn, drawn.share < 0.05)))
                if sum((each.share < HARD_SHARE).sum() for each in found) >= share:
                    break
            kept.append(_hardest(found, share))
        return kept

    def _drawn(self, name: str, task: Task, family: str, number: int) -> Iterator[FrozenScenes]:
        """Yield drawn scenes, whose numbers are rounded to what a file holds."""
        sampler = task.sampler()
        seed = SEEDS[name] + (SENSED if task.sensor else 0)
        for first in range(0, MOST_DRAWN * number, TOGETHER):
            seeds = [(seed, *family.encode(), first + each) for each in range(TOGETHER)]
            scenes = rounded(sampler([np.random.default_rng(seed) for seed in seeds]))
            possible = []
            for row in range(TOGETHER):
                with contextlib.suppress(ValueError):  # rounding may have made one impossible
                    check_scenes(scenes.take([row]), self.task.arm)
                    possible.append(row)
            scenes = scenes.take(possible)
            share = self._share(scenes)
            names = np.full(len(share), family)
            yield FrozenScenes(name=name, task=self.task.as_dict(), scenes=scenes, share=share, family=names)

    def _share(self, scenes: Scenes) -> Float:
        """Return the solution shares of scenes, shape (N,)."""
        number = len(scenes.start)
        if not self.task.n_obstacles[1]:
            return np.ones(number)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_ACTIONS, self.task.action.size))
        every = np.broadcast_to(actions, (number, *actions.shape))
        problem = Problem.of_scenes(scenes, self.task)
        clearance = plan_clearances(self.task, problem, every, CLEARANCE_MARGIN, CLEARANCE_MARGIN)
        return np.asarray((clearance >= CLEARANCE_MARGIN).mean(axis=-1))

    def _solved(self, drawn: FrozenScenes, wanted: Bool | None = None) -> Bool:
        """Return True for scenes, of those that are wanted, in which a clear movement of the search succeeds."""
        solved = np.zeros(len(drawn.share), bool)
        rows = np.arange(len(solved)) if wanted is None else np.flatnonzero(wanted)
        if rows.size:
            scenes = drawn.scenes.take(rows)
            if self.task.sensor:  # what is solved is the scene, not what is seen of it
                decided = self._search.solve(Problem.of_scenes(scenes, self.task))
            else:
                decided = self._search.decide(self._simulation.observe(scenes))
            solved[rows] = self._simulation.play(self._search, scenes, decided)["is_success"]
            if self.task.whole_movement:
                problem = Problem.of_scenes(scenes, self.task)
                clearance = plan_clearances(self.task, problem, decided[:, None], 0.0, 0.0, exact=True)
                solved[rows] &= clearance[:, 0] >= 0.0
        return solved


def rounded(scenes: Scenes) -> Scenes:
    """Return scenes whose numbers single precision represents."""
    obstacles = scenes.obstacles._replace(**_single(scenes.obstacles, OBSTACLE_PARTS))
    return scenes._replace(obstacles=obstacles, **_single(scenes, SCENE_PARTS))


def _single(record: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return fields of a record in numbers that single precision represents."""
    return {name: getattr(record, name).astype(np.float32).astype(np.float64) for name in names}


def shipped_sets(path: Path) -> dict[str, FrozenScenes]:
    """Return the sets of a shipped file by their names."""
    with np.load(path, allow_pickle=False) as archive:
        names = [name for name in SETS if f"{name}/task" in archive]
    return {name: load(path, name) for name in names}


def together(parts: Sequence[FrozenScenes]) -> FrozenScenes:
    """Return the scenes of several sets of one task under the name of the first."""
    return dataclasses.replace(
        parts[0],
        scenes=Scenes.together([part.scenes for part in parts]),
        share=np.concatenate([part.share for part in parts]),
        family=np.concatenate([part.family for part in parts]),
    )


def _hardest(found: list[FrozenScenes], number: int) -> FrozenScenes:
    """Return the scenes with the least shares."""
    scenes = together(found)
    return scenes.take(np.sort(np.argsort(scenes.share, kind="stable")[:number]))


def in_common(first: FrozenScenes, second: FrozenScenes) -> int:
    """Return how many scenes of a set are in another one of the same task, up to CLOSE, which compilers may change."""
    if Task.of(**first.task).as_dict() != Task.of(**second.task).as_dict():
        return 0
    tree = cKDTree(numbers_of(second))
    return int((tree.query(numbers_of(first), p=np.inf)[0] <= CLOSE).sum())


def numbers_of(scenes: FrozenScenes) -> Float:
    """Return all numbers of each scene of a set, shape (N, n)."""
    obstacles = [getattr(scenes.scenes.obstacles, name) for name in ("kind", *OBSTACLE_PARTS)]
    every = [*obstacles, *(getattr(scenes.scenes, name) for name in SCENE_PARTS)]
    flat = np.concatenate([each.reshape(len(scenes.share), -1) for each in every], axis=1)
    return np.asarray(np.nan_to_num(flat, posinf=1e9))


def make_sets(env: tuple[str, ...] = (), sets: tuple[str, ...] = SETS, check: bool = False) -> None:
    """Make the frozen sets of scenes, and print what was made.

    Args:
        env: Ids of environments; all if none is given.
        sets: Names of sets.
        check: Make the sets that ship again, and tell how many of their scenes are as they ship; the exit code is 1 if
            it is less than a share of SAME.
    """
    different = 0
    # Ids of environments whose scenes differ; a set fits every task with the same scenes
    first: dict[str, str] = {}
    for env_id, kwargs in TASKS.items():
        if kwargs.get("decide_at") != "steps":  # tasks of control steps have the scenes of those of movements
            first.setdefault(str(kwargs), env_id)
    for env_id in env or first.values():
        maker, path = Maker(env_id), shipped_path(env_id)
        there = shipped_sets(path) if path.is_file() else {}
        for name in [each for each in sets if each in maker.numbers()]:
            if name in there and not check:
                continue
            made = maker.make(name)
            counts = np.bincount(made.band, minlength=len(BANDS))
            told = ", ".join(f"{band}: {count}" for band, count in zip(BANDS, counts, strict=True))
            if check:
                same = in_common(there[name], made) if name in there else 0
                different += same < SAME * len(made.share)
                print(f"{path.stem} {name}: {same} of {len(made.share)} as they ship ({told})", flush=True)
            else:
                there[name] = made
                save_sets(path, there)
                print(f"{path.stem} {name}: {len(made.share)} scenes ({told})", flush=True)
    sys.exit(bool(different))


if __name__ == "__main__":
    tyro.cli(make_sets)
