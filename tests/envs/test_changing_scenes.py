"""Scenes in which targets jump and obstacles move: drawn, given, refused, and hidden until it happens."""

import gymnasium as gym
import numpy as np
import pytest
from revised import GOAL, JUMP, MOVING, OTHER, START, events, make, play

from viapoint.envs.registration import REPLANNING_TASKS
from viapoint.envs.scenes.motion import ChangeSampler


def test_what_lies_in_the_future_is_hidden():
    (one, first), (other, second) = make(jumps=[[0.5, *OTHER]]), make(jumps=[[0.4, *START + 0.1]])
    for _ in range(2):
        for name, part in first.items():
            np.testing.assert_array_equal(part, second[name])
        (first, *_), (second, *_) = one.step(np.zeros(3)), other.step(np.zeros(3))
    assert not np.array_equal(first["goal"], second["goal"])


@pytest.mark.parametrize("env_id", REPLANNING_TASKS)
def test_the_scenes_of_an_episode_are_options_that_make_it_again(env_id):
    drawn, given = gym.make_vec(env_id, num_envs=5), gym.make_vec(env_id, num_envs=5)
    first, _ = drawn.reset(seed=3)
    again, _ = given.reset(options=drawn.unwrapped.scenes.as_options())
    for k in range(4):
        for name, part in first.items():
            np.testing.assert_array_equal(part, again[name])
        actions = np.random.default_rng(k).uniform(-0.3, 0.3, drawn.action_space.shape)
        (first, reward, over, *_), (again, same, *_) = drawn.step(actions), given.step(actions)
        np.testing.assert_array_equal(reward, same)
        if over.any():
            return


def test_jumps_and_courses_are_drawn_as_asked():
    env = gym.make_vec(JUMP, num_envs=100, n_jumps=(0, 3), n_obstacles=2).unwrapped
    env.reset(seed=0)
    times, arm = env.scenes.jump_times, env.arm
    assert set(np.isfinite(times).sum(axis=-1)) == {0, 1, 2, 3}
    assert (np.diff(np.where(np.isfinite(times), times, 99.0 + np.arange(4)), axis=-1) > 0.0).all()
    assert (arm.reach_margin(env.scenes.jumps[np.isfinite(times)][:, 1:]) > 0.0).all()
    moving = gym.make_vec(MOVING, num_envs=200).unwrapped
    moving.reset(seed=0)
    scenes = moving.scenes
    speed = np.linalg.norm(scenes.courses[..., :2], axis=-1)[scenes.present]
    assert (speed > 0.0).mean() > 0.9
    assert 0.3 < scenes.turns[scenes.present].mean() < 0.7


def test_where_no_jump_fits_another_scene_is_drawn():
    """In one of a few hundred of these; the seeds of all others give what they would give alone."""
    several = {"whole_arm": True, "n_obstacles": (1, 4)}
    first, _ = gym.make_vec(JUMP, num_envs=64, **several).reset(seed=0)
    alone = gym.make(JUMP, **several)
    for seed in (36, 37, 38):  # none fits into what is drawn first from 37
        for name, part in alone.reset(seed=seed)[0].items():
            np.testing.assert_array_equal(part, first[name][seed])


def test_a_given_scene_in_which_no_jump_fits_is_refused(monkeypatch):
    def fits(self, scenes, time, targets, _):
        return np.zeros(targets.shape[:2], bool)

    monkeypatch.setattr(ChangeSampler, "_fits", fits)
    env = gym.make(JUMP).unwrapped
    with pytest.raises(ValueError, match=r"no jump .* give the jumps, too"):
        env.reset(seed=0, options={"start": START, "goal": GOAL})
    with pytest.raises(ValueError):  # as there is none anywhere
        env.reset(seed=0)


def test_rows_of_zeros_are_no_jumps_wherever_they_stand():
    rows = [[0.3, *OTHER], [0.0, 0.0, 0.0], [0.5, 0.1, 0.45]]
    (gap, _), (packed, _) = make(jumps=rows), make(jumps=rows[::2])
    np.testing.assert_array_equal(gap.batch.scenes.jumps, packed.batch.scenes.jumps)
    assert events(play(gap)) == events(play(packed))


def test_any_jumps_and_courses_are_played_or_refused_with_a_reason():
    generator, found = np.random.default_rng(0), {True: 0, False: 0}
    env = gym.make(MOVING).unwrapped
    edges = [0.0, -0.0, 1e-300, 1e-9, 1e-3, 0.3, 2.4, 2.5, 1e9, -1.0]
    for seed in range(150):
        env.reset(seed=seed)
        options = {name: part[0] for name, part in env.batch.scenes.as_options().items()}
        number = int((options["obstacles"][:, -1] > 0.0).sum())
        options["obstacles"], courses = options["obstacles"][:number], options["courses"][:number]
        nasty = generator.random(courses.shape) < 0.05
        courses = np.where(nasty, generator.choice(edges, courses.shape), courses)
        times = np.sort(generator.choice(edges[2:8], 2))
        jumps = np.column_stack((times, options["goal"] + generator.uniform(-0.1, 0.1, (2, 2))))
        reason = ""
        try:
            env.reset(options={**options, "jumps": jumps[: seed % 3], "courses": courses})
        except ValueError as error:
            reason = str(error)
        assert not reason or reason.startswith("scene 0: ")
        found[not reason] += 1
        for info in () if reason else play(env, actions=0.5, seed=seed):
            assert np.isfinite(list(info.values())).all()
    assert min(found.values()) > 20
