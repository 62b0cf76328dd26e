"""Files made to deceive: each is refused by its name, and none of what it carries is run."""

import io
import json
import os
import pickle
import resource
import struct
import sys
import zipfile

import numpy as np
import pytest
import torch
from helpers import PLANE, SENSED
from safetensors.numpy import load_file, save, save_file

from viapoint.envs.plans import MOST_VIAS
from viapoint.envs.task import MOST_OBSTACLES
from viapoint.training import Run, load_agent
from viapoint.training.agents.model_io import build, load_model, save_model
from viapoint.training.configs import PRESETS
from viapoint.training.files import BadFileError
from viapoint.training.runs import read_checkpoint, read_state, write_checkpoint

RECORD, WEIGHTS = "model.json", "weights.safetensors"
SMALL = {"learning_starts": 8, "batch_size": 8, "buffer_size": 64, "policy_kwargs": {"net_arch": [8]}}


def new(env):
    preset = PRESETS["sac"]
    return build("sac", preset.policy, env, {**preset.hyperparameters, **SMALL}, seed=1)


@pytest.fixture(scope="module")
def saved(env, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    save_model(new(env), folder)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def model(saved, tmp_path):
    """A good model's folder, to be spoilt."""
    for name, content in saved.items():
        (tmp_path / name).write_bytes(content)
    load_model(tmp_path)
    return tmp_path


def edit(folder, **changes):
    record = json.loads((folder / RECORD).read_text())
    (folder / RECORD).write_text(json.dumps({**record, **changes}))


def check_refused(folder, name):
    """Check that the error is about one of the files."""
    with pytest.raises(BadFileError) as error:
        load_model(folder)
    assert error.value.path == folder / name


class Canary:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def zipped(**members):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return content.getvalue()


def test_a_pickle_is_not_opened_wherever_it_hides(model):
    canary = model / "canary"
    evil = pickle.dumps(Canary(canary))
    archive = zipped(data=json.dumps({"policy_class": {":serialized:": "x"}}), **{"policy.pth": evil})
    hidden = save({"w": np.frombuffer(evil.ljust(len(evil) + -len(evil) % 4), np.float32)})
    for content in (evil, archive, hidden):
        (model / WEIGHTS).write_bytes(content)
        check_refused(model, WEIGHTS)
    for content in (evil, archive):
        (model / RECORD).write_bytes(content)
        check_refused(model, RECORD)
    assert not canary.exists()


def test_no_module_is_imported_by_name(model, monkeypatch):
    (model / "evil_module.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(model)
    edit(model, env={"id": "evil_module:viapoint/PlanarReach-v0", "kwargs": {}})
    check_refused(model, RECORD)
    settings = {"env": "evil_module:viapoint/PlanarReach-v0", "algo": "sac", "seed": 0, "n_timesteps": 8}
    (model / "config.json").write_text(json.dumps(settings))
    assert Run(model).config.env == "viapoint/PlanarReach-v0"
    assert "evil_module" not in sys.modules


HUGE = b'{"w":{"dtype":"F32","shape":[1000000000],"data_offsets":[0,4000000000]}}'
HEADERS = b"", struct.pack("<Q", len(HUGE)) + HUGE, struct.pack("<Q", 2**63) + b"{}"
CONTENTS = [
    *((WEIGHTS, content) for content in HEADERS),
    *((RECORD, content) for content in (b"", b"[" * 200_000, b"[]", b"\xff\xfe\x00", b" " * (2 << 20))),
    *((RECORD, b'{"format": ' + number + b"}") for number in (b"9" * 100_000, b"1e999", b"NaN")),
]


@pytest.mark.parametrize(("name", "content"), CONTENTS)
def test_content_that_is_none_is_refused(name, content, model):
    (model / name).write_bytes(content)
    check_refused(model, name)


@pytest.mark.parametrize(
    "change",
    [
        {"algorithm": "os.system"},
        {"policy": "CnnPolicy2"},
        {"hyperparameters": {"tensorboard_log": "x"}},
        *({"num_timesteps": number} for number in (-5, 1e300, "7", True)),
        {"hyperparameters": {"learning_rate": {"kind": "eval"}}},
        *({"env": {"id": name, "kwargs": {}}} for name in ("../../etc/passwd", "os:system", None, ["x"])),
    ],
)
def test_a_record_of_something_else_is_refused(change, model):
    edit(model, **change)
    check_refused(model, RECORD)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda arrays, name: {**arrays, name: arrays[name][:-1]},
        lambda arrays, name: {**arrays, name: np.full_like(arrays[name], np.nan)},
        lambda arrays, name: {**arrays, name: arrays[name].astype(np.float64)},
        lambda arrays, name: {**arrays, "../more": np.zeros(3, np.float32)},
        lambda arrays, name: {each: array for each, array in arrays.items() if each != name},
    ],
)
def test_weights_that_do_not_fit_are_refused(spoil, model):
    arrays = load_file(model / WEIGHTS)
    save_file(spoil(arrays, sorted(arrays)[0]), model / WEIGHTS)
    check_refused(model, WEIGHTS)


def test_what_describes_more_than_its_weights_is_refused_before_memory_is_taken(model):
    record = json.loads((model / RECORD).read_text())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for change in (
        {"policy_kwargs": {"net_arch": [3_000_000_000]}},
        {"policy_kwargs": {"net_arch": [8] * 30_000}},
        {"policy_kwargs": {"n_critics": 10**9, "net_arch": [8]}},
    ):
        edit(model, hyperparameters={**record["hyperparameters"], **change})
        check_refused(model, RECORD)
    edit(model, hyperparameters={**record["hyperparameters"], "buffer_size": 10**15})
    load_model(model)  # to decide, it needs no buffer
    for kwargs in ({"n_obstacles": [1, MOST_OBSTACLES + 1]}, {"n_via": MOST_VIAS + 1}, {"nothing": 1}):
        edit(model, **{**record, "env": {**record["env"], "kwargs": kwargs}})
        check_refused(model, RECORD)
    for name in (WEIGHTS, RECORD):
        with (model / name).open("r+b") as file:
            file.truncate(1 << 40)  # takes no room on the disk
        check_refused(model, name)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024


@pytest.mark.parametrize(
    ("env_id", "change"),
    [
        (PLANE, {"candidates": 10**9}),
        (PLANE, {"refinements": 64, "per_refinement": 1024}),
        (PLANE, {"refine": 10**9}),
        (SENSED, {"instants": 10**9}),
    ],
)
def test_what_could_not_decide_in_time_is_refused(env_id, change, tmp_path):
    load_agent(env_id).save(tmp_path)
    hyperparameters = json.loads((tmp_path / RECORD).read_text())["hyperparameters"]
    policy = {**hyperparameters["policy_kwargs"], **change}
    edit(tmp_path, hyperparameters={**hyperparameters, "policy_kwargs": policy})
    check_refused(tmp_path, RECORD)


@pytest.mark.parametrize("name", [RECORD, WEIGHTS])
def test_what_is_cut_damaged_missing_or_would_be_read_for_ever_is_refused(name, model):
    content = bytearray((model / name).read_bytes())
    (model / name).write_bytes(content[: len(content) // 2])
    check_refused(model, name)
    content[-3] ^= 1
    (model / name).write_bytes(content)
    check_refused(model, name)
    (model / name).unlink()
    check_refused(model, name)
    os.mkfifo(model / name)
    check_refused(model, name)
    (model / name).unlink()
    (model / name).symlink_to("/dev/zero")
    check_refused(model, name)


@pytest.fixture(scope="module")
def checkpoint(env, tmp_path_factory):
    model = new(env)
    model.learn(16)
    path = tmp_path_factory.mktemp("checkpoint") / "16.pt"
    write_checkpoint(model, path, 5.0)
    return path


def test_a_checkpoint_with_code_is_not_opened(env, checkpoint, tmp_path):
    path, canary = tmp_path / "evil.pt", tmp_path / "canary"
    torch.save({**read_state(checkpoint), "extra": Canary(canary)}, path)
    with pytest.raises(BadFileError):
        read_checkpoint(new(env), path)
    assert not canary.exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state.update(format=1),
        lambda state: state.pop("model"),
        lambda state: state["arrays"].pop("counters"),
        lambda state: state["arrays"]["random"].update(numpy={}),
        lambda state: state["model"].update(algorithm="ppo"),
        lambda state: state["arrays"]["buffer"]["arrays"].update(rewards=torch.zeros((8, 9))),
    ],
)
def test_a_forged_checkpoint_is_refused(change, env, checkpoint, tmp_path):
    path, state = tmp_path / "forged.pt", read_state(checkpoint)
    torch.save(state, path)
    assert read_checkpoint(new(env), path) == 5.0
    change(state)
    torch.save(state, path)
    with pytest.raises(BadFileError):
        read_checkpoint(new(env), path)


def test_a_newer_format_says_which_version_wrote_it(model):
    edit(model, format=9, viapoint="7.1.0")
    with pytest.raises(BadFileError, match=r"7\.1\.0"):
        load_model(model)
