"""The commands, from configurations and words to files: training, evaluation, films, demo, doctor and fit."""

import io
import json
import os
import pty
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pandas as pd
import pytest
from helpers import MOVING, PLANE, REACH, SENSED, STEP, UR5E, scenes_of
from matplotlib.image import imread
from PIL import Image

from viapoint.primitives import fit_via_points, through
from viapoint.training import GeometrySearch, Run, TrainConfig, configs, evaluate, load_agent
from viapoint.training.agents.model_io import ALGORITHMS, check_hyperparameters
from viapoint.training.cli import demo, doctor
from viapoint.training.cli import entry as cli
from viapoint.training.configs import DemoConfig, EvaluateConfig, from_words, to_words
from viapoint.training.trainer import RunCallback, TrainingStoppedError
from viapoint.training.video import record_video

MAIN = "from viapoint.training.cli.entry import main; main()"
FEW = "gradient_steps=1", 'policy_kwargs={"candidates":32,"refinements":1,"per_refinement":16}'
"""Hyperparameters of an agent that learns and decides quickly."""


def run(*words):
    cli.main([str(word) for word in words])


def test_errors_of_options_are_the_same_on_a_terminal(capsys):
    words = "play", "--out", "x.mp4"
    with pytest.raises(SystemExit):
        run(*words)
    shown, terminal = pty.openpty()
    command = [sys.executable, "-c", MAIN, *words]
    subprocess.run(command, stdin=terminal, stdout=terminal, stderr=terminal)
    assert os.read(shown, 10_000).decode().splitlines() == capsys.readouterr().err.splitlines()


@pytest.mark.parametrize("words", [(), ("help",), ("--help",)])
def test_the_help_fits_a_screen(words, capsys):
    with pytest.raises(SystemExit) as end:
        run(*words)
    lines = capsys.readouterr().out.splitlines()
    assert not end.value.code
    assert set(cli.COMMANDS) <= {line.partition("  ")[2].partition(" ")[0] for line in lines}
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80


def test_output_that_nobody_reads_ends_the_command_without_a_word():
    command = [sys.executable, "-c", MAIN, "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


@pytest.mark.parametrize("output", [io.TextIOWrapper(io.BytesIO(), "ascii"), None])
def test_names_are_printed_where_the_output_knows_only_ascii_or_is_closed(output, monkeypatch):
    monkeypatch.setattr(sys, "stdout", output)
    monkeypatch.setattr(cli, "run_command", lambda config: print("runs/größe"))
    run("doctor")


INTERRUPTED = RuntimeError()
INTERRUPTED.__context__ = KeyboardInterrupt()  # as Numba's, when Ctrl-C comes while it loads code


@pytest.mark.parametrize(
    ("error", "code"),
    [(ZeroDivisionError("over nothing"), 2), (KeyboardInterrupt(), 130), (INTERRUPTED, 130)],
)
def test_an_end_in_the_middle_is_one_line_and_a_code(error, code, failed, monkeypatch):
    def broken(config):
        raise error

    monkeypatch.setattr(cli, "run_command", broken)
    assert str(error) in failed("doctor", code=code)
    if code == 2:
        with pytest.raises(ZeroDivisionError):
            run("doctor", "--debug")


def test_warnings_are_lines_that_name_flags(capsys, monkeypatch):
    given = UserWarning("name one with tool=, or a base with base="), UserWarning, "a.py", 1
    monkeypatch.setattr(cli, "run_command", lambda _: print(warnings.formatwarning(*given)))
    run("plan")
    assert capsys.readouterr().out == "warning: name one with --tool, or a base with --base\n\n"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    run(
        "train", "--env", PLANE, "--n-timesteps", 64, "--n-envs", 32, "--eval-every", 64, "--eval-scenes", 8,
        "--out", folder, "--no-progress", "--env-kwargs", "threads=1",
        "--hyperparameters", "learning_starts=32", *FEW,
    )  # fmt: skip
    return folder


def test_train_then_evaluate_then_play(trained, shipped, tmp_path, capsys, failed):
    results = tmp_path / "new" / "results.json"
    words = ["evaluate", trained, "--baselines", "straight", "--scenes", "test", "--json", results]
    run(*words, "--n-scenes", 12)
    assert str(results) in capsys.readouterr().out
    record = json.loads(results.read_text())
    assert [each["scenes"] for each in record["methods"].values()] == [12, 12]
    assert record["env"] == PLANE
    results.write_bytes(b"")  # nobody's
    run(*words, "--n-scenes", 1)  # results are replaced, other files stay
    assert [path.name for path in results.parent.iterdir()] == ["results.json"]
    for kept in (trained / "final" / "model.json", trained / "versions.json"):
        assert kept.name in failed(*words[:-1], kept, "--n-scenes", 1)
    run("evaluate", trained, "--baselines", "--checks", 0, 8, "--n-scenes", 4)
    kept = [json.loads(path.read_text()) for path in (trained / "evaluations").glob("test-*.json")]
    assert ["agent", "agent, 8 checks"] in [list(each["methods"]) for each in kept]
    video = tmp_path / "film" / "a.mp4"
    run("play", trained, "--video", video, "--n-scenes", 1)
    assert video.stat().st_size > 1000
    run("play", "--env", STEP, "--video", video, "--n-scenes", 1)
    assert [path.name for path in video.parent.iterdir()] == ["a.mp4"]


def test_an_evaluation_in_some_scenes_replaces_none_in_others(trained, shipped, tmp_path):
    few, file = shipped.take(slice(3, 6)), tmp_path / "validation.npz"
    few.save(file)
    some = "validation", "--n-scenes"
    for words in (["validation"], [*some, 4], [file], [*some, 40]):
        run("evaluate", trained, "--baselines", "straight", "--scenes", *words)
    run("evaluate", trained, "--baselines", "random", "--scenes", "validation", "--n-scenes", 4)
    kept = [json.loads(path.read_text()) for path in (trained / "evaluations").glob("validation-*.json")]
    assert sorted(each["methods"]["straight"]["scenes"] for each in kept) == [3, 4, 40]
    assert ["agent", "straight", "random"] in [list(each["methods"]) for each in kept]


def test_a_run_is_continued_with_its_own_flags_only(tmp_path, capsys, failed):
    folder = tmp_path / "run"
    begun = [
        "train", "--out", folder, "--seed", 3, "--env", REACH, "--n-timesteps", 64, "--n-envs", 32, "--eval-every", 0,
        "--no-progress", "--env-kwargs", "threads=1", "--hyperparameters", "gradient_steps=1",
    ]  # fmt: skip
    run(*begun)
    before = (folder / "config.json").read_bytes()
    for words, named in (
        ("--seed 7 --algo ppo", ("algo viaq", "seed 3")),
        ("--seed 0", ("seed 3",)),  # as usual, but not here
        (f"--env {PLANE}", (REACH,)),
        ("--env-kwargs threads=2", ("threads 1",)),
        ("--hyperparameters tau=0.1", ("tau as usual",)),
        ("--n-timesteps 32", ("64 decisions", "got 32")),
    ):
        told = failed("train", "--out", folder, "--resume", *words.split())
        assert all(name in told for name in named), told
        assert (folder / "config.json").read_bytes() == before
    assert "--resume" in failed(*begun)
    run(*begun, "--resume")
    run("train", "--out", folder, "--resume", "--n-timesteps", 96, "--no-progress")
    assert "96 of 96 decisions" in capsys.readouterr().out


@pytest.mark.parametrize("value", [1e-7, True, None, [1, 8], {"a": [16]}, "learned", "2", "true", "", "a: b"])
def test_values_survive_the_way_to_words_and_back(value):
    assert from_words([*to_words({"x": value}), "y=1e-3", "z=a=b"]) == {"x": value, "y": 0.001, "z": "a=b"}


def test_words_become_a_configuration():
    words = "train --env viapoint/PlanarReach-v0 --algo sac --seed 3 --n-timesteps 9"
    words += " --env-kwargs n_via=2 timing=learned --hyperparameters tau=0.1"
    config = cli.parse(shlex.split(words))
    given = {"env_kwargs": {"n_via": 2, "timing": "learned"}, "hyperparameters": {"tau": 0.1}}
    assert config == TrainConfig(env=REACH, algo="sac", seed=3, n_timesteps=9, **given)
    assert cli.parse(shlex.split(config.command)[1:]) == config
    for named in ("--agent runs/x", "--agent=runs/x"):
        config = cli.parse(shlex.split(f"evaluate --json a.json --baselines planner {named}"))
        assert config == EvaluateConfig(agent="runs/x", baselines=("planner",), json=Path("a.json"))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_short_training_begins_to_learn_in_proportion(algo):
    env = SENSED if algo == "viarank" else PLANE
    usual = TrainConfig(env=env, algo=algo).resolved
    short = TrainConfig(env=env, algo=algo, n_timesteps=usual.n_timesteps // 8).resolved
    if "learning_starts" in usual.hyperparameters:
        ratio = short.hyperparameters["learning_starts"] / usual.hyperparameters["learning_starts"]
        assert ratio == pytest.approx(1 / 8)
    given = TrainConfig(algo="sac", n_timesteps=64, hyperparameters={"learning_starts": 100})
    assert given.resolved.hyperparameters["learning_starts"] == 100


def test_every_algorithm_has_presets_that_fit():
    assert set(configs.PRESETS) == set(ALGORITHMS)
    kinds = configs.PRESETS, configs.STEP_PRESETS, configs.REACH_PRESETS, configs.REPLANNING_PRESETS
    for presets in kinds:
        for algo, preset in presets.items():
            assert preset.policy in ALGORITHMS[algo].policy_aliases
            check_hyperparameters(algo, preset.hyperparameters)


@pytest.fixture
def quick(monkeypatch, shipped, tmp_path):
    monkeypatch.setattr(demo, "PICTURES", 2)
    monkeypatch.setattr(demo, "MOVEMENTS", 1)
    return DemoConfig(out=tmp_path / "demo", n_timesteps=64, n_scenes=8)


def test_an_interrupted_demo_goes_on_and_what_is_done_is_not_done_again(quick, capsys, monkeypatch):
    begin = RunCallback._on_training_start

    def interrupted(self):
        begin(self)
        self.interrupted = True

    with monkeypatch.context() as patch:
        patch.setattr(RunCallback, "_on_training_start", interrupted)
        with pytest.raises(TrainingStoppedError):
            demo.run(quick)
    demo.run(quick)
    told = capsys.readouterr().out
    written = {name: (quick.out / name).stat().st_mtime_ns for name in demo.FILES}
    assert all(str(quick.out / name) in told for name in (*demo.FILES, "best"))
    methods = json.loads((quick.out / "table.json").read_text())["methods"]
    assert {"agent", "agent, 16 checks", "untrained", "search512"} <= set(methods)
    assert methods["straight"]["success"]["rate"] == 0.0
    assert np.asarray(Image.open(quick.out / "gallery.png").convert("RGB")).std() > 5.0
    for name in ("evaluate", "gallery", "record_video"):
        monkeypatch.setattr(demo, name, pytest.fail)
    demo.run(quick)
    assert written == {name: (quick.out / name).stat().st_mtime_ns for name in demo.FILES}


def test_the_command_line_takes_an_arm_of_a_file(tmp_path, monkeypatch) -> None:
    shutil.copy(UR5E, tmp_path / "my_arm.xml")
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "run"
    few = "--n-scenes", 4, "--scenes", "validation"
    run("evaluate", "--arm", "my_arm.xml", "--baselines", "straight", "plan_motion", *few)
    run(
        "train", "--arm", "my_arm.xml", "--env-kwargs", "n_obstacles=2",
        "--n-timesteps", 64, "--n-envs", 16, "--eval-every", 0, "--out", folder, "--hyperparameters", *FEW,
    )  # fmt: skip
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert Run(folder).config.env_kwargs["arm"] == str(tmp_path / "my_arm.xml")
    agent = load_agent(folder)
    result = evaluate(agent, baselines=["straight"], scenes="validation", n_scenes=4)
    assert len(result.rows) == 2
    seen = agent.observation_space.sample()
    action, _ = agent.predict(seen, deterministic=True)
    (tmp_path / "my_arm.xml").unlink()  # the run keeps a copy
    kept = load_agent(folder)
    assert Run(folder).config.env_kwargs["arm"] == str(folder / "arm.xml")
    np.testing.assert_array_equal(kept.predict(seen, deterministic=True)[0], action)
    run("evaluate", folder, "--baselines", "straight", *few)


def test_a_run_goes_on_with_its_copy_of_an_arm(tmp_path, capsys) -> None:
    file = tmp_path / "my_arm.xml"
    shutil.copy(UR5E, file)
    settings = ("--n-envs", 16, "--eval-every", 0, "--out", tmp_path / "run", "--hyperparameters", *FEW)
    run("train", "--arm", file, "--n-timesteps", 16, *settings)
    shutil.copytree(tmp_path / "run", tmp_path / "same")
    decisions = 16
    # The run goes on without the file, and then with the file again; the other run the other way round.
    for name in ("elsewhere.xml", "my_arm.xml"):
        decisions += 16
        run("train", "--resume", "--out", tmp_path / "same", "--n-timesteps", decisions)
        file = file.rename(tmp_path / name)
        run("train", "--resume", "--out", tmp_path / "run", "--n-timesteps", decisions)
    assert "damaged" not in capsys.readouterr().err
    assert Run(tmp_path / "run").config == Run(tmp_path / "same").config
    first, second = (tmp_path / name / "final" / "weights.safetensors" for name in ("run", "same"))
    assert first.read_bytes() == second.read_bytes()


GOOD, GONE = "print('fine')", "import no_such_module"
EXTRA = ("torch", "stable_baselines3", "sb3_contrib", "tyro", "rich", "matplotlib")


def test_all_is_well_here(capsys):
    with pytest.raises(SystemExit) as end:
        run("doctor")
    assert (end.value.code, "fails" in capsys.readouterr().out) == (0, False)


@pytest.mark.parametrize(
    ("name", "exit_code", "remedy"), [("MuJoCo", 1, "'mujoco>=4'"), ("pictures", 0, "libegl1")]
)
def test_what_is_missing_is_named_with_the_remedy(name, exit_code, remedy, capsys, monkeypatch):
    checks = {each: (GONE if each == name else GOOD, advice) for each, (_, advice) in doctor.CHECKS.items()}
    monkeypatch.setattr(doctor, "CHECKS", checks)
    with pytest.raises(SystemExit) as end:
        run("doctor")
    printed = capsys.readouterr().out
    assert (end.value.code, "no_such_module" in printed, remedy in printed) == (exit_code, True, True)


def test_a_crash_and_a_hang_end_no_report(monkeypatch):
    assert not doctor.outcome("import os; os.abort()")[0]
    monkeypatch.setattr(doctor, "LIMIT", 0.2)
    assert not doctor.outcome("import time; time.sleep(60)")[0]


@pytest.mark.parametrize(("words", "code"), [(["train"], 2), (["--help"], 2), (["doctor"], 0)])
def test_without_the_extra_everything_says_what_to_install(words, code, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] in {EXTRA}:\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Blocked())\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", "")))}
    script = [sys.executable, "-c", MAIN, *words]
    failed = subprocess.run(script, capture_output=True, text=True, env=env)
    assert failed.returncode == code
    assert "pip install '.[training]' in a clone" in failed.stdout + failed.stderr
    assert code == 0 or len(failed.stderr.splitlines()) == 1
    assert code != 0 or re.search(r"\(no torch: extra training\)(.|\n)*pictures +works", failed.stdout)


def camera(env_id=PLANE):
    return gym.make(env_id, render_mode="rgb_array_list", width=96, height=96)


@pytest.mark.parametrize(("env_id", "number"), [(PLANE, 2), (MOVING, 1)])
def test_a_film_shows_every_movement(env_id, number, tmp_path):
    env, path = camera(env_id), tmp_path / "film.mp4"
    search = GeometrySearch(env.unwrapped.task, 8)
    count = record_video(path, env, scenes_of(env.unwrapped.task, number), search.decide)
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]
    assert len(frames) == count
    assert meta["fps"] == pytest.approx(env.metadata["render_fps"] / 2.0)
    duration = env.unwrapped.last_rollout.time[-1]
    assert count > number * meta["fps"] * 0.4 + duration * env.metadata["render_fps"]
    assert all(frame[:-48].std() > 5.0 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50
    assert [each.name for each in tmp_path.iterdir()] == ["film.mp4"]


def broken(observation, scenes):
    raise KeyError("policy")


def on_a_full_disk(path, *_, **__):
    Path(path).write_bytes(b"half a film")
    while True:
        yield


@pytest.mark.parametrize(("decide", "error"), [(broken, KeyError), (lambda *_: np.zeros((1, 3)), OSError)])
def test_a_film_that_cannot_be_finished_leaves_nothing(decide, error, tmp_path, monkeypatch):
    env, decisions = camera(), iter([lambda *_: np.zeros((1, 3)), decide])
    if error is OSError:
        monkeypatch.setattr(imageio_ffmpeg, "write_frames", on_a_full_disk)
    scenes = scenes_of(env.unwrapped.task, 2)
    with pytest.raises(error):
        record_video(tmp_path / "film.mp4", env, scenes, lambda *seen: next(decisions)(*seen))
    assert not list(tmp_path.iterdir())


WAYPOINTS = {
    "around": [[0.0, 0.3, 0.1], [0.12, 0.45, 0.1], [0.3, 0.3, 0.2]],
    "$straight^$": [[0.0, 0.3, 0.1], [0.3, 0.35, 0.1]],  # no formula
}


def recorded(*columns):
    """Table of two movements with little noise, which begin and end within the recording."""
    rng, parts = np.random.default_rng(0), []
    for name, waypoints in WAYPOINTS.items():
        trajectory = through(waypoints, [0.5] * (len(waypoints) - 1))
        time = np.arange(-0.1, float(trajectory.duration) + 0.1, 0.01)
        position = trajectory(time) + rng.normal(0.0, 2e-4, (len(time), 3))
        part = pd.DataFrame({"time": time, **dict(zip("xyz", position.T, strict=True)), "movement": name})
        parts.append(part[list(columns)])
    return pd.concat(parts) if "movement" in columns else parts[0]


def test_a_file_gives_a_table_and_a_figure(tmp_path, capsys):
    file, folder = tmp_path / "movements.csv", tmp_path / "new" / "fit"
    recorded("movement", "time", "x", "y", "z").to_csv(file, index=False)
    run("fit", file, "--out", folder)
    printed = capsys.readouterr().out
    table = pd.read_csv(folder / "fit.csv")
    assert list(table["movement"]) == list(WAYPOINTS)
    assert list(table["n_via"]) == [1, 0]
    assert all(name in printed for name in WAYPOINTS)
    around = table.iloc[0]
    via = around[["via1_x", "via1_y", "via1_z"]].astype(float)
    np.testing.assert_allclose(via, WAYPOINTS["around"][1], atol=5e-3)
    np.testing.assert_allclose(around[["duration", "via1_time"]].astype(float), [1.0, 0.5], atol=0.02)
    assert table["via1_x"].isna().tolist() == [False, True]
    assert np.ptp(imread(folder / "fit.png")) > 0.5
    assert "replaced" not in printed
    run("fit", file, "--out", folder, "--n-via", 0, 2)  # a folder of the command is written again
    assert "fit.csv, replaced" in capsys.readouterr().out
    pd.testing.assert_frame_equal(pd.read_csv(folder / "fit.csv"), table)


def test_a_plane_movement_needs_no_other_columns_and_is_that_of_the_function(tmp_path):
    path, table = tmp_path / "one.csv", recorded("time", "x", "y")
    table.to_csv(path, index=False)
    run("fit", path, "--out", tmp_path, "--n-via", 1, "--no-free-ends")
    fit = fit_via_points(table["time"].to_numpy(), table[["x", "y"]].to_numpy(), 1, free_ends=False)
    written = pd.read_csv(tmp_path / "fit.csv").iloc[0]
    np.testing.assert_allclose(written[["via1_x", "via1_y"]].astype(float), fit.via_points[0], atol=1e-9)
    assert "via1_z" not in written
    for format_ in ({"sep": ";", "decimal": ","}, {"sep": "\t", "decimal": ","}, {"sep": " "}):
        table.assign(movement="1,5").rename(columns=str.title).to_csv(path, index=False, **format_)
        run("fit", path, "--out", tmp_path, "--n-via", 1, "--no-free-ends")
        again = pd.read_csv(tmp_path / "fit.csv", dtype={"movement": str}).iloc[0]
        assert again.pop("movement") == "1,5"
        pd.testing.assert_series_equal(again, written.drop("movement"), check_dtype=False)


@pytest.mark.parametrize(
    ("scaled", "most", "told"), [("time", 1, "seconds"), ("x", 1, "metres"), ([], 1, "filtered"), ([], 2, "")]
)
def test_other_units_and_the_most_via_points_are_told(scaled, most, told, tmp_path, capsys):
    table = recorded("time", "x", "y")
    table[scaled] *= 1000.0
    table.to_csv(tmp_path / "one.csv", index=False)
    run("fit", tmp_path / "one.csv", "--out", tmp_path, "--n-via", 0, most)
    printed = capsys.readouterr().err
    assert told in printed
    assert ("filtered" in printed) == (most == 1)


def test_movements_that_cannot_be_fitted_are_left_out_and_doubtful_ones_told(tmp_path, capsys):
    good = recorded("time", "x", "y").assign(movement="good", trial=1)
    xy, noise = ["x", "y"], np.random.default_rng(1).normal(0.0, 5e-4, (len(good), 2))
    lost = good.assign(movement="lost")
    lost.loc[40:43, xy] = 0.0
    still = good.assign(movement="still", x=0.3, y=0.3)
    noisy = good.assign(movement="noisy", x=noise[:, 0], y=noise[:, 1])
    later = good.assign(time=good["time"] + 2.0)
    parts = [still, good, lost, noisy, good.assign(movement="few")[:6], later]
    pd.concat(parts).to_csv(tmp_path / "all.csv", index=False)
    run("fit", tmp_path / "all.csv", "--out", tmp_path)
    told = capsys.readouterr().err
    assert list(pd.read_csv(tmp_path / "fit.csv")["movement"]) == ["good", "lost", "noisy"]
    words = ["still is left out", "few is left out", "lost: sample 40,", "noisy: the fit explains"]
    for each in (*words, f"good begins again in line {4 * len(good) + 8}", "not read: trial;"):
        assert each in told


def test_ends_of_lines_begin_no_column_and_other_encodings_are_told(tmp_path, failed):
    path = tmp_path / "plain.csv"
    recorded("time", "x", "y").to_csv(path, index=False)
    run("fit", path, "--out", tmp_path / "plain")
    wanted = pd.read_csv(tmp_path / "plain" / "fit.csv")
    head, *lines = path.read_text().splitlines()
    for separator, end in ((",", ","), ("\t", ","), (" ", "  "), (";", ",")):
        text = "\n".join([head, *(line + end for line in lines)])
        path.write_text(text.replace(",", separator))
        run("fit", path, "--out", tmp_path / "other")
        pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "other" / "fit.csv"), wanted)
    path.write_bytes("time,x,y,movement\n0.0,0.1,0.2,é".encode("latin-1"))
    assert "UTF-8" in failed("fit", path, "--out", tmp_path / "other")


TABLE = ["time,x,y", "0.0,0.1,0.2", "0.1,0.1,0.2", "0.2,0.1,0.2"]


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ([TABLE[0], *(f"{line},0.3" for line in TABLE[1:])], "Expected 3 fields in line 2, saw 4"),
        ([*TABLE[:3], "", "  ", "0.2,0.1"], "line 6, column y: nothing"),
        (["y", "0.1"], "no column time"),
        (["t;px;py", "0.0;0.1;0.2"], "optionally z and movement, got t, px, py"),
        ([*TABLE[:3], TABLE[2]], "equal time in line 4"),
        ([*TABLE, *TABLE[1:]], "add a column `movement`"),
        (["time,x,y", "s,m,m", *TABLE[1:]], "line 2, column time: s; leave out lines of units"),
        (["# arm 1", *TABLE], "first line must name the columns"),
        (TABLE[:1], "holds no samples"),
        ([], "is empty"),
        (["", *TABLE[:3], "0.1,,0.2"], "line 5, column x: nothing"),
        (["time,x,y,x", "0.0,0.1,0.2,0.1"], "several columns x"),
        (["time,x,y,movement", "0.0,0.1,0.2,a", "", "0.1,0.1,0.2,"], "names no movement in line 4"),
        (["time,x,y,movement", "0.0,0.1,0.2,NA"], "names no movement in line 2; NA"),
    ],
)
def test_lines_at_fault_are_told_by_their_number_in_the_file(lines, told, tmp_path, failed):
    path = tmp_path / "lines.csv"
    path.write_text("\n".join(lines))
    assert told in failed("fit", path, "--out", tmp_path / "fit")
    assert not (tmp_path / "fit").exists()
