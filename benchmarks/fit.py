"""Errors of fitted via-points against noise: `python benchmarks/fit.py` writes the table of docs/fit.md.

It also writes docs/reach.csv, two movements that are made up, as if they had been recorded.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from viapoint.primitives import ViaPointFit, fit_via_points, passage_durations, through

PAGE = Path(__file__).parents[1] / "docs" / "fit.md"
RECORDED = PAGE.with_name("reach.csv")
BEGIN, END = "<!-- table -->", "<!-- end of table -->"
NOISE = (0.5, 1.0, 2.0, 5.0)
"""Standard deviations of the noise of a coordinate, [mm]."""
DRAWS = 100
SECONDS: dict[int | None, list[float]] = {}
"""Processor times of all fits by the number of via-points that was given, [s]."""
RATE = 100.0
"""Samples per second, [Hz]."""
REST = 0.2
"""Time at rest before and after the movement, where its ends are fitted, [s]."""


def drawn(n_via: int, seed: int) -> tuple[Any, Any]:
    """Return waypoints and durations of a movement of 1 s over 0.3 m, with passage times near those of least jerk."""
    rng = np.random.default_rng((n_via, seed))
    along = (np.arange(n_via) + rng.uniform(0.7, 1.3, n_via)) / (n_via + 1)
    side = rng.choice([-1.0, 1.0]) * (-1.0) ** np.arange(n_via)
    vias = np.stack([0.3 * along, side * rng.uniform(0.05, 0.15, n_via)], axis=-1)
    waypoints = np.concatenate([[[0.0, 0.0]], vias, [[0.3, 0.0]]])
    durations = passage_durations(waypoints, 1.0) * rng.uniform(0.9, 1.1, n_via + 1)
    return waypoints, durations / durations.sum()


def worst_of_a_walk(seed: int) -> float:
    """Return the greatest error of three via-points of a random walk, recorded without rest, noise 1 mm, [mm]."""
    rng = np.random.default_rng(seed)
    waypoints = np.cumsum(rng.normal(0.0, 0.12, (5, 2)), axis=0)
    times = np.linspace(0.0, 1.0, 150)
    position = through(waypoints, passage_durations(waypoints, 1.0))(times) + rng.normal(0.0, 1e-3, (150, 2))
    fit = fit_via_points(times, position, 3)
    return float(1e3 * np.linalg.norm(fit.via_points - waypoints[1:-1], axis=-1).max())


def fitted(n_via: int, seed: int, noise: float, free_ends: bool, given: int | None) -> ViaPointFit:
    """Return the fit of one draw, and note its time."""
    times = np.arange(-REST * free_ends, 1.0 + REST * free_ends + 1e-9, 1.0 / RATE)
    errors = np.random.default_rng(seed).normal(0.0, 1e-3 * noise, (len(times), 2))
    position = through(*drawn(n_via, seed))(times) + errors
    begin = time.process_time()
    fit = fit_via_points(times, position, given, free_ends=free_ends)
    SECONDS.setdefault(given, []).append(time.process_time() - begin)
    return fit


def row(noise: float, free_ends: bool) -> dict[str, str]:
    """Return one line of the table: medians over the draws, and how often the number of via-points is right."""
    cells = {"noise": f"{noise} mm", "onset and end": "fitted" if free_ends else "given"}
    for n_via, name in ((1, "one via-point"), (2, "two via-points"), (3, "three via-points")):
        places, passages = [], []
        for seed in range(DRAWS):
            waypoints, durations = drawn(n_via, seed)
            fit = fitted(n_via, seed, noise, free_ends, n_via)
            places.append(np.linalg.norm(fit.via_points - waypoints[1:-1], axis=-1).mean())
            passages.append(np.abs(fit.passage_times - np.cumsum(durations)[:-1]).mean())
        cells[name] = f"{1e3 * np.median(places):.1f} mm, {1e3 * np.median(passages):.1f} ms"
    for n_via in (0, 1, 2, 3):
        right = [int(fitted(n_via, seed, noise, free_ends, None).n_via) == n_via for seed in range(DRAWS)]
        cells[f"{n_via} found"] = f"{100.0 * np.mean(right):.0f} %"
    print(cells, flush=True)
    return cells


def write_recorded() -> None:
    """Write movements with rest before and after them, at 50 Hz, with noise of 0.5 mm."""
    movements = {
        "around": through([[-0.1, 0.3], [0.12, 0.45], [0.25, 0.3]], [0.6, 0.45]),
        "two turns": through([[-0.1, 0.3], [0.1, 0.42], [0.22, 0.25], [0.3, 0.35]], [0.55, 0.4, 0.3]),
    }
    rng = np.random.default_rng(0)
    parts = []
    for name, movement in movements.items():
        times = np.arange(0.0, movement.duration + 2.0 * REST, 0.02)
        position = movement(times - REST) + rng.normal(0.0, 5e-4, (len(times), 2))
        columns = {"movement": name, "time": times.round(3), "x": position[:, 0], "y": position[:, 1]}
        parts.append(pd.DataFrame(columns))
    pd.concat(parts).to_csv(RECORDED, index=False, float_format="%.5f")


def main() -> None:
    """Measure, and write the table into the page."""
    write_recorded()
    rows = [row(noise, free_ends) for free_ends in (False, True) for noise in NOISE]
    table = pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True)
    one, chosen = (1e3 * np.median(SECONDS[given]) for given in (1, None))
    walks = [worst_of_a_walk(seed) for seed in range(DRAWS)]
    notes = (
        f"One via-point takes {one:.0f} ms; the choice among 0 to 3 takes {chosen:.0f} ms (medians, one core).\n"
        "Of three via-points of a random walk, recorded without rest and with noise of 1 mm, the worst errs by "
        f"{np.median(walks):.0f} mm (median), in {np.mean(np.greater(walks, 20.0)):.0%} by more than 20 mm."
    )
    before, _, after = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = after.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n\n{notes}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
