"""The page of the environments in space says what the code does."""

import json
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs import TASKS, obstacles_from_rows
from viapoint.envs.arms import PANDA
from viapoint.envs.arms.panda import MAX_HEIGHT, MIN_HEIGHT, ROLL_SHARE
from viapoint.envs.arms.serial_arm import LIMIT_SHARE
from viapoint.envs.scenes.config import SpaceDistribution
from viapoint.envs.scenes.families import scene_families

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "environments-panda.md").read_text(encoding="utf-8")
WORDS = {8: "eight", 10: "ten", 14: "fourteen"}


def table(section, number=0):
    """The rows of a table of a section, by default the first one, without its head."""
    text = f"\n{PAGE}".partition(f"\n{section}\n")[2].partition("\n##")[0]
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    lines = tables[number].splitlines()[2:]
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines]


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
    assert rows.pop("obstacles")[0] == str(env.observation_space["obstacles"].shape)
    for name, (size, low, high) in rows.items():
        box = env.observation_space[name]
        assert box.shape == (int(size),)
        for stated, bound in ((low, box.low), (high, box.high)):
            numbers = np.array([float(n) for n in stated.split(",")])
            np.testing.assert_allclose(np.tile(numbers, len(bound) // len(numbers)), bound, atol=1e-6)
    assert f"is {WORDS[env.observation_layout.n_rows]} rows" in PAGE


def test_rows_of_obstacles(env):
    box, columns = env.observation_space["obstacles"], []
    for each, content, low, high, _ in table("## Observation Space", 1):
        first, _, last = each.partition("-")
        some = range(int(first), int(last or first) + 1)
        columns += some
        assert (box.low[:, some] == float(low)).all()
        assert (box.high[:, some] == float(high)).all()
        if "one-hot" in content:
            assert content == f"shape one-hot: {', '.join(env.task.scenes.shapes)}"
    assert columns == list(range(box.shape[1]))
    rows = env.reset(seed=0)[0]["obstacles"]
    parts = env.observation_layout.obstacles(rows)
    np.testing.assert_array_equal(np.concatenate((*parts[:-1], parts.present[:, None]), axis=-1), rows)
    present, obstacles = parts.present > 0.5, obstacles_from_rows(env.observation_layout.scene_rows(rows))
    assert present.sum() == len(obstacles)
    for centre, half, each in zip(parts.centre[present], parts.half_lengths[present], obstacles, strict=True):
        np.testing.assert_allclose((centre, half), each.box(), atol=1e-6)


def test_starting_state():
    assert {row[0]: int(row[1]) for row in table("## Starting State")} == {
        name: family.n_obstacles for name, family in scene_families(3).items()
    }
    families = gym.make("viapoint/PandaObstacles-v0").unwrapped.task.scenes.families
    assert f"One of {WORDS[len(set(families))]} families" in PAGE
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
    assert f"higher than {100 * MAX_HEIGHT:g} cm" in text
    apart = json.loads((DOCS / "panda-collision.json").read_text(encoding="utf-8"))
    both = apart["forearm_and_flange"]
    assert f"overlap in {both['touching']} % of the positions" in text
    assert f"are at least {both['geometry']} mm apart" in text
    for reason, pairs in apart["not_compared"].items():
        assert f"| {', '.join(pairs)} | {reason}" in text
    assert f"and {WORDS[len(PANDA.base)]} for the base" in text
    assert f"({PANDA.hand_stiffness / 1000:g} kN/m, {PANDA.hand_damping:g} N s/m)" in text
    assert "({:g} and {:g} rad/s)".format(*sorted(set(PANDA.velocity_limit))) in text
    assert "({:g} and {:g} N m,".format(*sorted(set(PANDA.torque_limit), reverse=True)) in text


def test_the_example_puts_a_scene_of_a_family_into_the_environment():
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names = {}
    exec(example, names)
    assert names["scenes"].present.sum(axis=-1).min() >= scene_families(3)["tunnel"].n_obstacles
    assert names["observation"]["hand"] == pytest.approx(names["scenes"].start[0], abs=1e-6)
