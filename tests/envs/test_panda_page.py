"""The page of the environments in space says what the code does."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs import TASKS
from viapoint.envs.arms import PANDA
from viapoint.envs.arms.panda import MIN_HEIGHT, ROLL_SHARE
from viapoint.envs.arms.serial_arm import LIMIT_SHARE
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.families import scene_families

PAGE = (Path(__file__).parents[2] / "docs" / "environments-panda.md").read_text(encoding="utf-8")
WORDS = {1: "one", 2: "two", 6: "six", 8: "eight"}


def table(section):
    """The rows of the first table of a section, without its head."""
    text = f"\n{PAGE}".partition(f"\n{section}\n")[2].partition("\n##")[0]
    rows = [
        [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line[:1] == "|"
    ]
    return rows[2:]


@pytest.fixture
def env():
    return gym.make("viapoint/PandaObstacles-v0").unwrapped


def test_the_sections_are_in_the_order_of_gymnasium():
    assert re.findall(r"^## (.*)$", PAGE, re.MULTILINE) == [
        "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
        "Version History",
    ]  # fmt: skip


def test_every_id_is_listed_with_what_it_sets():
    rows = {row[0]: row[3] for row in table("# Seven joints in space")}
    ours = {name: kwargs for name, kwargs in TASKS.items() if kwargs.get("arm") == "panda"}
    assert rows == {name: ", ".join(f"{k}={v}" for k, v in kwargs.items()) for name, kwargs in ours.items()}


def test_action_space(env):
    assert f"`Box(-1.0, 1.0, {env.action_space.shape}, float32)`" in PAGE
    layout = env.action_layout
    stated = [[str(i), n, u] for i, (n, u) in enumerate(zip(layout.names, layout.units, strict=True))]
    assert table("## Action Space") == stated


def test_observation_space(env):
    rows = {row[0]: row[1:4] for row in table("## Observation Space")}
    assert set(rows) == set(env.observation_space)
    for name, (size, low, high) in rows.items():
        box = env.observation_space[name]
        assert box.shape == (int(size),)
        for stated, bound in ((low, box.low), (high, box.high)):
            numbers = np.array([float(n) for n in stated.split(",")])
            np.testing.assert_allclose(np.tile(numbers, len(bound) // len(numbers)), bound, atol=1e-6)
    assert f"is {WORDS[env.observation_layout.n_rows]} rows" in PAGE


def test_starting_state():
    assert {row[0]: int(row[1]) for row in table("## Starting State")} == {
        name: family.n_obstacles for name, family in scene_families(3).items()
    }
    distribution, (low, high) = SpaceDistribution(), PANDA.workspace
    assert "{:g} to {:g} m apart".format(*distribution.distance) in PAGE
    assert f"from {low} to {high} m".replace("0.50", "0.5") in " ".join(PAGE.split())
    assert distribution.steepness == 0.5


def test_numbers_of_the_description(env):
    text = " ".join(PAGE.split())
    assert f"{WORDS[len(PANDA.shape)].capitalize()} capsules stand for the links" in text
    assert f"exceed {100 * LIMIT_SHARE:g} % of its velocity limit" in text
    assert f"{round(1 / env.model.opt.timestep)} physics steps a second" in text
    assert f"takes {ROLL_SHARE} of the turn" in text
    assert f"lower than {100 * MIN_HEIGHT:g} cm" in text
    assert f"({PANDA.hand_stiffness / 1000:g} kN/m, {PANDA.hand_damping:g} N s/m)" in text
    assert "({:g} and {:g} rad/s)".format(*sorted(set(PANDA.velocity_limit))) in text
    assert "({:g} and {:g} N m,".format(*sorted(set(PANDA.torque_limit), reverse=True)) in text


def test_the_example_puts_a_scene_of_a_family_into_the_environment():
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names = {}
    exec(example, names)
    assert names["scenes"].present.sum(axis=-1).min() >= scene_families(3)["tunnel"].n_obstacles
    assert names["observation"]["hand"] == pytest.approx(names["scenes"].start[0], abs=1e-6)
