"""Agents that act in every control step, beside those that decide once."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.registration import STEP_TASKS
from viapoint.training.agents.model_io import build
from viapoint.training.config.presets import STEP_PRESETS
from viapoint.training.evaluation.evaluator import evaluate_methods
from viapoint.training.planning.baselines import Straight, agent_method
from viapoint.training.rollouts.rollout import SceneSimulation, StepAgentMethod, whole_task
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.scene_sets.scene_set import load

STEP, WHOLE = "viapoint/PlanarObstaclesStep-v0", "viapoint/PlanarObstacles-v0"


@pytest.fixture(scope="module")
def model():
    preset = STEP_PRESETS["sac"]
    return build("sac", preset.policy, ViaVecEnv(STEP, 4), {**preset.arguments(), "buffer_size": 10}, seed=0)


def test_the_task_of_a_step_wise_id_is_its_twin():
    assert STEP in STEP_TASKS
    assert WHOLE not in STEP_TASKS
    weights = {"progress": 2.0, "success": 3.0}
    given = {"control_step": 0.02, "n_obstacles": 3, "reward_weights": weights}
    assert whole_task(STEP, given) == (WHOLE, {"n_obstacles": 3, "reward_weights": {"success": 3.0}})
    assert whole_task(WHOLE, {"n_via": 2}) == (WHOLE, {"n_via": 2})
    SceneSimulation(*whole_task(STEP, given)[:1], 2, **whole_task(STEP, given)[1]).close()


class Forwards:
    """Steers straight ahead, faster for some goals than for others, so that episodes end at different times."""

    def predict(self, observation, deterministic):
        speed = 0.3 + 0.3 * (1.0 + np.sin(50.0 * observation["goal"][..., :1]))
        return np.concatenate((speed, 0.1 * speed), axis=-1), None


def test_what_a_method_carries_out_is_what_the_single_environment_does():
    frozen, model = load("validation", WHOLE).take(slice(0, 6)), Forwards()
    method = StepAgentMethod("forwards", model, STEP, {})
    simulation = SceneSimulation(WHOLE, 6)
    together = method.execute(frozen.scenes, method.decide(simulation.observe(frozen.scenes), frozen.scenes))
    env = gym.make(STEP)
    for i in range(6):
        observation, _ = env.reset(options=frozen.scenes.take([i]).as_options())
        total, over = 0.0, False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            total, over = total + reward, terminated or truncated
        assert together.reward[i] == pytest.approx(total, abs=1e-4)
        for name in ("is_success", "collision", "reachable"):
            assert together.info[name][i] == info[name]
        for name in ("goal_error", "path_length", "duration", "min_clearance"):
            assert together.info[name][i] == pytest.approx(info[name], abs=1e-4), name
    assert len(np.unique(together.info["duration"])) > 1


def test_it_stands_in_one_table_with_the_others(model):
    assert isinstance(agent_method("agent", model), StepAgentMethod)
    frozen = load("validation", WHOLE).take(slice(0, 12))
    methods = [agent_method("agent", model), Straight(SceneSimulation(WHOLE, 4))]
    result = evaluate_methods(methods, frozen, WHOLE, batch=5, time_decisions=False)
    for each in result.results:
        assert each.summary()["scenes"] == 12
    assert set(result.results[1].outcomes) <= set(result.results[0].outcomes)
