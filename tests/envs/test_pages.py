"""Tables on the pages of the environments, and the code."""

import inspect
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.registration import twin_of
from viapoint.envs.sim.replan_triggers import Event

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {
    "environments": "viapoint/PlanarObstacles-v0",
    "environments-step": "viapoint/PlanarObstaclesStep-v0",
    "environments-replanning": "viapoint/PlanarMovingObstacles-v0",
}


@pytest.fixture(params=PAGES)
def page(request):
    return request.param


@pytest.fixture
def env(page):
    return gym.make(PAGES[page]).unwrapped


def table(page, section):
    """The rows of the first table of a section, without its head."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    section = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    lines = re.search(r"(?:^\|.*\n)+", section, re.MULTILINE).group(0).splitlines()
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_actions(page, env):
    layout = getattr(env, "steering", env.action_layout)
    rows = zip(map(str, range(len(layout.names))), layout.names, layout.units, strict=True)
    assert table(page, "Action Space") == [list(row) for row in rows]


def test_observations(page, env):
    rows = {row[0]: row[1:4] for row in table(page, "Observation Space")}
    twin = twin_of(PAGES[page])
    others = set() if twin == PAGES[page] else set(gym.make(twin).observation_space)
    assert set(rows) == set(env.observation_space) - others
    for name, (size, *sides) in rows.items():
        box = env.observation_space[name]
        assert box.shape == (int(size),)
        for told, side in zip(sides, (box.low, box.high), strict=True):
            numbers = [float(number) for number in told.split(",")]
            np.testing.assert_allclose(side, np.resize(numbers, side.shape), atol=1e-4)


def test_rewards(page, env):
    weights = {row[0]: float(row[1]) for row in table(page, "Rewards")}
    assert weights == vars(env.task.weights)


def test_arguments(page, env):
    code = {}
    for name, parameter in inspect.signature(type(env.batch)).parameters.items():
        if name != "num_envs":
            code[name] = "ADULT" if name == "arm" else repr(parameter.default)
    assert {row[0]: row[1] for row in table(page, "Arguments")} == code


def test_events():
    rows = table("environments-replanning", "Episode End")
    assert [(int(row[0]), row[1].upper()) for row in rows] == [(event, event.name) for event in Event]
