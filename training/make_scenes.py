"""Makes the frozen scenes again: `python -m viapoint.training.make_scenes`.

`validation` and `test` are drawn from the training distribution with seeds that training never uses, a quarter of each
set in each band of the solution share. `hard` holds scenes of families that are never trained on, as many of each, all
with a share below 5 %. Every scene was solved in simulation by some of at most 4,096 random actions, so that its
difficulty is known, and by the planner.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.scene_families import FAMILIES, family_sampler
from viapoint.envs.scenes import Scenes
from viapoint.training.frozen_scenes import BAND_EDGES, BANDS, FrozenScenes, bands, shipped_path
from viapoint.training.scene_search import Found, Kinds, Source, search
from viapoint.training.trial import Trial

Float = NDArray[np.float64]

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
}
"""Environments with shipped scenes, and their sets."""


def make(env_id: str, name: str, size: int | None = None, threads: int = 0) -> FrozenScenes:
    """Draw, measure and certify a set of scenes.

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
    names = list(FAMILIES) if name == "hard" else [""]
    parts = [
        of_family(trial, family, size // len(names)) if family else _drawn(trial, name, size)
        for family in names
    ]
    trial.close()
    order = np.arange(size).reshape(len(names), -1).T.ravel()  # families in turn
    return FrozenScenes(
        name=name,
        env_id=env_id,
        scenes=Scenes(*(np.concatenate(f) for f in zip(*(part.scenes for part in parts), strict=True))),
        share=np.concatenate([part.share for part in parts]),
        solution=np.concatenate([part.solution for part in parts]),
        family=np.repeat(names, size // len(names)),
    ).take(order)


def _drawn(trial: Trial, name: str, size: int) -> Found:
    """Scenes of the training distribution, as many in each band."""
    seed, task = SEEDS[name], trial.task
    if task.scenes.n_obstacles[1] == 0:
        source = _source(task.sampler(), seed, block=size)
        kinds = Kinds(of_share=lambda share: np.zeros(len(share), np.int64), names=("any",), quota=size)
    else:
        rare = not task.whole_arm  # few scenes are hard where the hand alone must clear
        source = _source(
            task.sampler(),
            seed,
            block=2048 if rare else 512,
            levels=((0.03, 2048), (0.013, 16384)) if rare else ((0.03, 1024),),
        )
        kinds = Kinds(of_share=bands, names=BANDS, quota=size // len(BANDS))
    return search(trial, source, kinds, seed=seed, label=f"{trial.env_id} {name}")


def of_family(trial: Trial, family: str, size: int) -> Found:
    """Hard scenes of one family."""
    seed = SEEDS["hard"] + 101 * list(FAMILIES).index(family)
    kinds = Kinds(of_share=lambda share: np.where(share < HARDEST, 0, -1), names=("share < 5 %",), quota=size)
    source = _source(family_sampler(trial.task, family), seed, block=64)
    return search(trial, source, kinds, seed=seed, label=f"{trial.env_id} hard, {family}")


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
    """Make the sets named on the command line, or all, and say whether they are as they were."""
    parser = argparse.ArgumentParser(
        description="Make the frozen scenes and compare their hashes with those shipped."
    )
    parser.add_argument("--env", nargs="*", default=list(SETS), choices=list(SETS), help="environment ids")
    parser.add_argument("--sets", nargs="*", default=list(SEEDS), choices=list(SEEDS), help="sets of scenes")
    parser.add_argument("--out", type=Path, default=None, help="folder to write to instead of the package's")
    parser.add_argument("--threads", type=int, default=0, help="of the simulation, 0 for one per core")
    arguments = parser.parse_args()
    for env_id in arguments.env:
        for name in (name for name in SETS[env_id] if name in arguments.sets):
            frozen, shipped = make(env_id, name, threads=arguments.threads), shipped_path(name, env_id)
            before = "new" if not shipped.exists() else _sha256(shipped)
            path = shipped if arguments.out is None else arguments.out / shipped.name
            path.parent.mkdir(parents=True, exist_ok=True)
            frozen.save(path)
            counts = ", ".join(f"{label}: {(frozen.band == i).sum()}" for i, label in enumerate(BANDS))
            verdict = "unchanged" if before == frozen.sha256 else f"was {before}"
            print(
                f"{path.name}: {len(frozen.share)} scenes ({counts}) sha256 {frozen.sha256} ({verdict})",
                flush=True,
            )


def _sha256(path: Path) -> str:
    with np.load(path, allow_pickle=False) as archive:
        return str(archive["sha256"])


if __name__ == "__main__":
    main()
