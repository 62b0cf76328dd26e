"""Trajectories: positions as piecewise polynomials of time, their scaling to limits, and derivatives of their cost.

Extrema are at roots of a derivative and at ends of segments. Their values are evaluated in the caller's array library,
with gradients that are right: the slope vanishes at an extremum (envelope theorem), or the time is a knot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ._knot_solver import States, least_cost_coefficients
from ._polynomial import (
    derivative_factors,
    differentiate,
    energy_table,
    evaluate,
    multiply,
    root_candidates,
)
from .array_api import (
    Array,
    Floats,
    Namespace,
    as_floats,
    broadcast_batch,
    broadcast_to,
    leading_shape,
    like,
    namespace_of,
    ordered_sum,
    require,
    to_numpy,
    unit_factors,
    vector_length,
    whole_orders,
)

# Size of the basis of one block of trajectories, which stays in a core's second-level cache.
_BLOCK_BYTES = 1_200_000
# Roundings besides those of the sum of durations by which a time may lie outside the movement and count as inside.
_ROUNDINGS = 4


@dataclass(frozen=True)
class Extrema:
    """Least and greatest value along each axis, with the first time of each.

    Attributes:
        minimum: (..., D) [m/s^nu].
        minimum_time: (..., D) [s].
        maximum: (..., D) [m/s^nu].
        maximum_time: (..., D) [s].

    Example:
        >>> from viapoint.primitives import point_to_point
        >>> extrema = point_to_point([0.0], [1.0], 2.0).extrema(1)  # of the velocity
        >>> extrema.maximum.round(9).tolist(), extrema.maximum_time.round(9).tolist()
        ([0.9375], [1.0])
    """

    minimum: Array
    minimum_time: Array
    maximum: Array
    maximum_time: Array


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Batch of movements x(t), 0 <= t <= duration, each a chain of S polynomials.

    Segment s runs from knot s to knot s + 1 and is sum_k c_k u^k in unit time u = (t - t_s) / h_s. A trajectory owns
    its arrays: NumPy arrays become read-only; do not write into torch tensors.

    Attributes:
        coefficients: (..., 2 order, S, D), c_k of segment s [m].
        durations: (..., S) the segments' durations h [s], which movements of a batch may share.
        order: order of the derivative whose square is least: 2 acceleration, 3 jerk, 4 snap.
        starts: (..., S) first instant of each segment [s].
        rates: (..., S) 1 / h [1/s].
        end: (..., 1) the last instant [s].

    Example:
        >>> from viapoint.primitives import point_to_point
        >>> reach = point_to_point([0.0, 0.0], [0.3, 0.4], 0.8)
        >>> reach
        Trajectory(batch (), 1 segments, dimension 2, order 3)
        >>> position, velocity, acceleration = reach.sample(200)
        >>> position.shape, round(float(reach.peak(1)), 6)  # peak speed 1.875 A / T
        ((200, 2), 1.171875)
    """

    coefficients: Array
    durations: Array
    order: int
    starts: Array
    rates: Array
    end: Array

    def __post_init__(self) -> None:
        if isinstance(self.coefficients, np.ndarray):
            for array in (self.coefficients, self.durations, self.starts, self.rates, self.end):
                array.setflags(write=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the constructor call for copy and pickle, so that copies are read-only too."""
        return type(self), tuple(getattr(self, field.name) for field in fields(self))

    @property
    def namespace(self) -> Namespace:
        """Array API functions of the arrays."""
        return namespace_of(self.coefficients)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading shape `...`."""
        return tuple(self.coefficients.shape[:-3])

    @property
    def dimension(self) -> int:
        """Dimension of space, D."""
        return int(self.coefficients.shape[-1])

    @property
    def duration(self) -> Array:
        """Total duration, (...,) [s]."""
        return broadcast_to(self.namespace, self.end[..., 0], self.batch_shape)

    @property
    def knots(self) -> Array:
        """Times at start, via-points and goal, (..., S + 1) [s]."""
        xp = self.namespace
        inner = xp.cumulative_sum(self.durations[..., :-1], axis=-1)
        knots = xp.concat([0.0 * self.end, inner, self.end], axis=-1)
        return broadcast_to(xp, knots, (*self.batch_shape, knots.shape[-1]))

    def __repr__(self) -> str:
        shape = f"batch {self.batch_shape}, {self.durations.shape[-1]} segments, dimension {self.dimension}"
        return f"Trajectory({shape}, order {self.order})"

    def __call__(self, time: Array, nu: int = 0) -> Array:
        """Return the nu-th time derivative, (..., T, D) [m/s^nu].

        Args:
            time: (T,) for all trajectories or (..., T) for each [s]; a single number gives (..., D). Before 0
                and after the duration, but for rounding, the end point is held at rest. A knot belongs to the segment
                that begins there.
            nu: order of the derivative, at least 0 (from 2 order on it is zero).
        """
        if isinstance(time, int | float):
            return self.sample([time], (nu,))[0][..., 0, :]
        if getattr(time, "ndim", 1) == 0:
            return self.sample(time.reshape(1), (nu,))[0][..., 0, :]
        return self.sample(time, (nu,))[0]

    def sample(self, time: Array | int, nu: int | Sequence[int] = (0, 1, 2)) -> tuple[Array, ...]:
        """Return several time derivatives at once, one array (..., T, D) per order [m/s^nu].

        Args:
            time: as in a call; or a whole number of at least 2, the number of evenly spaced times from 0 to
                the duration of each trajectory, both included.
            nu: orders of derivative; one number counts as a sequence of one.
        """
        xp = self.namespace
        time, inside = self._times(time, xp)
        orders = whole_orders(nu)
        if time.ndim > 1:
            broadcast_batch(trajectory=self.batch_shape, time=tuple(time.shape[:-1]))
        values = _evaluate(self.coefficients, self.starts, self.rates, time, orders, xp)
        if inside is None:
            return tuple(values)
        moving = xp.astype(inside, self.coefficients.dtype)[..., None]
        return tuple(v * moving if order else v for order, v in zip(orders, values, strict=True))

    def _times(self, time: Array | int, xp: Namespace) -> tuple[Array, Array | None]:
        """Return times (..., T) clipped to the movement, and True where they were inside (None: all)."""
        end = self.end
        if isinstance(time, int | np.integer):
            if time < 2:
                raise ValueError(f"time as a number of samples must be at least 2, got {time}")
            count = xp.arange(int(time), dtype=end.dtype, device=getattr(end, "device", None))
            return end * (count / (int(time) - 1)), None
        (time,) = self.floats(time=time)
        if time.ndim < 1:
            raise ValueError(f"time must have shape (T,) or (..., T), got shape {tuple(time.shape)}")
        inside = (time >= 0) & (time <= end)
        if inside.all():
            return time, None
        # The end is a sum of durations, so a total that was asked for may lie some roundings after it.
        slack = (_ROUNDINGS + self.durations.shape[-1]) * float(xp.finfo(end.dtype).eps) * end
        inside = (time >= -slack) & (time <= end + slack)
        return xp.minimum(xp.maximum(time, xp.zeros_like(time)), end), inside

    def floats(
        self, optional: Mapping[str, Any] | None = None, /, *, widest: bool = False, **required: Any
    ) -> list[Any]:
        """Convert arguments to arrays of the trajectory's library, required ones first (see as_floats).

        Their dtype is the trajectory's, or with `widest` the widest of all.
        """
        optional, coefficients = optional or {}, self.coefficients
        reference = {"coefficients": coefficients[..., 0, 0, 0]}
        xp, (*arrays, _) = as_floats({**optional, **reference}, **required)
        if (xp is np) != isinstance(coefficients, np.ndarray):
            given = [*required, *(name for name, value in optional.items() if value is not None)]
            raise ValueError(f"{', '.join(given)} must be of the trajectory's own kind, not of {xp.__name__}")
        if not widest:
            for i, array in enumerate(arrays):
                if array is not None and array.dtype != coefficients.dtype:
                    arrays[i] = xp.astype(array, coefficients.dtype)
        return arrays

    def cost(self) -> Array:
        """Return (...,) the cost 1/2 integral of |x^(order)|^2 [m^2 / s^(2 order - 1)], in closed form."""
        return 0.5 * self.energy(self.order)

    def energy(self, nu: int) -> Array:
        """Return (...,) the integral of |x^(nu)|^2 [m^2 / s^(2 nu - 1)], nu < 2 order, in closed form."""
        (nu,) = whole_orders((nu,))
        if nu >= 2 * self.order:
            raise ValueError(f"nu must lie in 0 ... {2 * self.order - 1}, got {nu}")
        xp = self.namespace
        upper = self.coefficients[..., nu:, :, :]
        flat = xp.reshape(upper, (*upper.shape[:-2], upper.shape[-2] * upper.shape[-1]))
        modes = xp.reshape(xp.matmul(like(xp, energy_table(self.order, nu), flat), flat), upper.shape)
        scale = self.durations if nu == 0 else math.prod([self.rates] * (2 * nu - 1))
        return xp.sum(xp.sum(xp.sum(modes * modes, axis=-1), axis=-2) * scale, axis=-1)

    def extrema(self, nu: int = 0) -> Extrema:
        """Return the least and greatest nu-th derivative per axis, with their times; at a jump, both sides count."""
        coefficients = self._finite_derivative(nu)
        polynomials = unit_polynomials(coefficients)
        u = _with_ends(root_candidates(differentiate(polynomials)))
        values = evaluate(polynomials[..., None, :], u)
        return Extrema(*self._at_best(coefficients, u, -values), *self._at_best(coefficients, u, values))

    def peak(self, nu: int = 0) -> Array:
        """Return (...,) the largest Euclidean norm of the nu-th derivative [m/s^nu]; ValueError if it overflows."""
        coefficients = self._finite_derivative(nu)
        polynomials = unit_polynomials(coefficients)
        square = ordered_sum(multiply(polynomials, polynomials), -2)
        u = _with_ends(root_candidates(differentiate(square)))
        score = evaluate(square[..., None, :], u)
        values, _ = self._at_best(coefficients, u[..., None, :], score[..., None, :])
        return vector_length(self.namespace, values)

    def _finite_derivative(self, nu: int) -> Array:
        """Return the coefficients of the nu-th derivative, or raise ValueError if it overflows."""
        xp, (nu,) = self.namespace, whole_orders((nu,))
        with np.errstate(all="ignore"):
            coefficients = derivative_coefficients(xp, self.coefficients, self.rates, nu)
        if not xp.isfinite(coefficients).all():
            durations = to_numpy(self.durations)
            shortest = durations[durations > 0].min()
            raise ValueError(
                f"derivative {nu} of the trajectory overflows {self.coefficients.dtype}: its shortest segment "
                f"lasts {shortest:g} s"
            )
        return coefficients

    def _at_best(self, coefficients: Array, u: Floats, score: Floats) -> tuple[Array, Array]:
        """Return the values (..., D) of polynomials at the best of candidates u, the earliest of equals, and the times.

        Candidates and scores are (..., S, D, P), for each axis its own; or (..., S, 1, P), one for all axes.
        """
        xp, (powers, segments, _) = self.namespace, coefficients.shape[-3:]
        durations = to_numpy(self.durations)[..., None, None]
        times = to_numpy(self.starts)[..., None, None] + u * durations
        score = np.where(durations > 0, score, -np.inf)
        places = np.swapaxes(np.stack([u, times, score]), -3, -2)  # (3, ..., D, S, P)
        places = places.reshape(*places.shape[:-2], segments * u.shape[-1])
        best = np.argmax(places[2], axis=-1)
        u, time, _ = np.take_along_axis(places, best[None, ..., None], axis=-1)[..., 0]
        segment = best // score.shape[-1]
        chosen = segment[..., None, None, :] == np.arange(segments)[:, None]  # (..., 1, S, D or 1)
        basis = chosen * u[..., None, None, :] ** np.arange(powers)[:, None, None]
        values = xp.sum(xp.sum(like(xp, basis, coefficients) * coefficients, axis=-2), axis=-2)
        time = np.minimum(time, to_numpy(self.end))  # no rounding past the end
        return values, like(xp, time, coefficients)

    def stretched(self, duration: Array) -> Trajectory:
        """Return the movement along the same path with time scaled to a new duration (...,) [s], 0 where none moves."""
        xp = self.namespace
        (duration,) = self.floats(duration=duration)
        batch = broadcast_batch(trajectory=self.batch_shape, duration=tuple(duration.shape))
        if not (duration > 0).all():
            moves = (self.coefficients[..., 1:, :, :] != 0).any(-1).any(-1).any(-1)
            allowed = (duration > 0) | ((duration == 0) & ~moves)
            require(allowed, "duration", broadcast_to(xp, duration, batch), "must be positive")
        end = duration[..., None] + 0.0 * self.end  # the leading shape of the durations
        factor = end / xp.where(self.end > 0, self.end, 1.0)
        with np.errstate(all="ignore"):
            runs = (self.rates > 0) & (factor > 0)
            rates = xp.where(runs, self.rates / xp.where(factor > 0, factor, 1.0), 0.0 * factor)
        coefficients = broadcast_to(xp, self.coefficients, (*batch, *self.coefficients.shape[-3:]))
        return Trajectory(coefficients, self.durations * factor, self.order, self.starts * factor, rates, end)

    def transformed(
        self, rotation: Array | None = None, translation: Array | None = None, scale: Array | None = None
    ) -> Trajectory:
        """Return the movement scale * rotation @ x(t) + translation.

        Args:
            rotation: (..., D', D) matrix (any linear map), default the identity.
            translation: (..., D') [m], default zero.
            scale: (...,) factor, default one.
        """
        named = {"rotation": rotation, "translation": translation, "scale": scale}
        rotation, translation, scale = self.floats(named)
        xp, moved = self.namespace, self.coefficients
        shapes = {"trajectory": self.batch_shape}
        if rotation is not None:
            shapes["rotation"] = leading_shape("rotation", rotation, None, self.dimension)
            broadcast_batch(**shapes)
            moved = xp.matmul(moved, rotation[..., None, :, :].mT)
        if scale is not None:
            shapes["scale"] = tuple(scale.shape)
            broadcast_batch(**shapes)
            moved = moved * scale[..., None, None, None]
        if translation is not None:
            shapes["translation"] = leading_shape("translation", translation, moved.shape[-1])
            moved = broadcast_to(xp, moved, (*broadcast_batch(**shapes), *moved.shape[-3:]))
            first = moved[..., :1, :, :] + translation[..., None, None, :]
            moved = xp.concat([first, moved[..., 1:, :, :]], axis=-3)
        return Trajectory(moved, self.durations, self.order, self.starts, self.rates, self.end)


def unit_polynomials(coefficients: Array) -> Floats:
    """Return coefficients (..., n, S, D) as (..., S, D, n) NumPy float64, of a size of about 1."""
    numbers = np.moveaxis(to_numpy(coefficients).astype(np.float64), -3, -1)
    return np.ascontiguousarray(numbers * unit_factors(np, numbers, (-3, -2, -1)))


def _with_ends(u: Floats) -> Floats:
    """Return the points with 0 before and 1 after them."""
    edge = np.zeros((*u.shape[:-1], 1))
    return np.concatenate([edge, u, edge + 1.0], axis=-1)


def require_trajectory(value: object) -> None:
    """Raise ValueError unless the value is a Trajectory."""
    if not isinstance(value, Trajectory):
        hint = "; give its attribute `trajectory`" if hasattr(value, "trajectory") else ""
        name = type(value).__name__
        raise ValueError(f"trajectory must be a viapoint.primitives.Trajectory, got {name}{hint}")


def minimum_duration(
    trajectory: Trajectory,
    *,
    velocity: Array | None = None,
    acceleration: Array | None = None,
    jerk: Array | None = None,
) -> Array:
    """Return the shortest duration to which the movement can be scaled within the limits.

    Scaling time by a factor s divides the nu-th derivative by s^nu and keeps the path, so
    s = max_nu (peak_nu / limit_nu)^(1 / nu), with the exact extrema of the trajectory.

    Args:
        trajectory: the movement, of any duration.
        velocity: limit [m/s]: a number or an array (..., 1) limits the Euclidean norm, an array (..., D) each
            axis.
        acceleration: limit [m/s^2], likewise.
        jerk: limit [m/s^3], likewise.

    Returns:
        (...,) [s]; 0 where nothing moves.

    Example:
        >>> from viapoint.primitives import minimum_duration, point_to_point
        >>> reach = point_to_point([0.0], [0.4], 1.0)
        >>> fastest = reach.stretched(minimum_duration(reach, velocity=1.5))
        >>> round(float(fastest.duration), 9), round(float(fastest.peak(1)), 9)
        (0.5, 1.5)
    """
    require_trajectory(trajectory)
    named = {"velocity": velocity, "acceleration": acceleration, "jerk": jerk}
    if all(limit is None for limit in named.values()):
        raise ValueError("give at least one limit: velocity, acceleration or jerk")
    xp, limits = trajectory.namespace, trajectory.floats(named, widest=True)
    factor = 0.0 * trajectory.duration
    for nu, (name, limit) in enumerate(zip(named, limits, strict=True), start=1):
        if limit is None:
            continue
        require(limit > 0, name, limit, "must be positive")
        if limit.ndim and limit.shape[-1] not in (1, trajectory.dimension):
            allowed = f"a number, (..., 1) or (..., {trajectory.dimension})"
            raise ValueError(f"{name} must be {allowed}, got shape {tuple(limit.shape)}")
        broadcast_batch(trajectory=trajectory.batch_shape, **{name: tuple(limit.shape[:-1])})
        if limit.ndim == 0 or limit.shape[-1] == 1:
            excess = trajectory.peak(nu) / xp.reshape(limit, limit.shape[:-1])
        else:
            extrema = trajectory.extrema(nu)
            excess = xp.max(xp.maximum(-extrema.minimum, extrema.maximum) / limit, axis=-1)
        # The slope of a root is infinite at 0, and torch would multiply it by 0: take the root of positive ratios only.
        moves = excess > 0
        root = xp.where(moves, excess, 1.0) ** (1.0 / nu)
        factor = xp.maximum(factor, xp.where(moves, root, 0.0))
    return factor * trajectory.duration


@dataclass(frozen=True)
class CostGradient:
    """Derivatives of Trajectory.cost() with respect to waypoints, durations and boundary values.

    Attributes:
        waypoints: (..., S + 1, D) with respect to start, via-points and goal. At a via-point it is minus
            Flash & Hogan's multiplier pi. A dropped via-point and its neighbour share the derivative of the
            point they have in common.
        durations: (..., S) with respect to each segment's duration; equal for all segments at free passage
            times, and then also the derivative with respect to the total duration (-5 cost / duration from
            rest to rest, order 3).
        start_velocity, goal_velocity: (..., D) with respect to the boundary velocities; zero where FREE.
        start_acceleration, goal_acceleration: (..., D) likewise (zero for order 2).

    Example:
        >>> from viapoint.primitives import cost_gradient, point_to_point
        >>> gradient = cost_gradient(point_to_point([0.0], [1.0], 1.0))
        >>> gradient.waypoints.tolist(), gradient.durations.tolist()  # the cost is 360 A^2 / T^5
        ([[-720.0], [720.0]], [-1800.0])
    """

    waypoints: Array
    durations: Array
    start_velocity: Array
    goal_velocity: Array
    start_acceleration: Array
    goal_acceleration: Array


def cost_gradient(trajectory: Trajectory) -> CostGradient:
    """Return all derivatives of the least cost.

    For order m, dJ/dx^(i)(T) = (-1)^(m-1-i) x^(2m-1-i)(T) at the goal, the opposite at the start, and at a
    via-point the jump of (-1)^(m-1) x^(2m-1), left minus right. By the envelope theorem they hold for the
    optimum over everything that was left open: the states at the via-points, and the passage times if the
    segment durations came from `passage_durations`.

    Raises:
        ValueError: the argument is not a Trajectory.

    Example:
        >>> from viapoint.primitives import cost_gradient, through
        >>> movement = through([[0.0, 0.0], [0.5, 0.2], [1.0, 0.0]], [0.5, 0.5])
        >>> cost_gradient(movement).waypoints[1].round(6).tolist()  # -pi: only across the line
        [0.0, 4096.0]
    """
    require_trajectory(trajectory)
    xp, m = trajectory.namespace, trajectory.order
    coefficients = trajectory.coefficients
    rates = trajectory.rates
    highest = derivative_coefficients(xp, coefficients, rates, 2 * m - 1)[..., 0, :, :] * (-1.0) ** (m - 1)
    rows = [-highest[..., :1, :], highest[..., :-1, :] - highest[..., 1:, :], highest[..., -1:, :]]
    ends = []
    for i in (1, 2):
        if i >= m:
            ends += [0.0 * highest[..., 0, :]] * 2
            continue
        sign = (-1.0) ** (m - 1 - i)
        derivative = derivative_coefficients(xp, coefficients, rates, 2 * m - 1 - i)
        ends.append(-sign * derivative[..., 0, 0, :])  # at the beginning of the first segment, u = 0
        ends.append(sign * derivative[..., -1, :].sum(-2))  # at the end of the last one, u = 1
    return CostGradient(xp.concat(rows, axis=-2), duration_gradient(coefficients, rates), *ends)


def duration_gradient(coefficients: Array, rates: Array) -> Array:
    """Return dJ/dh of each segment, (..., S), minus its Hamiltonian (Flash & Hogan 1985, Eqs. C6, C7).

    For order m, dJ/dh = -1/2 |x^(m)|^2 - sum_{i=1}^{m-1} (-1)^i x^(m+i) . x^(m-i), constant along a segment; for jerk
    it is -|jerk|^2/2 + snap . acceleration - crackle . velocity. Coefficients are (..., 2m, S, D) in unit time.
    """
    order = coefficients.shape[-3] // 2
    total: Any = 0.0
    for i in range(order):  # at the beginning of the segment, where x^(k) = k! c_k / h^k
        weight = (0.5 if i == 0 else (-1.0) ** i) * math.factorial(order + i) * math.factorial(order - i)
        product = coefficients[..., order + i, :, :] * coefficients[..., order - i, :, :]
        total = total + weight * product.sum(-1)
    return -total * math.prod([rates * rates] * order)


def connect(xp: Namespace, order: int, waypoints: Array, durations: Array, states: States) -> Trajectory:
    """Return the least-cost trajectory through all waypoints at fixed times, see `least_cost_coefficients`."""
    durations = 1.0 * durations  # a copy of its own
    empty = durations <= 0
    some_empty = bool(empty.any())
    if some_empty:
        durations = broadcast_to(xp, durations, (*waypoints.shape[:-2], durations.shape[-1]))
    coefficients = least_cost_coefficients(xp, order, waypoints, durations, states)
    ends = xp.cumulative_sum(durations, axis=-1)
    end = ends[..., -1:]
    starts = xp.concat([0.0 * end, ends[..., :-1]], axis=-1)
    if not some_empty:
        return Trajectory(coefficients, durations, order, starts, 1.0 / durations, end)
    # An empty segment at the end must not become current at the last instant: start it later.
    starts = xp.where(starts >= end, 2 * end, starts)
    rates = xp.where(empty, 0.0, 1.0 / xp.where(empty, 1.0, durations))
    return Trajectory(coefficients, durations, order, starts, rates, end)


def derivative_coefficients(xp: Namespace, coefficients: Array, rates: Array, nu: int) -> Array:
    """Return the coefficients (..., 2m - nu, S, D) of the nu-th derivative in seconds, in unit time.

    Beyond the degree it is the constant zero, (..., 1, S, D).
    """
    if nu == 0:
        return coefficients
    if nu >= coefficients.shape[-3]:
        return 0.0 * coefficients[..., :1, :, :]
    table = derivative_factors(coefficients.shape[-3] // 2, nu)
    scale: Array = math.prod([rates] * (nu - 1), start=rates)
    factors = like(xp, table, coefficients) * scale[..., None, :]
    return coefficients[..., nu:, :, :] * factors[..., None]


def _evaluate(
    coefficients: Array, starts: Array, rates: Array, time: Array, orders: Sequence[int], xp: Namespace
) -> list[Array]:
    """Return derivatives of some orders, each (..., T, D), at times (..., T).

    All segments go into one small matrix product per trajectory, with the same inner sizes alone and in a batch, so
    that an item of a batch gives the same bits as alone:

        x^(nu)(t) = sum_(k, s) B_(k, s)(t) c^(nu)_(k, s),   B_(k, s)(t) = u_s^k if segment s is current, else 0.
    """
    powers, segments, dimension = coefficients.shape[-3:]
    batch = coefficients.shape[:-3]
    if xp is np and len(batch) == 1 and time.ndim < 3:
        size = max(1, _BLOCK_BYTES // max(1, powers * segments * time.shape[-1] * coefficients.itemsize))
        if size < batch[0] and batch in (starts.shape[:-1], time.shape[:-1]):
            whole = [np.empty((*batch, time.shape[-1], dimension), coefficients.dtype) for _ in orders]
            for first in range(0, batch[0], size):
                rows = slice(first, first + size)
                own = [each[rows] if each.shape[:-1] == batch else each for each in (starts, rates, time)]
                parts = _evaluate(coefficients[rows], own[0], own[1], own[2], orders, xp)
                for values, part in zip(whole, parts, strict=True):
                    values[rows] = part
            return whole
    basis = _basis(time, starts, rates, powers - min(orders), xp)
    results = []
    for nu in orders:
        weight = derivative_coefficients(xp, coefficients, rates, nu)
        weight = weight.reshape(*weight.shape[:-3], weight.shape[-3] * segments, dimension)
        results.append(xp.matmul(basis[..., : weight.shape[-2], :].mT, weight))
    return results


def _basis(time: Array, starts: Array, rates: Array, number: int, xp: Namespace) -> Array:
    """Return the transposed basis of `_evaluate`: rows k S + s of u_s^k, k < number, where segment s is current."""
    local = (time[..., None, :] - starts[..., None]) * rates[..., None]
    current = xp.ones_like(local)
    if starts.shape[-1] > 1:  # start_s <= time < start_(s+1); the last segment has no end
        reached = time[..., None, :] >= starts[..., 1:, None]
        edge = xp.ones_like(reached[..., :1, :])
        reached = xp.concat([edge, reached, ~edge], axis=-2)
        current = xp.astype(reached[..., :-1, :] & ~reached[..., 1:, :], starts.dtype)
        local = local * current
    rows = [current, local]
    while len(rows) < number:
        rows.append(rows[-1] * local)
    return xp.concat(rows, axis=-2)
