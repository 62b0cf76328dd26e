"""Bad input raises one error where it enters: the input, and the type of the error."""

import contextlib
import dataclasses
import functools
import json
import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation, NormalizeObservation, RescaleAction
from helpers import JUMPS, MOVING, PANDA, PLANE, REACH, SENSED, STEP
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecExtractDictObs, VecFrameStack, VecNormalize

from viapoint.envs import PointCloud, Pose, Sphere, Task, arm_of
from viapoint.envs.geometry.obstacles import no_obstacles
from viapoint.training import (
    GeometrySearch,
    Run,
    TrainConfig,
    ViaQ,
    ViaRank,
    ViaVecEnv,
    evaluate,
    evaluation,
    load_agent,
    plan_motion,
    plan_motions,
    train,
)
from viapoint.training.agents.agent import SAC, find_model
from viapoint.training.agents.model_io import ALGORITHMS
from viapoint.training.checks import ELSEWHERE
from viapoint.training.configs import (
    DemoConfig,
    EvaluateConfig,
    LiveConfig,
    PaperConfig,
    PlayConfig,
    from_words,
)
from viapoint.training.evaluation import evaluate_methods
from viapoint.training.files import BadFileError
from viapoint.training.planning.baselines import agent_method, make_method
from viapoint.training.planning.benchmark import benchmark_planner
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import load, scenes_for, shipped_path

CHANGING = MOVING, JUMPS
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
    (TrainConfig, {"env_kwargs": {"sensor": object()}}),
    (TrainConfig, {"env_kwargs": {"arm": dataclasses.replace(arm_of("panda"), home=np.zeros(7))}}),
    *((TrainConfig, {"env_kwargs": {name: 1}}) for name in ELSEWHERE),
    *((TrainConfig, {name: 5}) for name in ("hyperparameters", "progress")),
    *((TrainConfig, {"stop_when_stalled": share}) for share in (0.0, 1.0, True, "0.3", math.nan)),
    (TrainConfig, STALLING),  # the preset has no more decisions than it must make
    (TrainConfig, {**STALLING, "n_timesteps": 10**5, "eval_every": 0}),
    *((EvaluateConfig, {"env": PLANE, "checks": checks}) for checks in ((8,), ())),
    (PlayConfig, {"agent": "a", "video": "film.gif"}),
    (LiveConfig, {"port": 70_000}),
    (DemoConfig, {"env": "viapoint/PlanarWholeArmStep-v0"}),
    *((kind, {"out": out}) for kind in (TrainConfig, DemoConfig, PaperConfig) for out in ("", 3)),
    (EvaluateConfig, {"env": PLANE, "json": ""}),
]


@pytest.mark.parametrize(("kind", "values"), CONFIGURATIONS)
def test_configurations(kind, values):
    with pytest.raises(ValueError):
        kind(**values)


@pytest.mark.parametrize(
    ("kind", "name", "needed"),
    [
        (EvaluateConfig, "json", {"agent": "a"}),
        (PlayConfig, "video", {"agent": "a"}),
        (PaperConfig, "out", {}),
        (DemoConfig, "out", {}),
    ],
)
def test_places_that_cannot_be_written_to(kind, name, needed, tmp_path):
    (tmp_path / "file").write_text("mine")
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
    *(("ppo", {name: 1.5}) for name in ("n_epochs", "gae_lambda")),
    *(("ppo", values) for values in ({"batch_size": 1}, {"clip_range": 0})),
    *(("viaq", {name: 1}) for name in ("action_noise", "use_sde")),
    *(("viaq", {"policy_kwargs": {"width": value}}) for value in (0, 128.0, "wide")),
    *(("viaq", {"policy_kwargs": {name: 3}}) for name in ("optimizer_kwargs", "task", "heads")),
]
UNTRAINABLE = [
    *({"algo": algo, "hyperparameters": values} for algo, values in HYPERPARAMETERS),
    {"env_kwargs": {"colour": 1}},
    {"env_kwargs": {"n_via": -1}},
    *({"callback": given} for given in (5, "stop", [print])),
]


@pytest.mark.parametrize("changes", UNTRAINABLE)
def test_what_cannot_be_trained_leaves_no_folder(changes, tmp_path):
    callback = changes.get("callback")
    settings = {name: value for name, value in changes.items() if name != "callback"}
    with pytest.raises(ValueError):
        train(TrainConfig(out=tmp_path / "runs" / "run", n_timesteps=1, n_envs=2, **settings), callback)
    assert list(tmp_path.iterdir()) == []


@functools.cache
def agent():
    return load_agent(PLANE)


def plan(**changes):
    return GeometrySearch(PLANE, 8).plan(**{"start": (-0.2, 0.3), "goal": (0.1, 0.4), **changes})


def predicted(**changes):
    observation, _ = gym.make(PLANE).reset(seed=0)
    return agent().predict({**observation, **changes})


def sensed(**changes):
    observation = {**ViaVecEnv(SENSED, 2, seed=0).reset(), **changes}
    with contextlib.suppress(ValueError):  # both must refuse
        SAC("MultiInputPolicy", ViaVecEnv(SENSED, 1), buffer_size=2).predict(observation)
        return
    ViaRank("ViaRankPolicy", ViaVecEnv(SENSED, 1)).predict(observation)


def revising(**changes):
    return ViaQ("ViaQPolicy", ViaVecEnv(MOVING, 1), **changes)


PANDA_ARM = arm_of("panda")


def moved(**changes):
    given = {"arm": PANDA_ARM, "start": PANDA_ARM.home, "goal": PANDA_ARM.home + 0.1}
    return plan_motion(**{**given, **changes})


def many_points():
    """Return more points than a scene of the physics may have, far from the arm."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (300, 3))
    return PointCloud(points, 0.01, position=(0.0, -0.8, 0.2))


class Decides:
    def __init__(self, name, decided):
        self.name, self.decided = name, decided

    def decide(self, observation, scenes):
        return self.decided


ZERO = np.zeros((2, 3))
CALLS = [
    *(lambda words=words: from_words(words) for words in (
        ["n_via"], ["=3"], ["n_via=2", "n_via=3"], ["x=[1,8"], ['x={"a":'], ["x={a: 1, a: 2}"],
    )),
    *(lambda name=name: make_method(name, PLANE) for name in ("magic", "search", "search3", "sobol0")),
    *(lambda name=name: make_method(name, MOVING) for name in ("constant", "rest:ompl", "ompl")),
    lambda: SAC("MultiInputPolicy", ViaVecEnv(PLANE, 1), buffer_size=2, replay_buffer_class=HerReplayBuffer),
    lambda: benchmark_planner("search99999999999"),
    *(lambda more=more: GeometrySearch(PLANE, **more) for more in (
        {"n_checks": 10**6}, {"refinements": 64, "per_round": 2048}, {"n_checks": 1.5}, {"refinements": -1},
    )),
    *(lambda name=name, value=value: setattr(agent().policy, name, value) for name, value in (
        ("checks", -1), ("checks", 1.5), ("refine", True), ("candidates", 0), ("refinements", 10**9),
    )),
    lambda: setattr(load_agent(SENSED).policy, "belief", "magic"),
    *(lambda depths=depths: setattr(load_agent(SENSED).policy, "depths", depths)
      for depths in ((0.1,), (0.1, 0.0, 0.2, 0.3, 0.4, 0.5), (-0.1, 0.0, 0.1, 0.2, 0.3, 0.4), 0.1)),
    lambda: ViaQ("ViaQPolicy", ViaVecEnv(PLANE, 1), replay_buffer_class=HerReplayBuffer),
    *(lambda name=name, weight=weight: setattr(load_agent(SENSED).policy, name, weight)
      for name in ("caution", "effort") for weight in (-0.1, np.nan)),
    lambda: agent_method("agent", SAC("MultiInputPolicy", ViaVecEnv(PLANE, 1), buffer_size=2), 8),
    lambda: evaluate_methods([], load(shipped_path(PLANE), "test"), PLANE),
    lambda: evaluate(PLANE, env=REACH),
    lambda: evaluate(5, env=PLANE),
    *(lambda given=given: evaluate(env=PLANE, baselines=given) for given in (
        5, [3], [None], ["straight", "straight"], [Decides("a", ZERO), Decides("a", ZERO)],
    )),
    *(lambda checks=checks: evaluate(PLANE, checks=checks) for checks in ([4, 4], [0, 1.5], [-1])),
    *(lambda scenes=scenes: evaluate(PLANE, scenes=scenes) for scenes in (5, None, ["test"], "nowhere.npz")),
    *(lambda given=given: evaluate(env=PLANE, baselines=[Decides("a", given)], n_scenes=2) for given in (
        None, "left", ZERO[0], ZERO[:1], ZERO[:, :2], ZERO + math.nan, ZERO.astype(object),
    )),
    lambda: evaluate(baselines=["straight"]),
    *(lambda name=name: make_method(name, PLANE) for name in ("cautious64", "thick:search64", "deep:plan_motion")),
    *(lambda name=name: make_method(name, SENSED) for name in (
        "cautious0", "thin:search64", "thick:straight", "thick:cautious64", "thick:points:search64",
    )),
    lambda: evaluate("nowhere"),
    *(lambda path=path: load_agent(path) for path in (Path(__file__), Path(__file__).parent)),
    *(lambda wrap=wrap: evaluate(SAC("MlpPolicy", NormalizeObservation(wrap(FlattenObservation(gym.make(PLANE))))))
      for wrap in (lambda env: env, Monitor)),
    lambda: evaluate(SAC("MlpPolicy", VecExtractDictObs(ViaVecEnv(PLANE, 2), "goal"))),
    lambda: evaluate(SAC("MultiInputPolicy", RescaleAction(gym.make(PLANE), np.float32(0), np.float32(1)))),
    lambda: evaluate(PLANE, baselines="straight"),
    lambda: evaluate(PLANE, n_scenes=0),
    *(lambda goal=goal: plan(goal=goal) for goal in ((0.1, 0.2, 0.3), (0.9, 0.4), (-0.2, 0.3))),
    lambda: plan(obstacles=[Sphere(0.02, position=(-0.2, 0.3, 0.0), name="can")]),  # touches the arm
    lambda: agent().plan((-0.2, 0.3), (0.1, 0.4), [Sphere(0.01, position=(0.5, 0.1 * i, 0.0)) for i in range(9)]),
    lambda: revising().plan((-0.2, 0.3), (0.1, 0.4)),
    lambda: revising(policy_kwargs={"refine": 4}),
    lambda: revising(policy_kwargs={"candidate": 8}),
    lambda: revising(gradient_steps=0),
    lambda: agent_method("agent", revising(), refine=4),
    lambda: agent().learn(8),  # loaded for decisions
    lambda: predicted(wind=np.zeros(2)),
    lambda: predicted(goal=np.array([np.nan, 0.3])),
    lambda: predicted(goal=gym.make(PLANE).reset(seed=0)[0]["hand"]),
    *(lambda changes=changes: sensed(**changes) for changes in (
        {"ranges": np.full((2, 192), np.nan)}, {"ranges": np.ones((2, 100))},
        {"points": np.ones((2, 576))}, {"obstacles": np.zeros((2, 3))}, {"ranges": np.full((2, 192), 50.0)},
    )),
    lambda: ViaVecEnv("viapoint/Nothing-v0", 2),
    lambda: ViaVecEnv("CartPole-v1", 2),
    lambda: SceneSimulation("Nothing-v3"),
    lambda: load_agent("viapoint/Reach-v0"),
    lambda: Task.of(**{**agent().get_env().get_attr("task")[0].as_dict(), "arm": "octopus"}),
    *(lambda env_id=env_id: ViaQ("ViaQPolicy", ViaVecEnv(env_id, 2)) for env_id in (STEP, SENSED)),
    lambda: ViaQ("ViaQPolicy", make_vec_env("Pendulum-v1")),
    *(lambda wrapper=wrapper: ViaQ("ViaQPolicy", make_vec_env(PLANE, 2, wrapper_class=wrapper))
      for wrapper in (FlattenObservation, lambda env: RescaleAction(env, np.float32(-2), np.float32(2)))),
    lambda: evaluate(load_agent(SENSED), scenes="validation", n_scenes=2, env_kwargs={
        "sensor": dataclasses.replace(registered_task(SENSED).sensor, range=0.4),
    }),
    *(lambda changes=changes: evaluate(PLANE, scenes="validation", n_scenes=2, env_kwargs=changes)
      for changes in ({"shapes": ["box", "cylinder"]}, {"duration_range": (0.3, 0.6)}, {"n_obstacles": 8})),
    *(lambda wrapped=wrapped: ViaQ("ViaQPolicy", wrapped)
      for wrapped in (VecNormalize(ViaVecEnv(PLANE, 2)), VecFrameStack(ViaVecEnv(PLANE, 2), 2))),
    lambda: ViaRank("ViaRankPolicy", ViaVecEnv(PLANE, 1)),
    *(lambda labels=labels: ViaRank("ViaRankPolicy", ViaVecEnv(SENSED, 1), labels=labels)
      for labels in (100, "all")),
    lambda: ViaRank("ViaRankPolicy", make_vec_env("Pendulum-v1")),
    lambda: ViaRank("ViaRankPolicy", VecNormalize(ViaVecEnv(SENSED, 2))),
    *(lambda changes=changes: moved(**changes) for changes in (
        {"start": PANDA_ARM.home[:6]}, {"goal": np.full(7, np.nan)}, {"goal": Pose((2.0, 0.0, 0.3))},
        {"start": None}, {"goal": "home"}, {"goal": [Pose((0.5, 0.2, 0.4)), None]},
        {"goal": {"position": (0.4, 0.3, 0.4), "angle": 3.0}}, {"arm": "robot"}, {"space": "hand"},
        {"n_via": 4}, {"seeds": -1}, {"seeds": np.zeros((2, 3, 7))}, {"margin": -0.1}, {"rng": -1},
        {"time_limit": np.nan}, {"duration": 0.0}, {"velocity": np.zeros(3)},
        {"obstacles": [{"shape": "box"}]}, {"obstacles": no_obstacles(2)},
    )),
    lambda: plan_motions(PANDA_ARM, 2 * [PANDA_ARM.home], [PANDA_ARM.home], [[], []]),
    *(lambda changes=changes: plan_motions(PANDA_ARM, [PANDA_ARM.home], [PANDA_ARM.home], [[]], **changes)
      for changes in ({"n_via": 4}, {"time_limit": math.nan}, {"rng": -1}, {"threads": 2.5})),
    lambda: moved().joints(rate=1e9),
    lambda: moved(obstacles=[many_points()]).execute(force=True),
    lambda: scenes_for("tests", Task.of()),
    *(lambda name=name: evaluate(env=PLANE, baselines=["straight"], scenes=load(shipped_path(name), "test"))
      for name in (PANDA, *CHANGING)),
    *(lambda successes=successes: evaluation.wilson(successes, 4) for successes in (5, -1)),
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


def test_an_environment_of_another_task_is_named():
    with pytest.raises(ValueError, match=f"{PLANE}, .*{PANDA} {{'n_via': 2}}") as raised:
        load_agent(PLANE, env=ViaVecEnv(PANDA, 1, n_via=2))
    assert not isinstance(raised.value, BadFileError)  # the file is not to blame


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
    written = json.loads((run.folder / "config.json").read_text())
    others = [{**written, "env": "viapoint/Nothing-v0"}, {**written, "colour": "red"}, {}]
    del written["algo"]
    for content in (*map(json.dumps, [*others, written]), "{"):
        (run.folder / "config.json").write_text(content)
        with pytest.raises(BadFileError):
            Run(run.folder)


COMMANDS = [
    ("trian", "did you mean 'train'"),
    ("train --env viapoint/PlanarObstacle-v0", "did you mean 'viapoint/PlanarObstacles-v0'"),
    ("train --algo dqn", "('viaq', 'viarank', 'sac', 'td3', 'ppo', 'tqc')"),
    ("train --n-timesteps -5", "--n-timesteps must be a whole number, from 1"),
    ("train --env-kwargs n_via=2 --env-kwargs timing=learned", "--env-kwargs is there twice"),
    ("fit movements.csv --n-via 1.5", "--n-via: must be whole numbers"),
    ("train --n-timesteps 1e5", "--n-timesteps: must be a whole number, got '1e5'"),
    ("train --n-timesteps 16 --n-envs 16 --out=", "--out: must be a path, got ''"),
    ("train --env-kwargs n_vias=2 --out full", "did you mean 'n_via'"),
    ("train --env-kwargs n_via", "n_via"),
    ("train --env-kwargs num_envs=4", "--n-envs"),
    ('train --hyperparameters policy_kwargs={"width":0} --out new', "width"),
    ("train --out /proc/x/y", "/proc/x/y cannot be written"),
    ("train --n-timesteps 1 --out full", "full"),
    ("train --resume --out full", "full"),
    ("evaluate", "--env"),
    ("plan --position 0.4 0.3", "--position needs 3 numbers for panda, x y z, got 2"),
    ("plan --goal 0.4 0.3", "--goal needs 7 numbers"),
    ("plan --arm panda --velocity-limit 0 --position 0.4 0.3 0.3", "--velocity-limit"),
    ("plan --arm nowhere.xml --position 0.4 0.3 0.3", "nowhere.xml"),
    ("plan --arm panda --goal 0 0 0 -1 0 1 0 --quaternion 0 1 0 0", "--quaternion"),
    ("evaluate --baselines straight --agent", "--agent needs a name"),
    ("record", "name an agent"),
    (f"evaluate --baselines straight {PLANE}", "(first, or as --agent NAME)"),
    ("plan --position 0.4 0.3 0.3 --rate 0", "--rate must be"),
    ("plan --position 0.4 0.3 0.3 --scene full/notes.txt", "notes.txt: "),
    ("evaluate --scenes motionbenchmaker --baselines nothing", "plan_motion+ompl"),
    ("evaluate --scenes motionbenchmaker --baselines", "at least one planner"),
    ("evaluate --problems nowhere", "nowhere"),
    ("evaluate --problems . --scenes hard", "not both"),
    (f"evaluate --env {PLANE} --baselines straight --scenes nowhere.npz", "nowhere.npz"),
    (f"evaluate --env {SENSED} --baselines search16 --env-kwargs sensor=nose", "hand_rays"),
    (
        f"evaluate --env {SENSED} --baselines thick:plan_motion --env-kwargs sensor=hand_rays decide_at=[sight]",
        "searchN",
    ),
    (f"evaluate --env {PLANE} --json /proc/x", "--json /proc/x cannot be written"),
    (
        f"evaluate --env {SENSED} --baselines reach:search16 --env-kwargs decide_at=[sight] moving_obstacles=true",
        "searchN",
    ),
    (f"evaluate --env {PLANE} --baselines untrained", "untrained needs an agent"),
    (f"evaluate --env {PLANE} --baselines cautious16", "cautious16 needs a task with a sensor"),
    *((f"fit nothing.csv --n-via {numbers}", "--n-via must be") for numbers in ("2 1", "0 1 2", "9", "-1")),
    ("fit nothing.csv", "nothing.csv"),
    (f"paper --agent {find_model('viapoint/PlanarReach-v0')}", "PlanarReach"),
    ("demo --out full", "full"),
    (f"play {PLANE} --arm panda", "the same arm"),
    ("study nowhere.yaml", "nowhere.yaml"),
    ("doctor --out", "--out"),
]


@pytest.mark.parametrize(("words", "named"), COMMANDS)
def test_commands_end_with_one_line_that_names_the_offender(words, named, failed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_bytes(b"\xff mine")
    assert named in failed(*words.split())
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "notes.txt"]
