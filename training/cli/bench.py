"""Throughput as ratios: what the environment and the primitives cost beyond what must be done anyway.

Ratios of measurements that alternate within one run hold on any machine; absolute speeds only stand
beside them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import viapoint.envs
from viapoint import primitives
from viapoint.envs.mdp.task import Task
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.simulator import Simulator
from viapoint.training.config.configs import BenchConfig
from viapoint.training.io.files import write_json

assert viapoint.envs.TASKS, "importing it registers the environments"

TRAJECTORIES, SAMPLES = 4096, 200
MIDDLE = 0.3
"""Random actions lie within this of the straight movement, so that most are within reach."""


class Ratio(NamedTuple):
    """One thing against the least that it could take."""

    name: str
    measured: float
    floor: float
    unit: str
    ratio: float
    """Share of the floor's speed; for the primitives how many times the floor's time."""


def bench(config: BenchConfig) -> list[Ratio]:
    """Measure everything; takes about half a minute."""
    return [
        _simulation(config.env, config.num_envs, config.repeats),
        _single(config.env, config.repeats, resets=False),
        _single(config.env, config.repeats, resets=True),
        *(_sampling(shared, config.repeats) for shared in (True, False)),
    ]


def run(config: BenchConfig, console: Console | None = None) -> None:
    """Measure, print, and write the figures where asked to."""
    ratios = bench(config)
    table = Table("what", "measured", "floor", "unit", "ratio")
    for ratio in ratios:
        table.add_row(
            ratio.name, _shown(ratio.measured), _shown(ratio.floor), ratio.unit, f"{ratio.ratio:.2f}"
        )
    (console or Console()).print(table)
    if config.json is not None:
        config.json.parent.mkdir(parents=True, exist_ok=True)
        write_json(config.json, {ratio.name: ratio._asdict() for ratio in ratios})


def fastest(repeats: int, *calls: Callable[[], Any]) -> list[float]:
    """Least time of each call, [s]; they take turns, so that all meet the same moods of the machine."""
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(repeats):
        for call, mine in zip(calls, times, strict=True):
            began = time.perf_counter()
            call()
            mine.append(time.perf_counter() - began)
    return [min(each) for each in times]


def _simulation(env_id: str, num_envs: int, repeats: int) -> Ratio:
    """Physics steps per second of `make_vec(...).step` and of the engine alone on the same model."""
    env: Any = gym.make_vec(env_id, num_envs=num_envs)
    env.reset(seed=0)
    actions = _actions(env.single_action_space, num_envs)
    scenes, before = env.unwrapped.scenes, env.unwrapped.physics_steps
    env.step(actions)
    steps = (env.unwrapped.physics_steps - before) // num_envs
    engine = _engine(env.unwrapped.task, scenes, actions, steps, threads=0)

    def step() -> float:
        began = time.perf_counter()
        env.step(actions)
        return time.perf_counter() - began

    rates = _rates(env, step, engine, num_envs * steps, repeats)
    env.close()
    return Ratio(f"make_vec, {num_envs} environments", *rates)


def _single(env_id: str, repeats: int, *, resets: bool) -> Ratio:
    """The same for one environment through `gym.make`, with or without the time to draw its scenes."""
    env = gym.make(env_id)
    env.reset(seed=0)
    action = _actions(env.action_space, 1)[0]
    inner: Any = env.unwrapped
    scenes, before = inner.batch.scenes, inner.physics_steps
    env.step(action)
    steps = inner.physics_steps - before

    def episodes() -> float:
        spent = 0.0
        for _ in range(20):
            began = time.perf_counter()
            env.reset()
            ready = time.perf_counter()
            env.step(action)
            spent += time.perf_counter() - (began if resets else ready)
        return spent

    alone = _engine(inner.task, scenes, action[None], steps, threads=1)

    def engine() -> None:
        for _ in range(20):
            alone()

    rates = _rates(env, episodes, engine, 20 * steps, repeats)
    env.close()
    return Ratio(f"make, one environment, {'reset and step' if resets else 'step'}", *rates)


def _rates(
    env: Any, step: Callable[[], float], engine: Callable[[], Any], raw_steps: int, repeats: int
) -> tuple[float, float, str, float]:
    """Steps per second of both sides; those of the environment are counted, as scenes and lengths differ.

    `step` returns the seconds that count.
    """
    best = 0.0

    def counted() -> None:
        nonlocal best
        before = env.unwrapped.physics_steps
        spent = step()
        best = max(best, (env.unwrapped.physics_steps - before) / spent)

    _, raw = fastest(repeats, counted, engine)
    return best, raw_steps / raw, "physics steps/s", best / (raw_steps / raw)


def _engine(
    task: Task, scenes: Scenes, actions: NDArray[np.float32], steps: int, threads: int
) -> Callable[[], Any]:
    """A rollout of the engine alone: the same controls in the same scenes, with the records the environment needs."""
    number = len(actions)
    simulator = Simulator(
        task.collision_model,
        n_obstacles=task.observation.n_rows,
        num_envs=number,
        threads=threads,
    )
    joints = np.asarray(task.arm.inverse_kinematics(scenes.start))
    simulator.place(np.arange(number), joints, scenes.obstacles, scenes.present)
    movement = task.action.decode(actions.astype(np.float64), scenes.start, scenes.goal).trajectory()
    controls = np.ascontiguousarray(
        task.arm.controls(*movement.sample(simulator.timestep * np.arange(steps)))
    )
    state = simulator.batch.state.copy()

    def rollout() -> None:
        simulator.batch.state[:] = state
        simulator.batch.rollout(steps, controls, record=simulator.recorded)

    return rollout


def _actions(space: Any, number: int) -> NDArray[np.float32]:
    generator = np.random.default_rng(0)
    return generator.uniform(-MIDDLE, MIDDLE, (number, *space.shape)).astype(np.float32)


def _sampling(shared: bool, repeats: int) -> Ratio:
    """Microseconds per trajectory of position, velocity and acceleration, and of a copy of the numbers."""
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


def _shown(value: float) -> str:
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.2f}"
