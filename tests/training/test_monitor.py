"""What a training tells about itself: the values of its TensorBoard log, its learning curve, its progress."""

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from viapoint.training.config.configs import TrainConfig
from viapoint.training.runs import callback
from viapoint.training.runs.trainer import train


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return train(
        TrainConfig(
            out=tmp_path_factory.mktemp("runs") / "run",
            n_timesteps=128,
            n_envs=64,
            eval_every=64,
            eval_scenes=40,
            env_kwargs={"threads": 1},
            hyperparameters={"learning_starts": 64, "gradient_steps": 1},
            progress=False,
        )
    )


@pytest.fixture(scope="module")
def log(run):
    events = EventAccumulator(str(run.folder / "tensorboard"))
    events.Reload()
    return {tag: events.Scalars(tag) for tag in events.Tags()["scalars"]}


def test_the_log_says_what_the_learning_curve_says(run, log):
    assert [event.step for event in log["validation/success_rate"]] == [0, 64, 128]
    for name in callback.VALIDATED:
        values = [record[name] for record in run.curve]
        rates = isinstance(values[0], dict)
        shown = [event.value for event in log[f"validation/{name}_rate" if rates else f"validation/{name}"]]
        expected = [value["rate"] for value in values] if rates else [v for v in values if v is not None]
        assert shown == pytest.approx(expected, rel=1e-6)
    assert {"rollout/success_rate", "rollout/collision_rate", "rollout/duration"} <= set(log)
    for record in run.curve:
        assert record["simulated_seconds"] == pytest.approx(0.002 * record["physics_steps"])
