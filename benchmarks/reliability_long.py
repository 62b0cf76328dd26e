"""Measure whether memory and speed are constant over a million decisions and ten thousand environments.

    python benchmarks/reliability_long.py decisions --json decisions.json   # about half an hour of one core
    python benchmarks/reliability_long.py cycles    --json cycles.json      # about a quarter of an hour
    python benchmarks/reliability_long.py picture decisions.json cycles.json --out docs/images/reliability_memory.png

Memory is the resident set of this process without free blocks of its allocator. Speed is decisions per second of
processor time, which other processes do not influence. Both are read from /proc, so this runs on Linux only.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import ctypes
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import viapoint.envs
from viapoint.envs.rendering import renderer

MEGABYTE = 1 << 20
LEAST = 10
"""Least number of points for a result."""
SAMPLES = 200
"""Number of points of a curve."""
WARM = 0.1
"""Fraction of a run in which caches fill, left out of the slope."""
ALLOWED = 8.0
"""Allowed growth of memory after the warm-up, [MB]."""
RENDERED = 5
"""Interval of rendered environments: a software context takes half a second."""
SLOWER = 0.1
"""Allowed loss of speed from the first fifth to the last."""


def memory() -> float:
    """Return the resident memory of this process without free blocks of its allocator, [MB]."""
    getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: 0)(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / MEGABYTE


def state() -> dict[str, float]:
    """Return memory [MB], open files and threads of this process."""
    return {
        "memory": memory(),
        "files": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
    }


def decisions(env_id: str, number: int, num_envs: int = 500) -> Iterator[dict[str, Any]]:
    """Run random decisions in the vector environment and yield intermediate results."""
    env = gym.make_vec(env_id, num_envs=num_envs, threads=1)
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    every = max(1, number // num_envs // SAMPLES)
    curve, began = [], time.process_time()
    for step in range(number // num_envs + 1):
        if step % every == 0:
            curve.append({"count": step * num_envs, "seconds": time.process_time() - began, **state()})
            if len(curve) > LEAST:
                yield {
                    **speeds(curve),
                    "what": f"decisions in {env_id}, {num_envs} at a time",
                    **growth(curve),
                }
        _, reward, *_ = env.step(generator.uniform(-1.0, 1.0, env.action_space.shape))
        assert np.isfinite(reward).all()
    env.close()


def speeds(curve: list[dict[str, float]]) -> dict[str, float]:
    """Return the speed in the first fifth and in the last, [1/s of processor time]."""
    rate = np.diff([point["count"] for point in curve]) / np.diff([point["seconds"] for point in curve])
    fifth = len(rate) // 5
    return {"first_speed": float(np.median(rate[:fifth])), "last_speed": float(np.median(rate[-fifth:]))}


def cycles(number: int, size: int = 64) -> Iterator[dict[str, Any]]:
    """Create, use and close environments of every id; every fifth is rendered, every fifth is a vector."""
    what = f"environments made, used and closed, one in {RENDERED} rendered"
    renderer.STILL_SUPERSAMPLING = 1  # contexts could leak, the size of a picture does not matter
    ids, curve, began = sorted(viapoint.envs.TASKS), [], time.process_time()
    every = max(1, number // SAMPLES)
    for cycle in range(number + 1):
        if cycle % every == 0:
            curve.append({"count": cycle, "seconds": time.process_time() - began, **state()})
            if len(curve) > LEAST:
                yield {"what": what, **growth(curve)}
        env_id, turn = ids[cycle % len(ids)], cycle // len(ids) % RENDERED
        kwargs = {"render_mode": "rgb_array", "width": size, "height": size, "threads": 2}
        env = gym.make_vec(env_id, num_envs=3, **kwargs) if turn == 1 else gym.make(env_id, **kwargs)
        env.reset(seed=cycle)
        env.step(env.action_space.sample())
        if turn == 0:
            assert np.ptp(env.render()) > 0
        env.close()


def growth(curve: list[dict[str, float]]) -> dict[str, Any]:
    """Return the curve and the growth after the warm-up by linear regression."""
    kept = curve[int(WARM * len(curve)) :]
    count = [point["count"] for point in kept]
    slope = np.polyfit(count, [point["memory"] for point in kept], 1)[0]
    return {
        "curve": curve,
        "memory_growth": slope * (count[-1] - count[0]),
        "files_growth": kept[-1]["files"] - kept[0]["files"],
        "threads_growth": kept[-1]["threads"] - kept[0]["threads"],
    }


def verdict(result: dict[str, Any]) -> bool:
    """Print the numbers and return whether they are within the limits."""
    count, growth = result["curve"][-1]["count"], result["memory_growth"]
    print(f"{count:,} {result['what']}")
    print(f"  memory {result['curve'][0]['memory']:.1f} MB at the start, {growth:+.2f} MB after the warm-up")
    print(f"  open files {result['files_growth']:+.0f}, threads {result['threads_growth']:+.0f}")
    flat = growth < ALLOWED and not result["files_growth"] > 0 and not result["threads_growth"] > 0
    if "first_speed" not in result:
        return bool(flat)
    ratio = result["last_speed"] / result["first_speed"]
    print(
        f"  {result['first_speed']:.0f} a second of processor time at first, {result['last_speed']:.0f} at last"
    )
    return bool(flat and ratio > 1.0 - SLOWER)


def picture(results: list[dict[str, Any]], path: Path) -> None:
    """Draw memory over the number of decisions or environments."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(results), 2.6), dpi=80, layout="constrained")
    for axes, result in zip(np.atleast_1d(figure.subplots(1, len(results))), results, strict=True):
        count = np.array([point["count"] for point in result["curve"]])
        axes.plot(count, [point["memory"] for point in result["curve"]], color="#2a6f97", linewidth=1.4)
        axes.set(ylim=(0, None), ylabel="resident memory [MB]", xlabel=result["what"].partition(",")[0])
        axes.set_title(f"{result['memory_growth']:+.1f} MB after the first tenth", fontsize=9)
        axes.locator_params(axis="x", nbins=4)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("part", choices=("decisions", "cycles", "picture"))
    parser.add_argument("results", nargs="*", type=Path, help="JSON files for the picture")
    parser.add_argument("--env", default="viapoint/PlanarObstacles-v0")
    parser.add_argument(
        "--number", type=int, help="decisions or cycles; a million and ten thousand by default"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/images/reliability_memory.png"))
    arguments = parser.parse_args()
    if arguments.part == "picture":
        picture([json.loads(path.read_text()) for path in arguments.results], arguments.out)
        return
    if arguments.part == "decisions":
        results = decisions(arguments.env, arguments.number or 1_000_000)
    else:
        results = cycles(arguments.number or 10_000)
    result: dict[str, Any] = {}
    for result in results:
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(result, indent=1))
    raise SystemExit(0 if verdict(result) else 1)


if __name__ == "__main__":
    main()
