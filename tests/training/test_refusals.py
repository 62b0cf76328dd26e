"""Bad input raises one error where it enters: the input, and the type of the error."""

import functools
import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation, NormalizeObservation, RescaleAction
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecExtractDictObs, VecNormalize

from viapoint.envs import Sphere, Task
from viapoint.training import evaluate, load_agent
from viapoint.training.agents.agent import SAC, find_model
from viapoint.training.agents.model_io import ALGORITHMS
from viapoint.training.agents.viaq import ViaQ
from viapoint.training.agents.viarank import ViaRank
from viapoint.training.config.checks import ELSEWHERE
from viapoint.training.config.configs import (
    DemoConfig,
    EvaluateConfig,
    LiveConfig,
    PaperConfig,
    PlayConfig,
    StudyConfig,
    TrainConfig,
    from_words,
)
from viapoint.training.evaluation import statistics
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.io.files import BadFileError
from viapoint.training.planning.baselines import agent_method, make_method
from viapoint.training.planning.benchmark import benchmark_planner
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.plotting import plots
from viapoint.training.plotting.video import record_video
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import train
from viapoint.training.scene_sets import load, scenes_for, shipped_path

ENV, REACH, STEP = (
    f"viapoint/{name}-v0" for name in ("PlanarObstacles", "PlanarReach", "PlanarObstaclesStep")
)
MOVING, SENSED = "viapoint/PlanarMovingObstacles-v0", "viapoint/PlanarSensed-v0"
CHANGING = MOVING, "viapoint/PlanarTargetJump-v0"
STALLING = {"stop_when_stalled": 0.3}

CONFIGURATIONS = [
    (TrainConfig, {"env": "viapoint/Nothing-v0"}),
    (TrainConfig, {"env": "CartPole-v1"}),
    (TrainConfig, {"env": STEP}),  # viaq decides on whole movements
    (TrainConfig, {"algo": "dqn"}),
    *((TrainConfig, {"seed": seed}) for seed in (-1, 1.5, 2**32)),
    *((TrainConfig, {"n_envs": number}) for number in (0, True, 10**9)),
    *((TrainConfig, {name: 0}) for name in ("n_timesteps", "checkpoint_every", "eval_scenes")),
    (TrainConfig, {"env_kwargs": ("n_via",)}),
    *((TrainConfig, {"env_kwargs": {name: 1}}) for name in ELSEWHERE),
    (TrainConfig, {"hyperparameters": 5}),
    *((TrainConfig, {"stop_when_stalled": share}) for share in (0.0, 1.0, True, "0.3", math.nan)),
    (TrainConfig, STALLING),  # the preset has no more decisions than it must make
    (TrainConfig, {**STALLING, "n_timesteps": 10**5, "eval_every": 0}),
    (EvaluateConfig, {}),
    (EvaluateConfig, {"baselines": ("ompl", "ompl"), "env": ENV}),
    *((EvaluateConfig, {"env": ENV, "checks": checks}) for checks in ((8,), ())),
    (EvaluateConfig, {"agent": ENV, "checks": (-1,)}),
    (EvaluateConfig, {"agent": ENV, "n_scenes": 0}),
    (EvaluateConfig, {"agent": "runs/x", "pretrained": ENV}),
    (EvaluateConfig, {"pretrained": "nobody"}),
    (PlayConfig, {}),
    (PlayConfig, {"agent": "a", "video": "film.gif"}),
    (LiveConfig, {"port": 70_000}),
    (LiveConfig, {"env": "nothing"}),
    (DemoConfig, {"env": "viapoint/PlanarWholeArmStep-v0"}),
    (StudyConfig, {"file": "study.yaml", "workers": 0}),
    *((kind, {"out": ""}) for kind in (TrainConfig, DemoConfig, PaperConfig)),
    (EvaluateConfig, {"env": ENV, "json": ""}),
]


@pytest.mark.parametrize(("kind", "values"), CONFIGURATIONS)
def test_configurations(kind, values):
    with pytest.raises(ValueError):
        kind(**values)


@pytest.mark.parametrize(
    "words", [["n_via"], ["=3"], ["n_via=2", "n_via=3"], ["x=[1,8"], ['x={"a":'], ["x={a: 1, a: 2}"]]
)
def test_words(words):
    with pytest.raises(ValueError):
        from_words(words)


@pytest.mark.parametrize(
    ("kind", "name", "needed"),
    [
        (EvaluateConfig, "json", {"agent": "a"}),
        (PlayConfig, "video", {"agent": "a"}),
        (PaperConfig, "out", {}),
        (DemoConfig, "out", {}),
        (StudyConfig, "out", {"file": "study.yaml"}),
    ],
)
def test_places_that_cannot_be_written_to(kind, name, needed, tmp_path):
    (tmp_path / "file").write_text("")
    kind(**needed, **{name: tmp_path / "deeper/new.mp4"})
    for bad in ("file", "file/deeper/new.mp4"):
        with pytest.raises(ValueError):
            kind(**needed, **{name: tmp_path / bad})


NUMBERS = (math.nan, -math.inf, "abc", [], {"kind": "eval"})
RATES = (0.0, True, {"kind": "linear", "start": 1.0})
HYPERPARAMETERS = [
    *(("sac", {name: value}) for name in ("learning_rate", "gamma", "batch_size") for value in NUMBERS),
    *((algo, {"learning_rate": value}) for algo in ALGORITHMS for value in RATES),
    *((algo, values) for algo in ALGORITHMS for values in ({"speed": 1}, {"batch_size": True})),
    *(("sac", {name: 7}) for name in ("gamma", "tau", "policy_kwargs")),
    *(("sac", {"ent_coef": value}) for value in (-0.1, "auto_0", "much")),
    *(("sac", {"train_freq": pair}) for pair in ([0, "step"], [1, "episode"])),
    *(("sac", {"policy_kwargs": values}) for values in ({"speed": 1}, {"net_arch": [-3]})),
    *(("td3", {"action_noise": {"kind": "normal", "sigma": sigma}}) for sigma in (-0.1, math.nan, "x")),
    *(("td3", {name: -1}) for name in ("policy_delay", "target_policy_noise", "buffer_size")),
    *(("ppo", {name: 0}) for name in ("n_steps", "clip_range")),
    *(("ppo", {name: 1.5}) for name in ("n_epochs", "gae_lambda")),
    ("ppo", {"batch_size": 1}),
    *(("viaq", {name: 0}) for name in ("temperature", "explore_candidates", "next_candidates")),
    *(("viaq", {name: 1.5}) for name in ("explore_uniformly", "policy_kwargs")),
    *(("viaq", {name: 1}) for name in ("action_noise", "use_sde")),
    *(("viaq", {"policy_kwargs": {"width": value}}) for value in (0, 128.0, "wide")),
    *(
        ("viaq", {"policy_kwargs": {name: -1}})
        for name in ("candidates", "instants", "refinements", "checks")
    ),
    *(("viaq", {"policy_kwargs": {name: 3}}) for name in ("optimizer_kwargs", "task", "heads")),
]
UNTRAINABLE = [
    *({"algo": algo, "hyperparameters": values} for algo, values in HYPERPARAMETERS),
    {"env_kwargs": {"colour": 1}},
    {"env_kwargs": {"n_via": -1}},
]


@pytest.mark.parametrize("changes", UNTRAINABLE)
def test_what_cannot_be_trained_leaves_no_folder(changes, tmp_path):
    with pytest.raises(ValueError):
        train(TrainConfig(out=tmp_path / "runs" / "run", n_timesteps=1, n_envs=2, **changes))
    assert list(tmp_path.iterdir()) == []


@functools.cache
def agent():
    return load_agent(ENV)


def plan(**changes):
    return GeometrySearch(ENV, 8).plan(**{"start": (-0.2, 0.3), "goal": (0.1, 0.4), **changes})


def predicted(**changes):
    observation, _ = gym.make(ENV).reset(seed=0)
    return agent().predict({**observation, **changes})


def scenes(number):
    return SceneSimulation(ENV, 1).task.sampler()([np.random.default_rng(0)] * number)


def film(path="film.mp4", number=1, mode="rgb_array_list"):
    record_video(path, gym.make(ENV, render_mode=mode), scenes(number), lambda *_: np.zeros((1, 3)))


class Decides:
    """Method that always decides the same."""

    def __init__(self, name, decided):
        self.name, self.decided = name, decided

    def decide(self, observation, scenes):
        return self.decided


ZERO = np.zeros((2, 3))
CALLS = [
    *(lambda name=name: make_method(name, ENV) for name in ("magic", "search", "search3", "sobol0", "unrevised")),
    *(lambda name=name: make_method(name, MOVING) for name in ("constant", "random16", "ompl")),
    lambda: SAC("MultiInputPolicy", ViaVecEnv(ENV, 1), buffer_size=2, replay_buffer_class=HerReplayBuffer),
    *(lambda name=name: make_method(name, ENV) for name in ("search99999999999", "sobol65537")),
    lambda: make_method("cautious99999999999", SENSED),
    lambda: benchmark_planner("search99999999999"),
    *(lambda more=more: GeometrySearch(ENV, **more) for more in (
        {"n_checks": 10**6}, {"refinements": 10**9}, {"per_round": 10**9}, {"refinements": 64, "per_round": 2048},
    )),
    *(lambda name=name, value=value: setattr(agent().policy, name, value) for name, value in (
        ("checks", -1), ("checks", 1.5), ("refine", True), ("candidates", 0), ("refinements", 10**9),
    )),
    lambda: setattr(load_agent(SENSED).policy, "belief", "magic"),
    lambda: agent_method("agent", SAC("MultiInputPolicy", ViaVecEnv(ENV, 1), buffer_size=2), 8),
    lambda: evaluate_methods([], load(shipped_path("test", ENV)), ENV),
    lambda: evaluate(ENV, env=REACH),
    lambda: evaluate(5, env=ENV),
    *(lambda given=given: evaluate(env=ENV, baselines=given) for given in (
        5, [3], [None], ["straight", "straight"], [Decides("a", ZERO), Decides("a", ZERO)],
    )),
    lambda: evaluate(ENV, checks=[4, 4]),
    *(lambda scenes=scenes: evaluate(ENV, scenes=scenes) for scenes in (5, None, ["test"])),
    *(lambda given=given: evaluate(env=ENV, baselines=[Decides("a", given)], n_scenes=2) for given in (
        None, "left", ZERO[0], ZERO[:1], ZERO[:, :2], ZERO + math.nan, ZERO.astype(object),
    )),
    lambda: evaluate(ENV, baselines=["unrevised"]),
    lambda: evaluate(baselines=["straight"]),
    lambda: evaluate(env=ENV, baselines=["untrained"]),
    lambda: evaluate("nowhere"),
    lambda: load_agent(Path(__file__)),
    lambda: load_agent(Path(__file__).parent),
    *(lambda wrap=wrap: evaluate(SAC("MlpPolicy", NormalizeObservation(wrap(FlattenObservation(gym.make(ENV))))))
      for wrap in (lambda env: env, Monitor)),
    lambda: evaluate(SAC("MlpPolicy", VecExtractDictObs(ViaVecEnv(ENV, 2), "goal"))),
    lambda: evaluate(SAC("MultiInputPolicy", RescaleAction(gym.make(ENV), np.float32(0), np.float32(1)))),
    lambda: evaluate(ENV, baselines="straight"),
    lambda: evaluate(ENV, checks=[0, 1.5]),
    lambda: evaluate(ENV, n_scenes=0),
    lambda: evaluate(ENV, scenes="nowhere.npz"),
    *(lambda name=name, value=value: GeometrySearch(ENV, **{name: value})
      for name, value in (("n_checks", 1.5), ("refinements", -1), ("per_round", True))),
    lambda: plan(start=(0.1, 0.2, 0.3)),
    lambda: plan(goal=(np.nan, 0.4)),
    lambda: plan(goal=(0.9, 0.4)),
    lambda: plan(goal=(-0.2, 0.3)),  # where it starts
    lambda: plan(obstacles=[(0.0, 0.3, 0.1)]),
    lambda: plan(obstacles=[Sphere(0.02, position=(-0.2, 0.3, 0.0), name="can")]),  # touches the arm
    lambda: agent().plan((-0.2, 0.3), (0.1, 0.4), [Sphere(0.01, position=(0.5, 0.1 * i, 0.0)) for i in range(9)]),
    lambda: ViaQ("ViaQPolicy", ViaVecEnv(MOVING, 1)).plan((-0.2, 0.3), (0.1, 0.4)),
    lambda: agent().learn(8),  # loaded for decisions
    lambda: predicted(wind=np.zeros(2)),
    lambda: predicted(goal=np.array([np.nan, 0.3])),
    lambda: predicted(goal=gym.make(ENV).reset(seed=0)[0]["hand"]),
    lambda: ViaVecEnv("viapoint/Nothing-v0", 2),
    lambda: ViaVecEnv("CartPole-v1", 2),
    lambda: SceneSimulation("Nothing-v3"),
    lambda: load_agent("viapoint/Reach-v0"),
    lambda: Task.from_dict({**agent().get_env().get_attr("task")[0].as_dict(), "arm": "octopus"}),
    *(lambda env_id=env_id: ViaQ("ViaQPolicy", ViaVecEnv(env_id, 2)) for env_id in (STEP, "Pendulum-v1")),
    lambda: ViaQ("ViaQPolicy", VecNormalize(ViaVecEnv(ENV, 2))),
    lambda: ViaRank("ViaRankPolicy", VecNormalize(ViaVecEnv(SENSED, 2))),
    lambda: load(Path("tests")),
    lambda: scenes_for("tests", Task.of()),
    *(lambda env_id=env_id: scenes_for(shipped_path("validation", env_id), Task.of()) for env_id in CHANGING),
    *(lambda name=name: evaluate(env=ENV, baselines=["straight"], scenes=load(shipped_path("test", name)))
      for name in ("viapoint/PandaObstacles-v0", *CHANGING)),
    lambda: scenes_for("hard", Task.of(n_obstacles=3)),
    lambda: scenes_for(shipped_path("test", ENV), Task.of(n_obstacles=1)),
    lambda: scenes_for(shipped_path("test", ENV), Task.of(arm="panda")),
    lambda: film("film.gif"),
    lambda: film("film"),
    lambda: film(mode=None),
    lambda: film(number=0),
    lambda: plots.learning_curve("none.png", []),
    lambda: statistics.wilson(5, 4),
    lambda: statistics.wilson(-1, 4),
]  # fmt: skip


@pytest.mark.parametrize("call", CALLS)
def test_calls(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError):
        call()
    assert list(tmp_path.iterdir()) == []


COPIES = [
    (lambda env: (env.set_options([{"start": 0.0}, *[{}] * 5]), env.reset()), ValueError),
    (lambda env: (env.set_options([{}] * 5), env.reset()), ValueError),
    (lambda env: (env.set_options(5), env.reset()), ValueError),
    (lambda env: env.get_attr("num_envs", 6), IndexError),
    (lambda env: env.env_method("__str__", indices=[0, -7]), IndexError),
    (lambda env: env.env_is_wrapped(gym.Wrapper, indices=[9]), IndexError),
    (lambda env: env.get_attr("nothing"), AttributeError),
    (lambda env: env.set_attr("mark", 2, indices=[0]), ValueError),
]


@pytest.mark.parametrize(("call", "error"), COPIES)
def test_what_copies_of_an_environment_cannot_share(call, error, env):
    with pytest.raises(error):
        call(env)
    env.reset()


def test_folders_that_are_no_runs(tmp_path):
    run = Run.create(TrainConfig(out=tmp_path / "run"))
    for call in (
        lambda: Run(tmp_path / "nothing"),
        lambda: Run(tmp_path),
        lambda: Run.create(TrainConfig(out=tmp_path)),
        lambda: find_model(run.folder),
        lambda: find_model(tmp_path),
        lambda: train(TrainConfig(out=tmp_path / "nothing", resume=True)),
        lambda: train(TrainConfig(out=run.folder, resume=True, seed=7)),
    ):
        with pytest.raises(ValueError):
            call()
    with pytest.raises(BadFileError, match="--resume"):
        Run.create(TrainConfig(out=run.folder))
    for content in ('{"env": "viapoint/Nothing-v0"}', '{"colour": "red"}', "{"):
        (run.folder / "config.json").write_text(content)
        with pytest.raises(BadFileError):
            Run(run.folder)


COMMANDS = [
    ("", "train"),
    ("trian", "did you mean 'train'"),
    ("train --env viapoint/PlanarObstacle-v0", "Did you mean: `PlanarObstacles`"),
    ("train --n-timesteps -5", "--n-timesteps must be a whole number, from 1"),
    ("train --n-timesteps 1e5", "--n-timesteps: must be a whole number, got '1e5'"),
    ("train --n-timesteps 16 --n-envs 16 --out=", "--out: must be a path, got ''"),
    ("train --env-kwargs n_vias=2 --out full", "did you mean 'n_via'"),
    ("train --env-kwargs n_obstacles=999", "n_obstacles"),
    ("train --env-kwargs n_via", "n_via"),
    ("train --env-kwargs num_envs=4", "--n-envs"),
    ("train --hyperparameters gamma=7 --out new", "gamma"),
    ('train --hyperparameters policy_kwargs={"width":0} --out new', "width"),
    ("train --out /proc/x/y", "/proc/x/y cannot be written"),
    ("train --n-timesteps 1 --out full", "full"),
    ("train --resume --out full", "full"),
    ("evaluate", "--env"),
    ("evaluate nowhere", "nowhere"),
    (f"evaluate --env {ENV} --baselines magic", "magic"),
    (f"evaluate --env {ENV} --baselines straight --scenes nowhere.npz", "nowhere.npz"),
    (f"evaluate --env {ENV} --json /proc/x", "--json /proc/x cannot be written"),
    (f"evaluate --env {ENV} --baselines straight --json full", "full"),
    (f"evaluate {REACH} --baselines unrevised", "unrevised"),
    ("paper --out full/notes.txt", "notes.txt"),
    (f"paper --agent {find_model('viapoint/PlanarReach-v0')}", "PlanarReach"),
    ("demo --out full", "full"),
    ("study nowhere.yaml", "nowhere.yaml"),
    ("doctor --out", "--out"),
]


@pytest.mark.parametrize(("words", "named"), COMMANDS)
def test_commands_end_with_one_line_that_names_the_offender(words, named, failed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert named in failed(*words.split())
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "notes.txt"]
