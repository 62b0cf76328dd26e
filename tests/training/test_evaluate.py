"""Agents and baselines are measured in the same scenes, and figures, intervals and tables are what they say."""

import io
import itertools
import json
import math
from statistics import NormalDist

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from helpers import MOVING, PLANE, REACH, STEP, scenes_of
from stable_baselines3.common.vec_env import VecNormalize

from viapoint.envs import scene_from_json, scene_to_json
from viapoint.training import GeometrySearch, ViaVecEnv, evaluate, evaluation, report
from viapoint.training.agents.agent import PPO
from viapoint.training.agents.model_io import build
from viapoint.training.configs import STEP_PRESETS
from viapoint.training.evaluation import SLOW_DECISION, MethodResult, evaluate_methods
from viapoint.training.planning.baselines import StepAgentMethod, Straight, agent_method, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import SceneSimulation, whole_task
from viapoint.training.scene_sets import BANDS, drawn

ZEROS = np.zeros((40, 3))


class Given:
    """Decides what it is told, and remembers what it was shown."""

    def __init__(self, name, actions):
        self.name, self.actions = name, actions
        self.goals, self.observed = [], []

    def decide(self, observation, scenes):
        done = sum(map(len, self.goals))
        self.goals.append(scenes.goal)
        self.observed.append(observation["goal"])
        return self.actions[done : done + len(scenes.goal)]


def run(methods, scenes, **kwargs):
    settings = {"env_kwargs": {"threads": 1}, "time_decisions": False, **kwargs}
    return evaluate_methods(methods, scenes, PLANE, **settings)


def test_every_method_meets_the_same_scenes(small_scenes):
    simulation = SceneSimulation(PLANE, 8, threads=1)
    observation = simulation.observe(small_scenes.scenes)
    solutions = make_method("search64", PLANE).decide(observation, small_scenes.scenes)
    methods = [Given("a", ZEROS), Given("b", solutions)]
    evaluation = run(methods, small_scenes, batch=16)  # results do not depend on the batch
    hands = simulation.task.arm.hand(small_scenes.scenes.goal)
    for method in methods:
        assert [len(goals) for goals in method.goals] == [16, 16, 8]
        np.testing.assert_array_equal(np.concatenate(method.goals), small_scenes.scenes.goal)
        np.testing.assert_allclose(np.concatenate(method.observed), hands, atol=1e-6)
    for result, method in zip(evaluation.results, methods, strict=True):
        direct = simulation(small_scenes.scenes, method.actions)
        for name, values in direct.items():
            np.testing.assert_array_equal(result.outcomes[name], values, err_msg=name)
    record = evaluation.to_dict()
    assert record["sha256"] == small_scenes.sha256
    assert evaluation.results[0].success.sum() == 0  # the straight line always hits something
    solved = int(evaluation.results[1].success.sum())
    assert solved > 30
    assert len(record["outcomes"]["a"]["action"]) == 40


def test_a_model_that_was_loaded_without_an_environment_gets_the_one_that_is_named():
    model = PPO("MultiInputPolicy", ViaVecEnv(PLANE, 2), n_steps=2, batch_size=4, seed=0)
    model.env = None
    assert len(evaluate(model, env=PLANE, checks=np.int64(0), scenes="validation", n_scenes=2).rows) == 1


@pytest.mark.parametrize("env_id", [REACH, "viapoint/PlanarReachStep-v0", MOVING])
def test_a_model_of_normalised_observations_sees_such_ones(env_id, made, monkeypatch):
    env = VecNormalize(made(env_id, threads=1), norm_reward=False)
    model = PPO("MultiInputPolicy", env, n_steps=2, batch_size=16, seed=0).learn(16)
    raw, seen = [], []
    normalize, predict = env.normalize_obs, model.policy.predict
    count = float(env.obs_rms["hand"].count)

    def decide(observation, *args, **kwargs):
        seen.append(observation)
        return predict(observation, *args, **kwargs)

    def normalized(observation):
        raw.append(observation)
        return normalize(observation)

    monkeypatch.setattr(model.policy, "predict", decide)
    monkeypatch.setattr(env, "normalize_obs", normalized)
    evaluate(model, scenes="validation", n_scenes=4)
    if model.get_env().get_attr("task", [0])[0].whole_movement:
        model.plan((-0.2, 0.35), (0.15, 0.35))
    assert len(raw) == len(seen) > 2
    for before, after in zip(raw, seen, strict=True):
        assert any((before[name] != after[name]).any() for name in before)
        for name, part in normalize(before).items():
            np.testing.assert_array_equal(after[name], part)
    assert env.obs_rms["hand"].count == count


def fake(success, **changes):
    n = len(success)
    outcomes = {
        "is_success": np.array(success),
        "collision": ~np.array(success),
        "reachable": np.ones(n, dtype=bool),
        "min_clearance": np.linspace(-0.01, 0.01, n),
        "goal_error": np.zeros(n),
        "tracking_error": np.zeros(n),
        "jerk_ratio": np.where(success, 2.0, 100.0),
        "duration": np.where(success, 0.8, 9.0),
        "path_length": np.where(success, np.linspace(0.3, 0.65, n), 7.0),
    }
    values = {
        "name": "fake",
        "outcomes": outcomes,
        "decision_times": np.linspace(0.001, 0.003, 101),
        "band": np.arange(n) % 4,
        "family": np.full(n, ""),
        "partial": False,
    }
    return MethodResult(**{**values, **changes})


def test_the_metrics_are_what_their_names_say():
    success = [True, False, True, True, False, False, True, True]
    summary = fake(success).summary()
    assert summary["success"]["rate"] == summary["success"]["count"] / summary["success"]["of"] == 5 / 8
    assert summary["success"]["low"] < 5 / 8 < summary["success"]["high"]
    assert summary["collision"]["rate"] == pytest.approx(3 / 8)
    assert summary["unreachable"]["rate"] == 0.0
    assert summary["success_by_band"] == {
        band: {**summary["success_by_band"][band], "rate": rate, "of": 2}
        for band, rate in zip(BANDS, (0.5, 0.0, 1.0, 1.0), strict=True)
    }
    assert (summary["jerk_ratio"], summary["duration"]) == (2.0, 0.8)
    assert summary["path_length"] == pytest.approx(0.45)
    assert summary["min_clearance"] == pytest.approx(0.0)
    assert summary["decision_time"] == pytest.approx(0.002)
    assert summary["decision_time_98"] == pytest.approx(0.00296)
    families = fake([True, False, True], family=np.array(["gate", "gate", ""])).summary()["success_by_family"]
    assert {name: (rate["count"], rate["of"]) for name, rate in families.items()} == {"gate": (1, 2)}
    failed = fake([False] * 4, band=np.full(4, -1)).summary()
    assert failed["jerk_ratio"] is failed["duration"] is None
    assert failed["success_by_band"] == {}


class Interrupted(Given):
    def decide(self, observation, scenes):
        if len(self.goals) == 2:
            raise KeyboardInterrupt
        return super().decide(observation, scenes)


def test_an_interrupted_evaluation_keeps_what_is_done(small_scenes):
    methods = [Given("first", ZEROS), Interrupted("second", ZEROS), Given("third", ZEROS)]
    evaluation = run(methods, small_scenes, batch=10)
    assert evaluation.partial
    found = [(result.name, len(result.success), result.partial) for result in evaluation.results]
    assert found == [("first", 40, False), ("second", 20, True)]
    record = json.loads(json.dumps(evaluation.to_dict(), allow_nan=False))
    assert record["methods"]["second"]["scenes"] == 20


def test_decisions_are_timed_one_by_one_and_slow_ones_by_the_batch(small_scenes, monkeypatch):
    class Timed(Given):
        cost = 0.001

        def decide(self, observation, scenes):
            clock["now"] += self.cost * len(scenes.goal)
            self.goals.append(scenes.goal)
            return np.zeros((len(scenes.goal), 3))

    clock = {"now": 0.0}
    monkeypatch.setattr(evaluation.time, "perf_counter", lambda: clock["now"])
    quick, slow = Timed("quick", ZEROS), Timed("slow", ZEROS)
    slow.cost = 2.0 * SLOW_DECISION
    results = run([quick, slow], small_scenes, time_decisions=True).results
    assert results[0].decision_times == pytest.approx(np.full(39, 0.001))
    assert results[1].decision_times == pytest.approx([slow.cost])
    assert [len(goals) for goals in quick.goals] == [40, *[1] * 40]


def test_every_decision_of_an_episode_is_timed_where_plans_are_revised():
    frozen = drawn("test", registered_task(MOVING), 4)
    (result,) = evaluate_methods([make_method("straight", MOVING)], frozen, MOVING).results
    assert len(result.decision_times) == result.outcomes["decisions"].sum() - 1 > 4


@pytest.fixture(scope="module")
def record(small_scenes):
    return run([Given("still [bold]", ZEROS), make_method("search32", PLANE)], small_scenes).to_dict()


def test_the_document_holds_every_method_and_metric(record, tmp_path):
    report.write(record, tmp_path / "new")
    document, data = (tmp_path / "new" / f"table.{suffix}" for suffix in ("md", "json"))
    lines = [line for line in document.read_text().splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert {len(line) for line in cells} == {len(cells[0])}
    assert [line[0] for line in cells[2:]] == ["still [bold]", "search32"]
    summary = record["methods"]["search32"]
    search = dict(zip(cells[0], cells[3], strict=True))
    assert search["success"] == f"{100 * summary['success']['rate']:.1f} %"
    assert search["clearance [mm]"] == f"{1e3 * summary['min_clearance']:.1f}"
    assert search["goal error [mm, mrad]"] == f"{1e3 * summary['goal_error']:.2f}"  # as the space has it
    assert json.loads(data.read_text()) == record
    assert record["sha256"][:12] in document.read_text()
    rate = summary["success"]["rate"]
    csv = pd.read_csv(io.StringIO(report.formatted(record, "csv"))).set_index("method")
    assert csv["success rate"]["search32"] == rate
    parsed = json.loads(report.formatted(record, "json"))
    assert parsed["methods"]["search32"]["success"]["rate"] == rate
    assert f"{100 * rate:.1f} %" in report.formatted(record, "table")


@pytest.mark.parametrize("number", [1, 12])
def test_the_table_fits_a_terminal_of_80_columns(record, number):
    (summary, *_) = record["methods"].values()
    names = [f"untrained, {16 * i} checks" for i in range(number)]
    shown = report.text({**record, "methods": dict.fromkeys(names, summary)})
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.count("untrained") == number


def test_a_bar_that_moves_once_ends_its_line(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with report.scene_progress() as progress:
        progress("straight", 20, 20)
    last = capsys.readouterr().err.rpartition("\r")[2]
    assert ("20/20" in last, last[-1]) == (True, "\n")


def test_fewer_scenes_than_asked_for_are_told(small_scenes, capsys):
    result = evaluate(env=PLANE, scenes=small_scenes, n_scenes=50, baselines=["straight"])
    assert len(result.results[0].success) == 40
    assert "40 scenes, not 50" in capsys.readouterr().err


def test_wilson_equals_published_values():
    # Newcombe 1998, Stat. Med. 17, 857-872, table I, method 3
    assert evaluation.wilson(81, 263) == pytest.approx((81 / 263, 0.2553, 0.3662), abs=5e-5)


def test_across_seeds_draws_whole_agents():
    """Three agents, each the same in all scenes: all 27 draws of three of them can be written down."""
    rates = np.array([0.2, 0.5, 0.6])
    scores = np.repeat(rates[:, None], 40, axis=1)
    interval = evaluation.across_seeds(scores, np.zeros(40), np.random.default_rng(0), samples=20_000)
    draws = sorted(np.mean(each) for each in itertools.product(rates, repeat=3))
    # One draw of 27 is more than 2.5 %.
    assert interval == pytest.approx((rates.mean(), draws[0], draws[-1]))
    five = np.array([[0.0], [0.5], [0.6], [0.7], [1.0]])
    trimmed = evaluation.across_seeds(five, [0], np.random.default_rng(0))
    assert trimmed[0] == pytest.approx(0.6)


def test_across_seeds_draws_scenes_within_their_strata():
    success = np.random.default_rng(0).random(400) < 0.7
    given = success[None], np.zeros(400), np.random.default_rng(1)
    _, low, high = evaluation.across_seeds(*given, samples=4000)
    half = 1.96 * math.sqrt(success.mean() * (1 - success.mean()) / 400)
    assert high - low == pytest.approx(2 * half, rel=0.1)
    score = np.where(success, 0.9, 0.2)
    known = evaluation.across_seeds(score[None], success, np.random.default_rng(1))
    assert known == pytest.approx((score.mean(),) * 3)  # within a stratum all are alike


def test_across_seeds_covers_the_truth():
    """Agents of different worth in scenes of different difficulty: other agents and scenes are foreseen."""
    generator = np.random.default_rng(5)
    covered = 0
    for _ in range(100):
        worth, ease = generator.normal(1.0, 0.5, (8, 1)), generator.normal(0.0, 1.0, (1, 100))
        scores = generator.normal(size=(8, 100)) < worth + ease
        _, low, high = evaluation.across_seeds(scores, np.zeros(100), generator, samples=200)
        truth = NormalDist().cdf(1.0 / math.sqrt(1.0 + 0.25 + 1.0))
        covered += low <= truth <= high
    assert covered >= 85


@pytest.mark.parametrize("solved", [0, 5, 20])
def test_across_seeds_without_any_spread_is_wilsons(solved):
    strata = np.arange(20) < solved
    interval = evaluation.across_seeds(np.tile(strata, (3, 1)), strata, np.random.default_rng(0))
    assert interval == evaluation.wilson(solved, 20)


REACHING = {"courses": "reaches"}


def test_courses_are_predicted_the_better_the_more_is_known():
    """Among obstacles on reaches of their own: at rest, constant velocities, fitted reaches, the truth."""
    task = registered_task(MOVING, **REACHING)
    frozen = drawn("validation", task, 60)
    methods = []
    for name in ("rest:search64", "search64", "reach:search64", "known:search64"):
        methods.append(make_method(name, MOVING, **REACHING))
    found = evaluate_methods(methods, frozen, MOVING, env_kwargs=REACHING, time_decisions=False)
    rates = [result.success.mean() for result in found.results]
    assert rates == sorted(rates)
    assert rates[3] > rates[2] + 0.1 > rates[1] + 0.2


def test_episodes_with_the_same_ends_are_not_mixed_up():
    simulation = SceneSimulation(MOVING, 8, **REACHING)
    method = make_method("reach:search64", MOVING, **REACHING)
    scenes = scenes_of(simulation.task, 6, 5)
    scenes.start[:], scenes.goal[:] = scenes.start[0], scenes.goal[0]
    together = method.execute(scenes, method.decide(simulation.observe(scenes), scenes))
    for row in range(6):
        one = scenes.take([row])
        alone = method.execute(one, method.decide(simulation.observe(one), one))
        assert alone["reward"][0] == together["reward"][row]


class Forwards:
    """Steers straight ahead, faster for some goals than for others, so that episodes end at different times."""

    def get_vec_normalize_env(self):
        return None

    def predict(self, observation, deterministic):
        speed = 0.3 + 0.3 * (1.0 + np.sin(50.0 * observation["goal"][..., :1]))
        return np.concatenate((speed, 0.1 * speed), axis=-1), None


def test_the_whole_movement_of_a_step_wise_task_has_no_reward_for_progress():
    given = {"n_obstacles": 3, "reward_weights": {"progress": 2.0, "success": 3.0}}
    whole = registered_task(STEP, **whole_task(STEP, given))
    assert (whole.whole_movement, whole.weights.success, whole.weights.progress) == (True, 3.0, 0.0)
    assert whole_task(MOVING, {"n_via": 2}) == {"n_via": 2}


def test_what_a_method_carries_out_is_what_the_single_environment_does():
    method = StepAgentMethod("forwards", Forwards(), STEP, {})
    simulation = SceneSimulation(STEP, 6)
    scenes = scenes_of(simulation.task, 6, 1)
    together = method.execute(scenes, method.decide(simulation.observe(scenes), scenes))
    env = gym.make(STEP)
    for i in range(6):
        text = scene_to_json(scenes, simulation.task.arm, "hand", scene=i)
        observation, _ = env.reset(options=scene_from_json(text))
        total, over = 0.0, False
        while not over:
            action, _ = method._model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            total, over = total + reward, terminated or truncated
        assert together["reward"][i] == pytest.approx(total, abs=1e-3)
        for name in ("is_success", "collision", "reachable"):
            assert together[name][i] == info[name]
        for name in ("goal_error", "path_length", "min_clearance"):
            assert together[name][i] == pytest.approx(info[name], abs=1e-3), name
    assert len(np.unique(together["duration"])) > 1


@pytest.mark.parametrize("env_id", [STEP, "viapoint/PlanarMovingObstaclesStep-v0"])
def test_an_agent_of_steps_stands_in_one_table_with_the_others(env_id):
    preset = STEP_PRESETS["sac"]
    settings = {**preset.hyperparameters, "buffer_size": 10}
    agent = agent_method("agent", build("sac", preset.policy, ViaVecEnv(env_id, 4), settings, seed=0))
    assert isinstance(agent, StepAgentMethod)
    env_kwargs = whole_task(env_id, {})
    simulation = SceneSimulation(env_id, 4, **env_kwargs)
    scenes = drawn("validation", simulation.task, 12)
    methods = [agent, Straight(simulation)]
    found = evaluate_methods(methods, scenes, env_id, env_kwargs=env_kwargs, batch=5, time_decisions=False)
    for each in found.results:
        assert each.summary()["scenes"] == 12
    assert set(found.results[1].outcomes) <= set(found.results[0].outcomes)


def test_an_evaluation_has_one_row_for_each_method_and_number_of_checks():
    search = GeometrySearch(PLANE, 8)
    result = evaluate(PLANE, checks=(0, 4), baselines=["untrained", search], n_scenes=10)
    names = [row["method"] for row in result.rows]
    assert names == ["agent", "agent, 4 checks", "untrained", "untrained, 4 checks", "sobol8"]
    assert result.to_dict()["methods"]["agent"]["success"]["rate"] == result.success_rate
    assert evaluate(search, env=PLANE, n_scenes=10).success_rate == result.rows[-1]["success"]["rate"]
