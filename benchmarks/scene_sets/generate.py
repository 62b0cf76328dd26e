"""Command that makes the frozen scenes again and compares them with those shipped.

    PYTHONPATH=benchmarks python -m scene_sets.generate [--env ID ...] [--sets test ...] [--write | --out DIR]

`validation` and `test` are drawn from the training distribution with seeds that training never uses, a quarter of each
set in each band of the solution share. `hard` holds equal numbers of scenes of several families, all with a share below
5 %. No agent in the plane is trained on these families; in space they are the narrow ones, of which `tunnel` is never
trained on. Every scene was solved in simulation by at least one of at most 4,096 random actions, which gives its
difficulty, and by the planner. `uniform` holds scenes in which nothing is placed about a feasible path
(:class:`~viapoint.envs.scenes.sampler.UniformSampler`): the first ones that have a solution. Their shares are not
measured.

The search for scenes uses estimates of their shares, which change with the program. Each scene of a file therefore has
its number among the drawn scenes. The command draws these scenes again, measures their shares, and compares hashes.
Scenes that change during an episode: see :mod:`scene_sets.replanning`.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scene_sets.replanning import SIZES as REPLANNING_SIZES
from scene_sets.replanning import make_replanning
from scene_sets.scene_search import (
    Kinds,
    Source,
    first_solved,
    measured,
    redrawn,
    search,
)
from viapoint.envs.geometry.rows import CAPSULES
from viapoint.envs.mdp.task import Task, family_sampler
from viapoint.envs.registration import REPLANNING_TASKS
from viapoint.envs.scenes.families import scene_families
from viapoint.envs.scenes.sampler import SceneSampler, UniformSampler
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets.scene_set import (
    BAND_EDGES,
    BANDS,
    DRAWN,
    FrozenScenes,
    bands,
    load,
    shipped_path,
)

SEEDS = {"validation": 1_000_003, "test": 2_000_003, "hard": 3_000_017, "uniform": 4_000_037}
"""First seeds of the sets; training draws from seeds below a million."""
SIZES = {"validation": 500, "test": 1000, "uniform": 500}
OF_FAMILY = 100
"""Number of hard scenes of each family."""
WITHOUT_OBSTACLES = 100
"""Number of scenes of a set without obstacles."""
HARDEST = BAND_EDGES[1]
"""Upper limit of the shares of hard scenes."""
ALL = ("validation", "test", "hard", "uniform")
SETS = {
    "viapoint/PlanarReach-v0": ALL[:2],
    "viapoint/PlanarObstacles-v0": ALL,
    "viapoint/PlanarWholeArm-v0": ALL,
    "viapoint/PandaReach-v0": ALL[:2],
    "viapoint/PandaObstacles-v0": ALL,
}
"""Environments without replanning that have shipped scenes, and their sets."""
ALL_SETS = {**SETS, **dict.fromkeys(REPLANNING_TASKS, ALL[:2])}
"""All environments that have shipped scenes, and their sets."""


class Lot(NamedTuple):
    """Scenes of a set that come from one source."""

    family: str
    source: Source
    kinds: Kinds
    seed: int


def lots(task: Task, name: str, size: int) -> list[Lot]:
    """Return the sources of the scenes of a set.

    Args:
        task: Task of the scenes.
        name: `validation`, `test`, `hard` or `uniform`.
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
    any_ = Kinds(of_share=lambda share: np.zeros(len(share), np.int64), names=("any",), quota=size)
    if name == "uniform":
        sampler = UniformSampler(task.collision_model, task.scenes)
        return [Lot(DRAWN, _source(sampler, seed, block=64), any_, seed)]
    if task.scenes.n_obstacles[1] == 0:
        return [Lot(DRAWN, _source(task.sampler(), seed, block=WITHOUT_OBSTACLES), any_, seed)]
    rare = not task.whole_arm  # few scenes are hard where the hand alone must clear
    levels = ((0.03, 2048), (0.013, 16384)) if rare else ((0.03, 1024),)
    source = _source(task.sampler(), seed, block=2048 if rare else 512, levels=levels)
    return [Lot(DRAWN, source, Kinds(of_share=bands, names=BANDS, quota=size // len(BANDS)), seed)]


def hard_families(task: Task) -> dict[str, SceneSampler]:
    """Return samplers of the families of hard scenes of a task, by name."""
    families, known = scene_families(task.arm.dimension).items(), {*task.scenes.shapes, *CAPSULES}
    return {
        name: family_sampler(task, name)
        for name, family in families
        if family.hard and set(family.shapes) <= known
    }


def size_of(task: Task, name: str) -> int:
    """Return the number of scenes of a set."""
    if name == "hard":
        return OF_FAMILY * len(hard_families(task))
    return SIZES[name] if task.scenes.n_obstacles[1] else WITHOUT_OBSTACLES


def make(env_id: str, name: str, size: int | None = None, threads: int = 0) -> FrozenScenes:
    """Search for the scenes of a set, measure and certify them.

    Args:
        env_id: Environment of the scenes.
        name: `validation`, `test`, `hard` or `uniform`.
        size: Number of scenes N, a multiple of the bands or families; by default the set's.
        threads: Of the simulation, 0 for one per core; the result does not depend on it.

    Raises:
        RuntimeError: Scenes of some kind are too rare.
    """
    simulation = SceneSimulation(env_id, threads=threads)
    size = size or size_of(simulation.task, name)
    parts = lots(simulation.task, name, size)
    found = []
    for lot in parts:
        label = f"{env_id} {name} {lot.family}".strip()
        if name == "uniform":
            found.append(first_solved(simulation, lot.source, size, label))
        else:
            found.append(search(simulation, lot.source, lot.kinds, seed=lot.seed, label=label))
    simulation.close()
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
        RuntimeError: A stored solution fails.
    """
    simulation = SceneSimulation(frozen.env_id, threads=threads)
    starts, goals, obstacles, share = (array.copy() for array in (*frozen.scenes, frozen.share))
    for lot in lots(simulation.task, frozen.name, len(frozen.share)):
        rows = np.flatnonzero(frozen.family == lot.family)
        scenes = redrawn(lot.source, frozen.number[rows])
        Scenes(starts, goals, obstacles).put(rows, scenes)
        label = f"{frozen.env_id} {frozen.name} {lot.family}".strip()
        if not np.isnan(share[rows]).all():
            share[rows] = measured(simulation, scenes, lot.seed, label)
    again = dataclasses.replace(frozen, scenes=Scenes(starts, goals, obstacles), share=share)
    solved = simulation(again.scenes, again.solution).success
    simulation.close()
    if not solved.all():
        raise RuntimeError(
            f"{frozen.env_id} {frozen.name}: the solution of scene {int((~solved).argmax())} fails"
        )
    return again


def _source(
    sampler: Callable[[list[np.random.Generator]], Scenes],
    seed: int,
    *,
    block: int,
    levels: tuple[tuple[float, int], ...] = (),
) -> Source:
    """Return a source whose scenes all come from one generator."""
    generator = np.random.default_rng(seed)
    return Source(draw=lambda number: sampler([generator] * number), block=block, levels=levels)


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where to write; by default, nothing is written."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--write", action="store_true", help="replace the shipped files")
    where.add_argument("--out", type=Path, help="folder to write to")


def shipped(name: str, env_id: str) -> FrozenScenes | None:
    """Return a set as it is shipped; None if there is none yet."""
    return load(name, env_id) if shipped_path(name, env_id).is_file() else None


def compare_with_shipped(sets: Iterable[FrozenScenes], arguments: argparse.Namespace) -> bool:
    """Print each set's hash as soon as it is made, write it if asked to, and return True if all are as shipped."""
    same = True
    for frozen in sets:
        before, path = shipped(frozen.name, frozen.env_id), shipped_path(frozen.name, frozen.env_id)
        if arguments.out is not None:
            arguments.out.mkdir(parents=True, exist_ok=True)
            frozen.save(arguments.out / path.name)
        elif arguments.write:
            frozen.save(path)
        print(
            f"{path.name}: {_bands(frozen)}, sha256 {frozen.sha256}: {_verdict(before, frozen)}", flush=True
        )
        same &= before is not None and before.sha256 == frozen.sha256
    return same


def _bands(frozen: FrozenScenes) -> str:
    """Return the number of scenes in each band as text."""
    if np.isnan(frozen.share).all():
        return f"{len(frozen.share)} scenes"
    counts = ", ".join(f"{label}: {int(np.sum(frozen.band == i))}" for i, label in enumerate(BANDS))
    return f"{len(frozen.share)} scenes ({counts})"


def _verdict(before: FrozenScenes | None, frozen: FrozenScenes) -> str:
    """Return the result of the comparison as text."""
    if before is None:
        return "new"
    return "as shipped" if before.sha256 == frozen.sha256 else f"DIFFERENT, shipped is {before.sha256}"


def main() -> None:
    """Make the sets named on the command line, or all, and tell by the exit status whether they are as shipped."""
    parser = argparse.ArgumentParser(
        description="Make the frozen scenes again and compare their hashes with those shipped."
    )
    parser.add_argument(
        "--env", nargs="+", default=list(ALL_SETS), choices=list(ALL_SETS), help="environment ids"
    )
    parser.add_argument("--sets", nargs="+", default=list(SEEDS), choices=list(SEEDS), help="sets of scenes")
    parser.add_argument(
        "--search", action="store_true", help="choose scenes anew, as for a set not there yet"
    )
    parser.add_argument("--threads", type=int, default=0, help="of the simulation, 0 for one per core")
    _add_arguments(parser)
    arguments = parser.parse_args()
    made = (
        _made(env_id, name, search_anew=arguments.search, threads=arguments.threads)
        for env_id in arguments.env
        for name in ALL_SETS[env_id]
        if name in arguments.sets
    )
    raise SystemExit(0 if compare_with_shipped(made, arguments) else 1)


def _made(env_id: str, name: str, *, search_anew: bool, threads: int) -> FrozenScenes:
    """Return a set: searched anew, or drawn again by the numbers of its scenes."""
    if env_id in REPLANNING_TASKS:
        return make_replanning(env_id, name, REPLANNING_SIZES[name])
    before = None if search_anew else shipped(name, env_id)
    return make(env_id, name, threads=threads) if before is None else remake(before, threads=threads)


if __name__ == "__main__":
    main()
