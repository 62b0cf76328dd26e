"""Trainings that discount by time: the environments tell it, runs and models know its unit."""

import gymnasium as gym
import numpy as np
import pytest
from decision_chain import SECONDS, Chain

from viapoint.envs.velocity_env import VelocityVectorEnv
from viapoint.training.algorithms.model_io import load_model
from viapoint.training.algorithms.smdp_buffers import unit_of
from viapoint.training.config.configs import TrainConfig
from viapoint.training.io.files import BadFileError, read_arrays, read_json
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import train

STEP = "viapoint/PlanarObstaclesStep-v0"


class Uneven(VelocityVectorEnv):
    """Steps that are said to have taken as long as the hand has moved."""

    def execute_actions(self, actions):
        decision = super().execute_actions(actions)
        return decision._replace(info={**decision.info, "elapsed": 0.04 + decision.info["path_length"]})


@pytest.fixture
def uneven(monkeypatch):
    """The step-wise environment by its id, telling the time of each step."""
    monkeypatch.setattr(gym.spec(STEP), "vector_entry_point", Uneven)


def config(folder, algo, **changes):
    hyperparameters = {
        "sac": {"learning_starts": 32, "gradient_steps": 1, "batch_size": 16, "buffer_size": 96},
        "ppo": {"n_steps": 2, "batch_size": 16, "n_epochs": 2},
    }
    values = {
        "out": folder, "env": STEP, "algo": algo, "n_timesteps": 160, "n_envs": 16, "eval_every": 0,
        "checkpoint_every": 64, "env_kwargs": {"threads": 1, "n_obstacles": 1},
        "hyperparameters": hyperparameters[algo], "discount_unit": 0.1, "progress": False,
    }  # fmt: skip
    return TrainConfig(**{**values, **changes})


def test_every_info_of_the_vector_environment_tells_the_time(uneven):
    env = ViaVecEnv(STEP, 6, seed=0, threads=1)
    env.reset()
    ended = 0
    for _ in range(40):
        *_, done, infos = env.step(np.full((6, 2), 0.9, np.float32))
        assert all(info["elapsed"] >= 0.04 for info in infos)
        assert all(("episode" in info) == over for info, over in zip(infos, done, strict=True))
        ended += done.sum()
    assert ended
    env.close()


class Midway(Chain):
    """Begins anywhere but at the end, so that copies end at different times."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(3))
        return self._observed(), {}


def test_single_environments_tell_the_time_of_their_last_step_too():
    gym.register("test/Midway-v0", entry_point=Midway)
    env = ViaVecEnv("test/Midway-v0", 5, seed=0)
    observed = env.reset()
    mixed = 0
    for _ in range(20):
        expected = SECONDS[observed.argmax(axis=-1)]
        observed, _, done, infos = env.step(np.zeros((5, 1)))
        assert [info["elapsed"] for info in infos] == expected.tolist()
        mixed += 0 < done.sum() < 5
    assert mixed
    env.close()
    del gym.registry["test/Midway-v0"]


@pytest.mark.parametrize("algo", ["sac", "ppo"])
def test_a_run_that_discounts_by_time_resumes_bit_for_bit(algo, uneven, tmp_path, monkeypatch):
    whole = train(config(tmp_path / "whole", algo))
    other = train(config(tmp_path / "other", algo, discount_unit=0.3))
    with monkeypatch.context() as patch:
        step, left = ViaVecEnv.step_wait, iter(range(7))

        def mortal(self):
            if next(left, None) is None:
                raise SystemError("killed")
            return step(self)

        patch.setattr(ViaVecEnv, "step_wait", mortal)
        with pytest.raises(SystemError, match="killed"):
            train(config(tmp_path / "killed", algo))
    resumed = train(TrainConfig(out=tmp_path / "killed", resume=True, progress=False))
    tensors = [read_arrays(run.checkpoints()[-1] / "tensors.safetensors") for run in (whole, resumed, other)]
    assert set(tensors[0]) == set(tensors[1])
    for name, tensor in tensors[0].items():
        np.testing.assert_array_equal(tensor, tensors[1][name], err_msg=name)
    if algo == "sac":
        discounts = tensors[0]["buffer/arrays/discounts"]
        assert len(np.unique(discounts)) > 10
    weights = [read_arrays(run.folder / "final" / "weights.safetensors") for run in (whole, other)]
    assert any((weights[0][name] != weights[1][name]).any() for name in weights[0])


def test_models_and_checkpoints_know_their_unit(uneven, tmp_path):
    run = train(config(tmp_path / "run", "sac"))
    assert Run(run.folder).config.discount_unit == 0.1
    assert read_json(run.folder / "final" / "model.json")["discount_unit"] == 0.1
    assert unit_of(load_model(run.folder / "final")) == 0.1
    path = run.folder / "config.json"
    path.write_text(path.read_text().replace('"discount_unit": 0.1', '"discount_unit": 0.2'))
    with pytest.raises(BadFileError, match=r"discount_unit was 0\.1, is 0\.2"):
        train(TrainConfig(out=run.folder, resume=True, n_timesteps=320, progress=False))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"discount_unit": 0.0}, "discount_unit must be a positive number of seconds, got 0.0"),
        ({"env": "viapoint/PlanarObstacles-v0", "algo": "viaq"}, "must be None for viaq"),
    ],
)
def test_the_configuration_refuses_what_cannot_be_meant(changes, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        TrainConfig(**{"env": STEP, "algo": "sac", "discount_unit": 0.1, **changes})


def test_n_steps_and_time_are_refused_together(uneven, tmp_path):
    with pytest.raises(ValueError, match="n_steps must be 1"):
        train(config(tmp_path, "sac", hyperparameters={"n_steps": 3}))
