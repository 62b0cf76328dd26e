"""What a training tells about itself: the values of its TensorBoard log, its learning curve, its progress."""

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from viapoint.training.config.configs import TrainConfig
from viapoint.training.runs import callback
from viapoint.training.runs.trainer import train
from viapoint.training.scene_sets.scene_set import BANDS


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
    for tag, name in callback.VALIDATED.items():
        for event, record in zip(log[tag], run.curve, strict=True):
            value = record[name]["rate"] if isinstance(record[name], dict) else record[name]
            assert event.value == pytest.approx(value, rel=1e-6)
    for band in BANDS:
        shown = [event.value for event in log[callback.BAND_TAGS[band]]]
        assert shown == pytest.approx([record["success_by_band"][band]["rate"] for record in run.curve])


def test_rates_are_rates_and_times_are_times(run, log):
    assert {"rollout/success_rate", "train/clearance_loss", *callback.OUTCOMES} <= set(log)
    for tag, events in log.items():
        values = np.array([event.value for event in events])
        if tag.endswith("_rate") or "_rate_" in tag:
            assert ((values >= 0.0) & (values <= 1.0)).all(), tag
        if tag.endswith("duration"):
            assert ((values > 0.5) & (values < 1.3)).all(), tag
    for record in run.curve:
        assert record["simulated_seconds"] == pytest.approx(0.002 * record["physics_steps"])
    last = run.curve[-1]
    assert 0.6 < last["simulated_seconds"] / last["decisions"] < 1.3  # a movement and its settling


def test_the_bar_shows_the_last_validation(shipped, tmp_path, capsys):
    run = train(
        TrainConfig(
            n_timesteps=64,
            n_envs=32,
            eval_every=32,
            eval_scenes=4,
            checkpoint_every=32,
            out=tmp_path / "run",
            env_kwargs={"threads": 1},
            hyperparameters={"learning_starts": 32},
        )
    )
    success = f"{100.0 * run.curve[-1]['success']['rate']:.1f} %"
    assert f"validation={success}" in capsys.readouterr().err.rstrip().splitlines()[-1]
    assert f"success {success}" in repr(run)
