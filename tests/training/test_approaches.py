"""What is seen of the links of an arm in space is what an exact and much slower look sees."""

import numpy as np
import pytest
import torch

from viapoint.envs.arms import PANDA
from viapoint.envs.clearance import clearance_profile
from viapoint.envs.scenes import Scenes
from viapoint.training import sight
from viapoint.training.approaches import CLOSE, Obstacles, approaches
from viapoint.training.features import foresee, look_at
from viapoint.training.sight import INSTANTS, LOOKS, STRETCHES
from viapoint.training.trial import Trial

SCENES, PLANS, FINE = 16, 8, 10
IN_ORDER = np.sort(INSTANTS)


@pytest.fixture(scope="module")
def trial():
    trial = Trial("viapoint/PandaObstacles-v0", 16, threads=1)
    yield trial
    trial.close()


@pytest.fixture(scope="module")
def scenes(trial):
    return trial.task.sampler()([np.random.default_rng(seed) for seed in range(SCENES)])


def paths(trial, scenes, times):
    """Random movements at fractions of their durations, and which of them stay in reach."""
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (SCENES, PLANS, 4))
    start, goal = (
        np.broadcast_to(place[:, None], (SCENES, PLANS, 3)) for place in (scenes.start, scenes.goal)
    )
    plan = trial.task.action.decode(actions, start, goal)
    hand = plan.trajectory()(plan.durations.sum(axis=-1)[..., None] * times)
    return hand, np.asarray(PANDA.reach_margin(hand)).min(axis=-1) > 0.0


def exact(hand, scenes):
    """Clearance at each instant, shape (B, H, T)."""
    links = PANDA.links(PANDA.posture(hand))
    rows, present = scenes.obstacles[:, None], scenes.present[:, None]
    profile = clearance_profile(hand, PANDA.hand_radius, rows, present, links, PANDA.link_radii)
    return np.asarray(profile).min(axis=2)


def test_the_nearest_approach_is_that_of_an_exact_look_ten_times_as_often(trial, scenes):
    hand, inside = paths(trial, scenes, IN_ORDER)
    often, _ = paths(trial, scenes, np.arange(1, FINE * len(IN_ORDER) + 1) / (FINE * len(IN_ORDER)))
    truth = exact(often, scenes).min(axis=-1)
    packed = Obstacles.packed(scenes.obstacles.astype(np.float32), scenes.present)
    found = approaches(PANDA, hand.astype(np.float32), packed, STRETCHES, -np.inf)
    error = (found.clearance.min(axis=-1) - truth)[inside & (truth < CLOSE)]
    assert len(error) > 50
    assert error.min() > -1e-3  # hardly ever seen too near
    assert np.quantile(error, 0.9) < 2e-3
    assert np.quantile(error, 0.5) < 1e-4
    assert not found.gradient.any()


def test_what_becomes_of_a_movement_does_not_depend_on_the_others(trial, scenes):
    hand = paths(trial, scenes, IN_ORDER)[0].astype(np.float32)
    packed = Obstacles.packed(scenes.obstacles.astype(np.float32), scenes.present)
    every = approaches(PANDA, hand, packed, STRETCHES, 0.06)
    for i in (0, 7):
        one = slice(i, i + 1)
        alone = approaches(PANDA, hand[one, 2:3], Obstacles(*(part[one] for part in packed)), STRETCHES, 0.06)
        for part, together in zip(alone, every, strict=True):
            np.testing.assert_array_equal(part[0, 0], together[i, 2])


def test_where_nothing_stands_everything_is_far(trial, scenes):
    hand = paths(trial, scenes, IN_ORDER)[0].astype(np.float32)
    nothing = Scenes(scenes.start, scenes.goal, np.zeros_like(scenes.obstacles))
    packed = Obstacles.packed(nothing.obstacles.astype(np.float32), nothing.present)
    found = approaches(PANDA, hand, packed, STRETCHES, 0.06)
    assert (found.clearance == 1.0).all()
    assert not found.gradient.any()


def test_the_push_is_where_the_exact_look_sees_it(trial, scenes, monkeypatch):
    """For most; where two obstacles are about as near, the looks may choose different ones."""
    observation = trial.observe(scenes)
    actions = 0.5 * np.random.default_rng(2).uniform(-1.0, 1.0, (SCENES, PLANS, 4)).astype(np.float32)
    quick = look_at(observation, actions, trial.task)
    monkeypatch.setattr(sight, "among_links", lambda task: False)
    slow = look_at(observation, actions, trial.task)
    inside = quick.fares[..., STRETCHES + 2] > 0.0
    pushes = [look.fares[inside][:, STRETCHES + 4 :].ravel() for look in (quick, slow)]
    assert np.corrcoef(*pushes)[0, 1] > 0.85
    np.testing.assert_array_equal(quick.free, slow.free)


def test_the_gradient_with_respect_to_an_action_is_the_exact_one(trial, scenes, monkeypatch):
    observation = {name: torch.from_numpy(part) for name, part in trial.observe(scenes).items()}
    start = 0.5 * np.random.default_rng(2).uniform(-1.0, 1.0, (SCENES, PLANS, 4)).astype(np.float32)

    def gradient():
        actions = torch.from_numpy(start).requires_grad_()
        seen = foresee(observation, actions, trial.task).seen
        seen.clearance.amin(dim=-1).clamp(max=0.05).sum().backward()
        return actions.grad.numpy().ravel(), seen.reach_margin.detach().numpy() > 0.0

    quick, inside = gradient()
    monkeypatch.setattr(sight, "among_links", lambda task: False)
    slow, _ = gradient()
    rows = np.repeat(inside.ravel(), 4)
    assert np.corrcoef(quick[rows], slow[rows])[0, 1] > 0.9


def test_a_path_has_a_look_in_the_middle_of_each_stretch():
    assert LOOKS % 2 == 1
