"""The page of the step-wise environments says what the code does."""

import inspect
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.mdp.rewards import StepRewardWeights
from viapoint.envs.registration import STEP_TASKS
from viapoint.envs.sim.outcome import GOAL_TOLERANCE, REST_SPEED, SETTLING
from viapoint.envs.velocity_env import VelocityVectorEnv

PAGE = (Path(__file__).parents[2] / "docs" / "environments-step.md").read_text(encoding="utf-8")
WORDS = " ".join(PAGE.split())


def table(section):
    """The rows of the table of a section, without its head."""
    text = f"\n{PAGE}".partition(f"\n{section}\n")[2].partition("\n## ")[0]
    rows = [
        [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line[:1] == "|"
    ]
    return rows[2:]


@pytest.fixture
def env():
    return gym.make("viapoint/PlanarObstaclesStep-v0").unwrapped


def test_the_sections_are_in_the_order_of_gymnasium():
    assert re.findall(r"^## (.*)$", PAGE, re.MULTILINE) == [
        "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
        "Version History",
    ]  # fmt: skip


def test_every_id_is_listed_with_its_twin():
    assert dict(table("# An action in every control step")) == STEP_TASKS


def test_action_space(env):
    assert f"`Box(-1.0, 1.0, {env.action_space.shape}, float32)`" in PAGE
    steering = env.steering
    named = [[str(i), n, u] for i, (n, u) in enumerate(zip(steering.names, steering.units, strict=True))]
    assert table("## Action Space") == named
    assert f"control step of {steering.control_step} s" in WORDS
    assert f"({steering.bandwidth:g} rad/s)" in WORDS
    assert f"{1.0 / steering.control_step:g} times a second" in WORDS


def test_observation_space(env):
    rows = {row[0]: row[1:4] for row in table("## Observation Space")}
    twin = gym.make(STEP_TASKS["viapoint/PlanarObstaclesStep-v0"])
    assert set(rows) | set(twin.observation_space) == set(env.observation_space)
    assert not set(rows) & set(twin.observation_space)
    for name, (size, low, high) in rows.items():
        box = env.observation_space[name]
        assert box.shape == (int(size),)
        np.testing.assert_allclose(box.low, float(low), atol=1e-4)
        np.testing.assert_allclose(box.high, float(high), atol=1e-4)


def test_rewards():
    rows, weights = table("## Rewards"), StepRewardWeights()
    assert {row[0]: float(row[1]) for row in rows} == {
        name: getattr(weights, name) for name in weights.__dict__
    }


def test_arguments():
    parameters = inspect.signature(VelocityVectorEnv).parameters
    code = {n: p.default for n, p in parameters.items() if n not in ("self", "num_envs", "unknown")}
    stated = {row[0]: row[1] for row in table("## Arguments")}
    assert set(stated) == set(code)
    for name, default in code.items():
        assert stated[name] == ("ADULT" if name == "arm" else repr(default))


def test_episode_end(env):
    assert f"for {SETTLING} s, within {GOAL_TOLERANCE} m and slower than {REST_SPEED} m/s" in WORDS
    assert f"within {env.batch.control_steps} control steps" in WORDS
