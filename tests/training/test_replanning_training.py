"""Laws of measuring where plans are revised, and of agents that act in every control step."""

import gymnasium as gym
import numpy as np
import pytest
from helpers import JUMPS, MOVING, STEP, scenes_of

from viapoint.envs import scene_from_json, scene_to_json
from viapoint.training import ViaVecEnv, evaluate
from viapoint.training.agents.model_io import build
from viapoint.training.evaluation import evaluate_methods
from viapoint.training.planning.baselines import StepAgentMethod, Straight, agent_method, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.presets import STEP_PRESETS
from viapoint.training.rollout import SceneSimulation, whole_task
from viapoint.training.scene_sets import drawn

MOVING_STEP = "viapoint/PlanarMovingObstaclesStep-v0"
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
        assert alone.reward[0] == together.reward[row]


def test_a_jumping_target_is_reached_by_revision():
    result = evaluate(
        env=JUMPS, baselines=["straight"], n_scenes=12, scenes="validation", time_decisions=False
    )
    assert result.success_rate == 1.0
    assert (result.results[0].outcomes["decisions"] > 1).all()


class Forwards:
    """Steers straight ahead, faster for some goals than for others, so that episodes end at different times."""

    def get_vec_normalize_env(self):
        return None

    def predict(self, observation, deterministic):
        speed = 0.3 + 0.3 * (1.0 + np.sin(50.0 * observation["goal"][..., :1]))
        return np.concatenate((speed, 0.1 * speed), axis=-1), None


def test_the_whole_movement_of_a_step_wise_task_has_no_reward_for_progress():
    given = {"n_obstacles": 3, "reward_weights": {"progress": 2.0, "success": 3.0}}
    whole = SceneSimulation(STEP, 2, **whole_task(STEP, given)).task
    assert whole.whole_movement
    assert (whole.weights.success, whole.weights.progress) == (3.0, 0.0)
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
        assert together.reward[i] == pytest.approx(total, abs=1e-3)
        for name in ("is_success", "collision", "reachable"):
            assert together.info[name][i] == info[name]
        for name in ("goal_error", "path_length", "min_clearance"):
            assert together.info[name][i] == pytest.approx(info[name], abs=1e-3), name
    assert len(np.unique(together.info["duration"])) > 1


@pytest.mark.parametrize("env_id", [STEP, MOVING_STEP])
def test_an_agent_of_steps_stands_in_one_table_with_the_others(env_id):
    preset = STEP_PRESETS["sac"]
    settings = {**preset.arguments(), "buffer_size": 10}
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
