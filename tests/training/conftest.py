"""Small scenes and small trainings, shared by the tests of training."""

import dataclasses
import signal

import numpy as np
import pytest
import torch
from helpers import PLANE

from viapoint.training import ViaVecEnv, scene_sets
from viapoint.training.cli import entry
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import DRAWN, FrozenScenes


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def env():
    env = ViaVecEnv(PLANE, 6, seed=3, threads=1)
    yield env
    env.close()


@pytest.fixture
def made():
    """Function that makes environments, which SB3 takes and which are closed at the end."""
    opened = []

    def make(env_id=PLANE, number=8, **kwargs):
        opened.append(ViaVecEnv(env_id, number, seed=0, **kwargs))
        return opened[-1]

    yield make
    for env in opened:
        env.close()


@pytest.fixture(scope="session")
def small_scenes():
    """Forty scenes, with the share of 12 random actions that solve each."""
    simulation = SceneSimulation(PLANE, 64, threads=1)
    generator = np.random.default_rng(0)
    scenes = simulation.task.sampler()([generator] * 40)
    actions = generator.uniform(-1.0, 1.0, (12, 40, simulation.task.action.size))
    success = np.array([simulation(scenes, each)["is_success"] for each in actions])
    return FrozenScenes(
        name="small",
        task=simulation.task.as_dict(),
        scenes=scenes,
        share=success.mean(axis=0),
        family=np.full(40, DRAWN),
    )


@pytest.fixture
def shipped(small_scenes, monkeypatch):
    """The small scenes in place of every shipped set."""
    found = lambda name, task: dataclasses.replace(small_scenes, name=name)  # noqa: E731
    monkeypatch.setattr(scene_sets, "shipped_set", found)
    return small_scenes


@pytest.fixture
def failed(capsys):
    """Function of the words of a command that fails; it returns the one line on the standard error output."""

    def told(*words, code=2):
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            entry.main([str(word) for word in words])
        assert end.value.code == code
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith("viapoint: ")
        return line

    return told


@pytest.fixture(autouse=True, scope="session")
def _heeds_ctrl_c():
    """A shell's background jobs ignore Ctrl-C, and so would everything that the tests start."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
