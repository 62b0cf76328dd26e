"""Throughput of environments and primitives, as ratios to the unavoidable work.

Ratios of measurements that alternate within one run hold on any machine; absolute speeds only stand
beside them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

import viapoint.envs
from viapoint import primitives
from viapoint.envs.mdp.task import Task
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.executor import Executor
from viapoint.envs.sim.simulator import Simulator
from viapoint.training.io.files import write_json
from viapoint.training.rollouts.vec_env import ViaVecEnv

assert viapoint.envs.TASKS, "importing it registers the environments"

TRAJECTORIES, SAMPLES = 4096, 200
WARM_UP = 2
"""Steps before those that are timed."""
EPISODES = 20
"""Episodes of a single environment that are timed together."""
MIDDLE = 0.3
"""Bound of the components of random actions, so that most movements are within reach."""


class Ratio(NamedTuple):
    """Measured speed or time with its bound."""

    name: str
    measured: float
    floor: float
    unit: str
    ratio: float
    """Measured value divided by the bound."""


def main(
    env: str = "viapoint/PlanarObstacles-v0", num_envs: int = 512, repeats: int = 9, json: Path | None = None
) -> None:
    """Measure and print all ratios; takes about half a minute.

    Args:
        env: Id of an environment in which an action is a whole movement.
        num_envs: Environments in the batch.
        repeats: Alternating measurements of each side; environments count with their mean, primitives with the fastest.
        json: JSON file for the figures.
    """
    ratios = [
        _simulation(env, num_envs, repeats),
        _single(env, repeats, resets=False),
        _single(env, repeats, resets=True),
        _sampling(True, repeats),
        _sampling(False, repeats),
        _make_vec_env(env, min(num_envs, 64), repeats),
    ]
    table = Table("what", "measured", "floor", "unit", "ratio")
    for name, measured, floor, unit, ratio in ratios:
        table.add_row(name, _shown(measured), _shown(floor), unit, f"{ratio:.2f}")
    Console().print(table)
    if json is not None:
        write_json(json, {each.name: each._asdict() for each in ratios})


def timed(repeats: int, *calls: Callable[[], Any]) -> list[list[float]]:
    """Return the times of each call, [s]; calls alternate, so that load on the machine affects all of them."""
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(repeats):
        for call, mine in zip(calls, times, strict=True):
            began = time.perf_counter()
            call()
            mine.append(time.perf_counter() - began)
    return times


def fastest(repeats: int, *calls: Callable[[], Any]) -> list[float]:
    """Return the least time of each call, [s]."""
    return [min(each) for each in timed(repeats, *calls)]


def _simulation(env_id: str, num_envs: int, repeats: int) -> Ratio:
    """Return physics steps per second of `make_vec(...).step` and of the engine alone on the same model."""
    env: Any = gym.make_vec(env_id, num_envs=num_envs)
    env.reset(seed=0)
    actions = _actions(env.single_action_space, num_envs)
    engine, steps = _engine(env.unwrapped.task, env.unwrapped.scenes, actions, threads=0)

    def step() -> float:
        began = time.perf_counter()
        env.step(actions)
        return time.perf_counter() - began

    rates = _rates(env, step, engine, steps, repeats)
    env.close()
    return Ratio(f"make_vec, {num_envs} environments", *rates)


def _single(env_id: str, repeats: int, *, resets: bool) -> Ratio:
    """Return physics steps per second of one environment of `gym.make`, with or without the time of resets."""
    env = gym.make(env_id)
    env.reset(seed=0)
    action = _actions(env.action_space, 1)[0]
    inner: Any = env.unwrapped

    def episodes() -> float:
        spent = 0.0
        for _ in range(EPISODES):
            began = time.perf_counter()
            env.reset()
            ready = time.perf_counter()
            env.step(action)
            spent += time.perf_counter() - (began if resets else ready)
        return spent

    # The time of a step depends on the scene, so the engine has as many scenes.
    scenes = inner.task.sampler()([np.random.default_rng(seed) for seed in range(EPISODES)])
    engine, steps = _engine(inner.task, scenes, np.repeat(action[None], EPISODES, axis=0), threads=1)
    rates = _rates(env, episodes, engine, steps, repeats)
    env.close()
    return Ratio(f"make, one environment, {'reset and step' if resets else 'step'}", *rates)


def _rates(
    env: Any, step: Callable[[], float], engine: Callable[[], Any], raw_steps: int, repeats: int
) -> tuple[float, float, str, float]:
    """Return physics steps per second of both sides, counted in the environment, as the lengths of episodes differ.

    They are means, because only some steps sample scenes. `step` returns the seconds that count.
    """
    for _ in range(WARM_UP):
        step()
    spent, before = 0.0, env.unwrapped.physics_steps

    def counted() -> None:
        nonlocal spent
        spent += step()

    _, raw = timed(repeats, counted, engine)
    speed = (env.unwrapped.physics_steps - before) / spent
    engine_speed = repeats * raw_steps / sum(raw)
    return speed, engine_speed, "physics steps/s", speed / engine_speed


def _engine(
    task: Task, scenes: Scenes, actions: NDArray[np.float32], threads: int
) -> tuple[Callable[[], Any], int]:
    """Return rollouts of the engine alone and their physics steps: the same movements as in the environment."""
    simulator = Simulator(
        task.collision_model,
        n_obstacles=task.observation.n_rows,
        num_envs=len(actions),
        threads=threads,
        shapes=task.scenes.shapes,
    )
    joints = np.asarray(task.arm.inverse_kinematics(scenes.start))
    simulator.place(np.arange(len(actions)), joints, scenes.obstacles, scenes.present)
    plan = task.action.decode(actions.astype(np.float64), scenes.start, scenes.goal)
    stages = Executor(simulator)
    groups = [stages.build_references(each) for each in stages.scale_time(scenes, plan).groups()]
    runs = [(each.movements.sims[each.reachable], each.controls[each.reachable]) for each in groups]
    state = simulator.batch.state.copy()

    def rollouts() -> None:
        simulator.batch.state[:] = state
        for sims, controls in runs:
            if len(sims):
                simulator.batch.rollout(controls.shape[1], controls, record=simulator.recorded, ids=sims)

    return rollouts, sum(controls.shape[0] * controls.shape[1] for _, controls in runs)


def _actions(space: Any, number: int) -> NDArray[np.float32]:
    generator = np.random.default_rng(0)
    return generator.uniform(-MIDDLE, MIDDLE, (number, *space.shape)).astype(np.float32)


def _sampling(shared: bool, repeats: int) -> Ratio:
    """Return microseconds per trajectory of sampling position, velocity and acceleration, and of a copy."""
    generator = np.random.default_rng(0)
    waypoints = generator.uniform(-0.5, 0.5, (TRAJECTORIES, 3, 2))
    durations = np.full((TRAJECTORIES, 2), 0.4) if shared else generator.uniform(0.3, 0.6, (TRAJECTORIES, 2))
    trajectory = primitives.through(waypoints, durations[0] if shared else durations)
    source = [generator.random((TRAJECTORIES, SAMPLES, 2)) for _ in range(3)]
    target = [np.empty_like(each) for each in source]

    def copy() -> None:
        for to, of in zip(target, source, strict=True):
            np.copyto(to, of)

    sampled, copied = fastest(repeats, lambda: trajectory.sample(SAMPLES, nu=(0, 1, 2), out=target), copy)
    micro = 1e6 / TRAJECTORIES
    name = f"sample {SAMPLES} x (position, velocity, acceleration), {'shared' if shared else 'own'} knots"
    return Ratio(name, micro * sampled, micro * copied, "us/trajectory", sampled / copied)


def _make_vec_env(env_id: str, num_envs: int, repeats: int) -> Ratio:
    """Return decisions per second of `make_vec_env` of Stable-Baselines3 and of ViaVecEnv, each on its defaults."""
    envs: list[VecEnv] = [make_vec_env(env_id, num_envs), ViaVecEnv(env_id, num_envs)]
    actions = _actions(envs[0].action_space, num_envs)
    return _decisions(f"make_vec_env against ViaVecEnv, {num_envs} environments", envs, actions, repeats)


def _decisions(name: str, envs: Sequence[Any], actions: NDArray[np.float32], repeats: int) -> Ratio:
    """Return decisions per second of two vector environments."""
    for env in envs:
        env.reset()
    steps = [partial(env.step, actions) for env in envs]
    timed(WARM_UP, *steps)
    times = timed(repeats, *steps)
    for env in envs:
        env.close()
    first, second = (len(actions) * repeats / sum(each) for each in times)
    return Ratio(name, first, second, "decisions/s", first / second)


def _shown(value: float) -> str:
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.2f}"


if __name__ == "__main__":
    tyro.cli(main)
