"""Least-squares fit of movements through via-points to measured positions.

With fixed passage times a minimum-jerk movement is linear in its waypoints,

    x(t) = sum_k B_k(t) x_k.                                                                        (1)

So the waypoints of least squares follow from a linear system, and only the times are searched for: variable
projection (Golub & Pereyra 1973). The search works in units of the recording: time from 0 to 1, positions of size 1.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .array_api import (
    Array,
    Floats,
    as_floats,
    broadcast_batch,
    flat_batch,
    is_whole,
    leading_shape,
    like,
    namespace_of,
    require,
    to_numpy,
)
from .minimum_jerk import through
from .trajectory import Trajectory

MOST_VIA_POINTS = 8  # Greatest number of via-points of a fit

USUAL_RANGE = (0, 3)  # Fewest and most via-points among which n_via=None chooses

# Time before the first and after the last sample in which a movement may begin and end, in lengths of the recording.
_BEYOND = 0.25
# Shortest segment, in durations of the movement: via-points closer in time cannot be told apart; least share of the
# recording that the movement takes.
_SHORTEST, _LEAST = 0.02, 1e-3
# Speed between samples that is a jump: in medians of the speeds around it, this number on either side, and in the speed
# that crosses the extent once in the recording.
_APART, _AROUND, _FAST = 8.0, 4, 10.0
# Number of instants among which the first passage times are chosen.
_GRID = 8
# Numbers of the best starts that go on, and of their steps.
_STAGES = ((40, 3), (10, 8), (1, 80))
# Number of samples, evenly spread, with which the best start is found.
_ENOUGH = 200
# Greatest size of a parameter; beyond it a share does not change any more.
_GREATEST = 40.0
# Step of the difference quotients of the residuals.
_STEP = 1e-7
# Least gain of a step, relative to the squares and absolute, in units of the recording.
_CONVERGED, _TINY = 1e-10, 1e-28
# Residual, in sizes of the movement, below which a better fit is only rounding.
_ROUNDING = 1e-7
# Search for a movement in a long recording: number of parts; change from one to the next, relative to the greatest,
# with which the hand moves; share of parts below which the others are cut off; fewest samples of which some are.
_PARTS, _CHANGED, _MOSTLY, _FEWEST = 40, 0.1, 0.6, 200
# Share of the integral of the squared speed of a reach, and the part of its duration in which it is reached.
_ENERGY, _BEFORE = 0.01, 0.17


@dataclass(frozen=True, eq=False)
class ViaPointFit:
    """Minimum-jerk movement through via-points that was fitted to a measured one.

    Movements of a batch may have different numbers of via-points; K is the greatest, and others are padded with NaN.
    Times are on the clock of the measurement.

    Attributes:
        n_via: (...,) numbers of via-points.
        via_points: (..., K, D) [m].
        passage_times: (..., K) [s].
        start: (..., D) position before the movement [m].
        goal: (..., D) position after the movement [m].
        onset: (...,) beginning of the movement [s].
        end: (...,) end of the movement [s].
        r_squared: (...,) explained share of the variance of the positions, from 0 to 1.
        noise: (...,) standard deviation of the residuals of a coordinate, with the degrees of freedom of the fit [m].
        bic: (...,) Bayesian information criterion; differences between fits to the same samples have a meaning.
        trajectory: the movement; its own clock starts at 0 at the onset.

    Example:
        >>> import numpy as np
        >>> from viapoint.primitives import fit_via_points, through
        >>> time = np.linspace(0.0, 1.0, 50)
        >>> fit = fit_via_points(time, through([[0.0, 0.0], [0.2, 0.1], [0.4, 0.0]], [0.4, 0.6])(time), n_via=1)
        >>> fit.via_points.round(3).tolist(), fit([0.4]).round(3).tolist()
        ([[0.2, 0.1]], [[0.2, 0.1]])
    """

    n_via: Array
    via_points: Array
    passage_times: Array
    start: Array
    goal: Array
    onset: Array
    end: Array
    r_squared: Array
    noise: Array
    bic: Array
    trajectory: Trajectory

    @property
    def duration(self) -> Array:
        """Duration of the movement, (...,) [s]."""
        return self.end - self.onset

    def __call__(self, time: Array, nu: int = 0) -> Array:
        """Return the nu-th derivative of the fitted movement, see `Trajectory`; `time` is that of the measurement."""
        (time,) = self.trajectory.floats(time=time)
        if time.ndim == 0:
            return self(time[None], nu)[..., 0, :]
        return self.trajectory(time - self.onset[..., None], nu)


# Times (N,) [s] and positions (N, D) [m] of each movement, leading shape of the results, an array of their kind
_Recordings: TypeAlias = tuple[list[tuple[Floats, Floats]], tuple[int, ...], Array]

# Times of start, via-points and goal of one movement (K + 2,) [s], the points (K + 2, D) [m], R^2, noise, BIC
_Fit: TypeAlias = tuple[Floats, Floats, float, float, float]


def fit_via_points(
    time: Array,
    position: Array,
    n_via: int | tuple[int, int] | None = None,
    *,
    free_ends: bool = True,
) -> ViaPointFit:
    """Fit a minimum-jerk movement through via-points to measured positions, by least squares.

    The movement begins and ends at rest. Start, via-points, goal, passage times, onset and end are fitted. The onset
    may lie before the first sample and the end after the last one by up to a quarter of the recording, as in movements
    that were cut at a threshold of speed.

    The number of via-points, where it is not given, has the least Bayesian information criterion
    n log(squares / n) + p log n of n coordinates and p fitted numbers. A better minimum than the one found cannot be
    excluded. The computation runs in NumPy and double precision for every input and has no gradient.

    Args:
        time: (N,) or (..., N) ascending times of the samples [s].
        position: (..., N, D) [m]; or a list of movements of different length (N_i, D), and then `time` is a list too.
        n_via: number of via-points; (fewest, most) to choose among; None for (0, 3).
        free_ends: False for a movement that begins with the first sample and ends with the last one.

    Raises:
        ValueError: an argument is not finite or has a wrong shape; times do not ascend; nothing moves; there are
            fewer than 2 n_via + 5 samples, or an unknown n_via.

    Example:
        >>> import numpy as np
        >>> from viapoint.primitives import fit_via_points, through
        >>> time, noise = np.linspace(0.0, 1.2, 120), np.random.default_rng(0).normal(0.0, 0.001, (120, 2))
        >>> movement = through([[0.0, 0.0], [0.15, 0.20], [0.30, 0.0]], [0.4, 0.6])
        >>> fit = fit_via_points(time, movement(time - 0.1) + noise)
        >>> fit.via_points.round(2).tolist(), fit.passage_times.round(1).tolist(), round(float(fit.noise), 4)
        ([[0.15, 0.2]], [0.5], 0.001)
    """
    counts = _counts(n_via)
    if not isinstance(free_ends, bool | np.bool_):
        raise ValueError(f"free_ends must be True or False, got {free_ends!r}")
    movements, batch, kind = _recordings(time, position, 2 * counts[-1] + 5)
    fits = []
    for i, (times, positions) in enumerate(movements):
        _warn_of_jumps(times, positions, f" of movement {i}" if len(movements) > 1 else "")
        candidates = [_fit(times, positions, count, free_ends) for count in counts]
        fits.append(min(candidates, key=lambda fit: fit[-1]))  # the least BIC
    return _record(fits, batch, kind)


def _warn_of_jumps(time: Floats, position: Floats, whose: str) -> None:
    """Warn of a step between samples (N, D) that is much faster than those around it, as where a marker was lost."""
    steps, gaps = np.linalg.norm(np.diff(position, axis=0), axis=-1), np.diff(time)
    speeds = steps / np.maximum(gaps, np.median(gaps))  # clocks of recordings are not even
    around = sliding_window_view(np.pad(speeds, _AROUND, mode="symmetric"), 2 * _AROUND + 1)
    fast = _FAST * np.ptp(position, axis=0).max() / (time[-1] - time[0])
    jumps = np.flatnonzero(speeds > np.maximum(_APART * np.median(around, axis=-1), fast))
    if jumps.size:
        first = jumps[0]
        warnings.warn(
            f"sample {first + 1}{whose}, at {time[first + 1]:g} s, is {steps[first]:.3g} m away from the one before; "
            "leave out what was not measured",
            stacklevel=3,
        )


def _counts(n_via: Any) -> range:
    """Return the numbers of via-points to try."""
    given = USUAL_RANGE if n_via is None else n_via
    pair = given if isinstance(given, list | tuple) else (given, given)
    whole = len(pair) == 2 and all(map(is_whole, pair))
    if not whole or not pair[0] <= pair[1] <= MOST_VIA_POINTS:
        raise ValueError(
            f"n_via must be a whole number from 0 to {MOST_VIA_POINTS}, a pair (fewest, most) of them, or None for "
            f"{USUAL_RANGE}, got {n_via!r}"
        )
    return range(pair[0], pair[1] + 1)


def _recordings(time: Any, position: Any, fewest: int) -> _Recordings:
    """Return the movements of arrays or of a list, after all checks."""
    if not _is_list(position):
        return _checked("time", time, "position", position, fewest)
    times = time if _is_list(time, 1) else [time] * len(position)
    if len(times) != len(position):
        raise ValueError(f"time must hold an array for each of {len(position)} movements, got {len(times)}")
    movements, kinds = [], []
    for i, (own_time, own_position) in enumerate(zip(times, position, strict=True)):
        own, _, kind = _checked(f"time[{i}]", own_time, f"position[{i}]", own_position, fewest)
        movements += own
        kinds.append(kind)
    dimensions = sorted({kind.shape[-1] for kind in kinds})
    if len(dimensions) > 1:
        raise ValueError(f"position must hold movements of one dimension, got {dimensions}")
    return movements, (len(kinds),), kinds[0]


def _is_list(value: Any, axes: int = 2) -> bool:
    """Return True for a list or tuple whose entries all have this number of axes."""
    if not isinstance(value, list | tuple) or not value:
        return False
    try:
        return all(np.ndim(each) == axes for each in value)
    except ValueError:  # ragged lists
        return False


def _checked(time_name: str, time: Any, name: str, position: Any, fewest: int) -> _Recordings:
    """Return the movements of arrays (..., N) and (..., N, D), after all checks."""
    try:
        # Clocks need more digits than positions may have.
        _, (exact,) = as_floats(None, **{time_name: time})
        _, (time, position) = as_floats(None, **{time_name: exact, name: position})
    except ValueError as error:
        advice = "; leave out samples that were not measured" if "finite" in str(error) else ""
        raise ValueError(f"{error}{advice}") from None
    batch = leading_shape(name, position, None, None)
    count = position.shape[-2]
    if time.ndim and time.shape[-1] != count:
        shapes = f"{tuple(time.shape)} and {tuple(position.shape)}"
        raise ValueError(
            f"{time_name} (..., N) and {name} (..., N, D) must have as many samples N, got {shapes}"
        )
    batch = broadcast_batch(**{name: batch, time_name: leading_shape(time_name, time, count)})
    if count < fewest:
        most = (fewest - 5) // 2
        fewer = f", or give n_via={(count - 5) // 2} at most" if count >= 5 else ""
        raise ValueError(
            f"{name} must have {fewest} or more samples for n_via up to {most}, got {count}: "
            f"measure at a higher rate{fewer}"
        )
    if 0 in batch:
        raise ValueError(f"{name} must hold one movement or more, got shape {tuple(position.shape)}")
    times = flat_batch(np, to_numpy(exact).astype(float), batch, 1)
    places = flat_batch(np, to_numpy(position).astype(float), batch, 2)
    ascending = np.diff(times, prepend=-np.inf) > 0
    order = "must ascend: sort the samples, and keep one of equal times"
    require(ascending.reshape(*batch, count), time_name, times.reshape(*batch, count), order)
    moves = np.ptp(places, axis=1).any(axis=-1)
    if not moves.all():
        still = int(moves.argmin())
        which = f" of movement {still}" if batch else ""
        raise ValueError(f"{name}{which} must change, all samples are {places[still, 0].tolist()}")
    return list(zip(times, places, strict=True)), batch, position


def _basis(knots: Floats, time: Floats) -> Floats:
    """Return B_k (Eq. 1) at times (N,) for M vectors of knots (M, K + 2), shape (M, N, K + 2)."""
    unit = through(np.eye(knots.shape[-1]), np.diff(knots))  # a movement whose coordinates are the B_k
    basis: Floats = unit(time - knots[:, :1])
    return basis


def _knots(theta: Floats, free_ends: bool) -> Floats:
    """Return knots (..., K + 2) in units of the recording.

    Any numbers theta stand for ascending knots: the segments are shares of the movement, and the movement, with
    `free_ends`, a share of the recording and what may lie beyond it.
    """
    count = theta.shape[-1] - 2 * free_ends
    ends = np.cumulative_sum(_shares(theta[..., :count], _SHORTEST), axis=-1, include_initial=True)
    if not free_ends:
        return ends
    before, inside, _ = np.moveaxis(_shares(theta[..., count:], _LEAST), -1, 0)
    whole = 1.0 + 2.0 * _BEYOND
    knots: Floats = whole * (before[..., None] + inside[..., None] * ends) - _BEYOND
    return knots


def _shares(theta: Floats, least: float) -> Floats:
    """Return shares (..., n + 1) from `least` on that add up to 1: a softmax of theta (..., n) and 0, with a floor."""
    last = np.zeros((*theta.shape[:-1], 1))
    weights = np.exp(np.concatenate([theta, last], axis=-1).clip(-_GREATEST, _GREATEST))
    weights = weights / weights.sum(axis=-1, keepdims=True)
    shares: Floats = least + (1.0 - least * weights.shape[-1]) * weights
    return shares


def _theta(knots: Floats, free_ends: bool) -> Floats:
    """Return the parameters of knots (S, K + 2), the inverse of `_knots`; no segment may be a shortest one."""
    onset, end = knots[:, :1], knots[:, -1:]
    inner = np.log(np.diff(knots) / (end - onset) - _SHORTEST)
    outer = np.hstack([onset + _BEYOND, end - onset, 1.0 + _BEYOND - end]) / (1.0 + 2.0 * _BEYOND)
    outer = np.log(outer - _LEAST)
    theta: Floats = np.hstack([inner[:, :-1] - inner[:, -1:], outer[:, :-1] - outer[:, -1:]])
    return theta if free_ends else theta[:, :-2]


def _residuals(knots: Floats, time: Floats, position: Floats) -> Floats:
    """Return the residuals (M, N D) with the waypoints of least squares; large ones for knots outside the recording."""
    basis, _ = np.linalg.qr(_basis(knots, time))
    residuals = position - basis @ (basis.mT @ position)
    # A segment without samples would leave a waypoint open.
    outside: Any = (knots[:, :-1] >= 1.0).any(axis=-1) | (knots[:, 1:] <= 0.0).any(axis=-1)
    residuals = np.where(outside[:, None, None], 10.0 * position, residuals)
    return residuals.reshape(len(knots), -1)


def _expansion(
    theta: Floats, time: Floats, position: Floats, free_ends: bool
) -> tuple[Floats, Floats, Floats]:
    """Return half the squares (S,), their gradient (S, P) and the Gauss-Newton matrix (S, P, P) at theta (S, P)."""
    starts, count = theta.shape
    tried = theta[:, None] + _STEP * np.eye(count + 1, count, k=-1)  # the first row is theta itself
    knots = _knots(tried.reshape(starts * (count + 1), count), free_ends)
    residuals = _residuals(knots, time, position).reshape(starts, count + 1, -1)
    base = residuals[:, :1]
    jacobian = (residuals[:, 1:] - base) / _STEP
    return 0.5 * (base * base).sum(axis=(1, 2)), (jacobian @ base.mT)[..., 0], jacobian @ jacobian.mT


def _descend(
    theta: Floats, time: Floats, position: Floats, free_ends: bool, steps: int
) -> tuple[Floats, Floats]:
    """Return parameters (S, P) after steps of Levenberg and Marquardt, and half their squares (S,)."""
    squares, gradient, matrix = _expansion(theta, time, position, free_ends)
    damping = np.full(len(theta), 1e-2)
    for _ in range(steps):
        size = damping * (np.trace(matrix, axis1=1, axis2=2) + _TINY)
        damped = matrix + size[:, None, None] * np.eye(theta.shape[1])
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        gain = -(step * gradient).sum(axis=-1)
        if (gain <= _CONVERGED * squares + _TINY).all():
            break
        tried = theta + step
        new = _expansion(tried, time, position, free_ends)
        better = new[0] < squares
        theta = np.where(better[:, None], tried, theta)
        squares = np.where(better, new[0], squares)
        gradient = np.where(better[:, None], new[1], gradient)
        matrix = np.where(better[:, None, None], new[2], matrix)
        damping = np.where(better, damping / 5.0, damping * 4.0).clip(1e-10, 1e10)
    return theta, squares


def _moving_part(time: Floats, position: Floats) -> tuple[float, float]:
    """Return about where a movement begins and ends, from the speed of a smooth curve through all samples."""
    knots = np.linspace(0.0, 1.0, min(12, len(time) // 2))
    points = np.linalg.lstsq(_basis(knots[None], time)[0], position)[0]
    speed = np.square(through(points, np.diff(knots)).sample(200, 1)[0]).sum(axis=-1)
    reached = np.cumsum(speed) / speed.sum()
    first, last = np.interp([_ENERGY, 1.0 - _ENERGY], reached, np.linspace(0.0, 1.0, 200))
    beyond = (last - first) * _BEFORE / (1.0 - 2.0 * _BEFORE)
    most = 0.9 * _BEYOND
    return max(first - beyond, -most), min(last + beyond, 1.0 + most)


def _around_movement(position: Floats) -> slice:
    """Return the samples from one length of a movement before it to one after it, of positions (N, D).

    The movement is where the means of short parts of the recording change. In each step most of long rests is cut off.
    """
    kept = slice(0, len(position))
    while kept.stop - kept.start >= _FEWEST:
        parts = np.array_split(position[kept], _PARTS)
        means = np.array([part.mean(axis=0) for part in parts])
        edges = kept.start + np.cumsum([0, *map(len, parts)])
        steps = np.linalg.norm(np.diff(means, axis=0), axis=-1)
        moving = np.flatnonzero(steps >= _CHANGED * steps.max())
        margin = moving[-1] - moving[0] + 2
        first, last = max(moving[0] - margin, 0), min(moving[-1] + 2 + margin, _PARTS)
        if last - first > _MOSTLY * _PARTS:
            break
        kept = slice(int(edges[first]), int(edges[last]))
    return kept


def _starts(time: Floats, position: Floats, n_via: int, free_ends: bool) -> Floats:
    """Return knots (S, K + 2) with passage times of a grid, those of least squares first."""
    grid = max(_GRID, n_via + 3)
    places = np.arange(1, grid + 1) / (grid + 1)
    chosen = list(combinations(places, n_via))
    inner = np.array([(0.0, *each, 1.0) for each in chosen])
    spans = [(0.0, 1.0), _moving_part(time, position)] if free_ends else [(0.0, 1.0)]
    knots = np.concatenate([onset + (end - onset) * inner for onset, end in spans])
    squares = np.square(_residuals(knots, time, position)).sum(axis=-1)
    return knots[np.argsort(squares, kind="stable")]


def _units(time: Floats, position: Floats) -> tuple[float, float, Floats, float]:
    """Return begin and length of a recording, [s], and centre (D,) and size of its positions, [m]."""
    centre: Floats = position.mean(axis=0)
    size = math.sqrt(np.square(position - centre).sum(axis=-1).mean())
    return time[0], time[-1] - time[0], centre, size


def _fit(time: Floats, position: Floats, n_via: int, free_ends: bool) -> _Fit:
    """Fit one movement with a number of via-points."""
    first, length, centre, size = _units(time, position)
    samples = (time - first) / length, (position - centre) / size
    kept = _around_movement(position) if free_ends else slice(0, len(time))
    if len(time) > kept.stop - kept.start:
        # The movement is looked for without the rests around it, from where all samples count.
        knots, *_ = _fit(time[kept], position[kept], n_via, free_ends)
        start = _theta(((knots - first) / length)[None], free_ends)
        theta, _ = _descend(start, *samples, free_ends, _STAGES[-1][1])
        return _result(theta[0], time, position, free_ends)
    every = max(1, len(time) // _ENOUGH)
    some = samples[0][::every], samples[1][::every]
    theta = _theta(_starts(*some, n_via, free_ends), free_ends)
    for count, steps in _STAGES:
        theta, squares = _descend(theta[:count], *(samples if count == 1 else some), free_ends, steps)
        theta = theta[np.argsort(squares, kind="stable")]
    return _result(theta[0], time, position, free_ends)


def _result(theta: Floats, time: Floats, position: Floats, free_ends: bool) -> _Fit:
    """Return the movement of parameters (P,) with the waypoints of least squares, and how well it fits."""
    first, length, centre, size = _units(time, position)
    knots = _knots(theta, free_ends)
    basis = _basis(knots[None], (time - first) / length)[0]
    scaled = (position - centre) / size
    points = np.linalg.lstsq(basis, scaled)[0]
    residual = float(np.square(basis @ points - scaled).sum())
    count = position.size
    parameters = points.size + len(knots) - 2 + 2 * free_ends
    variance = max(residual / count, _ROUNDING**2) * size**2
    r_squared = max(0.0, 1.0 - residual / len(time))
    noise = size * math.sqrt(residual / (count - parameters))
    bic = count * math.log(variance) + parameters * math.log(count)
    return first + length * knots, centre + size * points, r_squared, noise, bic


def _record(fits: list[_Fit], batch: tuple[int, ...], kind: Array) -> ViaPointFit:
    """Return the fits in one record with a leading shape, in the library and dtype of an array."""
    times, places, *numbers = zip(*fits, strict=True)
    n_via = np.array(list(map(len, times))) - 2
    # A goal that is repeated after no time is no via-point for `through`.
    last = np.arange(n_via.max() + 2)
    knots = np.stack([own[np.minimum(last, len(own) - 1)] for own in times])
    waypoints = np.stack([own[np.minimum(last, len(own) - 1)] for own in places])
    exists = np.arange(n_via.max()) < n_via[:, None]

    def shaped(values: Any) -> Array:
        array = np.asarray(values)
        return like(namespace_of(kind), array.reshape((*batch, *array.shape[1:])), kind)

    r_squared, noise, bic = map(shaped, numbers)
    return ViaPointFit(
        n_via=namespace_of(kind).asarray(n_via.reshape(batch)),
        via_points=shaped(np.where(exists[..., None], waypoints[:, 1:-1], np.nan)),
        passage_times=shaped(np.where(exists, knots[:, 1:-1], np.nan)),
        start=shaped(waypoints[:, 0]),
        goal=shaped(waypoints[:, -1]),
        onset=shaped(knots[:, 0]),
        end=shaped(knots[:, -1]),
        r_squared=r_squared,
        noise=noise,
        bic=bic,
        trajectory=through(shaped(waypoints), shaped(np.diff(knots))),
    )
