"""Environments in worker processes do what they do in one process."""

import dataclasses
import os
import pickle
import signal
import subprocess
import sys
import textwrap

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs import ENV_IDS, SHAPES, Box, ReachVectorEnv, Sphere
from viapoint.envs.arms import ARMS
from viapoint.envs.registration import OWN_ARM_TASKS
from viapoint.envs.worker_env import WorkerVectorEnv
from viapoint.envs.worker_process import WorkerDiedError, answer

OBSTACLES, STEP, MOVING = (
    f"viapoint/Planar{name}-v0" for name in ("Obstacles", "ObstaclesStep", "MovingObstacles")
)
N = 5


class Here:
    """A worker in this process; messages are pickled as between processes."""

    def __init__(self, make):
        self.server, self.answer = pickle.loads(pickle.dumps(make))(), (True, None)

    def submit(self, command, arguments):
        self.answer = answer(self.server, command, pickle.loads(pickle.dumps(arguments)))

    def result(self):
        succeeded, value = pickle.loads(pickle.dumps(self.answer))
        if not succeeded:
            raise value
        return value

    def close(self):
        pass


class Split(WorkerVectorEnv):
    def _start(self, servers, threads):
        return [Here(make) for make in servers]


def both(env_id, workers=2, number=N, **kwargs):
    """The environments in one process, and in several."""
    kwargs |= {"arm": "panda"} if env_id in OWN_ARM_TASKS else {}
    return [
        gym.make_vec(env_id, num_envs=number, threads=1, **kwargs, **each)
        for each in ({}, {"workers": workers})
    ]


def split(env_id, workers=2, **kwargs):
    """The environments in one object, and in several."""
    alone = both(env_id, **kwargs)[0].unwrapped
    given = {
        name: value
        for name, value in alone.spec.kwargs.items()
        if name not in ("num_envs", "vectorization_mode")
    }
    return alone, Split(type(alone), N, workers, **given)


def assert_same(mine, theirs):
    assert type(mine) is type(theirs)
    if isinstance(mine, dict):
        assert list(mine) == list(theirs)
        mine, theirs = list(mine.values()), list(theirs.values())
    if isinstance(mine, list | tuple) or getattr(mine, "dtype", None) is np.dtype(object):
        assert len(mine) == len(theirs)
        for a, b in zip(mine, theirs, strict=True):
            assert_same(a, b)
    elif isinstance(mine, np.ndarray):
        assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(mine, theirs)
    else:
        assert mine == theirs


def actions(env, seed=0):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32)


def numbers(state):
    """A state without what depends on what is simulated together: the work done, and numbers that nothing reads."""
    episodes = {name: part for name, part in (state["episodes"] or {}).items() if name != "physics"}
    return {**state, "episodes": episodes, "physics_steps": 0}


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_split_changes_nothing(env_id):
    """Resets, masks, steps with autoreset, infos, attributes and states of every id, bit for bit."""
    alone, several = split(env_id)
    assert_same(several.reset(seed=4), alone.reset(seed=4))
    for seed in range(2):
        assert_same(several.step(actions(alone, seed)), alone.step(actions(alone, seed)))
    mask = np.array([False, True, False, False, True])
    seeds = [None, 7, None, None, None]
    assert_same(*(each.reset(seed=seeds, options={"reset_mask": mask}) for each in (several, alone)))
    assert_same(several.scenes, alone.scenes)
    assert_same(numbers(several.state()), numbers(alone.state()))
    assert several.task == alone.task
    assert several.single_action_space == alone.single_action_space
    assert several.physics_steps > 0


@pytest.mark.parametrize("env_id", [OBSTACLES, STEP, MOVING])
def test_states_go_from_one_number_of_workers_to_another(env_id):
    alone, several = split(env_id)
    other = split(env_id, 3)[1]
    for each in (alone, several, other):
        each.reset(seed=0)
        each.step(actions(alone))
    several.reset(seed=90)
    several.restore(alone.state())
    other.restore(several.state())
    alone.restore(other.state())
    following = [[each.step(actions(alone, seed)) for seed in (1,)] for each in (alone, several, other)]
    assert_same(following[1], following[0])
    assert_same(following[2], following[0])


@pytest.mark.parametrize("env_id", [OBSTACLES, MOVING])
def test_given_scenes_and_their_errors_are_those_of_one_process(env_id):
    alone, several = split(env_id)
    alone.reset(seed=1)
    options = alone.scenes.as_options()
    several.reset(seed=2)
    assert_same(several.reset(seed=3, options=options), alone.reset(seed=3, options=options))
    near = Sphere(0.001, position=(0.0, 1.0, 0.0), name="ball")
    for obstacles in ([near], [[near]], [[near] if i == 4 else [] for i in range(N)]):
        given = {**options, "obstacles": obstacles}
        given.pop("courses", None)
        assert_same(several.reset(seed=3, options=given), alone.reset(seed=3, options=given))
    assert_same(several.reset(seed=3, options=options), alone.reset(seed=3, options=options))
    before = several.observe()
    far = options["goal"].copy()
    far[4] = 9.0
    ends = {name: options[name] for name in ("start", "goal")}
    ball = Sphere(0.02, position=(*options["start"][4], 0.0), name="ball")
    for wrong in (
        {**ends, "obstacles": [ball]},
        {**ends, "obstacles": [[ball] if i == 4 else [] for i in range(N)]},
        {"goal": far},
        {"goal": options["goal"][:3]},
        {"goal": [np.nan, 0.0]},
        {"obstacles": np.zeros((2, 1, 5))},
        {"nothing": 1},
        {"reset_mask": [True]},
        5,
    ):
        messages = []
        for each in (alone, several):
            with pytest.raises(ValueError, match=r"must|know|reach|touch") as caught:
                each.reset(options=wrong)
            messages.append(str(caught.value))
        assert messages[0] == messages[1]
        assert ("ball" in str(wrong)) == ("ball" in messages[0])
    assert_same(several.observe(), before)
    assert_same(several.step(actions(alone)), alone.step(actions(alone)))
    for wrong in (np.full(alone.action_space.shape, np.nan), np.zeros((N, 9)), "north"):
        for each in (alone, several):
            with pytest.raises(ValueError, match="action must"):
                each.step(wrong)


def test_processes_change_nothing_and_one_that_dies_is_named():
    """Real processes: messages, attributes, a killed worker."""
    alone, several = both(MOVING)
    assert isinstance(several.unwrapped, WorkerVectorEnv)
    assert_same(several.reset(seed=0), alone.reset(seed=0))
    kept = []
    for seed in range(3):
        results = [each.step(actions(alone, seed)) for each in (several, alone)]
        assert_same(*results)
        kept.append(results)
    for mine, theirs in kept:  # what was returned is not overwritten by what follows
        assert_same(mine, theirs)
    assert_same(several.unwrapped.last_rollout, alone.unwrapped.last_rollout)
    several.unwrapped.set_attr("mark", 3)
    assert several.unwrapped.get_attr("mark") == [3, 3]
    assert several.unwrapped.call("observe")[0]["goal"].shape == (2, 2)
    with pytest.raises(AttributeError, match=r"call\('execute_plan'\)"):
        several.unwrapped.execute_plan(None)
    with pytest.raises(AttributeError, match="nothing"):
        several.unwrapped.nothing  # noqa: B018
    os.kill(several.unwrapped._workers[1].pid, signal.SIGKILL)
    with pytest.raises(
        WorkerDiedError, match=r"worker 2 of 2 \(environments 2 to 4\) was killed by SIGKILL; all 5 "
    ):
        several.step(actions(alone))
    with pytest.raises(gym.error.ClosedEnvironmentError):
        several.reset()
    several.close()


def test_a_script_needs_no_guard_and_leaves_no_process():
    """As MuJoCo's and torch's threads do not survive a fork, and importing the main module again needs a guard."""
    script = """
        import gymnasium as gym, viapoint.envs
        envs = gym.make_vec("viapoint/PlanarReach-v0", num_envs=2, workers=2)
        envs.reset(seed=0)
        print(*(worker.pid for worker in envs.unwrapped._workers))
        """
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    for pid in map(int, done.stdout.split()):
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_arms_of_ones_own_are_known_in_the_processes(monkeypatch):
    monkeypatch.setitem(ARMS, "mine", dataclasses.replace(ARMS["panda"], name="mine"))
    env = gym.make_vec("viapoint/Reach-v0", num_envs=2, workers=1, arm="mine")
    assert env.reset(seed=0)[0]["goal"].shape == (2, 3)
    env.close()


def test_shapes_of_ones_own_are_known_in_the_processes(monkeypatch):
    @dataclasses.dataclass(frozen=True, eq=False)
    class Crate(Box):
        kind = "crate"

    monkeypatch.setitem(SHAPES, "crate", Crate)
    crate = Crate((0.05, 0.04, 0.03), position=(0.5, 0.0, 0.3))
    arguments = {"num_envs": 2, "shapes": ("capsule", "crate"), "vectorization_mode": "vector_entry_point"}
    seen = []
    for workers in (0, 2):
        env = gym.make_vec("viapoint/PandaObstacles-v0", workers=workers, **arguments)
        env.reset(seed=0, options={"obstacles": [[crate], [crate]]})
        seen.append(env.step(np.zeros((2, 4)))[0]["obstacles"])
        env.close()
    np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"workers": -1}, ValueError, "workers must be a whole number, 0 or more, got -1"),
        ({"workers": 1.5}, ValueError, "workers must be a whole number"),
        ({"workers": 4}, ValueError, "workers must be at most num_envs, which is 3, got 4"),
        ({"workers": 2, "speed": 1}, TypeError, "unknown keyword argument 'speed'; allowed are "),
        ({"workers": 2, "n_obstacles": -1}, ValueError, "n_obstacles"),
        ({"workers": 2, "threads": -1}, ValueError, "threads must be"),
        ({"workers": 2, "render_mode": "human"}, ValueError, "render_mode must be rgb_array"),
    ],
)
def test_bad_arguments_start_no_process(kwargs, error, message, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", None)
    with pytest.raises(error, match=message):
        ReachVectorEnv(3, **kwargs)
    with pytest.raises(TypeError, match=r"workers is an argument of gym\.make_vec"):
        gym.make(OBSTACLES, workers=2)
