"""Makes the frozen scenes again and compares them with those shipped.

    python -m viapoint.training.scene_sets.generate [--env ID ...] [--sets test ...] [--write | --out DIR]

`validation` and `test` are drawn from the training distribution with seeds that training never uses, a quarter of each
set in each band of the solution share. `hard` holds scenes of some families, as many of each, all with a share below
5 %. No agent of the plane is trained on its families; in space they are the narrow ones, one of which is never trained
on. Every scene was solved in simulation by some of at most 4,096 random actions, so that its difficulty is known, and
by the planner.

Searching for scenes takes estimates of their shares, which change with the program. So each scene of a file knows which
of the drawn scenes it is: what is made again are these, and the hash tells whether scenes and shares are the same.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from viapoint.envs.mdp.task import Task, family_sampler
from viapoint.envs.scenes.families import scene_families
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import Trial
from viapoint.training.scene_sets.scene_search import Kinds, Source, measured, redrawn, search
from viapoint.training.scene_sets.scene_set import BAND_EDGES, BANDS, DRAWN, FrozenScenes, bands
from viapoint.training.scene_sets.scene_set_diff import add_arguments, compare_with_shipped, shipped

SEEDS = {"validation": 1_000_003, "test": 2_000_003, "hard": 3_000_017}
"""First seeds of the sets; training draws from seeds below a million."""
SIZES = {"validation": 500, "test": 1000, "hard": 500}
WITHOUT_OBSTACLES = 100
"""Scenes of a set with nothing in the way."""
HARDEST = BAND_EDGES[1]
"""Shares of hard scenes are less."""
ALL = ("validation", "test", "hard")
SETS = {
    "viapoint/PlanarReach-v0": ALL[:2],
    "viapoint/PlanarObstacles-v0": ALL,
    "viapoint/PlanarWholeArm-v0": ALL,
    "viapoint/PandaReach-v0": ALL[:2],
    "viapoint/PandaObstacles-v0": ALL,
}
"""Environments with shipped scenes, and their sets."""


class Lot(NamedTuple):
    """Scenes of a set that come from one source."""

    family: str
    source: Source
    kinds: Kinds
    seed: int


def lots(task: Task, name: str, size: int) -> list[Lot]:
    """Where the scenes of a set come from.

    Args:
        task: They are for.
        name: `validation`, `test` or `hard`.
        size: Number of scenes, a multiple of the bands or families.
    """
    seed = SEEDS[name]
    if name == "hard":
        families = hard_families(task)
        seeds = {family: seed + 101 * i for i, family in enumerate(families)}
        hard = Kinds(
            of_share=lambda share: np.where(share < HARDEST, 0, -1),
            names=("share < 5 %",),
            quota=size // len(families),
        )
        return [
            Lot(family, _source(sampler, seeds[family], block=64), hard, seeds[family])
            for family, sampler in families.items()
        ]
    if task.scenes.n_obstacles[1] == 0:
        any_ = Kinds(of_share=lambda share: np.zeros(len(share), np.int64), names=("any",), quota=size)
        return [Lot(DRAWN, _source(task.sampler(), seed, block=WITHOUT_OBSTACLES), any_, seed)]
    rare = not task.whole_arm  # few scenes are hard where the hand alone must clear
    levels = ((0.03, 2048), (0.013, 16384)) if rare else ((0.03, 1024),)
    source = _source(task.sampler(), seed, block=2048 if rare else 512, levels=levels)
    return [Lot(DRAWN, source, Kinds(of_share=bands, names=BANDS, quota=size // len(BANDS)), seed)]


def hard_families(task: Task) -> dict[str, SceneSampler]:
    """The families of hard scenes of a task, by name."""
    families = scene_families(task.arm.dimension)
    return {name: family_sampler(task, name) for name, family in families.items() if family.hard}


def make(env_id: str, name: str, size: int | None = None, threads: int = 0) -> FrozenScenes:
    """Search for the scenes of a set, measure and certify them.

    Args:
        env_id: The environment they are for.
        name: `validation`, `test` or `hard`.
        size: Number of scenes N, a multiple of the bands or families; by default the set's.
        threads: Of the simulation, 0 for one per core; the result does not depend on it.

    Raises:
        RuntimeError: Scenes of some kind are too rare.
    """
    trial = Trial(env_id, threads=threads)
    size = size or (SIZES[name] if trial.task.scenes.n_obstacles[1] else WITHOUT_OBSTACLES)
    parts = lots(trial.task, name, size)
    found = [
        search(trial, lot.source, lot.kinds, seed=lot.seed, label=f"{env_id} {name} {lot.family}".strip())
        for lot in parts
    ]
    trial.close()
    order = np.arange(size).reshape(len(parts), -1).T.ravel()  # families in turn
    return FrozenScenes(
        name=name,
        env_id=env_id,
        scenes=Scenes(*(np.concatenate(f) for f in zip(*(part.scenes for part in found), strict=True))),
        share=np.concatenate([part.share for part in found]),
        solution=np.concatenate([part.solution for part in found]),
        family=np.repeat([lot.family for lot in parts], size // len(parts)),
        number=np.concatenate([part.number for part in found]),
    ).take(order)


def remake(frozen: FrozenScenes, threads: int = 0) -> FrozenScenes:
    """Draw the scenes of a set again by their numbers, measure them again, and try their solutions.

    Args:
        frozen: The set.
        threads: Of the simulation, 0 for one per core; the result does not depend on it.

    Raises:
        RuntimeError: A solution is none.
    """
    trial = Trial(frozen.env_id, threads=threads)
    starts, goals, obstacles, share = (array.copy() for array in (*frozen.scenes, frozen.share))
    for lot in lots(trial.task, frozen.name, len(frozen.share)):
        rows = np.flatnonzero(frozen.family == lot.family)
        scenes = redrawn(lot.source, frozen.number[rows])
        Scenes(starts, goals, obstacles).put(rows, scenes)
        label = f"{frozen.env_id} {frozen.name} {lot.family}".strip()
        share[rows] = measured(trial, scenes, lot.seed, label)
    again = dataclasses.replace(frozen, scenes=Scenes(starts, goals, obstacles), share=share)
    solved = trial(again.scenes, again.solution).success
    trial.close()
    if not solved.all():
        raise RuntimeError(
            f"{frozen.env_id} {frozen.name}: the solution of scene {int((~solved).argmax())} is none"
        )
    return again


def _source(
    sampler: Callable[[list[np.random.Generator]], Scenes],
    seed: int,
    *,
    block: int,
    levels: tuple[tuple[float, int], ...] = (),
) -> Source:
    generator = np.random.default_rng(seed)
    return Source(draw=lambda number: sampler([generator] * number), block=block, levels=levels)


def main() -> None:
    """Make the sets named on the command line, or all, and say whether they are as shipped."""
    parser = argparse.ArgumentParser(
        description="Make the frozen scenes again and compare their hashes with those shipped."
    )
    parser.add_argument("--env", nargs="+", default=list(SETS), choices=list(SETS), help="environment ids")
    parser.add_argument("--sets", nargs="+", default=list(SEEDS), choices=list(SEEDS), help="sets of scenes")
    parser.add_argument(
        "--search", action="store_true", help="choose scenes anew, as for a set not there yet"
    )
    parser.add_argument("--threads", type=int, default=0, help="of the simulation, 0 for one per core")
    add_arguments(parser)
    arguments = parser.parse_args()

    def each() -> Iterator[FrozenScenes]:
        for env_id in arguments.env:
            for name in (name for name in SETS[env_id] if name in arguments.sets):
                before = None if arguments.search else shipped(name, env_id)
                if before is None:
                    yield make(env_id, name, threads=arguments.threads)
                else:
                    yield remake(before, threads=arguments.threads)

    raise SystemExit(0 if compare_with_shipped(each(), arguments) else 1)


if __name__ == "__main__":
    main()
