"""The settings that were tried for the standard algorithms: each trained once, each measured on validation scenes.

    OMP_NUM_THREADS=1 python benchmarks/tuning.py --out tuning.jsonl [NAME ...]

Nothing here looks at the test scenes. A line of the output is one setting; a name that is in the file already is not
tried again. Without names all of them are tried, one after the other, which takes hours.

What was measured once, seed 0, on the 500 validation scenes of PlanarObstacles-v0 (processor time on a busy machine):

    name      decisions   success   > 20 %   5-20 %   1-5 %   < 1 %   jerk ratio   processor minutes
    sac          20,000    23.8 %     66.4     26.4     2.4     0.0        14.92   1.9
    sac-set      20,000    42.4 %     93.6     54.4    17.6     4.0         5.55   2.8
    ppo-set     200,000    32.0 %     74.4     34.4    13.6     5.6        19.33   7.8

So all presets have the set encoder.

In the step-wise twin with nothing in the way (n_obstacles=0, 128 drawn scenes, 8 updates a step, seed 0), SAC whose
entropy coefficient began at 1 had no success after 20,000 control steps. Begun at 0.02 it had 70 % after 12,000 and
62 to 73 % up to 30,000. So SAC and TQC begin there. The other settings are there to be tried.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is loaded

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from viapoint.training.algorithms.model_io import build
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.planners.baselines import agent_method
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.trainer import one_thread
from viapoint.training.scene_sets.scene_set import load

ENV_ID, STEP_ID = "viapoint/PlanarObstacles-v0", "viapoint/PlanarObstaclesStep-v0"
SET = {"features_extractor_class": {"kind": "extractor", "name": "SceneExtractor"}}
FALLING = {"kind": "linear", "start": 1e-3, "end": 2e-5, "end_fraction": 1.0}
NOISE = {"kind": "normal", "sigma": 0.2}
OFF_POLICY: dict[str, Any] = {
    "learning_rate": 1e-3, "buffer_size": 200_000, "learning_starts": 1024, "batch_size": 256, "gamma": 0.99,
    "train_freq": 1, "gradient_steps": 16, "policy_kwargs": {"net_arch": [256, 256]},
}  # fmt: skip
ON_POLICY: dict[str, Any] = {
    "learning_rate": {"kind": "linear", "start": 1e-3, "end": 1e-5, "end_fraction": 1.0}, "n_steps": 16,
    "batch_size": 256, "n_epochs": 10, "ent_coef": 0.001, "policy_kwargs": {"net_arch": [256, 256]},
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One training."""

    algorithm: str
    n_timesteps: int
    n_envs: int = 64
    env: str = ENV_ID
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)


def sac(n_timesteps: int = 20_000, n_envs: int = 64, algorithm: str = "sac", **changes: Any) -> Setting:
    """SAC, TD3 or TQC with changes to what all began with."""
    return Setting(
        algorithm=algorithm, n_timesteps=n_timesteps, n_envs=n_envs, hyperparameters={**OFF_POLICY, **changes}
    )


def step(setting: Setting, **changes: Any) -> Setting:
    """The same, with an action in every control step."""
    hyperparameters = {**setting.hyperparameters, "gamma": 0.98, **changes}
    return replace(setting, env=STEP_ID, hyperparameters=hyperparameters)


def ppo(n_timesteps: int = 200_000, n_envs: int = 64, **changes: Any) -> Setting:
    """PPO with changes to what it began with."""
    return Setting(
        algorithm="ppo", n_timesteps=n_timesteps, n_envs=n_envs, hyperparameters={**ON_POLICY, **changes}
    )


def network(*sizes: int) -> dict[str, Any]:
    """Policy arguments: the set encoder and layers of these sizes."""
    return {"policy_kwargs": {**SET, "net_arch": list(sizes)}}


SETTINGS: dict[str, Setting] = {
    "sac": sac(),
    "sac-set": sac(**network(256, 256)),
    "sac-set-entropy": sac(**network(256, 256), ent_coef="auto_0.02"),
    "sac-set-falling": sac(**network(256, 256), learning_rate=FALLING),
    "td3": sac(algorithm="td3", action_noise=NOISE),
    "td3-set": sac(algorithm="td3", action_noise=NOISE, **network(256, 256)),
    "tqc-set": sac(algorithm="tqc", **network(256, 256)),
    "step-sac-set": step(sac(100_000, **network(256, 256), gradient_steps=8, ent_coef="auto_0.02")),
    "ppo": ppo(),
    "ppo-set": ppo(**network(256, 256)),
}
"""Everything that was tried, by a name."""


def attempt(setting: Setting, seed: int = 0) -> dict[str, Any]:
    """Train and measure once."""
    env = ViaVecEnv(setting.env, setting.n_envs)
    model = build(setting.algorithm, "MultiInputPolicy", env, setting.hyperparameters, seed=seed)
    began, used = time.perf_counter(), time.process_time()
    model.learn(setting.n_timesteps)
    seconds, used = time.perf_counter() - began, time.process_time() - used
    agent = agent_method("agent", model)
    summary = (
        evaluate_methods([agent], load("validation", ENV_ID), ENV_ID, time_decisions=False)
        .results[0]
        .summary()
    )
    bands = {name: round(100.0 * band["rate"], 1) for name, band in summary["success_by_band"].items()}
    env.close()
    return {
        "success": round(100.0 * summary["success"]["rate"], 1),
        "bands": bands,
        "jerk_ratio": summary["jerk_ratio"],
        "minutes": round(seconds / 60.0, 2),
        "processor_minutes": round(used / 60.0, 2),
        "decisions": model.num_timesteps,
    }


def main() -> None:
    """Try what is named, and write down what came of it."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SETTINGS))
    parser.add_argument("--out", type=Path, default=Path("tuning.jsonl"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    lines = arguments.out.read_text().splitlines() if arguments.out.exists() else []
    done = {(record["name"], record["seed"]) for record in map(json.loads, lines)}
    for name in arguments.names or SETTINGS:
        if (name, arguments.seed) in done:
            continue
        with one_thread():
            result = attempt(SETTINGS[name], arguments.seed)
        record = {"name": name, "seed": arguments.seed, **result, "setting": asdict(SETTINGS[name])}
        print({name: value for name, value in record.items() if name != "setting"}, flush=True)
        with arguments.out.open("a") as file:
            file.write(json.dumps(record) + "\n")


if __name__ == "__main__":
    main()
