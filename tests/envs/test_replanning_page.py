"""The page of the environments whose plans are revised says what the code does."""

import inspect
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.mdp.rewards import ReplanningRewardWeights
from viapoint.envs.registration import REPLANNING_TASKS
from viapoint.envs.replanning_env import ReplanningVectorEnv
from viapoint.envs.scenes.dynamic_scene import MOST_JUMPS
from viapoint.envs.scenes.motion import ChangeDistribution
from viapoint.envs.scenes.scene import FASTEST
from viapoint.envs.sim.outcome import SETTLING
from viapoint.envs.sim.replan_triggers import FORESIGHT, LOOK, SAMPLED, Event
from viapoint.envs.sim.replanning_executor import SIMILAR, SLACK

PAGE = (Path(__file__).parents[2] / "docs" / "environments-replanning.md").read_text(encoding="utf-8")
WORDS = " ".join(PAGE.split())


def table(section):
    """The rows of the first table of a section, without its head."""
    text = f"\n{PAGE}".partition(f"\n{section}\n")[2].partition("\n## ")[0]
    block = re.search(r"(?:^\|.*\n)+", text, re.MULTILINE).group(0)
    rows = [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in block.splitlines()]
    return rows[2:]


@pytest.fixture
def env():
    return gym.make("viapoint/PlanarMovingObstacles-v0").unwrapped


def test_the_sections_are_in_the_order_of_gymnasium():
    assert re.findall(r"^## (.*)$", PAGE, re.MULTILINE) == [
        "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
        "Version History",
    ]  # fmt: skip


def test_every_id_is_listed_with_what_it_sets():
    told = {row[0]: row[2] for row in table("# Replanning environments")}
    assert told == {
        name: ", ".join(f"{k}={v if k == 'arm' else repr(v)}" for k, v in kwargs.items())
        for name, kwargs in REPLANNING_TASKS.items()
    }


def test_action_space(env):
    layout = env.action_layout
    assert f"`Box(-1.0, 1.0, {env.action_space.shape}, float32)`" in PAGE
    assert table("## Action Space") == [
        [str(i), name, unit] for i, (name, unit) in enumerate(zip(layout.names, layout.units, strict=True))
    ]
    panda = gym.make("viapoint/PandaMovingObstacles-v0").unwrapped
    least = f"{env.decoder.least_remaining:g} s ({panda.decoder.least_remaining:g} s"
    assert WORDS.count(least) == 2
    assert f"within {MIN_GOAL_DISTANCE} m of it" in WORDS
    assert f"centre duration ({layout.centre_duration:.4g} s)" in WORDS
    assert f"at most {SIMILAR} times the steps of its shortest, and {SLACK} more" in WORDS


def test_observation_space(env):
    rows = {row[0]: row[1:4] for row in table("## Observation Space")}
    assert set(rows) == set(env.observation_space)
    for name, (size, *sides) in rows.items():
        box = env.observation_space[name]
        assert box.shape == (int(size),)
        for told, side in zip(sides, (box.low, box.high), strict=True):
            one = [float(number) for number in told.split(",")]
            np.testing.assert_allclose(side, np.resize(one, side.shape), atol=1e-4)
    limits = {i: gym.make(i).unwrapped.batch.time_limit for i in REPLANNING_TASKS}
    assert f"{limits['viapoint/PlanarTargetJump-v0']:g} s in `PlanarTargetJump`" in WORDS
    assert f"{limits['viapoint/PandaMovingObstacles-v0']:g} s in `PandaMovingObstacles`" in WORDS


def test_rewards(env):
    weights = ReplanningRewardWeights()
    assert {row[0]: float(row[1]) for row in table("## Rewards")} == {
        name: getattr(weights, name) for name in weights.__dict__
    }
    assert f"- elapsed / {env.action_layout.centre_duration:.4g} s" in WORDS


def test_starting_state(env):
    d = ChangeDistribution()

    def span(pair, unit=""):
        return f"{pair[0]:g} to {pair[1]:g}{unit}"

    for part in (
        f"{span(d.first_jump)} after the start, another {span(d.next_jump)} after the one before",
        f"{span(d.jump_distance, ' m')} away",
        f"at {span(d.speed, ' m/s')}, and half of them change velocity once, {span(d.turn)} after the start",
        f"{span(d.meeting)} after the start",
        f"within {d.end_margin} m of the resting arm",
        f"at most {FASTEST:g} m/s",
    ):
        assert part in WORDS, part
    assert d.turning == 0.5
    assert [row[0] for row in table("## Starting State")] == ["jumps", "courses"]
    assert table("## Starting State")[0][2].startswith(f"at most {MOST_JUMPS},")


def test_episode_end():
    assert [(int(row[0]), row[1].upper()) for row in table("## Episode End")] == [(e, e.name) for e in Event]
    assert f"settled for {SETTLING} s" in WORDS
    assert (
        f"predicted every {LOOK * SAMPLED:g} s: that of the plan under way over the next {FORESIGHT} s"
        in WORDS
    )


def test_arguments():
    parameters = inspect.signature(ReplanningVectorEnv).parameters
    code = {n: p.default for n, p in parameters.items() if n not in ("self", "num_envs", "unknown")}
    stated = {row[0]: row[1] for row in table("## Arguments")}
    assert set(stated) == set(code)
    for name, default in code.items():
        assert stated[name] == ("ADULT" if name == "arm" else repr(default))
