"""Errors against a reference in 80 digits: the promises of the package, for hard inputs as well."""

import mpmath
import numpy as np
import pytest

from viapoint.primitives import minimum_jerk_coefficients, through

mpmath.mp.dps = 80


class Reference:
    """The minimum-jerk movement of one axis, rest to rest, by dense elimination in 80 digits."""

    def __init__(self, points, durations):
        self.x = [mpmath.mpf(float(x)) for x in points]
        self.h = [mpmath.mpf(float(h)) for h in durations]
        inner = len(self.x) - 2
        matrix, right = mpmath.zeros(2 * inner), mpmath.zeros(2 * inner, 1)
        for k in range(inner):
            # Continuity of snap and jerk at via-point k + 1, in terms of velocities and accelerations.
            left, after = self.h[k], self.h[k + 1]
            step, next_step = self.x[k + 1] - self.x[k], self.x[k + 2] - self.x[k + 1]
            v, a = 2 * k, 2 * k + 1
            matrix[v, v] = 192 * (left**-3 + after**-3)
            matrix[v, a] = matrix[a, v] = 36 * (after**-2 - left**-2)
            matrix[a, a] = 9 * (1 / left + 1 / after)
            if k + 1 < inner:
                matrix[v, v + 2] = matrix[v + 2, v] = 168 * after**-3
                matrix[v, a + 2] = matrix[a + 2, v] = -24 * after**-2
                matrix[a, v + 2] = matrix[v + 2, a] = 24 * after**-2
                matrix[a, a + 2] = matrix[a + 2, a] = -3 / after
            right[v] = 360 * (step / left**4 + next_step / after**4)
            right[a] = 60 * (next_step / after**3 - step / left**3)
        solution = mpmath.lu_solve(matrix, right) if inner else []
        self.v = [mpmath.mpf(0), *(solution[2 * k] for k in range(inner)), mpmath.mpf(0)]
        self.a = [mpmath.mpf(0), *(solution[2 * k + 1] for k in range(inner)), mpmath.mpf(0)]

    def segment(self, s):
        h, d = self.h[s], self.x[s + 1] - self.x[s]
        v0, v1 = self.v[s] * h, self.v[s + 1] * h
        a0, a1 = self.a[s] * h**2, self.a[s + 1] * h**2
        return [
            self.x[s],
            v0,
            a0 / 2,
            10 * d - 6 * v0 - 4 * v1 - 3 * a0 / 2 + a1 / 2,
            -15 * d + 8 * v0 + 7 * v1 + 3 * a0 / 2 - a1,
            6 * d - 3 * v0 - 3 * v1 - a0 / 2 + a1 / 2,
        ]

    def __call__(self, time, nu):
        time = mpmath.mpf(float(time))
        start, s = mpmath.mpf(0), 0
        while s + 1 < len(self.h) and time >= start + self.h[s]:
            start, s = start + self.h[s], s + 1
        u = (time - start) / self.h[s]
        terms = [c * mpmath.ff(k, nu) * u ** (k - nu) for k, c in enumerate(self.segment(s)) if k >= nu]
        return mpmath.fsum(terms) / self.h[s] ** nu

    def cost(self):
        total = mpmath.mpf(0)
        for s, h in enumerate(self.h):
            c3, c4, c5 = (6 * self.segment(s)[3], 24 * self.segment(s)[4], 60 * self.segment(s)[5])
            square = c3**2 + c3 * c4 + c4**2 / 3 + 2 * c3 * c5 / 3 + c4 * c5 / 2 + c5**2 / 5
            total += square / h**5 / 2
        return total


@pytest.mark.parametrize("duration", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(
    ("vias", "ratio"),
    [(0, 1), (1, 100), (5, 10), (20, 1), (20, 100), (5, 200), (2, 1000), (5, 1e8), (3, 1e12)],
)
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_derivatives_are_exact_to_rounding(vias, ratio, duration, offset, rng):
    points = offset + rng.uniform(-1, 1, vias + 2)
    durations = np.exp(rng.uniform(0, np.log(ratio), vias + 1))
    durations[vias // 2] = 1.0
    durations[-1] = ratio
    durations *= duration / durations.sum()
    trajectory = through(points[:, None], durations)
    reference = Reference(points, durations)
    time = rng.uniform(0, duration, 40)
    for nu in range(4):
        expected = np.array([float(reference(t, nu)) for t in time])
        error = np.abs(trajectory(time, nu)[:, 0] - expected).max() / np.abs(expected).max()
        assert error < (1e-10 if ratio == 200 else 1e-11), (nu, error)
    np.testing.assert_allclose(float(trajectory.cost()), float(reference.cost()), rtol=1e-12)


@pytest.mark.parametrize("duration", [1e-5, 1e-3, 2.0, 1e3, 1e5])
def test_the_primers_coefficients_meet_all_six_conditions_at_any_duration(duration, rng):
    x0, v0, a0, x1, v1, a1 = rng.normal(size=(6, 50))
    rate = 1 / duration
    found = minimum_jerk_coefficients(x0, v0 * rate, a0 * rate**2, x1, v1 * rate, a1 * rate**2, duration)
    unit = found * duration ** np.arange(6)
    np.testing.assert_allclose(unit[:, :3], np.stack([x0, v0, a0 / 2], axis=-1), rtol=1e-14)
    np.testing.assert_allclose(unit.sum(axis=-1), x1, atol=1e-12)
    np.testing.assert_allclose(unit @ np.arange(6), v1, atol=1e-12)
    np.testing.assert_allclose(unit @ (np.arange(6) * np.arange(-1, 5)), a1, atol=1e-11)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("exponent", [-20, -10, 10, 20])
def test_the_pace_changes_no_digit_of_a_movement_in_unit_time(exponent, order, dtype, rng):
    """Durations of 1e-6 s to 1e6 s, in single precision too: scaled by a power of two, coefficients stay."""
    pace = 2.0**exponent
    waypoints, velocity = rng.normal(size=(5, 4, 2)).astype(dtype), rng.normal(size=(5, 2)).astype(dtype)
    durations = rng.uniform(0.5, 1.0, (5, 3)).astype(dtype)
    plain = through(waypoints, durations, start_velocity=velocity, order=order)
    scaled = through(waypoints, durations * dtype(pace), start_velocity=velocity / dtype(pace), order=order)
    np.testing.assert_array_equal(scaled.coefficients, plain.coefficients)
    shared = through(waypoints[0], durations[0] * dtype(pace), order=order)
    np.testing.assert_array_equal(
        shared.coefficients, through(waypoints[0], durations[0], order=order).coefficients
    )
