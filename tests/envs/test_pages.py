"""The page of the environments says what the code does."""

import inspect
import json
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs import TASKS
from viapoint.envs.mdp.rewards import RewardWeights
from viapoint.envs.sim.outcome import GOAL_TOLERANCE, REST_SPEED, Outcome
from viapoint.envs.single_env import ReachVectorEnv

PAGE = (Path(__file__).parents[2] / "docs" / "environments.md").read_text(encoding="utf-8")


def table(section):
    """The rows of the first table of a section, without its head."""
    text = f"\n{PAGE}".partition(f"\n{section}\n")[2].partition("\n## ")[0]
    rows = [
        [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line[:1] == "|"
    ]
    return rows[2:]


@pytest.fixture
def env():
    return gym.make("viapoint/PlanarObstacles-v0").unwrapped


def test_the_stated_speeds_relative_to_mujoco_are_the_measured_ones():
    docs = Path(__file__).parents[2] / "docs"
    lines = (docs / "vectorized.md").read_text(encoding="utf-8").splitlines()
    names = {
        "256 environments of `make_vec`": "make_vec, 256 environments",
        "one environment of `make`, steps alone": "make, one environment, step",
        "one environment of `make`, with resets": "make, one environment, reset and step",
    }
    found = [json.loads((docs / f"bench-{name}-obstacles.json").read_text()) for name in ("planar", "panda")]
    for shown, name in names.items():
        ratios = " | ".join(f"{each[name]['ratio']:.2f}" for each in found)
        assert f"| {shown} | {ratios} |" in lines


def test_the_sections_are_in_the_order_of_gymnasium():
    assert re.findall(r"^## (.*)$", PAGE, re.MULTILINE) == [
        "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
        "Version History",
    ]  # fmt: skip


def test_every_id_is_listed_with_what_it_sets():
    rows = {row[0]: row[3] for row in table("# The environments")}
    assert set(rows) == set(TASKS)
    for name, kwargs in TASKS.items():
        assert rows[name] == (", ".join(f"{k}={v}" for k, v in kwargs.items()) or "-")


def test_action_space(env):
    assert f"`Box(-1.0, 1.0, {env.action_space.shape}, float32)`" in PAGE
    layout = env.action_layout
    assert table("## Action Space") == [
        [str(i), n, u] for i, (n, u) in enumerate(zip(layout.names, layout.units, strict=True))
    ]


def test_observation_space(env):
    rows = {row[0]: row[1:4] for row in table("## Observation Space")}
    assert set(rows) == set(env.observation_space)
    for name, (size, low, high) in rows.items():
        box = env.observation_space[name]
        assert box.shape == (int(size),)
        for stated, bound in ((low, box.low), (high, box.high)):
            numbers = np.array([float(n) for n in stated.split(",")])
            np.testing.assert_allclose(np.tile(numbers, len(bound) // len(numbers)), bound, atol=1e-6)


def test_rewards():
    weights = RewardWeights()
    assert {row[0]: float(row[1]) for row in table("## Rewards")} == {
        k: getattr(weights, k) for k in weights.__annotations__
    }


def test_arguments():
    parameters = inspect.signature(ReachVectorEnv).parameters
    skipped = {"self", "num_envs", "unknown"}
    code = {name: p.default for name, p in parameters.items() if name not in skipped}
    stated = {row[0]: row[1] for row in table("## Arguments")}
    assert set(stated) == set(code)
    for name, default in code.items():
        assert stated[name] == ("ADULT" if name == "arm" else repr(default))


def test_episode_end():
    for name in Outcome._fields:
        assert f"`{name}`" in PAGE
    assert f"within {GOAL_TOLERANCE} m of the goal" in PAGE.replace("\n", " ")
    assert f"slower than {REST_SPEED} m/s" in PAGE
