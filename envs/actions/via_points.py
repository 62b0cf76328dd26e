"""Action layout: decoding of actions into via-points and durations, and encoding."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from viapoint import primitives
from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import check_increasing_pair, finite_array, whole_number
from viapoint.primitives.array_api import Array, Namespace, namespace_of

Timing = Literal["optimal", "learned"]

AXES = ("along", "across", "above")
"""Names of the axes of the frame of start and goal, see :func:`frame`."""
LOG_SPLIT = float(np.log(4.0))
"""Log ratio of neighbouring segments' durations for an action of 1: a factor of four."""
SHORTEST_DURATION, LONGEST_DURATION = 0.05, 60.0
"""Bounds of the duration range, [s]."""
MOST_VIAS = 16
"""Greatest number of via-points of an action; more add no new movements in practice."""


class Plan(NamedTuple):
    """Movement as via-points and durations, or a batch of movements.

    Example:
        >>> from viapoint.envs import Plan
        >>> plan = Plan([[-0.2, 0.3], [0.0, 0.45], [0.2, 0.3]], [0.5, 0.5])  # m and s
        >>> trajectory = plan.trajectory()
        >>> trajectory(0.5).round(3).tolist()  # position of the hand at 0.5 s
        [0.0, 0.45]
    """

    waypoints: Array
    """Start, via-points and goal, shape (..., K + 2, D), [m]."""
    durations: Array
    """Durations of the segments, shape (..., K + 1), [s]."""

    def take(self, rows: Any) -> Plan:
        """Return the movements at `rows`, an index, slice or mask of the batch."""
        return Plan(self.waypoints[rows], self.durations[rows])

    def trajectory(self) -> primitives.Trajectory:
        """Return the minimum-jerk movement through the waypoints."""
        return primitives.through(self.waypoints, self.durations)


class Motion(NamedTuple):
    """State of N references, shape (N, ..., D) each."""

    position: Float
    """Position, [m]."""
    velocity: Float
    """Velocity, [m/s]."""
    acceleration: Float
    """Acceleration, [m/s^2]."""

    @classmethod
    def at_rest(cls, position: Float) -> Motion:
        """Return references that rest at `position`, shape (N, D), [m]."""
        return cls(position.copy(), np.zeros_like(position), np.zeros_like(position))


@dataclass(frozen=True, kw_only=True)
class ActionLayout:
    """Layout of actions: the meaning of each component.

    An action is a vector in [-1, 1]^m: for each of K via-points its offset from the k-th of K evenly spaced points of
    the straight line, in the frame of start and goal; then the duration; then, with `timing="learned"`, how it is
    split between the segments. The zero action is the straight minimum-jerk movement.
    """

    dimension: int = 2
    """Spatial dimension D."""
    n_via: int = 1
    """Number of via-points K, 0 to :data:`MOST_VIAS`."""
    timing: Timing = "optimal"
    """`optimal`: passage times of least jerk (Flash & Hogan 1985, Eq. C16); `learned`: part of the action."""
    duration_range: tuple[float, float] = (0.6, 1.2)
    """Shortest and longest total duration, [s]; an action of 0 is their geometric mean."""
    via_scale: tuple[float, ...] = (0.15, 0.25, 0.25)
    """Largest offset along, across and above the straight line, [m]."""

    def __post_init__(self) -> None:
        """Check all fields."""
        if self.dimension not in (2, 3):
            raise ValueError(f"dimension must be 2 or 3, got {self.dimension!r}")
        whole_number("n_via", self.n_via, 0, MOST_VIAS)
        if self.timing not in get_args(Timing):
            raise ValueError(f"timing must be one of {', '.join(get_args(Timing))}, got {self.timing!r}")
        check_increasing_pair("duration_range", self.duration_range, SHORTEST_DURATION, LONGEST_DURATION)
        scale = finite_array("via_scale", self.via_scale, (None,))
        if len(scale) < self.dimension or (scale <= 0.0).any():
            raise ValueError(f"via_scale must be {self.dimension} positive numbers, got {self.via_scale!r}")
        low, high = self.duration_range
        object.__setattr__(self, "duration_range", (float(low), float(high)))

    @functools.cached_property
    def size(self) -> int:
        """Number of components m."""
        return len(self.names)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the components, in order."""
        vias = [f"via_{k}_{axis}" for k in range(1, self.n_via + 1) for axis in AXES[: self.dimension]]
        splits = [f"split_{k}" for k in range(1, self.n_via + 1)] if self.timing == "learned" else []
        return (*vias, "duration", *splits)

    @functools.cached_property
    def units(self) -> tuple[str, ...]:
        """Value of an action of 1 in each component."""
        scale = [f"{s:g} m" for s in self.via_scale[: self.dimension]] * self.n_via
        low, high = self.duration_range
        splits = ["factor 4 between the segments before and after"] * (
            self.n_via if self.timing == "learned" else 0
        )
        return (*scale, f"factor {(high / low) ** 0.5:.4g} on {self.centre_duration:.4g} s", *splits)

    @functools.cached_property
    def centre_duration(self) -> float:
        """Duration of the zero action, [s]."""
        low, high = self.duration_range
        return float((low * high) ** 0.5)

    @functools.cached_property
    def _straight_split(self) -> tuple[float, ...]:
        """Log ratios of neighbouring segments' durations on the straight movement with evenly spaced vias."""
        waypoints = np.linspace(0.0, 1.0, self.n_via + 2)[:, None]
        durations = primitives.passage_durations(waypoints, np.asarray(1.0))
        return tuple(float(r) for r in np.diff(np.log(durations)))

    def decode(self, action: Array, start: Array, goal: Array) -> Plan:
        """Return the movement of an action.

        Args:
            action: Shape (..., m), in [-1, 1].
            start: Shape (..., D), [m].
            goal: Shape (..., D), [m], apart from the start.

        Raises:
            ValueError: One of them has another shape.
        """
        action, start, goal = _arrays(action, start, goal)
        # Shapes alone are checked, not values: exported graphs of tensors have none.
        batch = action.shape[:-1]
        _check_shape("action", action, (*batch, self.size))
        _check_shape("start", start, (*batch, self.dimension))
        _check_shape("goal", goal, (*batch, self.dimension))
        xp = np if isinstance(action, np.ndarray) else namespace_of(action)  # mostly NumPy: without a call
        line = goal - start
        axes = frame(line, xp)
        ends = self.n_via * self.dimension
        waypoints = [start]
        for k in range(self.n_via):
            via = start + line * ((k + 1) / (self.n_via + 1))
            for i, axis in enumerate(axes):
                component = k * self.dimension + i
                via = via + axis * (action[..., component : component + 1] * self.via_scale[i])
            waypoints.append(via)
        waypoints.append(goal)
        duration = self.centre_duration * xp.exp(action[..., ends] * self._log_half_range)
        points = xp.stack(waypoints, axis=-2)
        return Plan(points, self._durations(points, duration, action[..., ends + 1 :]))

    def encode(self, plan: Plan) -> Array:
        """Return the action of a movement, the inverse of :meth:`decode`.

        Components outside [-1, 1] say that the movement lies outside the action space.

        Raises:
            ValueError: The movement has another dimension or another number of via-points.
        """
        waypoints, durations = _arrays(*plan)
        batch = waypoints.shape[:-2]
        _check_shape("waypoints", waypoints, (*batch, self.n_via + 2, self.dimension))
        _check_shape("durations", durations, (*batch, self.n_via + 1))
        xp = namespace_of(waypoints)
        start, goal = waypoints[..., 0, :], waypoints[..., -1, :]
        line = goal - start
        components = []
        for k in range(self.n_via):
            offset = waypoints[..., k + 1, :] - (start + line * ((k + 1) / (self.n_via + 1)))
            components += [
                xp.sum(offset * a, axis=-1) / s for a, s in zip(frame(line), self.via_scale, strict=False)
            ]
        total = xp.sum(durations, axis=-1)
        components.append(xp.log(total / self.centre_duration) / self._log_half_range)
        if self.timing == "learned":
            ratios = xp.log(durations[..., 1:] / durations[..., :-1])
            components += [(ratios[..., k] - r) / LOG_SPLIT for k, r in enumerate(self._straight_split)]
        return xp.stack(components, axis=-1)

    @functools.cached_property
    def _log_half_range(self) -> float:
        low, high = self.duration_range
        return float(np.log(high / low) / 2.0)

    def _durations(self, waypoints: Array, duration: Array, split: Array) -> Array:
        if self.timing == "optimal":
            return primitives.passage_durations(waypoints, duration)
        xp = namespace_of(waypoints)
        logs = [xp.zeros_like(duration)]
        for k, ratio in enumerate(self._straight_split):
            logs.append(logs[-1] + ratio + LOG_SPLIT * split[..., k])
        shares = xp.exp(xp.stack(logs, axis=-1))
        return duration[..., None] * shares / xp.sum(shares, axis=-1, keepdims=True)


def frame(line: Array, xp: Namespace = None) -> list[Array]:
    """Return unit vectors along a line, across it (to its left, horizontal) and above it, each of shape (..., D).

    A vertical line in space has no left; the x axis replaces it. `xp` is the namespace of `line`, if it is known.
    """
    xp = xp or namespace_of(line)
    along = line / xp.sqrt(xp.sum(line * line, axis=-1, keepdims=True))
    x, y = along[..., 0], along[..., 1]
    if line.shape[-1] == 2:
        return [along, xp.stack((-y, x), axis=-1)]
    level = xp.sqrt(x * x + y * y)
    vertical = level < 1e-9
    safe = xp.where(vertical, xp.ones_like(level), level)
    zero = xp.zeros_like(level)
    left_x = xp.where(vertical, xp.ones_like(level), -y / safe)
    left_y = xp.where(vertical, zero, x / safe)
    across = xp.stack((left_x, left_y, zero), axis=-1)
    z = along[..., 2]
    above = xp.stack((-z * left_y, z * left_x, x * left_y - y * left_x), axis=-1)
    return [along, across, above]


def _arrays(*values: Array) -> tuple[Array, ...]:
    """Return arrays and tensors unchanged and anything else as arrays of numbers."""
    for value in values:
        if not hasattr(value, "shape"):
            break
    else:
        return values
    try:
        return tuple(v if hasattr(v, "shape") else np.asarray(v, dtype=np.float64) for v in values)
    except (TypeError, ValueError):
        raise ValueError(f"actions, places and durations must be arrays of numbers, got {values!r}") from None


def _check_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    """Check the shape of an array or a tensor."""
    if tuple(array.shape) != tuple(shape):
        raise ValueError(f"{name} must have shape {tuple(shape)}, got {tuple(array.shape)}")


MAX_START_OFFSET = 1e-3
"""Greatest distance of a plan's beginning from the hand, [m]."""


def checked_plan(plan: Plan, start: Float) -> Plan:
    """Return a plan as arrays, after a check that it begins at the hands, shape (N, D), [m]."""
    number, dimension = start.shape
    waypoints = finite_array("waypoints of the plan", plan[0], (number, None, dimension))
    durations = finite_array("durations of the plan", plan[1], (number, waypoints.shape[1] - 1))
    away = np.sqrt(((waypoints[:, 0] - start) ** 2).sum(axis=-1))
    if (away > MAX_START_OFFSET).any():
        env = int(away.argmax())
        raise ValueError(
            f"plan {env} must begin where the hand is, at {start[env]} m, got {waypoints[env, 0]} m"
        )
    return Plan(waypoints, durations)
