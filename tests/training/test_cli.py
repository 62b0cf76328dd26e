"""The command, from the words to the files."""

import io
import json
import re
import shlex

import pytest

from viapoint.envs.registration import ENV_IDS
from viapoint.training.algorithms.agent import find_model
from viapoint.training.cli import main as cli
from viapoint.training.config.checks import SHIPPED_IDS
from viapoint.training.config.configs import EvaluateConfig, TrainConfig
from viapoint.training.scene_sets.scene_set import load

ENV, REACH = "viapoint/PlanarObstacles-v0", "viapoint/PlanarReach-v0"


def run(*words):
    cli.main([str(word) for word in words])


def failed(capsys, *words, code=2):
    """The one line that a command left on the standard error output."""
    with pytest.raises(SystemExit) as end:
        run(*words)
    assert end.value.code == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("viapoint: ")
    return lines[0]


def test_words_become_a_configuration():
    config = cli.parse(
        shlex.split("train --env viapoint/PlanarReach-v0 --algo sac --seed 3 --n-timesteps 9 --resume")
    )
    assert config == TrainConfig(
        env="viapoint/PlanarReach-v0", algo="sac", seed=3, n_timesteps=9, resume=True
    )
    config = cli.parse(["train", "--env-kwargs", "n_via=2", "timing=learned", "--hyperparameters", "tau=0.1"])
    assert config.env_kwargs == {"n_via": 2, "timing": "learned"}
    assert config.hyperparameters == {"tau": 0.1}
    config = cli.parse(shlex.split("evaluate runs/x --baselines planner --json a.json"))
    assert isinstance(config, EvaluateConfig)
    assert (config.agent, config.baselines, str(config.json)) == ("runs/x", ("planner",), "a.json")


@pytest.mark.parametrize("words", [[], *([name] for name in cli.COMMANDS)])
def test_help_is_short_and_has_an_example(words, capsys):
    with pytest.raises(SystemExit) as end:
        run(*words, "--help")
    assert not end.value.code
    text = capsys.readouterr().out
    assert "Example: viapoint" in text
    assert len(text.splitlines()) < 70


@pytest.mark.parametrize("words", [[], ["train"], ["evaluate"], ["bench"], ["demo"], ["import-sb3"]])
def test_help_lists_the_environments(words, capsys):
    with pytest.raises(SystemExit):
        run(*words, "--help")
    text = "".join(capsys.readouterr().out.replace("│", "").split())
    assert all(env_id in text for env_id in ENV_IDS)


@pytest.mark.parametrize("command", ["evaluate", "play"])
def test_help_lists_the_shipped_agents(command, capsys):
    with pytest.raises(SystemExit):
        run(command, "--help")
    text = "".join(capsys.readouterr().out.replace("│", "").split())
    assert SHIPPED_IDS
    assert all(env_id in text for env_id in SHIPPED_IDS)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("", "train, evaluate, play, bench, paper, demo"),
        ("fly", "fly"),
        ("train --env viapoint/Nothing-v0", "env must be one of viapoint/PlanarReach-v0"),
        ("train --algo dqn", "dqn"),
        ("train --seed x", "--seed"),
        ("train --speed 3", "--speed"),
        ("train --env CartPole-v1", "viapoint/Reach-v0, viapoint/Obstacles-v0"),
        ("train --env CartPole-v1", "`import viapoint.envs` registers; got 'CartPole-v1'"),
        ("train --env-kwargs n_via", "NAME=VALUE"),
        ("train --env-kwargs n_via=2 n_via=3", "n_via is there twice, as 2 and as 3"),
        ("train --env-kwargs whole_arm=True", "whole_arm=True is no JSON"),
        ("train --env-kwargs num_envs=4", "--n-envs"),
        ("train --hyperparameters gamma=7", "gamma of viaq must be a number from 0 to 1, got 7"),
        ("evaluate", "name an agent"),
        ("evaluate nowhere", "no run folder"),
        ("evaluate /etc/passwd", "it is a file"),
        ("evaluate --baselines magic", "search4096, got 'magic'"),
        (f"evaluate {REACH} --env {ENV}", f"env must be {REACH}"),
        (f"evaluate {REACH} --baselines unrevised", "got 'unrevised'"),
        ("play viapoint/Reach-v0", "no agent is shipped for 'viapoint/Reach-v0'"),
        (f"evaluate --env {ENV} --baselines straight --failures there", "failures concerns an agent"),
        (f"evaluate --env {ENV} --baselines straight --json /", "json must be a file"),
        (f"play {REACH} --video film.gif", "video must end in .mp4, got film.gif"),
        ("paper --out /etc/passwd", "out /etc/passwd cannot be written"),
        ("paper --agent nowhere", "nowhere: is no run folder"),
        *(
            (f"paper --agent {find_model(f'viapoint/{name}-v0')}", f"is of viapoint/{name}-v0")
            for name in ("PlanarReach", "PandaReach", "PlanarMovingObstacles")
        ),
        (
            'train --hyperparameters policy_kwargs={"heads":0}',
            "heads in policy_kwargs of viaq must be a whole",
        ),
        (f"evaluate --env {ENV} --baselines straight random straight", "straight is there twice"),
        ("evaluate viapoint/Nothing-v0", "a shipped agent are viapoint/PandaMovingObstacles-v0"),
        (f"evaluate --baselines magic --env {ENV} --scenes test", "magic"),
        (f"evaluate --baselines straight --env {ENV} --scenes nowhere.npz", "nowhere.npz"),
        ("evaluate --baselines straight", "--env"),
        ("play nowhere", "no run folder"),
        ("train --out . --n-timesteps 1", "is not empty"),
    ],
)
def test_an_error_is_one_line_that_names_the_offender(words, named, capsys, shipped):
    assert named in failed(capsys, *words.split())


def test_an_error_is_the_same_where_the_output_knows_ascii_only(capsys, monkeypatch):
    framed = failed(capsys, "train", "--seed", "-1")
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), "ascii"))
    assert failed(capsys, "train", "--seed", "-1") == framed
    assert re.match(r"viapoint: (Error parsing TrainConfig: )?seed must be", framed)  # older tyro says less


def test_unexpected_errors_say_their_kind_and_debug_shows_them(capsys, monkeypatch):
    def broken(self, config):
        raise ZeroDivisionError("over nothing")

    monkeypatch.setattr(cli.Command, "__call__", broken)
    assert failed(capsys, "bench") == "viapoint: ZeroDivisionError: over nothing (--debug shows where)"
    with pytest.raises(ZeroDivisionError):
        run("bench", "--debug")


def test_ctrl_c_is_no_error_message(capsys, monkeypatch):
    def stopped(self, config):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.Command, "__call__", stopped)
    assert failed(capsys, "bench", code=130) == "viapoint: stopped"


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


def test_train_then_evaluate(trained, shipped, tmp_path, capsys):
    results = tmp_path / "new" / "results.json"
    words = ["evaluate", trained, "--baselines", "straight", "--scenes", "test", "--json", results]
    run(*words, "--n-scenes", 12)
    printed = capsys.readouterr().out
    assert "straight" in printed
    assert str(results) in printed
    record = json.loads(results.read_text())
    assert [each["scenes"] for each in record["methods"].values()] == [12, 12]
    assert record["env"] == ENV
    run(*words[:3], "--checks", 0, 8, "--n-scenes", 4, "--failures", tmp_path / "failures")
    counts = json.loads((tmp_path / "failures" / "failures.json").read_text())
    assert counts["method"] == "agent, 8 checks"
    kept = json.loads((trained / "evaluations" / "test.first-4.json").read_text())
    assert list(kept["methods"]) == ["agent", "agent, 8 checks"]


def test_an_evaluation_in_some_scenes_replaces_none_in_others(trained, tmp_path):
    few, file = load("validation", ENV).take(slice(3, 6)), tmp_path / "validation.npz"
    few.save(file)
    for words in (
        ("validation",),
        ("validation", "--n-scenes", 4),
        (file,),
        ("validation", "--n-scenes", 500),
    ):
        run("evaluate", trained, "--baselines", "straight", "--scenes", *words)
    kept = {
        path.name: json.loads(path.read_text())["methods"]["straight line"]["scenes"]
        for path in (trained / "evaluations").glob("validation*.json")
    }
    assert kept["validation.json"] == 500
    assert kept["validation.first-4.json"] == 4
    assert kept[f"validation.{few.sha256[:8]}.json"] == 3


def test_the_environment_is_that_of_the_run_or_of_the_pretrained_agent(trained, shipped, capsys):
    run("evaluate", trained, "--baselines", "straight", "--n-scenes", 2)
    assert ENV in capsys.readouterr().out
    for words in ((ENV, "--env", ENV), ("--pretrained", ENV)):
        run("evaluate", *words, "--baselines", "straight", "--n-scenes", 2)
        assert ENV in capsys.readouterr().out
    assert "named twice" in failed(capsys, "evaluate", trained, "--pretrained", ENV)
    assert "pretrained must be one of" in failed(capsys, "play", "--pretrained", "nobody")
    assert f"env must be {ENV}" in failed(
        capsys, "evaluate", trained, "--env", REACH, "--baselines", "straight"
    )


def test_an_agent_of_another_task_meets_scenes_of_that_task(tmp_path, capsys):
    folder = tmp_path / "run"
    run(
        "train", "--out", folder, "--n-timesteps", 32, "--n-envs", 32, "--eval-every", 0, "--no-progress",
        "--env-kwargs", "n_obstacles=3", "threads=1",
    )  # fmt: skip
    capsys.readouterr()
    run("evaluate", folder, "--baselines", "straight", "--n-scenes", 3)
    assert "with n_obstacles=3: they are drawn" in capsys.readouterr().err
    record = json.loads((folder / "evaluations" / "test.first-3.json").read_text())
    assert [each["scenes"] for each in record["methods"].values()] == [3, 3]
    run("play", folder, "--n-scenes", 1, "--video", tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").stat().st_size > 1000
    capsys.readouterr()
    assert "validation, test" in failed(capsys, "evaluate", folder, "--scenes", "hard")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("--env-kwargs n_vi=2", "n_vi"),
        ("--hyperparameters foo=2", "'foo'"),
        ('--hyperparameters policy_kwargs={"foo":2}', "foo"),
        ("--algo sac --discount-unit 1", "discount_unit must be left out"),
    ],
)
def test_what_is_mistyped_leaves_nothing_in_the_way_of_the_corrected_command(words, named, tmp_path, capsys):
    folder = tmp_path / "runs" / "one"
    assert named in failed(capsys, "train", "--out", folder, "--n-timesteps", 1, *words.split())
    assert list(tmp_path.iterdir()) == []


def test_flags_of_another_run_are_refused_and_the_same_ones_are_not(tmp_path, capsys):
    folder = tmp_path / "run"
    begun = [
        "train", "--out", folder, "--seed", 3, "--env", REACH, "--n-timesteps", 64, "--n-envs", 32, "--eval-every", 0,
        "--no-progress", "--env-kwargs", "threads=1", "--hyperparameters", "gradient_steps=1",
    ]  # fmt: skip
    run(*begun)
    before = (folder / "config.json").read_bytes()
    for words, named in (
        ("--seed 7 --algo ppo", ("algo", "seed 3", "seed 7")),
        ("--seed 0", ("seed 0",)),  # as usual, but not here
        (f"--env {ENV}", (ENV,)),
        ("--env-kwargs threads=2", ("threads 1", "threads 2")),
        ("--hyperparameters tau=0.1", ("the usual tau", "tau 0.1")),
        ("--n-timesteps 32", ("64 decisions", "got 32")),
    ):
        told = failed(capsys, "train", "--out", folder, "--resume", *words.split())
        assert all(name in told for name in named), told
        assert (folder / "config.json").read_bytes() == before
    run(*begun, "--resume")
    run("train", "--out", folder, "--resume", "--n-timesteps", 96, "--no-progress")
    assert "trained for 96 decisions" in capsys.readouterr().out


def test_a_second_training_in_the_folder_is_refused(trained, capsys):
    assert "--resume" in failed(capsys, "train", "--out", trained)


def test_play_films(trained, shipped, tmp_path, capsys):
    video = tmp_path / "film" / "a.mp4"
    run("play", trained, "--video", video, "--n-scenes", 1)
    assert video.stat().st_size > 1000
    assert str(video) in capsys.readouterr().out
