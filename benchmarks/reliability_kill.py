"""Kill trainings at random moments, resume them, and compare them with uninterrupted trainings.

    python benchmarks/reliability_kill.py [--kills 50] [--seed 0] [--json FILE]

SIGKILL ends the process at a random moment, uniform over the time of a whole training from the first import on.
Checkpoints are frequent, so many kills happen during a write. A killed training is resumed, and may be killed again,
until it ends. Then its best and its last model, its learning curve and its last checkpoint, with optimisers, replay
buffer, random states and environment, must be bit-equal to those of the uninterrupted training.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import json
import signal
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from viapoint.training.configs import TrainConfig
from viapoint.training.files import UNFINISHED, read_arrays
from viapoint.training.runs import Run, read_state

ENV = "viapoint/PlanarObstacles-v0"
OFF_POLICY: dict[str, Any] = {
    "learning_starts": 32,
    "gradient_steps": 2,
    "batch_size": 16,
    "buffer_size": 400,
}
ALGORITHMS: dict[str, dict[str, Any]] = {
    "viaq": OFF_POLICY,
    "sac": OFF_POLICY,
    "ppo": {"n_steps": 2, "batch_size": 16, "n_epochs": 2},
}
CLOCK = ("seconds", "t")
"""Names of entries that hold real time."""
DECISIONS, COPIES, EVERY = 480, 16, 32


def config(folder: Path, algo: str, *, resume: bool = False) -> TrainConfig:
    """Return the configuration of a training of about two seconds with frequent writes."""
    return TrainConfig(
        env=ENV, algo=algo, out=folder, resume=resume, n_timesteps=DECISIONS, n_envs=COPIES,
        eval_every=2 * EVERY, eval_scenes=8, checkpoint_every=EVERY, env_kwargs={"threads": 1},
        hyperparameters=ALGORITHMS[algo], progress=False,
    )  # fmt: skip


def start(folder: Path, algo: str, log: Path) -> int:
    """Start a training in a new process with its output in the log, and return the process id."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        with log.open("a") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        from viapoint.training.trainer import train

        train(config(folder, algo, resume=(folder / "config.json").exists()))
        code = 0
    except BaseException as error:
        os.write(2, f"FAILED {type(error).__name__}: {error}\n".encode())
    finally:
        os._exit(code)


def kill_after(process: int, seconds: float) -> bool:
    """Kill a process after a time; return False if it has ended before, without an error."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            assert os.waitstatus_to_exitcode(status) == 0, "a training failed: see the log"
            return False
        time.sleep(0.001)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return True


def content(folder: Path) -> dict[str, Any]:
    """Return the results of a run without its times."""
    run = Run(folder)
    newest = run.checkpoints()[-1]
    arrays = {name: read_arrays(folder / name / "weights.safetensors") for name in ("best", "final")}
    return {
        "curve": without_times(run.curve),
        "checkpoint": newest.name,
        "state": repr(without_times(read_state(newest))),
        "arrays": arrays,
    }


def without_times(value: Any) -> Any:
    """Return nested values without entries of real time."""
    if isinstance(value, dict):
        return {name: without_times(each) for name, each in value.items() if name not in CLOCK}
    if isinstance(value, list | tuple):
        return [without_times(each) for each in value]
    return value.numpy().tobytes() if isinstance(value, torch.Tensor) else value


def differences(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return the names of entries that differ between two runs."""
    found = [name for name in ("curve", "state", "checkpoint") if one[name] != other[name]]
    for group, arrays in one["arrays"].items():
        theirs = other["arrays"][group]
        found += sorted(set(arrays) ^ set(theirs))
        found += [name for name in set(arrays) & set(theirs) if not _same(arrays[name], theirs[name])]
    return found


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.shape == other.shape and one.dtype == other.dtype and one.tobytes() == other.tobytes()


def killed_during_write(folder: Path) -> bool:
    """Return whether a kill left an unfinished file or folder."""
    return any(UNFINISHED.fullmatch(path.name) for path in folder.rglob(".*"))


def experiment(algo: str, kills: int, generator: np.random.Generator, base: Path) -> dict[str, Any]:
    """Run and kill trainings of one algorithm until there are at least `kills` kills."""
    log, began = base / f"{algo}.log", time.monotonic()
    assert not kill_after(start(base / f"{algo}-whole", algo, log), 1e6)
    seconds = time.monotonic() - began
    whole = content(base / f"{algo}-whole")
    result = {"kills": 0, "amid a write": 0, "before the run existed": 0, "runs": 0, "differing": []}
    while result["kills"] < kills:
        folder = base / f"{algo}-{result['runs']}"
        while kill_after(start(folder, algo, log), generator.uniform(0.0, seconds)):
            result["kills"] += 1
            result["amid a write"] += killed_during_write(folder)
            result["before the run existed"] += not (folder / "config.json").exists()
        result["runs"] += 1
        result["differing"] += differences(whole, content(folder))
    result["checkpoints passed over"] = log.read_text().count("passed over a damaged checkpoint")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    import viapoint.training.trainer  # noqa: F401 - once, and not in every process

    generator, results = np.random.default_rng(arguments.seed), {}
    with tempfile.TemporaryDirectory() as base:
        for index, algo in enumerate(ALGORITHMS):
            share = (arguments.kills * (index + 1)) // len(ALGORITHMS) - (arguments.kills * index) // len(
                ALGORITHMS
            )
            results[algo] = experiment(algo, share, generator, Path(base))
            print(algo, json.dumps(results[algo]), flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=1))
    raise SystemExit(any(result["differing"] for result in results.values()))


if __name__ == "__main__":
    main()
