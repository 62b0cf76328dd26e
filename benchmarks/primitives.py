"""Measure the speed of the primitives relative to SciPy's spline.

    OMP_NUM_THREADS=1 python benchmarks/primitives.py [--json FILE]

4,096 planar movements, 200 samples of position, velocity and acceleration each, double precision, one thread.
Every number is the best of several runs in this one process, in microseconds of processor time per movement.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import json
import time
import timeit
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viapoint.primitives import passage_durations, through

MOVEMENTS, SAMPLES, DIMENSION = 4096, 200, 2


@dataclass(frozen=True)
class Row:
    """Measured time with its reference."""

    name: str
    microseconds: float
    """Per movement."""
    measure: str
    value: float
    limit: float | None
    """Greatest allowed value."""

    @property
    def holds(self) -> bool:
        return self.limit is None or self.value <= self.limit


def best(function: Callable[[], Any], count: int, repeat: int = 5) -> float:
    """Return microseconds per movement, the best of `repeat` runs."""
    clock = time.process_time  # other work on the machine does not count
    loops = max(1, int(0.02 / max(timeit.timeit(function, number=1), 1e-6)))
    return min(timeit.repeat(function, timer=clock, number=loops, repeat=repeat)) / loops / count * 1e6


def scene(vias: int, count: int = MOVEMENTS) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(vias)
    return rng.uniform(-1, 1, (count, vias + 2, DIMENSION)), rng.uniform(0.5, 1.5, (count, vias + 1))


def scipy_spline(knots: np.ndarray, waypoints: np.ndarray, at: np.ndarray) -> list[np.ndarray]:
    """Evaluate SciPy's quintic spline with clamped ends through waypoints (K + 2, ...), three derivatives."""
    from scipy.interpolate import make_interp_spline

    rest = np.zeros(waypoints.shape[1:])
    ends = [(1, rest), (2, rest)]
    spline = make_interp_spline(knots, waypoints, k=5, bc_type=(ends, ends))
    return [spline(at, nu) for nu in range(3)]


def sampling_rows() -> list[Row]:
    """Measure solving and sampling, with separate and with shared knot times, against SciPy."""
    return [*_rows_of(1), *_rows_of(3)]


def _rows_of(vias: int) -> list[Row]:
    """Measure movements through `vias` via-points."""
    waypoints, durations = scene(vias)
    shared = durations[0]
    knots = np.concatenate([[0.0], np.cumsum(shared)])
    at = np.linspace(0, knots[-1], SAMPLES)
    together = np.moveaxis(waypoints, 1, 0)

    common = best(lambda: through(waypoints, shared).sample(at), MOVEMENTS)
    own = best(lambda: through(waypoints, durations).sample(SAMPLES), MOVEMENTS)
    one = best(lambda: through(waypoints[:1], durations[:1]).sample(SAMPLES), 1)
    batch = best(lambda: scipy_spline(knots, together, at), MOVEMENTS, 3)
    single = best(lambda: scipy_spline(knots, waypoints[0], at), 1)
    label = f"K={vias}"
    return [
        Row(f"{label} shared knots", common, "times SciPy's batch", common / batch, 1.0),
        Row(f"{label} own knots", own, "times SciPy, one call each", own / single, 1 / 15),
        Row(f"{label} batch of one", one, "times SciPy, one call", one / single, 2.0),
    ]


def passage_rows() -> list[Row]:
    rows = []
    for vias, limit in ((1, 1.0), (2, None), (3, 100.0), (5, None)):
        waypoints, _ = scene(vias)
        cost = best(lambda w=waypoints: passage_durations(w, 1.0), MOVEMENTS, 3)
        rows.append(Row(f"K={vias} free passage times", cost, "microseconds", cost, limit))
    return rows


def decision_row() -> Row:
    """Measure what a batch of one spends per decision: passage time, movement, 500 samples."""
    waypoints, _ = scene(1, 1)
    duration = np.ones(1)
    spent = best(lambda: through(waypoints, passage_durations(waypoints, duration)).sample(500), 1)
    return Row("K=1 batch of one, passage time + movement + 500 samples", spent, "microseconds", spent, 250.0)


def torch_rows() -> list[Row]:
    """Measure what training spends: 1,024 movements, 20 positions each, in single precision."""
    import torch

    torch.set_num_threads(1)
    count = 1024
    rows = []
    for vias in (1, 3):
        points = torch.tensor(scene(vias, count)[0], dtype=torch.float32, requires_grad=True)
        duration = torch.ones(count)

        def positions(points: Any = points, duration: Any = duration) -> Any:
            return through(points, passage_durations(points, duration)).sample(20, nu=0)[0]

        forward = best(positions, count)
        both = best(lambda f=positions: f().square().sum().backward(), count)
        limit = 2.0 if vias == 1 else None
        label = f"K={vias} torch float32, {count} movements, 20 positions"
        rows.append(Row(f"{label}, forward", forward, "milliseconds for all", forward * count / 1e3, limit))
        rows.append(Row(f"{label}, and backward", both, "milliseconds for all", both * count / 1e3, None))
    return rows


def main() -> None:
    """Print the table, and write it as JSON if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="file to write the numbers to")
    arguments = parser.parse_args()
    rows = [*sampling_rows(), *passage_rows(), decision_row(), *torch_rows()]
    print(f"{'':58} {'us each':>9}  {'':28} {'value':>7} {'limit':>7}")
    for row in rows:
        limit = "" if row.limit is None else f"{row.limit:7.3g}" + ("" if row.holds else "  MISSED")
        print(f"{row.name:58} {row.microseconds:9.2f}  {row.measure:28} {row.value:7.3g} {limit}")
    if arguments.json:
        arguments.json.write_text(json.dumps([{**asdict(row), "holds": row.holds} for row in rows], indent=2))


if __name__ == "__main__":
    main()
