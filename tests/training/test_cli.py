"""The command, from the words to the files."""

import io
import json
import re
import subprocess
import sys

import pytest

from viapoint.training.cli import entry as cli

ENV, REACH = "viapoint/PlanarObstacles-v0", "viapoint/PlanarReach-v0"


def run(*words):
    cli.main([str(word) for word in words])


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as end:
        run(command, "--help")
    assert not end.value.code
    shown = capsys.readouterr().out
    assert f"viapoint {command}" in re.search("Example: (.+)", shown).group(1)


def test_output_that_nobody_reads_ends_the_command_without_a_word():
    command = [sys.executable, "-c", "from viapoint.training.cli.entry import main; main()", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


def test_names_are_printed_where_the_output_knows_only_ascii(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "ascii"))
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


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of a few decisions."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    run(
        "train", "--env", ENV, "--n-timesteps", 64, "--n-envs", 32, "--eval-every", 64, "--eval-scenes", 8,
        "--out", folder, "--no-progress", "--env-kwargs", "threads=1",
        "--hyperparameters", "learning_starts=32", "gradient_steps=1",
    )  # fmt: skip
    return folder


def test_train_then_evaluate_then_play(trained, shipped, tmp_path, capsys):
    results = tmp_path / "new" / "results.json"
    words = ["evaluate", trained, "--baselines", "straight", "--scenes", "test", "--json", results]
    run(*words, "--n-scenes", 12)
    assert str(results) in capsys.readouterr().out
    record = json.loads(results.read_text())
    assert [each["scenes"] for each in record["methods"].values()] == [12, 12]
    assert record["env"] == ENV
    run("evaluate", trained, "--baselines", "--checks", 0, 8, "--n-scenes", 4)
    kept = [json.loads(path.read_text()) for path in (trained / "evaluations").glob("test-*.json")]
    assert ["agent", "agent, 8 checks"] in [list(each["methods"]) for each in kept]
    video = tmp_path / "film" / "a.mp4"
    run("play", trained, "--video", video, "--n-scenes", 1)
    assert video.stat().st_size > 1000


def test_an_evaluation_in_some_scenes_replaces_none_in_others(trained, shipped, tmp_path):
    few, file = shipped.take(slice(3, 6)), tmp_path / "validation.npz"
    few.save(file)
    for words in (
        ("validation",),
        ("validation", "--n-scenes", 4),
        (file,),
        ("validation", "--n-scenes", 40),
    ):
        run("evaluate", trained, "--baselines", "straight", "--scenes", *words)
    kept = [json.loads(path.read_text()) for path in (trained / "evaluations").glob("validation-*.json")]
    assert sorted(each["methods"]["straight"]["scenes"] for each in kept) == [3, 4, 40]


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
        (f"--env {ENV}", (REACH,)),
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
