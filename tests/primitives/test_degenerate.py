"""Near degenerate input: nearly equal points, very many points, movements that stand still, and no movements."""

import numpy as np
import pytest
import torch

import viapoint.primitives as vp
from viapoint.primitives import passage_durations, retarget, through

GAPS = [1e-3, 1e-8, 1e-13]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("more", [1, 3])
@pytest.mark.parametrize("moving", [False, True])
def test_nearly_equal_via_points_along_the_way_cost_nothing(gap, more, moving, rng):
    waypoints = rng.normal(size=(4, 2))
    ends = {"start_velocity": rng.normal(size=2)} if moving else {}
    plain = through(waypoints, passage_durations(waypoints, 1.0, **ends), **ends)
    times = np.insert(plain.knots, 2, plain.knots[1] + gap * np.arange(1, more + 1))
    points = plain(times)
    movement = through(points, passage_durations(points, 1.0, **ends), **ends)
    assert movement.cost() <= plain.cost() * (1 + 1e-6)
    np.testing.assert_allclose(movement(movement.knots), points, atol=1e-10)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("gap", GAPS[:2])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_no_passage_time_is_better_for_nearly_equal_points_in_any_direction(gap, place, rng):
    waypoints = rng.normal(size=(20, 5, 2))
    waypoints[:, place + 1] = waypoints[:, place] + gap * rng.normal(size=(20, 2))
    durations = passage_durations(waypoints, 1.0)
    best = through(waypoints, durations).cost()
    for factor in (0.3, 0.9, 1.1, 3.0):
        moved = durations.copy()
        moved[:, place] *= factor
        moved[:, 3] += durations.sum(axis=1) - moved.sum(axis=1)
        assert (through(waypoints, moved).cost() >= best * (1 - 1e-6)).all()


def test_points_that_differ_by_rounding_are_one():
    plain = through([[0.0, 0.0], [0.3, 0.2], [1.0, 0.0]], [0.4, 0.6])
    for dtype, step in ((np.float64, 1e-16), (np.float32, 3e-8)):
        points = np.array([[0.0, 0.0], [0.3, 0.2], [0.3, 0.2 + step], [1.0, 0.0]], dtype)
        np.testing.assert_allclose(through(points, [0.4, 0.0, 0.6]).cost(), plain.cost(), rtol=1e-5)
        merged = through(points, passage_durations(points, 1.0)).cost()
        assert merged < 1.01 * plain.cost()


@pytest.mark.parametrize(("number", "noise"), [(50, 1e-3), (120, 0.0)])
def test_passage_times_of_many_points_are_stationary(number, noise, rng):
    x = np.linspace(0, 1, number)
    points = np.stack([x, 0.2 * np.sin(6 * x)], axis=-1) + noise * rng.normal(size=(number, 2))
    movement = through(points, passage_durations(points, 2.0))
    slopes = vp.cost_gradient(movement).durations  # equal at the optimum (Eq. C10)
    np.testing.assert_allclose(slopes, -5 * movement.cost() / 2.0, rtol=1e-4)


def test_a_via_point_reached_within_rounding_changes_no_movement_under_way(rng):
    for _ in range(5):
        waypoints = rng.normal(size=(3, 2))
        old = through(waypoints, passage_durations(waypoints, 1.0))
        for early in (1e-7, 1e-9, 1e-12, 1e-15):
            now = float(old.knots[1]) - early
            new = retarget(old, now, waypoints[2], 1.0, via=waypoints[1])
            rest = retarget(old, now, waypoints[2], 1.0)
            assert new.cost() <= rest.cost() * (1 + 1e-6)


SHAPES = {  # answer of a movement through two via-points in the plane: shape after the batch's
    "duration": (lambda movement: movement.duration, ()),
    "knots": (lambda movement: movement.knots, (4,)),
    "sample": (lambda movement: movement.sample([0.1] * 5, (0, 6, 1))[1], (5, 2)),
    "call": (lambda movement: movement(0.5, 1), (2,)),
    "peak": (lambda movement: movement.peak(1), ()),
    "peak beyond the degree": (lambda movement: movement.peak(6), ()),
    "extrema": (lambda movement: movement.extrema(1).maximum_time, (2,)),
    "cost": (lambda movement: movement.cost(), ()),
    "energy": (lambda movement: movement.energy(0), ()),
    "stretched": (lambda movement: movement.stretched(2.0).duration, ()),
    "transformed": (lambda movement: movement.transformed(np.eye(2), [1.0, 1.0], 2.0).cost(), ()),
    "jerk": (vp.dimensionless_jerk, ()),
    "arc length": (vp.spectral_arc_length, ()),
    "valleys": (lambda movement: vp.speed_valleys(movement).time, (0,)),
    "peaks": (lambda movement: vp.speed_peaks(movement).speed, (0,)),
    "curvature": (lambda movement: vp.curvature(movement, [0.1]), (1,)),
    "gradient": (lambda movement: vp.cost_gradient(movement).waypoints, (4, 2)),
    "limits": (lambda movement: vp.minimum_duration(movement, velocity=1.0, jerk=[3.0, 1.0]), ()),
    "new goal": (lambda movement: vp.retarget(movement, 0.2, [1.0, 1.0], 0.9, via=[0.5, 1.0]).duration, ()),
    "late": (lambda movement: vp.retarget(movement, 0.2, [1.0, 1.0], 0.9, freeze=0.9).duration, ()),
    "reach": (lambda movement: vp.point_to_point(movement(0.0), movement(1.0), 1.0).coefficients, (6, 1, 2)),
    "dropped": (lambda movement: vp.through(movement([0.0, 0.0, 1.0]), [0.0, 1.0]).coefficients, (6, 2, 2)),
    "polynomial": (lambda movement: vp.minimum_jerk_coefficients(*[movement.duration] * 7), (6,)),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [np, torch])
@pytest.mark.parametrize("vias", [0, 1, 2])
@pytest.mark.parametrize("name", sorted(SHAPES.keys() - {"polynomial", "new goal", "late"}))
def test_a_movement_that_stands_still_may_last_no_time_and_leaves_others_alone(name, vias, kind, rng):
    points = kind.asarray(np.stack([rng.normal(size=(vias + 2, 2)), np.ones((vias + 2, 2))]))
    durations = passage_durations(points, kind.asarray([1.0, 0.0]))
    together, alone = through(points, durations), through(points[0], durations[0])
    assert (together.duration == kind.asarray([1.0, 0.0])).all()
    ask, _ = SHAPES[name]
    asked, expected = np.asarray(ask(together))[0], np.asarray(ask(alone))
    np.testing.assert_allclose(asked, expected, rtol=1e-14, atol=1e-13)


@pytest.mark.parametrize("kind", [np, torch])
@pytest.mark.parametrize("batch", [(0,), (3, 0)])
@pytest.mark.parametrize("name", SHAPES)
def test_no_movements_have_every_property_of_movements(name, batch, kind):
    ask, shape = SHAPES[name]
    waypoints = kind.ones((*batch, 4, 2))
    for ends in ({}, {"start_velocity": kind.ones(2), "goal_acceleration": vp.FREE}):
        durations = vp.passage_durations(waypoints, kind.ones(batch), **ends)
        assert ask(vp.through(waypoints, durations, **ends)).shape == (*batch, *shape)
