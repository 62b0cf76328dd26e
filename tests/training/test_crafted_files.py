"""Files made to deceive: each is refused with its name and the reason, and none of what it carries is run."""

import hashlib
import io
import json
import os
import pickle
import resource
import struct
import zipfile

import numpy as np
import pytest
from safetensors.numpy import load_file, save, save_file

from viapoint.envs.actions.via_points import MOST_VIAS
from viapoint.envs.scenes.families import MOST_OBSTACLES
from viapoint.training.algorithms.model_io import build, load_model, save_model
from viapoint.training.config.presets import PRESETS
from viapoint.training.io.files import BadFileError
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.checkpoints import _digest, read_checkpoint, write_checkpoint

ENV = "viapoint/PlanarObstacles-v0"
MEGABYTE = 1 << 20
SMALL = {"learning_starts": 8, "batch_size": 8, "buffer_size": 64, "policy_kwargs": {"net_arch": [8]}}


@pytest.fixture(scope="module")
def env():
    env = ViaVecEnv(ENV, 2, seed=0, threads=1)
    yield env
    env.close()


def new(env):
    preset = PRESETS["sac"]
    return build("sac", preset.policy, env, {**preset.arguments(), **SMALL}, seed=1)


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


def with_header(header, data=b""):
    """A safetensors file with any header."""
    encoded = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(encoded)) + encoded + data


def tensor(**changes):
    return {"w": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8], **changes}}


def test_a_pickle_is_not_opened_wherever_it_hides(model):
    canary = model / "canary"
    evil = pickle.dumps(Canary(canary))
    archive = zipped(data=json.dumps({"policy_class": {":serialized:": "x"}}), **{"policy.pth": evil})
    hidden = save({"w": np.frombuffer(evil.ljust(len(evil) + -len(evil) % 4), np.float32)})
    for content in (evil, archive, hidden, with_header(evil), with_header(tensor(), evil)):
        (model / "weights.safetensors").write_bytes(content)
        with pytest.raises(BadFileError, match=r"weights\.safetensors"):
            load_model(model)
    for path in (b"\x80\x04", archive):
        (model / "model.json").write_bytes(path)
        with pytest.raises(BadFileError, match=r"model\.json"):
            load_model(model)
    assert not canary.exists()


@pytest.mark.parametrize(
    "content",
    [
        struct.pack("<Q", 2**63) + b"{}",
        struct.pack("<Q", 10**9) + b"{}",
        struct.pack("<Q", 2**64 - 1),
        with_header(tensor(shape=[2**62, 2**62])),
        with_header(tensor(shape=[10**9], data_offsets=[0, 4 * 10**9])),
        with_header(tensor(shape=[-1])),
        with_header(tensor(data_offsets=[8, 0]), bytes(8)),
        with_header(tensor(data_offsets=[0, 10**18]), bytes(8)),
        with_header({**tensor(), "v": tensor()["w"]}, bytes(8)),
        with_header(tensor(dtype="PICKLE"), bytes(8)),
        with_header(tensor(dtype="F32 "), bytes(8)),
        with_header({"w": "all of it"}),
        with_header({"w": {"dtype": "F32"}}),
        with_header(b"[" * 100_000),
        with_header(b"\xff\xfe"),
        with_header([1, 2]),
        with_header(tensor(), bytes(4)),
        with_header(tensor(), bytes(12)),
    ],
    ids=range(18),
)
def test_headers_that_lie_are_refused(content, model):
    (model / "weights.safetensors").write_bytes(content)
    with pytest.raises(BadFileError, match=r"weights\.safetensors"):
        load_model(model)


def test_names_cannot_lead_out_of_the_folder(model, tmp_path_factory):
    """A tensor's name is a name and no path; an environment's is looked up and never imported."""
    arrays = load_file(model / "weights.safetensors")
    outside = tmp_path_factory.mktemp("outside")
    save_file({f"../{outside.name}/x": np.zeros(1, np.float32), **arrays}, model / "weights.safetensors")
    with pytest.raises(BadFileError, match="unknown to the model"):
        load_model(model)
    assert list(outside.iterdir()) == []
    for name in ("../../etc/passwd", "os:system", "viapoint/../Planar-v0", "", None, ["x"]):
        edit(model, env={"id": name, "kwargs": {}})
        with pytest.raises(BadFileError, match=r"model\.json"):
            load_model(model)


def edit(folder, **changes):
    record = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps({**record, **changes}))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"[" * 200_000, "JSON"),
        (b'{"a":' * 100_000, "JSON"),
        (b'{"format": ' + b"9" * 100_000 + b"}", "JSON"),
        (b'{"format": 1e999}', "too large a number"),
        (b'{"format": NaN}', "NaN is no JSON number"),
        (b'{"format": 1, "format": 2}', "'format' is there twice"),
        (b'{"format": 1}', "does not describe"),
        (b"[]", "must hold a JSON object"),
        (b"\xff\xfe\x00", "JSON"),
        (b" " * (2 * MEGABYTE), "must have at most 1048576 bytes"),
    ],
    ids=range(10),
)
def test_json_that_is_none_is_refused(content, reason, model):
    (model / "model.json").write_bytes(content)
    with pytest.raises(BadFileError, match=reason):
        load_model(model)


HUGE = [
    {"policy_kwargs": {"net_arch": [50_000, 50_000]}},
    {"policy_kwargs": {"net_arch": [3_000_000_000]}},
    {"policy_kwargs": {"net_arch": [8] * 30_000}},
    {"policy_kwargs": {"n_critics": 10**9, "net_arch": [8]}},
]


def test_what_describes_more_than_its_weights_is_refused_before_memory_is_taken(model):
    record = json.loads((model / "model.json").read_text())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for change in HUGE:
        edit(model, hyperparameters={**record["hyperparameters"], **change})
        with pytest.raises(BadFileError, match=r"larger networks|allocate memory"):
            load_model(model)
    edit(model, hyperparameters={**record["hyperparameters"], "buffer_size": 10**15})
    load_model(model)  # to decide, it needs no buffer
    for kwargs in (
        {"n_obstacles": 10**9},
        {"n_obstacles": [1, MOST_OBSTACLES + 1]},
        {"n_via": MOST_VIAS + 1},
        {"threads": 10**6},
    ):
        edit(model, **{**record, "env": {"id": ENV, "kwargs": kwargs}})
        with pytest.raises(BadFileError, match="may be at most"):
            load_model(model)
    for name in ("weights.safetensors", "model.json"):
        with (model / name).open("r+b") as file:
            file.truncate(1 << 40)  # takes no room on the disk
        with pytest.raises(BadFileError, match=f"{name}: must have at most"):
            load_model(model)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024


def test_a_single_flipped_bit_is_noticed(model):
    path = model / "weights.safetensors"
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    with pytest.raises(BadFileError, match="is damaged"):
        load_model(model)


@pytest.mark.parametrize("name", ["model.json", "weights.safetensors"])
def test_what_would_be_read_for_ever_is_refused(name, model):
    (model / name).unlink()
    os.mkfifo(model / name)
    with pytest.raises(BadFileError, match=f"{name}: is no regular file"):
        load_model(model)
    (model / name).unlink()
    (model / name).symlink_to("/dev/zero")
    with pytest.raises(BadFileError, match=f"{name}: is no regular file"):
        load_model(model)


def test_a_newer_format_says_which_version_wrote_it(model):
    edit(model, format=9, viapoint="7.1.0")
    with pytest.raises(BadFileError, match=r"must have format 1, got 9; it was written by viapoint 7\.1\.0"):
        load_model(model)


@pytest.fixture(scope="module")
def checkpoint(env, tmp_path_factory):
    model = new(env)
    model.learn(16)
    folder = tmp_path_factory.mktemp("checkpoint") / "16"
    write_checkpoint(model, folder, {"curve": []})
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def forged(checkpoint, folder, change):
    """A checkpoint with other content and hashes that are right."""
    state = json.loads(checkpoint["state.json"])
    (folder / "tensors.safetensors").write_bytes(checkpoint["tensors.safetensors"])
    arrays = load_file(folder / "tensors.safetensors")
    change(state, arrays)
    save_file(arrays, folder / "tensors.safetensors")
    state["sha256"] = hashlib.sha256((folder / "tensors.safetensors").read_bytes()).hexdigest()
    state["digest"] = _digest(state)
    (folder / "state.json").write_text(json.dumps(state))


FORGERIES = {
    "another format": (lambda state, arrays: state.update(format=3), "must have format 1 or 2"),
    "no model": (lambda state, arrays: state.pop("model"), "must have format"),
    "no counters": (lambda state, arrays: state.pop("counters"), "'counters'"),
    "a missing tensor": (lambda state, arrays: arrays.pop("buffer/arrays/rewards"), "rewards"),
    "no random state": (lambda state, arrays: state["random"].update(numpy={}), "does not fit"),
    "a row beyond": (lambda state, arrays: state["buffer"].update(pos=10**9), "no row 1000000000"),
    "other shapes": (
        lambda state, arrays: arrays.update({"buffer/arrays/rewards": np.zeros((8, 9), np.float32)}),
        "rewards of the replay buffer must fit",
    ),
    "another environment": (lambda state, arrays: state["env"].update(generators=[]), "does not fit"),
    "nothing besides": (lambda state, arrays: state.pop("extra"), "'extra'"),
    "another algorithm": (lambda state, arrays: state["model"].update(algorithm="ppo"), "of another model"),
}


def test_the_checkpoint_itself_is_good(env, checkpoint, tmp_path):
    forged(checkpoint, tmp_path, lambda state, arrays: None)
    assert read_checkpoint(new(env), tmp_path) == {"curve": []}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_checkpoint_is_refused(name, env, checkpoint, tmp_path):
    change, reason = FORGERIES[name]
    forged(checkpoint, tmp_path, change)
    with pytest.raises(BadFileError, match=reason):
        read_checkpoint(new(env), tmp_path)


def test_a_number_changed_in_a_state_is_noticed(env, checkpoint, tmp_path):
    for name, content in checkpoint.items():
        (tmp_path / name).write_bytes(content)
    changed = checkpoint["state.json"].replace(b'"num_timesteps": 16', b'"num_timesteps": 17')
    assert changed != checkpoint["state.json"]
    (tmp_path / "state.json").write_bytes(changed)
    with pytest.raises(BadFileError, match="is damaged"):
        read_checkpoint(new(env), tmp_path)
