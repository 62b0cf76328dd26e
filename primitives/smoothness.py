"""Speed, curvature and smoothness measures, computed from the polynomials of a movement.

Values of the straight minimum-jerk reach of amplitude A and duration T, which the tests check: integral of
squared jerk 720 A^2 / T^5, peak speed 1.875 A / T, dimensionless jerk 204.8, log dimensionless jerk -5.3220,
spectral arc length -1.4024. Where nothing moves the ratios are undefined and NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ._polynomial import differentiate, multiply, root_candidates
from .array_api import Array, Namespace, as_number, like, to_numpy, unit_factors, vector_length
from .trajectory import Trajectory, require_trajectory, unit_polynomials

# Number of speed samples for the spectral arc length, for any duration: far beyond a movement's bandwidth.
_SPECTRUM_SAMPLES = 1000
_PADDED = 16 * 1024  # Number of samples with the zeros behind them
# Least rate of the squared speed, relative to its greatest, that is more than rounding in double precision.
_LEAST_TREND = 1e-12
# Least rate in lower precisions, in units of machine epsilon: their coefficients are rounded more.
_ROUNDINGS = 64


@dataclass(frozen=True)
class SpeedEvents:
    """Local extrema of the speed, padded with NaN where a movement has fewer than others of its batch.

    Attributes:
        time: (..., M) ascending [s].
        speed: (..., M) [m/s].

    Example:
        >>> from viapoint.primitives import point_to_point, speed_peaks
        >>> peaks = speed_peaks(point_to_point([0.0], [0.4], 1.0))
        >>> peaks.time.round(9).tolist(), peaks.speed.round(9).tolist()
        ([0.5], [0.75])
    """

    time: Array
    speed: Array


def speed(trajectory: Trajectory, time: Array) -> Array:
    """Return the tangential speed |v|, (..., T) [m/s], at times (T,) or (..., T) [s].

    Example:
        >>> from viapoint.primitives import point_to_point, speed
        >>> speed(point_to_point([0.0, 0.0], [0.3, 0.4], 1.0), [0.0, 0.5, 1.0]).round(9).tolist()
        [0.0, 0.9375, 0.0]
    """
    require_trajectory(trajectory)
    return vector_length(trajectory.namespace, trajectory(time, 1))


def curvature(trajectory: Trajectory, time: Array) -> Array:
    """Return the curvature of the path at given times.

    In the plane it is signed, (x' y'' - y' x'') / |v|^3, positive to the left (Flash & Hogan 1985, footnote 4).
    In space it is |v x a| / |v|^3. It is NaN at rest, and grows without bound at the ends of a movement through a
    via-point from rest to rest.

    Args:
        trajectory: movements in two or three dimensions.
        time: (T,) or (..., T) [s].

    Returns:
        (..., T) [1/m].

    Example:
        >>> from viapoint.primitives import curvature, through
        >>> arc = through([[0.0, 0.0], [0.5, 0.5], [1.0, 0.0]], [0.5, 0.5])
        >>> curvature(arc, [0.5]).round(4).tolist()  # a turn to the right
        [-3.7926]
    """
    require_trajectory(trajectory)
    if trajectory.dimension not in (2, 3):
        raise ValueError(f"trajectory must have dimension 2 or 3 for a curvature, got {trajectory.dimension}")
    xp = trajectory.namespace
    velocity, acceleration = trajectory.sample(time, (1, 2))
    slower = unit_factors(xp, velocity)
    flatter = unit_factors(xp, acceleration)
    velocity, acceleration = velocity * slower, acceleration * flatter
    if trajectory.dimension == 2:
        turn = velocity[..., 0] * acceleration[..., 1] - velocity[..., 1] * acceleration[..., 0]
    else:
        turn = xp.linalg.vector_norm(xp.linalg.cross(velocity, acceleration, axis=-1), axis=-1)
    length = xp.linalg.vector_norm(velocity, axis=-1)
    bend = _ratio(xp, turn, length * length * length)
    with np.errstate(all="ignore"):
        return bend * slower[..., 0] * (slower[..., 0] / flatter[..., 0])


def _ratio(xp: Namespace, numerator: Array, denominator: Array) -> Array:
    """Return the quotient, NaN where the denominator is 0; the gradient is 0 there."""
    # A mask of the quotient alone would not do: torch also differentiates what it hides, and 0 times infinity is NaN.
    defined = denominator != 0
    with np.errstate(all="ignore"):
        quotient = numerator / xp.where(defined, denominator, 1.0)
    return xp.where(defined, quotient, np.nan)[()]  # a number for a single movement, as operators return


def dimensionless_jerk(trajectory: Trajectory) -> Array:
    """Return the dimensionless jerk (...,), integral |jerk|^2 dt duration^3 / peak speed^2; smaller is smoother.

    The definition of Hogan & Sternad 2009, normalised by the peak speed. It is NaN where nothing moves. Jumps of the
    acceleration do not count, such as those at the ends of a movement of order 2: compare movements of one order.

    Example:
        >>> from viapoint.primitives import dimensionless_jerk, point_to_point
        >>> round(float(dimensionless_jerk(point_to_point([0.0], [0.4], 0.7))), 6)
        204.8
    """
    require_trajectory(trajectory)
    xp, batch = trajectory.namespace, trajectory.batch_shape
    if 0 not in batch:  # scaled by powers of two, which is exact, to a size and a duration of about 1
        size = unit_factors(xp, xp.reshape(trajectory.coefficients, (*batch, -1)))[..., 0]
        pace = unit_factors(xp, trajectory.end)[..., 0]
        trajectory = trajectory.transformed(scale=size).stretched(trajectory.duration * pace)
    duration, peak = trajectory.duration, trajectory.peak(1)
    with np.errstate(all="ignore"):
        jerk = trajectory.energy(3) * duration * duration * duration
        square = peak * peak
    return _ratio(xp, jerk, square)


def log_dimensionless_jerk(trajectory: Trajectory) -> Array:
    """Return minus the natural logarithm of the dimensionless jerk (...,); greater is smoother.

    It is infinite without jerk, and NaN where nothing moves.

    Example:
        >>> from viapoint.primitives import log_dimensionless_jerk, point_to_point
        >>> round(float(log_dimensionless_jerk(point_to_point([0.0], [0.4], 0.7))), 4)
        -5.322
    """
    ratio = dimensionless_jerk(trajectory)
    xp = trajectory.namespace
    without_jerk = ratio == 0  # masked before the logarithm, whose slope is infinite there
    logarithm = xp.log(xp.where(without_jerk, 1.0, ratio))
    return xp.where(without_jerk, np.inf, -logarithm)[()]


def spectral_arc_length(trajectory: Trajectory, *, cutoff: float = 10.0, threshold: float = 0.05) -> Array:
    """Return the spectral arc length of the speed (SPARC, Balasubramanian et al. 2015); greater is smoother.

    It is minus the arc length of the normalised amplitude spectrum up to the last frequency below `cutoff` at
    which the amplitude reaches `threshold`. The speed is sampled at 1000 instants and padded with zeros to 16
    times the next power of two.

    Args:
        trajectory: the movements.
        cutoff: highest frequency [Hz].
        threshold: amplitude below which the tail of the spectrum is left out, 0 to 1.

    Returns:
        (...,); -1.4024 for a straight reach of 1 s, NaN where nothing moves.

    Example:
        >>> from viapoint.primitives import point_to_point, spectral_arc_length
        >>> round(float(spectral_arc_length(point_to_point([0.0], [0.4], 1.0))), 4)
        -1.4024
    """
    require_trajectory(trajectory)
    if not as_number(cutoff) > 0:
        raise ValueError(f"cutoff must be a number above 0, got {cutoff!r}")
    if not 0 <= as_number(threshold) < 1:
        raise ValueError(f"threshold must be a number of at least 0 and below 1, got {threshold!r}")
    xp, dtype = trajectory.namespace, trajectory.coefficients.dtype
    if 0 in trajectory.batch_shape:  # not all libraries transform empty batches
        return 0.0 * trajectory.duration
    velocity = trajectory.sample(_SPECTRUM_SAMPLES + 1, 1)[0][..., :-1, :]
    speeds = vector_length(xp, velocity)
    if xp is not np and dtype.itemsize < 4:  # torch has no Fourier transform of half precision
        speeds = xp.astype(speeds, xp.float32)
    spectrum = xp.abs(xp.fft.rfft(speeds, n=_PADDED, axis=-1))
    spectrum = _ratio(xp, spectrum, spectrum[..., :1])
    numbers = to_numpy(spectrum)
    index = np.arange(numbers.shape[-1])
    with np.errstate(divide="ignore", invalid="ignore"):  # a movement that stands still may last no time
        step = _SPECTRUM_SAMPLES / (_PADDED * to_numpy(trajectory.duration)[..., None])  # [Hz]
        counts = (numbers >= threshold) & (index * step <= cutoff)
    # The first interval counts even if it is wider than the cutoff, as in very short movements.
    last = np.max(np.where(counts, index, 1), axis=-1, keepdims=True)
    used = like(xp, (index[:-1] < last).astype(float), spectrum)
    width = like(xp, 1.0 / last, spectrum)
    rise = spectrum[..., 1:] - spectrum[..., :-1]
    lengths = -xp.sum(used * xp.sqrt(width * width + rise * rise), axis=-1)
    return lengths if lengths.dtype == dtype else xp.astype(lengths, dtype)


def speed_valleys(trajectory: Trajectory) -> SpeedEvents:
    """Return the local minima of the speed strictly inside the movement, exact from the roots of v . a.

    Example:
        >>> from viapoint.primitives import speed_valleys, through
        >>> speed_valleys(through([[0.0, 0.0], [0.5, 0.5], [1.0, 0.0]], [0.5, 0.5])).time.round(9).tolist()
        [0.5]
    """
    return _speed_events(trajectory, 1.0)


def speed_peaks(trajectory: Trajectory) -> SpeedEvents:
    """Return the local maxima of the speed strictly inside the movement, exact from the roots of v . a.

    Example:
        >>> from viapoint.primitives import speed_peaks, through
        >>> speed_peaks(through([[0.0, 0.0], [0.5, 0.5], [1.0, 0.0]], [0.5, 0.5])).time.shape
        (2,)
    """
    return _speed_events(trajectory, -1.0)


def _speed_events(trajectory: Trajectory, sign: float) -> SpeedEvents:
    """Return the minima of the speed times a sign."""
    require_trajectory(trajectory)
    xp = trajectory.namespace
    times = _turning_times(trajectory)
    trend = sign * _speed_trend(trajectory, times)
    found = (trend[..., :-1] < 0) & (trend[..., 1:] > 0)
    times = times[..., 1:-1]
    count = int(found.sum(axis=-1).max(initial=0))
    order = np.argsort(~found, axis=-1, kind="stable")[..., :count]
    place = np.take_along_axis(times, order, axis=-1)
    exists = np.take_along_axis(found, order, axis=-1)
    time = like(xp, np.where(exists, place, 0.0), trajectory.coefficients)
    missing = like(xp, np.where(exists, 0.0, np.nan), trajectory.coefficients)
    value = speed(trajectory, time) if count else time
    return SpeedEvents(time + missing, value + missing)


def _turning_times(trajectory: Trajectory) -> Any:
    """Return all times (..., Q), ascending, at which the speed may be extreme: roots of v . a, and knots."""
    velocity = differentiate(unit_polynomials(trajectory.coefficients))
    power = multiply(velocity, differentiate(velocity)).sum(axis=-2)
    u = root_candidates(power)
    knots = to_numpy(trajectory.knots)
    times = knots[..., :-1, None] + u * np.diff(knots, axis=-1)[..., None]
    times = times.reshape(*times.shape[:-2], times.shape[-2] * times.shape[-1])
    times = np.concatenate([times, knots], axis=-1)
    return np.sort(times, axis=-1)


def _speed_trend(trajectory: Trajectory, times: Any) -> Any:
    """Return -1 or 1 where the speed falls or rises between neighbours of `times`, 0 before it changes at all."""
    middle = (times[..., 1:] + times[..., :-1]) / 2
    sampled = trajectory.sample(like(trajectory.namespace, middle, trajectory.coefficients), (1, 2))
    velocity, acceleration = (to_numpy(each) for each in sampled)
    velocity = velocity * unit_factors(np, velocity, (-2, -1))
    acceleration = acceleration * unit_factors(np, acceleration, (-2, -1))
    rate = (velocity * acceleration).sum(axis=-1)
    size = np.abs(velocity).max(axis=(-2, -1)) * np.abs(acceleration).max(axis=(-2, -1))
    wide = np.diff(times, axis=-1) > 1e-9 * times[..., -1:]  # only noise between two copies of one root
    precision = float(trajectory.namespace.finfo(trajectory.coefficients.dtype).eps)
    noise = max(_LEAST_TREND, _ROUNDINGS * precision) * size[..., None]
    trend = np.where(wide & (np.abs(rate) > noise), np.sign(rate), 0.0)
    for i in range(1, trend.shape[-1]):
        trend[..., i] = np.where(trend[..., i] == 0, trend[..., i - 1], trend[..., i])
    return trend
