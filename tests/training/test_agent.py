"""Laws of the agent: what it foresees is so, its networks see a set, and it learns."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from viapoint.envs.arms import ADULT, ARMS
from viapoint.envs.arms.planar import PlanarArm
from viapoint.envs.reach_vector import ReachVectorEnv
from viapoint.envs.scenes import Scenes
from viapoint.envs.task import Task
from viapoint.training import sight
from viapoint.training.anchors import Anchors
from viapoint.training.features import foresee, look_at, scene_view
from viapoint.training.policies import ViaPolicy
from viapoint.training.scene_pool import ScenePool, exchanged, mirrored
from viapoint.training.sight import INSTANTS, LOOKS, NEAR, STRETCHES, push, see
from viapoint.training.trial import Trial
from viapoint.training.vec_env import ViaVecEnv
from viapoint.training.via_td3 import ViaTD3

IDS = ("viapoint/PlanarReach-v0", "viapoint/PlanarObstacles-v0", "viapoint/PlanarWholeArm-v0")


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module", params=IDS)
def trial(request):
    trial = Trial(request.param, 64)
    yield trial
    trial.close()


def scenes_of(trial, number=64, seed=0):
    return trial.task.sampler()([np.random.default_rng(seed + i) for i in range(number)])


def observed(trial, scenes):
    return {name: torch.as_tensor(part) for name, part in trial.observe(scenes).items()}


def policy_for(trial, **kwargs):
    torch.manual_seed(0)
    env = next(iter(trial._envs.values()))
    return ViaPolicy(
        env.single_observation_space,
        env.single_action_space,
        lambda _: 1e-3,
        task=trial.task.as_dict(),
        width=64,
        **kwargs,
    )


def test_what_is_foreseen_of_a_movement_is_what_happens(trial):
    scenes = scenes_of(trial)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (64, trial.task.action.size)).astype(np.float32)
    done = trial(scenes, actions.astype(np.float64))
    seen = foresee(observed(trial, scenes), torch.as_tensor(actions)[:, None], trial.task)
    margin = seen.seen.reach_margin[:, 0].numpy()
    np.testing.assert_array_equal(margin > 0.0, done.info["reachable"])
    np.testing.assert_allclose(np.exp(seen.log_jerk[:, 0].numpy()), done.info["jerk_ratio"], rtol=1e-4)
    known = sum(done.info[f"reward_{name}"] for name in ("clearance", "smoothness", "duration"))
    error = np.abs(seen.reward.total()[:, 0].numpy() - known)
    assert error.mean() < 2e-2, "but for what lies between two looks"
    assert np.median(error) < 1e-2
    least = seen.seen.clearance[:, 0].amin(dim=-1).numpy()
    assert (least >= done.info["planned_clearance"] - 2e-3).all()
    promising = (least > 0.0) & (margin > 0.0)
    assert (promising >= done.success).all(), "a plan that fails for certain must not succeed"
    assert (promising == done.success).mean() > 0.95


def test_foresight_is_the_same_in_numpy_and_torch(trial):
    scenes = scenes_of(trial)
    actions = np.random.default_rng(2).uniform(-1.0, 1.0, (64, 3, trial.task.action.size)).astype(np.float32)
    ours = foresee(trial.observe(scenes), actions, trial.task)
    theirs = foresee(observed(trial, scenes), torch.as_tensor(actions), trial.task)
    difference = np.abs(ours.vector() - theirs.vector().numpy())
    assert np.quantile(difference, 0.98) < 2e-3, "but where two obstacles are equally near"
    for name, mine, others in zip(ours.reward._fields, ours.reward, theirs.reward, strict=True):
        atol = 2e-2 if name == "clearance" else 1e-4  # single precision is coarse where axes cross
        np.testing.assert_allclose(mine, others.numpy(), atol=atol)


def test_the_obstacles_push_where_clearance_grows(trial):
    """A path moved a little along the push of each stretch clears the nearest obstacle by more."""
    scenes = scenes_of(trial)
    if not scenes.obstacles.shape[1]:
        pytest.skip("there are no obstacles in this task")
    observation, task = trial.observe(scenes), trial.task
    actions = np.random.default_rng(3).uniform(-0.5, 0.5, (64, 2, task.action.size)).astype(np.float32)
    trajectory = task.action.decode(
        actions, *(np.repeat(observation[name][:, None], 2, axis=1) for name in ("hand", "goal"))
    ).trajectory()
    hand = trajectory(np.asarray(trajectory.duration)[..., None] * INSTANTS)
    seen, pushed = push(observation, hand, task)
    moved = see(observation, hand + 2e-3 * np.tile(pushed, (1, 1, LOOKS, 1)), task)
    close = (seen.clearance < NEAR / 2) & (seen.clearance > 5e-3)
    assert close.any()
    assert (moved.clearance >= seen.clearance - 2e-4)[close].mean() > 0.9


class WithAngles(PlanarArm):
    links_at = None


@pytest.mark.parametrize("hand_radius", [ADULT.hand_radius, 0.05])
def test_links_without_angles_look_the_same_and_the_hand_counts_with_them(hand_radius):
    numbers = vars(dataclasses.replace(ADULT, hand_radius=hand_radius))
    quick, slow = (
        ReachVectorEnv(arm=kind(**numbers), whole_arm=True).task for kind in (PlanarArm, WithAngles)
    )
    scenes = quick.sampler()([np.random.default_rng(seed) for seed in range(64)])
    observation = quick.observation.observe(np.asarray(quick.arm.posture(scenes.start)), scenes.start, scenes)
    straight = scenes.start[:, None] + (scenes.goal - scenes.start)[:, None] * INSTANTS[:, None]
    seen = [see(observation, straight[:, None], task).clearance for task in (quick, slow)]
    np.testing.assert_allclose(*seen, atol=1e-9)


@pytest.mark.parametrize("library", [np.asarray, torch.as_tensor])
def test_rows_are_picked_and_least_looks_found_as_indexing_says(library):
    generator = np.random.default_rng(4)
    hand, around = generator.normal(size=(3, 4, 48, 2)), generator.integers(0, 48, (3, 4, 16, 3))
    present, which = generator.normal(size=(3, 5)) > 0.0, generator.integers(0, 5, (3, 4, 16))
    scene, movement = np.arange(3)[:, None, None], np.arange(4)[None, :, None, None]
    picked = [
        sight._picked(library(hand), library(around), 2),
        sight._picked(library(present), library(which), 1),
    ]
    np.testing.assert_array_equal(picked[0], hand[scene[..., None], movement, around])
    np.testing.assert_array_equal(picked[1], present[scene, which])
    profile = hand[..., 0].reshape(3, 4, LOOKS, 16)
    np.testing.assert_array_equal(sight._least_look(library(profile)), profile.min(axis=-2))


def test_foresight_has_finite_gradients_everywhere(trial):
    actions = torch.rand((64, 5, trial.task.action.size)) * 2.0 - 1.0
    actions[:, 0] = 0.0
    actions.requires_grad_()
    foresee(observed(trial, scenes_of(trial)), actions, trial.task).vector().sum().backward()
    assert torch.isfinite(actions.grad).all()


def test_anchors_fare_as_their_actions_do(trial):
    """Their paths are scaled copies; the primitives give the same."""
    observation = trial.observe(scenes_of(trial))
    look = Anchors(trial.task).look(observation)
    again = look_at(observation, look.actions, trial.task)
    inside = (np.abs(look.actions) < 0.97).all(axis=-1)
    ours, theirs = (seen.fares[inside][:, :STRETCHES] for seen in (look, again))
    assert np.quantile(np.abs(ours - theirs), 0.98) < 2e-3, "but where two obstacles are equally near"
    np.testing.assert_allclose(look.known[inside], again.known[inside], atol=5e-2)


def test_the_order_of_the_obstacles_is_irrelevant_and_turning_the_scene_too(trial):
    scenes = scenes_of(trial)
    if not scenes.obstacles.shape[1]:
        pytest.skip("there are no obstacles in this task")
    policy = policy_for(trial)
    turned_over = Scenes(scenes.start, scenes.goal, scenes.obstacles[:, ::-1])
    one, other = (policy.actor.propose(observed(trial, s)) for s in (scenes, turned_over))
    for mine, theirs in zip(one, other, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-4)


def test_a_scene_is_seen_along_its_line(trial):
    """Turning start, goal and obstacles about the base changes nothing of the obstacles' view."""
    scenes = scenes_of(trial)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    rows = scenes.obstacles.copy()
    rows[..., :2], rows[..., 2:4] = rows[..., :2] @ turn.T, rows[..., 2:4] @ turn.T
    other = Scenes(scenes.start @ turn.T, scenes.goal @ turn.T, rows)
    here, there = (scene_view(observed(trial, s), trial.task) for s in (scenes, other))
    present = here.present.unsqueeze(-1)
    torch.testing.assert_close(here.rows * present, there.rows * present, atol=1e-5, rtol=1e-4)


def test_ranking_takes_the_best_of_what_it_judges(trial):
    policy = policy_for(trial)
    observation = observed(trial, scenes_of(trial))
    with torch.no_grad():
        alone, ranked = policy.actor(observation), policy.ranked(observation, 32)
        values = [policy.critic.judge(observation, a[:, None]).reward() for a in (alone, ranked)]
    assert (values[1] >= values[0] - 1e-6).all()


def test_the_task_survives_json(trial):
    record = json.loads(json.dumps(trial.task.as_dict()))
    assert Task.from_dict(record, ARMS) == trial.task
    with pytest.raises(ValueError, match=r"arm must be one of planar.*, got 'octopus'"):
        Task.from_dict({**record, "arm": "octopus"}, ARMS)


def test_companions_of_a_scene_are_scenes(trial):
    scenes = scenes_of(trial)
    twice = mirrored(mirrored(scenes))
    np.testing.assert_allclose(twice.obstacles, scenes.obstacles, atol=1e-12)
    np.testing.assert_array_equal(mirrored(scenes).present, scenes.present)
    np.testing.assert_array_equal(exchanged(exchanged(scenes)).start, scenes.start)


def test_the_pool_depends_on_seed_and_round_alone():
    trial = Trial(IDS[1], 1)
    look = policy_for(trial).actor.look
    straight, jumped = (ScenePool(trial.task, look, 7, fresh=4, rounds=3) for _ in range(2))
    for number in range(6):
        straight.begin(number)
    jumped.begin(5)
    for (one, seen), (other, also) in [(straight.sample(20), jumped.sample(20))]:
        for name in one:
            torch.testing.assert_close(one[name], other[name], atol=0.0, rtol=0.0)
        torch.testing.assert_close(seen.fares, also.fares, atol=0.0, rtol=0.0)


def test_it_learns_within_a_minute_what_chance_does_not():
    """A few hundred decisions suffice to double the success of random ones, and to triple it with ranking."""
    trial = Trial(IDS[1], 256)
    scenes = scenes_of(trial, 256, seed=10_000)
    observation = trial.observe(scenes)
    chance = trial(scenes, np.random.default_rng(0).uniform(-1.0, 1.0, (256, 3))).success.mean()
    env = ViaVecEnv(IDS[1], 64, seed=0)
    model = ViaTD3(
        "ViaPolicy",
        env,
        seed=0,
        learning_starts=256,
        gradient_steps=12,
        fresh_scenes=16,
        policy_kwargs={"width": 64},
    )
    model.learn(64 * 14)
    alone = trial(scenes, model.predict(observation)[0].astype(np.float64)).success.mean()
    model.policy.candidates = 32
    ranked = trial(scenes, model.predict(observation)[0].astype(np.float64)).success.mean()
    assert alone > 2.0 * chance
    assert ranked > 3.0 * chance
    assert ranked > 0.7
    env.close()
    trial.close()
