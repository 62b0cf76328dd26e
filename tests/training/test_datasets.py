"""Minari datasets: what was recorded is what the recovered environment does again."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from helpers import JUMPS, MOVING, PLANE, SENSED, STEP, UR5E

from viapoint.training.cli import entry as cli
from viapoint.training.cli.commands import record_dataset
from viapoint.training.planning.baselines import make_method

minari = pytest.importorskip("minari")

CUSTOM = "test/TwoPosts-v0"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Keep datasets in a temporary folder, and a custom id in the registry of the test."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    gym.register(
        CUSTOM,
        entry_point="viapoint.envs.env:ReachEnv",
        vector_entry_point="viapoint.envs.vector_env:ReachVectorEnv",
        kwargs={"n_obstacles": 2, "n_via": 2},
        disable_env_checker=True,
    )
    return tmp_path / "datasets"


def record(*words):
    cli.main(["record", *map(str, words)])


def assert_replays(dataset):
    """Reset with the recorded seeds, repeat the recorded actions, and expect the same bits."""
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    metadata = dataset.storage.get_episode_metadata(range(dataset.total_episodes))
    for episode, about in zip(dataset.iterate_episodes(), metadata, strict=True):
        observation, _ = env.reset(seed=about["seed"], options=about.get("options"))
        for k in range(len(episode) + 1):
            for name, values in episode.observations.items():
                np.testing.assert_array_equal(observation[name], values[k], err_msg=name, strict=True)
            if k == len(episode):
                break
            observation, reward, terminated, truncated, info = env.step(episode.actions[k])
            assert reward == episode.rewards[k]
            assert (terminated, truncated) == (episode.terminations[k], episode.truncations[k])
            assert info["is_success"] == episode.infos["is_success"][k]
        assert terminated or truncated
    env.close()


@pytest.mark.parametrize(
    ("method", "words"),
    [
        (PLANE, ()),
        ("search16", ("--env", PLANE, "--env-kwargs", "n_obstacles=[1,3]")),
        ("random", ("--env", STEP)),
        (MOVING, ()),
        ("straight", ("--env", JUMPS)),
        ("straight", ("--arm", "panda")),
        ("random", ("--env", CUSTOM)),
        ("straight", ("--env", "viapoint/Reach-v0", "--arm", UR5E)),
    ],
)
def test_a_dataset_replays_bit_for_bit(method, words, capsys):
    record(method, *words, "--episodes", 3, "--seed", 5, "--dataset", "group/name-v1")
    assert "3 episodes" in capsys.readouterr().out
    dataset = minari.load_dataset("group/name-v1")
    assert dataset.total_episodes == 3
    assert_replays(dataset)


def test_episodes_are_those_of_the_method_and_have_names_by_default(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "straight").mkdir()  # a folder of this name is no agent
    record("--env", PLANE, "--episodes", 2, "--agent=straight")
    dataset = minari.load_dataset("viapoint/PlanarObstacles/straight-v0")
    assert (folder / "viapoint/PlanarObstacles/straight-v0/data").is_dir()
    assert [np.abs(episode.actions).max() for episode in dataset.iterate_episodes()] == [0.0, 0.0]
    record("thick:search4", "--env", SENSED, "--episodes", 1)
    assert minari.load_dataset("viapoint/PlanarSensed/thick-search4-v0").total_episodes == 1


NAMES = "../name-v0", "t/a-v0", "name", "group//name-v0", "a b-v0", ""
"""Names that no dataset can have."""


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("straight",), "--env"),
        (("nothing", "--env", PLANE), "baseline must be"),
        (("plan_motion", "--env", PLANE), "no actions"),
        (("straight", "--env", STEP), "random"),
        (("straight", "--env", PLANE, "--episodes", 0), "episodes"),
        *((("straight", "--env", PLANE, "--dataset", name), "group/name-v0") for name in NAMES),
        ((PLANE, "--env-kwargs", "n_via=2"), "env_kwargs"),
    ],
)
def test_what_cannot_be_recorded_is_told_before_anything_is(words, told, failed, folder):
    assert told in failed("record", *words)
    assert not folder.exists()


@pytest.mark.parametrize("error", [OSError("No space left on device"), KeyboardInterrupt()])
def test_a_dataset_that_cannot_be_written_leaves_nothing(error, folder, monkeypatch):
    method = make_method("straight", PLANE)
    record_dataset("group/kept-v0", PLANE, {}, method, 1)
    before = sorted(folder.rglob("*"))
    with pytest.raises(ValueError):  # a dataset is never replaced
        record_dataset("group/kept-v0", PLANE, {}, method, 1)

    def full(*_):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("minari.dataset.minari_storage.MinariStorage.update_metadata", full)
        with pytest.raises(type(error)):
            record_dataset("group/new-v0", PLANE, {}, method, 1)
    assert sorted(folder.rglob("*")) == before
    record_dataset("group/new-v0", PLANE, {}, method, 1)


@pytest.mark.parametrize("library", ["minari", "h5py"])
def test_without_the_library_its_extra_is_named(library, monkeypatch, failed, folder):
    monkeypatch.setitem(sys.modules, library, None)
    assert "pip install '.[minari]' in a clone" in failed("record", "straight", "--env", PLANE)
