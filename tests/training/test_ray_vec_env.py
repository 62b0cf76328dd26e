"""Environments in actors of Ray: equal seeds give the episodes of one process, and dead actors are replaced."""

import contextlib
import importlib
import os
import sys
from functools import partial

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from viapoint.envs.worker_process import WorkerDiedError
from viapoint.training import LostEpisodesCallback, RayVecEnv, TrainConfig, ViaVecEnv, train
from viapoint.training.io.files import read_arrays
from viapoint.training.io.ray_cluster import connect, import_ray
from viapoint.training.rollouts import ray_actors

OBSTACLES, MOVING = "viapoint/PlanarObstacles-v0", "viapoint/PlanarMovingObstacles-v0"
pytestmark = pytest.mark.usefixtures("no_hang")


@pytest.fixture(scope="module", autouse=True)
def ray(ray_lock):
    """One Ray of two cores for all tests."""
    with ray_lock:
        connect(cpus=2)
    yield import_ray()
    import_ray().shutdown()


def kill(ray, actor):
    """Kill an actor and wait until it is dead: until then it may answer another call."""
    ray.kill(actor)
    with contextlib.suppress(ray.exceptions.RayActorError):
        while True:
            ray.get(actor.__ray_ready__.remote())


def assert_same(mine, theirs):
    """Check results of `VecEnv`, apart from wall times."""
    if isinstance(mine, dict):
        assert mine.keys() == theirs.keys()
        mine, theirs = ([each[name] for name in mine if name != "t"] for each in (mine, theirs))
    if isinstance(mine, list | tuple):
        for a, b in zip(mine, theirs, strict=True):
            assert_same(a, b)
    else:
        np.testing.assert_array_equal(mine, theirs)


def actions(env, seed):
    shape = (env.num_envs, *env.action_space.shape)
    return np.random.default_rng(seed).uniform(-0.5, 0.5, shape).astype(np.float32)


@pytest.mark.parametrize("env_id", [OBSTACLES, MOVING])
def test_actors_of_a_native_batch_change_nothing_even_if_they_die(env_id, ray, monkeypatch):
    monkeypatch.setattr(ray_actors, "SNAPSHOT_EVERY", 3)
    alone, env = ViaVecEnv(env_id, 3, seed=2, threads=1), RayVecEnv(env_id, 3, seed=2, workers=2)
    assert isinstance(env, RayVecEnv)
    assert isinstance(env, ViaVecEnv)
    assert_same(env.reset(), alone.reset())
    for step in range(7):
        if step in (1, 6):  # before the first snapshot and after one
            kill(ray, env.venv._workers[1].handle._actor)
        assert_same(env.step(actions(env, step)), alone.step(actions(env, step)))
        assert_same(env.last_outcome, alone.last_outcome)
    assert (env.restarts, env.lost_episodes) == (2, 0)
    assert_same(env.state()["generators"], alone.state()["generators"])
    env.restore(alone.state())
    assert_same(env.step(actions(env, 9)), alone.step(actions(env, 9)))
    env.close()


def test_any_environment_of_gymnasium_runs_and_lost_episodes_are_no_failures(ray):
    alone, env = make_vec_env("CartPole-v1", 3, seed=1), RayVecEnv("CartPole-v1", 3, seed=1, workers=2)
    assert isinstance(env, VecEnv)
    first = env.reset()
    assert_same(first, alone.reset())
    pushes = np.random.default_rng(0).integers(0, 2, (40, 3))
    for push in pushes:
        assert_same(env.step(push), alone.step(push))
    env.set_attr("mark", 7, indices=[2])
    assert env.get_attr("mark", indices=[-1]) == [7]
    assert env.env_method("get_wrapper_attr", "gravity", indices=[2, 0]) == [9.8, 9.8]
    assert env.env_is_wrapped(Monitor) == [True] * 3
    kill(ray, env._actors[1]._actor)
    last = env._observation
    observation, reward, done, infos = env.step(pushes[0])
    assert_same(observation[:1], alone.step(pushes[0])[0][:1])
    assert done.tolist()[1:] == [True, True]
    assert reward.tolist()[1:] == [0.0, 0.0]
    for row in (1, 2):
        assert infos[row]["lost"]
        assert infos[row]["TimeLimit.truncated"]
        assert "episode" not in infos[row]  # statistics do not count it
        np.testing.assert_array_equal(infos[row]["terminal_observation"], last[row])
        assert (observation[row] != first[row]).all()  # other episodes than those of the first seeds
    assert "lost" not in infos[0]
    assert (env.restarts, env.lost_episodes) == (1, 2)
    assert not any("lost" in info for info in env.step(pushes[1])[3])
    kill(ray, env._actors[0]._actor)  # noticed by a question that is no step
    assert env.get_attr("render_mode") == [None] * 3
    assert [bool(info.get("lost")) for info in env.step(pushes[2])[3]] == [True, False, False]
    env.seed(1)
    assert_same(env.reset(), first)
    env.close()
    env.close()


class Pretend:
    """Environments of which one loses its episode at some steps."""

    def __init__(self, steps):
        self.env, self.steps, self.count = make_vec_env("Pendulum-v1", 2, seed=0), steps, 0
        step_wait = self.env.step_wait

        def lossy():
            observation, reward, done, infos = step_wait()
            self.count += 1
            if self.count in self.steps:
                reward[1], done[1] = 0.0, True
                infos[1] = {"lost": True, "TimeLimit.truncated": True, "terminal_observation": observation[1]}
            return observation, reward, done, infos

        self.env.step_wait = lossy


@pytest.mark.parametrize("told", [True, False])
def test_a_replay_buffer_holds_no_lost_transition(told):
    """A lost one is replaced by that of the other environment, whose value is bootstrapped as before."""
    lossy = Pretend(steps=(3, 5))
    callback = CallbackList([LostEpisodesCallback()] if told else [])
    model = SAC("MlpPolicy", lossy.env, learning_starts=100, buffer_size=100, seed=0).learn(
        16, callback=callback
    )
    buffer = model.replay_buffer
    assert ((buffer.rewards[:8] == 0.0).sum() == 0) == told
    for step in (2, 4) if told else ():
        for part in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards):
            np.testing.assert_array_equal(part[step, 1], part[step, 0])
        assert buffer.dones[step, 1] * (1.0 - buffer.timeouts[step, 1]) == 0.0


def config(folder, **kwargs):
    small = {"learning_starts": 8, "gradient_steps": 1, "policy_kwargs": {"candidates": 8, "refinements": 0}}
    return TrainConfig(
        env="viapoint/PlanarReach-v0", n_timesteps=24, n_envs=4, eval_every=0, checkpoint_every=8, out=folder,
        progress=False, hyperparameters=small, **kwargs,
    )  # fmt: skip


def test_training_does_not_depend_on_rollout_workers(tmp_path, monkeypatch):
    """In actors, of which one dies, and in processes, of which one dies and the run is resumed."""
    runs = [train(config(tmp_path / "alone"))]
    step_wait, left = ViaVecEnv.step_wait, iter(range(4))

    def mortal(self):
        if next(left, None) is None:
            worker = self.venv.unwrapped._workers[1]
            import_ray().kill(worker.handle._actor) if isinstance(self, RayVecEnv) else os.kill(worker.pid, 9)
        return step_wait(self)

    monkeypatch.setattr(ViaVecEnv, "step_wait", mortal)
    runs.append(train(config(tmp_path / "ray", rollout_workers=2, on="ray")))
    left = iter(range(4))
    with pytest.raises(Exception, match=r"worker 2 of 2 .*SIGKILL.*--resume goes on from there"):
        train(config(tmp_path / "local", rollout_workers=2))
    monkeypatch.undo()
    runs.append(train(TrainConfig(out=tmp_path / "local", resume=True, rollout_workers=2, progress=False)))
    first, *others = (read_arrays(run.final / "weights.safetensors") for run in runs)
    for other in others:
        assert_same(other, first)


def test_an_actor_that_always_dies_at_the_same_point_is_named():
    actor = ray_actors.RecoveringActor(partial(importlib.import_module, "os"), "worker 1 of 1", 1)
    actor.result()
    actor.submit("_exit", (3,))
    with pytest.raises(WorkerDiedError, match=r"worker 1 of 1 died .*, 3 times at the same point"):
        actor.result()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"workers": 0}, "workers must be a whole number, 1 or more, got 0"),
        ({"workers": 5}, "workers must be at most num_envs, which is 4, got 5"),
        ({"workers": 3}, "the cluster has 2 cores, fewer than the 3 that the workers need"),
        ({"on": "local"}, "on must be ray or ray://HOST:PORT, got 'local'"),
        ({"on": "ray://127.0.0.1:1"}, "no Ray cluster can be used at ray://127.0.0.1:1"),
        ({"threads": 0}, "threads must be a whole number, 1 or more, got 0"),
        ({"n_obstacles": -1}, "n_obstacles"),
    ],
)
def test_bad_arguments_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        RayVecEnv(OBSTACLES, 4, **kwargs)
    if "threads" not in kwargs and "n_obstacles" not in kwargs:
        with pytest.raises(ValueError, match=message):
            RayVecEnv("CartPole-v1", 4, **kwargs)


def test_what_is_missing_is_said(monkeypatch, tmp_path):
    with pytest.raises(
        ValueError, match=r"there is no environment 'Nothing-v0'.*registers viapoint/PlanarReach-v0"
    ):
        RayVecEnv("Nothing-v0", 2)
    with pytest.raises(TypeError, match="speed"):
        RayVecEnv("CartPole-v1", 2, speed=1)
    for wrong, message in (
        ({"on": "ray"}, "on=ray needs rollout workers"),
        ({"on": "mars", "rollout_workers": 2}, "on must be local, ray or ray://HOST:PORT, got 'mars'"),
        ({"rollout_workers": 5}, "rollout_workers must be at most n_envs, which is 4, got 5"),
        ({"env_kwargs": {"workers": 2}}, "workers cannot be among env_kwargs: --rollout-workers"),
    ):
        with pytest.raises(ValueError, match=message):
            config(tmp_path, **wrong)
    with pytest.raises(ValueError, match="workers must be 0 for CartPole-v1"):
        ViaVecEnv("CartPole-v1", 2, workers=2)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'viapoint\[cluster\]'"):
        train(config(tmp_path / "run", rollout_workers=2, on="ray"))
    assert not (tmp_path / "run").exists()
