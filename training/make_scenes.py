"""Makes the frozen scenes again: `python -m viapoint.training.make_scenes`.

The sets are drawn from the training distribution with seeds that training never uses, a quarter of each set in each
band of the solution share as far as the bands occur. Every scene is certified: the planner solved it in simulation.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from viapoint.envs.scenes import Scenes
from viapoint.training.difficulty import planned_share, solution_share
from viapoint.training.frozen_scenes import BANDS, FrozenScenes, bands, shipped_path
from viapoint.training.planner import Planner
from viapoint.training.trial import Trial

SEEDS = {"validation": 1_000_003, "test": 2_000_003}
"""First seeds of the sets; training draws from seeds below a million."""
SIZES = {"validation": 500, "test": 1000}
WITHOUT_OBSTACLES = 100
"""Scenes of a set with nothing in the way."""
ENV_IDS = ("viapoint/PlanarReach-v0", "viapoint/PlanarObstacles-v0")
"""Environments with shipped scenes."""
DRAWN_AT_ONCE = 2048
MOST_DRAWN = 64 * DRAWN_AT_ONCE
SPARE, SAFE = 1.2, 1.1
"""How many more scenes than needed are taken by the estimated share, and what it is multiplied by, as it errs."""


def make(env_id: str, name: str, size: int | None = None) -> FrozenScenes:
    """Draw, measure and certify a set of scenes.

    Args:
        env_id: The environment they are for.
        name: `validation` or `test`.
        size: Number of scenes N; by default the set's.
    """
    trial = Trial(env_id)
    size = size or (SIZES[name] if trial.task.scenes.n_obstacles[1] else WITHOUT_OBSTACLES)
    drawn = _draw(trial, np.random.default_rng(SEEDS[name]), size)
    pieces = []
    for i in tqdm(
        range(0, len(drawn.start), 64), desc=f"{env_id} {name}", unit="x64 scenes", file=sys.stderr
    ):
        scenes = drawn.take(slice(i, i + 64))
        share, planned = solution_share(trial, scenes, seed=SEEDS[name]), Planner(trial)(scenes)
        solved = planned.success & (share > 0.0)
        pieces.append((scenes.take(solved), share[solved], planned.action[solved]))
    trial.close()
    scenes = Scenes(*(np.concatenate(fields) for fields in zip(*(piece[0] for piece in pieces), strict=True)))
    share, solution = (np.concatenate([piece[k] for piece in pieces]) for k in (1, 2))
    frozen = FrozenScenes(name=name, env_id=env_id, scenes=scenes, share=share, solution=solution)
    return frozen.take(np.sort(_balanced(share, size)))


def _draw(trial: Trial, generator: np.random.Generator, size: int) -> Scenes:
    """Scenes in about equal numbers in each band of the estimated share, a few more than needed."""
    sampler, wanted = trial.task.sampler(), int(SPARE * size)
    if trial.task.scenes.n_obstacles[1] == 0:
        return sampler([generator] * size)
    drawn, estimates = [], []
    for _ in range(MOST_DRAWN // DRAWN_AT_ONCE):
        drawn.append(sampler([generator] * DRAWN_AT_ONCE))
        estimates.append(SAFE * _estimate(trial, drawn[-1]))
        count = np.bincount(bands(np.concatenate(estimates)), minlength=len(BANDS))
        if (count >= wanted / len(BANDS)).all():
            break
    together = Scenes(*(np.concatenate(fields) for fields in zip(*drawn, strict=True)))
    return together.take(_balanced(np.concatenate(estimates), wanted))


def _estimate(trial: Trial, scenes: Scenes) -> NDArray[np.float64]:
    """Planned shares, more exact where they are small, shape (N,)."""
    share = planned_share(trial, scenes, draws=256)
    for below, draws in ((0.03, 2048), (0.013, 16384)):
        for row in np.flatnonzero(share < below):
            share[row] = planned_share(trial, scenes.take([row]), seed=draws, draws=draws)[0]
    return share


def _balanced(share: NDArray[np.float64], size: int) -> NDArray[np.int64]:
    """Indices of `size` scenes, the first ones of each band in equal numbers, short bands made up for by the others."""
    band = bands(share)
    rank = np.empty(len(share), dtype=np.int64)
    for index in range(len(BANDS)):
        rank[band == index] = np.arange((band == index).sum())
    return np.lexsort((-band, rank))[:size]


def main() -> None:
    """Make the sets named on the command line, or all, and say whether they are as they were."""
    parser = argparse.ArgumentParser(
        description="Make the frozen scenes and compare their hashes with those shipped."
    )
    parser.add_argument("--env", nargs="*", default=list(ENV_IDS), help="environment ids")
    parser.add_argument("--sets", nargs="*", default=list(SEEDS), choices=list(SEEDS), help="sets of scenes")
    parser.add_argument("--out", type=Path, default=None, help="folder to write to instead of the package's")
    arguments = parser.parse_args()
    for env_id in arguments.env:
        for name in arguments.sets:
            frozen, shipped = make(env_id, name), shipped_path(name, env_id)
            path = shipped if arguments.out is None else arguments.out / shipped.name
            path.parent.mkdir(parents=True, exist_ok=True)
            before = "new" if not path.exists() else _sha256(path)
            frozen.save(path)
            counts = ", ".join(f"{label}: {(frozen.band == i).sum()}" for i, label in enumerate(BANDS))
            verdict = "unchanged" if before == frozen.sha256 else f"was {before}"
            print(f"{path.name}: {len(frozen.share)} scenes ({counts}) sha256 {frozen.sha256} ({verdict})")


def _sha256(path: Path) -> str:
    with np.load(path, allow_pickle=False) as archive:
        return str(archive["sha256"])


if __name__ == "__main__":
    main()
