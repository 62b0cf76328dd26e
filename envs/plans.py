"""Plans: movements as via-points and durations, and actions that stand for them or steer the arm.

Replanning: plans begin at the present command, without a jump of position, velocity or acceleration. An action changes
the *nominal* plan: the rest of the plan under way while its goal is the present one, else the smoothest movement to the
new goal. By the principle of optimality the rest of a minimum-jerk movement, made again through its own via-points, is
itself, so a zero action changes nothing.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs.common.arrays import Bool, Float, norm, put, take
from viapoint.envs.common.validation import finite_array
from viapoint.envs.geometry.compiled import compiled

if TYPE_CHECKING:
    from viapoint.envs.arms.arm import Arm

Timing = Literal["optimal", "learned"]
SpaceName = Literal["hand", "joints"]

LOG_SPLIT = float(np.log(4.0))  # Log ratio of neighbouring durations for an action of 1: a factor of four
MOST_VIAS = 32  # Greatest number of via-points; movements through narrow passages may need some twenty
# Bounds of the duration range, [s] in hand space, factors in joint space
SHORTEST_DURATION, LONGEST_DURATION = 0.05, 60.0
NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)  # Nodes and weights of Gauss-Legendre quadrature
HAND_OFFSETS = (0.15, 0.25)  # Largest offsets of via-points along and across the line of the hand, [m]
# Largest offset of a joint at a via-point: a share of its range, and a bound, [rad]
RANGE_SHARE, LARGEST_OFFSET = 0.35, 1.0
UNLIMITED_SPEED = 4.0  # Speed that counts as the limit of joints without one in durations of actions, [rad/s]
MAX_START_OFFSET = 1e-3  # Greatest distance of a plan's beginning from the present reference, [m] or [rad]
QUADRATURE = 12  # Gauss-Legendre nodes for the jerk cost of a control step
PEAK_INSTANTS = 64  # Instants at which the joint rates of a movement are looked at
# Jerk with which a plan follows a goal that moves a little, [m/s^3] or [rad/s^3]: 60 distance / time^3
CORRECTION_JERK = 10.0
# Distance of a new goal from the old one below which the plan changes in proportion, [m] or [rad]
NEARBY = {"hand": 0.02, "joints": 0.05}


class Plan(NamedTuple):
    """Movement as via-points and durations, or a batch of movements.

    Coordinates are those of the space in which the movement is planned: of the hand [m], or of the joints [rad].

    Example:
        >>> from viapoint.envs.plans import Plan
        >>> plan = Plan([[-0.2, 0.3], [0.0, 0.45], [0.2, 0.3]], [0.5, 0.5])  # m and s
        >>> trajectory = plan.trajectory()
        >>> trajectory(0.5).round(3).tolist()  # position of the hand at 0.5 s
        [0.0, 0.45]
    """

    waypoints: Any
    """Start, via-points and goal, shape (..., K + 2, D)."""
    durations: Any
    """Durations of the segments, shape (..., K + 1), [s]."""
    velocity: Any = None
    """Initial velocity, shape (..., D); None for rest."""
    acceleration: Any = None
    """Initial acceleration, shape (..., D); None for rest."""

    @classmethod
    def at_rest(cls, waypoints: Float, durations: Float) -> Plan:
        """Return a batch of plans that begin at rest, with arrays for all parts."""
        start = waypoints[..., 0, :]
        return cls(waypoints, durations, np.zeros_like(start), np.zeros_like(start))

    @property
    def duration(self) -> Float:
        """Total duration, shape (...), [s]."""
        return np.asarray(np.sum(self.durations, axis=-1))

    def take(self, rows: Any) -> Plan:
        """Return the movements at `rows`, an index, slice or mask of the batch."""
        return Plan(*[part if part is None else part[rows] for part in self])

    def trajectory(self) -> primitives.Trajectory:
        """Return the minimum-jerk movement through the waypoints."""
        return primitives.through(
            self.waypoints, self.durations, start_velocity=self.velocity, start_acceleration=self.acceleration
        )


class Motion(NamedTuple):
    """States of references, shape (..., D) each."""

    position: Float  # Position
    velocity: Float  # Velocity
    acceleration: Float  # Acceleration

    @classmethod
    def at_rest(cls, position: Float) -> Motion:
        """Return references that rest at a position, shape (..., D)."""
        return cls(position.copy(), np.zeros_like(position), np.zeros_like(position))


class Movements(NamedTuple):
    """N minimum-jerk movements as :class:`~viapoint.primitives.Trajectory` has them, for compiled functions."""

    coefficients: Float  # Coefficients of powers of unit time, shape (N, 6, S, D)
    starts: Float  # First instant of each segment, shape (N, S), [s]
    rates: Float  # Rate of unit time in each segment, shape (N, S), [1/s]
    end: Float  # Last instant, shape (N, 1), [s]

    @classmethod
    def of(cls, plan: Plan) -> Movements:
        """Return the movements of a batch of plans."""
        found = plan.trajectory()
        return cls(*map(np.array, (found.coefficients, found.starts, found.rates, found.end)))

    def sample(self, times: Float) -> Motion:
        """Return the states at times of shape (N, T), [s]; outside the movement, the arm rests at an end."""
        return Motion(*_sampled(self, times))


# The second evaluation of such polynomials besides that of `primitives`: it takes a third of the time or less.
@compiled
def _sampled(movements: Movements, times: Float) -> tuple[Float, Float, Float]:
    """Return position, velocity and acceleration, see :meth:`Movements.sample`."""
    number, _, segments, dimension = movements.coefficients.shape
    shape = (number, times.shape[1], dimension)
    position = np.empty(shape)
    velocity = np.empty(shape)
    acceleration = np.empty(shape)
    for i in range(number):
        c = movements.coefficients[i]
        for k in range(times.shape[1]):
            time = min(max(times[i, k], 0.0), movements.end[i, 0])  # it rests before and after
            s = segments - 1
            while s > 0 and time < movements.starts[i, s]:
                s -= 1
            rate = movements.rates[i, s]
            u = (time - movements.starts[i, s]) * rate
            moving = 1.0 if time == times[i, k] else 0.0
            for d in range(dimension):
                high = c[3, s, d] + u * (c[4, s, d] + u * c[5, s, d])
                position[i, k, d] = c[0, s, d] + u * (c[1, s, d] + u * (c[2, s, d] + u * high))
                slope = 3.0 * c[3, s, d] + u * (4.0 * c[4, s, d] + u * 5.0 * c[5, s, d])
                slope = c[1, s, d] + u * (2.0 * c[2, s, d] + u * slope)
                bend = 6.0 * c[3, s, d] + u * (12.0 * c[4, s, d] + u * 20.0 * c[5, s, d])
                bend = 2.0 * c[2, s, d] + u * bend
                velocity[i, k, d] = moving * rate * slope
                acceleration[i, k, d] = moving * rate * rate * bend
    return position, velocity, acceleration


@compiled
def jerk_cost_between(movements: Movements, begin: Float, end: Float) -> Float:
    """Return half the integral of the squared jerk of movements between two times of each, shape (N,).

    On each segment the jerk is a parabola of time, so its square has degree four: three Gauss-Legendre nodes are exact.
    """
    number, _, segments, dimension = movements.coefficients.shape
    cost = np.zeros(number)
    for i in range(number):
        c = movements.coefficients[i]
        for s in range(segments):
            first, rate = movements.starts[i, s], movements.rates[i, s]
            last = movements.starts[i, s + 1] if s + 1 < segments else movements.end[i, 0]
            low = max(begin[i], first)
            high = min(end[i], last)
            half = 0.5 * max(high - low, 0.0)
            for node in range(3):
                u = (low + half * (1.0 + NODES[node]) - first) * rate
                square = 0.0
                for d in range(dimension):
                    jerk = 6.0 * c[3, s, d] + u * (24.0 * c[4, s, d] + u * 60.0 * c[5, s, d])
                    square += (rate * rate * rate * jerk) ** 2
                cost[i] += 0.5 * half * WEIGHTS[node] * square
    return cost


class ActionLayout:
    """Layout of actions: the meaning of each component.

    An action is a vector in [-1, 1]^m: for each of K via-points its offset from the k-th of K evenly spaced points of
    the straight line; then the duration; then, with `timing="learned"`, how it is split between the segments. The zero
    action is the straight minimum-jerk movement. In hand space offsets are along and across the straight line and
    durations are in seconds. In joint space offsets are of the joints, and the duration is relative to the shortest
    that the velocity limits of the joints allow.
    """

    def __init__(
        self,
        arm: Arm,
        space: SpaceName,
        n_via: int,
        timing: Timing,
        duration_range: tuple[float, float],
        via_range: float = 1.0,
    ) -> None:
        self.space, self.n_via, self.timing = space, n_via, timing
        self.duration_range = low, high = duration_range
        """Shortest and longest total duration, [s] or relative; an action of 0 is their geometric mean."""
        in_hand = space == "hand"
        self.names_of_axes = ("along", "across") if in_hand else arm.joint_names  # Names of the D components
        self.dimension = len(self.names_of_axes)  # Dimension D of the space
        width = arm.joint_range[:, 1] - arm.joint_range[:, 0]
        offsets = np.minimum(RANGE_SHARE * width, LARGEST_OFFSET)
        self.via_scale = via_range * (np.array(HAND_OFFSETS) if in_hand else offsets)
        """Largest offset of each component, shape (D,), [m] or [rad]."""
        limited = np.isfinite(arm.velocity_limit)
        self.rate_limit = np.where(limited, arm.velocity_limit, UNLIMITED_SPEED)  # Velocity limits, [rad/s]
        self.centre = float((low * high) ** 0.5)  # Duration of the zero action, [s], in joint space relative
        self.log_half_range = float(0.5 * np.log(high / low))  # Log factor on the duration for an action of 1
        vias = [f"via_{k}_{axis}" for k in range(1, n_via + 1) for axis in self.names_of_axes]
        splits = [f"split_{k}" for k in range(1, n_via + 1)] if timing == "learned" else []
        self.names = (*vias, "duration", *splits)  # Names of the components, in order
        self.size = len(self.names)  # Number of components m
        straight = np.linspace(0.0, 1.0, n_via + 2)[:, None]
        self._straight_split = np.diff(np.log(primitives.passage_durations(straight, np.asarray(1.0))))
        """Log ratios of neighbouring segments' durations on the straight movement with evenly spaced vias."""

    def zero_duration(self, start: Float, goal: Float) -> Float:
        """Return the duration of the zero action, shape (...), [s], for ends of shape (..., D)."""
        if self.space == "hand":
            return np.full(start.shape[:-1], self.centre)
        # The greatest rate of the straight minimum-jerk movement is 15/8 of the mean one.
        rate = 1.875 * np.abs(goal - start) / self.rate_limit
        return np.asarray(self.centre * rate.max(axis=-1))

    def decode(self, action: Any, start: Any, goal: Any) -> Plan:
        """Return the movements of actions.

        Args:
            action: Shape (..., m), in [-1, 1].
            start: Shape (..., D).
            goal: Shape (..., D), apart from the start.

        Raises:
            ValueError: One of them has another shape.
        """
        action = finite_array("action", action, (..., self.size))
        start = finite_array("start", start, (..., self.dimension))
        goal = finite_array("goal", goal, (..., self.dimension))
        return self.plans(action, start, goal)

    def plans(self, action: Float, start: Float, goal: Float) -> Plan:
        """Return the movements of actions that are known to be good; see :meth:`decode`."""
        waypoints = self.waypoints(action, start, goal)
        factor = self.centre * np.exp(action[..., self.n_via * self.dimension] * self.log_half_range)
        shares = self.shares(waypoints, action)
        unit = factor if self.space == "hand" else factor * self.shortest(waypoints, shares)
        return Plan.at_rest(waypoints, shares * unit[..., None])

    def waypoints(self, action: Float, start: Float, goal: Float) -> Float:
        """Return start, via-points and goal of actions, shape (..., K + 2, D)."""
        line = goal - start
        vias = [start]
        for k in range(self.n_via):
            offset = action[..., k * self.dimension : (k + 1) * self.dimension] * self.via_scale
            if self.space == "hand":
                offset = turned(offset, line)
            vias.append(start + line * ((k + 1) / (self.n_via + 1)) + offset)
        return np.stack([*vias, np.broadcast_to(goal, start.shape)], axis=-2)

    def encode(self, plan: Plan) -> Float:
        """Return the actions of movements, shape (..., m), the inverse of :meth:`decode`.

        Components outside [-1, 1] say that the movement lies outside the action space.

        Raises:
            ValueError: The movement has another dimension or another number of via-points.
        """
        waypoints = finite_array("waypoints", plan.waypoints, (..., self.n_via + 2, self.dimension))
        durations = finite_array("durations", plan.durations, (..., self.n_via + 1))
        start, goal = waypoints[..., 0, :], waypoints[..., -1, :]
        line = goal - start
        parts = []
        for k in range(self.n_via):
            offset = waypoints[..., k + 1, :] - (start + line * ((k + 1) / (self.n_via + 1)))
            if self.space == "hand":
                # The frame of the straight line turned back: its second axis mirrored.
                offset = turned(offset, line * np.array([1.0, -1.0]))
            parts.append(offset / self.via_scale)
        total = durations.sum(axis=-1)
        unit: Any = self.centre
        if self.space != "hand":
            unit = self.centre * self.shortest(waypoints, durations / total[..., None])
        parts.append((np.log(total / unit) / self.log_half_range)[..., None])
        if self.timing == "learned":
            ratios = np.log(durations[..., 1:] / durations[..., :-1])
            parts.append((ratios - self._straight_split) / LOG_SPLIT)
        return np.concatenate(parts, axis=-1)

    def shortest(self, waypoints: Float, shares: Float) -> Float:
        """Return the shortest durations that keep the velocity limits, (...), [s], for shares (..., K + 1)."""
        trajectory = primitives.through(waypoints, shares)
        velocity = trajectory(np.linspace(0.0, 1.0, PEAK_INSTANTS + 1)[1:-1], 1)
        relative = np.abs(velocity) / self.rate_limit
        return np.asarray(np.maximum(relative.max(axis=(-2, -1)), SHORTEST_DURATION))

    def shares(self, waypoints: Float, action: Float) -> Float:
        """Return the shares of the duration of the segments that actions choose, shape (..., K + 1)."""
        if self.timing == "optimal":
            return np.asarray(primitives.passage_durations(waypoints, np.ones(waypoints.shape[:-2])))
        split = action[..., self.n_via * self.dimension + 1 :]
        logs = np.cumsum(self._straight_split + LOG_SPLIT * split, axis=-1)
        shares = np.exp(np.concatenate((np.zeros((*logs.shape[:-1], 1)), logs), axis=-1))
        return np.asarray(shares / shares.sum(axis=-1, keepdims=True))


def turned(offset: Float, line: Float) -> Float:
    """Return offsets along and across a line in the plane as vectors of the plane, shape (..., 2)."""
    along = line / np.sqrt((line * line).sum(axis=-1, keepdims=True))
    x, y = along[..., 0], along[..., 1]
    u, v = offset[..., 0], offset[..., 1]
    return np.stack((u * x - v * y, u * y + v * x), axis=-1)


class NominalPlan(NamedTuple):
    """Plans that N arms follow on a zero action, in coordinates of the space."""

    begun: Bool  # True if a movement is under way; otherwise the nominal plan is the straight movement
    changed: Bool  # True if the goal differs from that of the plan under way
    jumped: Bool  # True if it differs so much that the default is the smoothest movement to it
    state: Motion  # Present command
    start: Float  # Start of the episode, shape (N, D)
    goal: Float  # Present goal, shape (N, D)
    vias: Float  # Via-points, shape (N, K, D)
    remaining: Float  # Remaining duration, shape (N,), [s]; 0 where the arm rests at its goal


def nominal_plan(
    layout: ActionLayout, plan: Plan, time: Float, begun: Bool, start: Float, goal: Float
) -> NominalPlan:
    """Return the plans of zero actions, `time` after the beginning of N movements under way, shape (N,), [s].

    The other arguments are parts of the result, see :class:`NominalPlan`.
    """
    number = layout.n_via
    trajectory = plan.trajectory()
    distance = norm(goal - plan.waypoints[:, -1])
    nearby = NEARBY[layout.space]
    jumped = distance >= nearby
    moving = Motion(*(part[:, 0] for part in trajectory.sample(time[:, None])))
    at_rest = Motion.at_rest(start)
    state = Motion(*(np.where(begun[:, None], a, b) for a, b in zip(moving, at_rest, strict=True)))
    shares = np.arange(1, number + 1) / (number + 1)
    straight = start[:, None] + (goal - start)[:, None] * shares[:, None]
    rest = trajectory(_passages(plan, time, number))
    whole = np.maximum(layout.zero_duration(state.position, goal), least_remaining(layout))
    anew = primitives.point_to_point(
        state.position, goal, whole, start_velocity=state.velocity, start_acceleration=state.acceleration
    )(whole[:, None] * shares)
    share = np.minimum(distance / nearby, 1.0)  # a small move changes the rest of the plan a little
    mixed = rest + share[:, None, None] * (anew - rest)
    vias = np.where(begun[:, None, None], mixed, straight)
    left = np.maximum(plan.duration - time, 0.0)
    left = np.maximum(left + share * (whole - left), np.cbrt(60.0 * distance / CORRECTION_JERK))
    remaining = np.where(jumped | ~begun, whole, left)
    return NominalPlan(begun, (distance > 0.0) & begun, jumped & begun, state, start, goal, vias, remaining)


def least_remaining(layout: ActionLayout) -> float:
    """Return the shortest revised movement; a plan with less time left is not revised, [s]."""
    return 0.5 * layout.duration_range[0] if layout.space == "hand" else 0.3


def revise(layout: ActionLayout, nominal: NominalPlan, plan: Plan, actions: Float) -> tuple[Plan, Bool]:
    """Return plans for actions (N, m), and True where the present one is kept: zero action or close to the goal."""
    zero = (actions == 0.0).all(axis=-1)
    near = (nominal.remaining > 0.0) & (nominal.remaining < least_remaining(layout))
    keep = nominal.begun & ~nominal.changed & (zero | near)
    revised = Plan(*(part.copy() for part in plan))
    first = np.flatnonzero(~nominal.begun)
    if first.size:
        fresh = layout.plans(actions[first], nominal.state.position[first], nominal.goal[first])
        put(revised, first, fresh)
    later = np.flatnonzero(nominal.begun & ~keep)
    if later.size:
        put(revised, later, _revised(layout, take(nominal, later), actions[later]))
    return revised, keep


def timed(waypoints: Float, duration: Float, state: Motion) -> Plan:
    """Return the plan through waypoints, from a state, with the passage times of least jerk."""
    durations = primitives.passage_durations(
        waypoints, duration, start_velocity=state.velocity, start_acceleration=state.acceleration
    )
    return Plan(waypoints, durations, state.velocity, state.acceleration)


def _revised(layout: ActionLayout, nominal: NominalPlan, actions: Float) -> Plan:
    """Return plans in motion for actions that change them."""
    state, number, d = nominal.state, layout.n_via, layout.dimension
    offsets = actions[:, : number * d].reshape(len(actions), number, d) * layout.via_scale
    if layout.space == "hand":
        # The frame's line is that from the hand to the goal or, at the goal, from the start.
        line = nominal.goal - state.position
        for other in (nominal.goal - nominal.start, np.eye(1, d)):
            line = np.where((norm(line) < NEARBY["hand"])[:, None], other, line)
        offsets = turned(offsets, line[:, None])
    points = np.concatenate((state.position[:, None], nominal.vias + offsets, nominal.goal[:, None]), axis=1)
    least = least_remaining(layout)
    remaining = np.maximum(nominal.remaining, least)
    duration = np.maximum(remaining * np.exp(layout.log_half_range * actions[:, number * d]), least)
    if layout.space == "hand":
        duration = np.minimum(duration, np.maximum(remaining, layout.duration_range[1]))
    zero = (actions == 0.0).all(axis=-1)
    slightly = nominal.changed & ~nominal.jumped
    plan = timed(points, np.where(zero & slightly, nominal.remaining, duration), state)
    # The smoothest movement itself: its via-points are evenly spaced in time.
    even = np.broadcast_to(duration[:, None] / (number + 1), plan.durations.shape)
    return plan._replace(durations=np.where((zero & ~slightly)[:, None], even, plan.durations))


def _passages(plan: Plan, time: Float, number: int) -> Float:
    """Return passage times of the remaining via-points, and times on the last segment for those passed.

    Shape (N, K), [s], in order.
    """
    knots = np.cumsum(plan.durations, axis=-1)
    inner, end = knots[:, :-1], knots[:, -1:]
    index = np.arange(number)
    ahead = (inner > time[:, None]).sum(axis=-1, keepdims=True)
    kept = np.take_along_axis(inner, np.minimum(index + number - ahead, number - 1), axis=-1)
    since = np.minimum(np.maximum(time[:, None], inner[:, -1:] if number else 0.0), end)
    filled = since + (end - since) * (index - ahead + 1) / (number - ahead + 1)
    return np.where(index < ahead, kept, filled)


@dataclass(frozen=True, kw_only=True)
class Steering:
    """Layout of the actions of control steps, and the filter that turns them into references.

    An action is the wanted velocity as a fraction of `top_speed`: of the hand along x and y of the world, or of the
    joints. The zero action brings the arm to rest. A critically damped filter of the second order makes a smooth
    reference of the velocity u, so that its jerk is finite:

        v'' = w^2 (u - v) - 2 w v'

    With u held over a control step the solution is known: one step of N references is a few multiplications.
    """

    names: tuple[str, ...]  # Names of the components, in order
    top_speed: tuple[float, ...]  # Velocity that an action of 1 stands for, [m/s] or [rad/s]
    bandwidth: float  # Bandwidth w of the filter, [rad/s]
    physics_steps: int  # Physics steps S of a control step
    timestep: float  # Length of a physics step, [s]

    @property
    def greatest_acceleration(self) -> float:
        """Bound of the acceleration of a component, [m/s^2] or [rad/s^2].

        The filter's response to a short push never changes sign, so no component exceeds its top speed; that of its
        rate is up to w / e twice.
        """
        return float(2.0 * np.sqrt(2.0) * max(self.top_speed) * self.bandwidth / np.e)

    def follow(self, motion: Motion, wanted: Float, number: int) -> Motion:
        """Return references now and after each of T physics steps, shape (N, T + 1, D) each."""
        tables = self._tables(number)
        return Motion(*(_combined(table, motion, wanted) for table in tables))

    def jerk_cost(self, motion: Motion, wanted: Float, duration: Float) -> Float:
        """Return half the integral of the squared jerk over times of a control step, shape (N,), exact, shape (N,)."""
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
        half = 0.5 * duration
        time = half[:, None] * (nodes + 1.0)
        w, decay = self.bandwidth, np.exp(-self.bandwidth * time)
        of_velocity = -(w**2) * (1.0 - w * time) * decay
        of_acceleration = (w * time - 2.0) * w * decay
        jerk = of_velocity[..., None] * (motion.velocity - wanted)[:, None]
        jerk = jerk + of_acceleration[..., None] * motion.acceleration[:, None]
        each = (jerk * jerk).sum(axis=-1)
        cost = np.zeros(len(each))
        for k, weight in enumerate(weights):  # one after the other: the same bits in any batch
            cost += 0.5 * weight * half * each[:, k]
        return cost

    @functools.cache  # noqa: B019 - records of tasks live as long as the process
    def _tables(self, number: int) -> tuple[Float, Float, Float]:
        """Matrices from (p, v, a, u) at the beginning to position, velocity and acceleration, (T + 1, 4) each."""
        time = self.timestep * np.arange(number + 1)
        w, decay = self.bandwidth, np.exp(-self.bandwidth * time)
        one, zero = np.ones_like(time), np.zeros_like(time)
        fast = (1.0 - decay * (1.0 + w * time)) / w**2
        slow = (1.0 - decay) / w + w * fast
        position = (one, slow, fast, time - slow)
        velocity = (zero, (1.0 + w * time) * decay, time * decay, 1.0 - (1.0 + w * time) * decay)
        rate = (zero, -(w**2) * time * decay, (1.0 - w * time) * decay, w**2 * time * decay)
        return np.stack(position, axis=-1), np.stack(velocity, axis=-1), np.stack(rate, axis=-1)


def _combined(table: Float, motion: Motion, wanted: Float) -> Float:
    """Return the product of a matrix with position, velocity, acceleration and wanted velocity, (N, rows, D)."""
    total = table[:, 0, None] * motion.position[:, None]
    for k, part in enumerate((motion.velocity, motion.acceleration, wanted)):
        total = total + table[:, k + 1, None] * part[:, None]
    return np.asarray(total)
