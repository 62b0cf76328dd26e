"""Running episodes of n environments on one thread: decisions, their execution, metrics and rewards."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.kinematics import slowdowns
from viapoint.envs.common.arrays import Bool, Float, Int, Observation, as_dict, from_dict, norm, put, take
from viapoint.envs.events import Event, EventPredictor, next_step
from viapoint.envs.geometry.clearance import FAR, memory, row_clearances
from viapoint.envs.geometry.obstacles import KINDS, no_obstacles
from viapoint.envs.outcome import (
    SETTLING,
    EpisodeState,
    Outcome,
    Rollout,
    relative_jerk,
    straight_jerk_cost,
)
from viapoint.envs.plans import (
    MAX_START_OFFSET,
    Motion,
    Movements,
    NominalPlan,
    Plan,
    jerk_cost_between,
    nominal_plan,
    revise,
    timed,
)
from viapoint.envs.rewards import reward_terms
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import Scenes, resting
from viapoint.envs.sensors import Looks
from viapoint.envs.simulator import Simulator, measure, risky_steps
from viapoint.envs.task import Task

BLOCK, SIMILAR = 32, 1.1
"""Greatest number of movements that are executed together, few enough for the processor's cache, and the greatest
length of one relative to another: all run as long as the longest one."""
CONTROL_STRIDE = 4  # Physics steps between two computed torques; those in between are interpolated linearly
LIMIT_INSTANTS = 64  # Instants at which the limits of a plan are checked
PROLONGED, ENOUGH = 6, 1.0  # Greatest number of prolongations of a plan in motion, and remaining factor
MOST_PROLONGED = 1.5
"""Greatest factor each time. Longer plans in motion swing out and need more: the factors would grow without bound."""

History = list[tuple[float, Plan]]  # Plans of an episode with the times at which they began, [s]
# Numbers of physics steps, joint positions [rad] and references after each, and contacts before it, in pieces of an
# episode
Piece = tuple[Int, Float, Float, Bool]
# Function of rows and a number of steps T that returns references from now on, shape (n, T + 1, D) each
References = Callable[[Int, int], Motion]


class Recorded(NamedTuple):
    """One episode as it was recorded."""

    scene: Scenes  # Scene, with one row
    history: History  # Plans
    rollout: Rollout  # States at every physics step


class Decision(NamedTuple):
    """Results of one decision in n environments."""

    observation: Observation
    reward: Float
    terminated: Bool
    truncated: Bool
    info: dict[str, Any]


class Episodes:
    """Running episodes of n environments of a task.

    Plans that begin in motion are prolonged where the limits of the arm need it, or executed as they are if not
    `prolong`.
    """

    def __init__(self, task: Task, number: int, *, prolong: bool = True) -> None:
        self.task = task
        self._prolong = prolong
        meshes = [name for name in task.shapes if name not in KINDS]
        self.simulator = Simulator(
            task.arm, n_obstacles=task.observation.n_rows, num_envs=number, meshes=meshes
        )
        home, far = np.tile(task.arm.home, (number, 1)), np.full(number, FAR)
        self.metrics = EpisodeState.at_rest(home, task.arm.hand(home), far, far)
        """Metrics of the running episodes."""
        self.scenes = resting(home, home.copy(), no_obstacles(number, task.observation.n_rows))
        """Scenes of the running episodes."""
        self.history: list[History] = [[] for _ in range(number)]  # Plans of the running episodes
        self._past: list[list[Piece]] = [[] for _ in range(number)]  # and their physics steps
        self._finished: tuple[Int, Scenes, list[tuple[History, list[Piece]]]] | None = None
        """Rows, scenes and records of the episodes before the running ones; None if they are not kept."""
        self._moving = False
        self._events = EventPredictor(task)
        self._placed = memory(task.arm.chain, task.arm.spheres)
        self._start = np.zeros((number, task.space.dimension))
        self._zero_duration = np.ones(number)
        points = task.n_via + 2
        self.plan = Plan.at_rest(
            np.zeros((number, points, task.space.dimension)), np.ones((number, points - 1))
        )
        """Plans under way."""
        self._movements = Movements.of(self.plan)
        self.begun = np.zeros(number, bool)  # True where a plan is under way, shape (n,)
        self._began = np.zeros(number, np.int64)
        self._motion = Motion.at_rest(self._start)
        self.last_plan: Plan | None = None
        """Plans of the last decisions; None before the first, and where the arm is steered."""
        self.looks = None if task.sensor is None else Looks.none(task.sensor, number)
        """Looks of the sensor in the running episodes; None without a sensor."""

    @functools.cached_property
    def sampler(self) -> SceneSampler:
        """Sampler of the task's scenes."""
        return self.task.sampler()

    @property
    def time(self) -> Float:
        """Time since the start of each episode, shape (n,), [s]."""
        return np.asarray(self.metrics.steps * self.simulator.timestep)

    def start(self, rows: Int, scenes: Scenes, *, keep: bool = False) -> None:
        """Start episodes at indices (n,) with the arms at rest at the start and the obstacles in place.

        The records of the episodes before are kept if `keep`, for pictures.
        """
        self._finished = None
        if keep:
            records = [(self.history[row], self._past[row]) for row in rows]
            self._finished = rows, self.scenes.take(rows), records
        if not keep and len(rows) == len(self.begun):
            self.last_plan = None
        self.scenes = self.scenes.put(rows, scenes)
        moving = self.scenes.obstacles.velocity, self.scenes.turn_velocity, self.scenes.reach
        self._moving = any(part.any() for part in moving)
        arm, space, joints = self.task.arm, self.task.space, scenes.start
        obstacles = scenes.obstacles_at(np.zeros(len(rows)))
        self.simulator.place(rows, joints, obstacles)
        apart, own = row_clearances(arm.chain, arm.spheres, joints, obstacles, FAR)
        nearest = apart.min(axis=1, initial=FAR)
        put(self.metrics, rows, EpisodeState.at_rest(joints, arm.hand(joints), nearest, own))
        start = space.coordinates(joints)
        goal = space.coordinates(scenes.goal)
        self._start[rows] = start
        self._zero_duration[rows] = self.task.action.zero_duration(start, goal)
        waiting = np.repeat(start[:, None], self.plan.waypoints.shape[1], axis=1)
        put(self.plan, rows, Plan.at_rest(waiting, np.ones(waiting.shape[:2])[:, 1:]))
        self.begun[rows] = False
        self._began[rows] = 0
        put(self._motion, rows, Motion.at_rest(start))
        for row in rows:
            self.history[row] = []
            self._past[row] = []
        if self.looks is not None and self.task.sensor is not None:
            put(self.looks, rows, Looks.none(self.task.sensor, len(rows)))
            self._look(rows)

    def _look(self, rows: Int) -> None:
        """Look with the sensor at the present scenes of some episodes."""
        if self.looks is not None and self.task.sensor is not None:
            obstacles = self.scenes.take(rows).obstacles_at(self.time[rows])
            joints = self.metrics.joints[rows]
            self.looks.add(rows, self.task.sensor, self.task.arm, joints, obstacles)

    def goals(self, time: Float) -> Float:
        """Return the goals at one time for each episode, in coordinates of the space, shape (n, D)."""
        return self.task.space.coordinates(self.scenes.goals(time))

    @property
    def nominal(self) -> NominalPlan:
        """Plans that a zero action leads to, and the present references."""
        since = (self.metrics.steps - self._began) * self.simulator.timestep
        goal = self.goals(self.time)
        return nominal_plan(self.task.action, self.plan, np.asarray(since), self.begun, self._start, goal)

    def observe(self) -> Observation:
        """Return the present observations."""
        state, task, time = self.metrics, self.task, self.time
        goal = self.scenes.goals(time)
        goals = goal, task.arm.hand(goal)
        nominal = self.nominal if task.replanning else None
        command = self._motion if task.stepwise else None
        if nominal is not None:
            command = nominal.state
        now = state.joints, state.hand, goals, self.scenes.obstacles_at(time)
        return task.observation.observe(*now, command, time, nominal, self.looks)

    def decide(self, actions: Float, active: Bool) -> Decision:
        """Make one decision for actions (n, m) in [-1, 1] and execute it until it ends.

        Results of environments that are not `active`, shape (n,), mean nothing.
        """
        if self.task.stepwise:
            return self._steer(actions, active)
        if self.task.whole_movement:
            plan = self.task.action.plans(actions, self._start, self.goals(self.time))
            return self._follow(plan, active, active)
        plan, kept = revise(self.task.action, self.nominal, self.plan, actions)
        return self._follow(plan, ~kept & active, active)

    def execute(self, plan: Plan) -> Decision:
        """Replace every plan by another one that begins where the references are, and follow it."""
        everyone = np.ones(len(self.begun), bool)
        return self._follow(plan, everyone, everyone)

    def plan_from_here(self, waypoints: Float, durations: Float) -> Plan:
        """Return plans that begin in the present state of the references.

        Raises:
            ValueError: A plan begins elsewhere, or has another number of via-points where plans are revised.
        """
        state = Motion.at_rest(self._start) if self.task.whole_movement else self.nominal.state
        away = norm(waypoints[:, 0] - state.position)
        if (away > MAX_START_OFFSET).any():
            row = int(away.argmax())
            where = f"at {state.position[row]}, got {waypoints[row, 0]}"
            raise ValueError(f"plan {row} must begin where the arm is, {where}")
        if not self.task.whole_movement and waypoints.shape != self.plan.waypoints.shape:
            raise ValueError(f"waypoints must have shape {self.plan.waypoints.shape}, got {waypoints.shape}")
        waypoints = np.concatenate((state.position[:, None], waypoints[:, 1:]), axis=1)
        return Plan(waypoints, durations, state.velocity, state.acceleration)

    def recorded(self, row: int) -> Recorded:
        """Return the running episode of one environment; where it has not moved yet, the one before if it is kept."""
        scene = self.scenes.take([row])
        history = self.history[row]
        pieces = self._past[row]
        if not self.metrics.steps[row] and self._finished is not None:
            rows, scenes, records = self._finished
            for i in np.flatnonzero(rows == row):
                scene = scenes.take([i])
                history, pieces = records[i]
        if not pieces:
            pieces = [self._still(1, scene.start)]
        steps, joints, planned, contact = map(np.concatenate, zip(*pieces, strict=True))
        time = np.asarray(self.simulator.timestep * steps)
        every = scene.take(np.zeros(len(time), np.int64)).obstacles_at(time, in_chords=True)
        arm = self.task.arm
        apart, _ = row_clearances(arm.chain, arm.spheres, joints, every, FAR)
        clearance = apart.min(axis=1, initial=FAR)
        return Recorded(scene, history, Rollout(time, planned, joints, arm.hand(joints), contact, clearance))

    def _still(self, step: int, joints: Float) -> Piece:
        """Return the record of one physics step at rest at joint positions, shape (1, J)."""
        return np.array([step]), joints.copy(), self.task.space.coordinates(joints), np.zeros(1, bool)

    # Decisions that are plans

    def _follow(self, plan: Plan, revised: Bool, active: Bool) -> Decision:
        """Follow plans, new ones where they were revised, until the decisions end."""
        state, scenes = self.metrics, self.scenes
        first = ~self.begun
        before = self._outcome(np.zeros(len(first), bool))
        begin = state.steps.copy()
        self._adopt(plan, np.flatnonzero(revised))
        step, event, final = self._events(self.plan, self._began, begin, scenes, self.goals, self.looks)
        self._run_until(np.where(state.reachable & active, step, begin), self._references)
        rows = np.flatnonzero(state.steps > begin)
        times = self.simulator.timestep * (np.stack((begin, state.steps)) - self._began)[:, rows]
        state.jerk_cost[rows] += jerk_cost_between(take(self._movements, rows), times[0], times[1])
        return self._decision(before, begin, first, final, event)

    def _adopt(self, plan: Plan, rows: Int) -> None:
        """Begin new plans in some episodes, as slow as the arm's limits need them.

        A plan that begins in motion cannot be slowed down as it is. It is prolonged, which changes its path; where that
        is not enough the plan under way stays, which keeps the limits.
        """
        if not rows.size:
            return
        state, given = self.metrics, plan
        plan, movements, stretch, within, inside = self._within_limits(plan.take(rows))
        state.reachable[rows] &= inside  # the arm does not start on a plan that leaves the reach
        adopted = within | ~self.begun[rows]
        rows, plan = rows[adopted], plan.take(adopted)
        state.stretch[rows] = np.maximum(state.stretch[rows], stretch[adopted])
        # Whole movements have any number of via-points.
        if given.waypoints.shape != self.plan.waypoints.shape:
            self.plan = Plan(*[part.copy() for part in given])
            self._movements = Movements.of(self.plan)
        put(self.plan, rows, plan)
        put(self._movements, rows, take(movements, adopted))
        self.last_plan = Plan(*[part.copy() for part in self.plan])
        self._began[rows] = state.steps[rows]
        self.begun[rows] = True
        for i, row in enumerate(rows):
            self.history[row].append((float(self.time[row]), plan.take([i])))

    def _within_limits(self, plan: Plan) -> tuple[Plan, Movements, Float, Bool, Bool]:
        """Return plans that are slow enough, with what they are like, shape (n,).

        Returns:
            The plans; their movements; how much slower they are; True where they keep the limits; True where they stay
            within reach.
        """
        movements = Movements.of(plan)
        needed, inside = self._look_at(movements)
        stretch = np.maximum(needed, 1.0)
        moving = ((plan.velocity != 0.0) | (plan.acceleration != 0.0)).any(axis=-1)
        stretch[moving] = np.minimum(stretch[moving], MOST_PROLONGED if self._prolong else 1.0)
        scale = stretch[:, None]
        slower = plan._replace(durations=plan.durations * scale)
        shape, starts, rates, end = movements
        movements = Movements(shape, starts * scale, rates / scale, end * scale)
        rows = changed = np.flatnonzero(moving & (needed > ENOUGH) & self._prolong)
        for _ in range(PROLONGED):
            if not rows.size:
                break
            state = Motion(plan.waypoints[rows, 0], plan.velocity[rows], plan.acceleration[rows])
            put(slower, rows, timed(plan.waypoints[rows], slower.duration[rows], state))
            again, inside[rows] = self._look_at(Movements.of(slower.take(rows)))
            rows = rows[again > ENOUGH]
            again = np.minimum(again[again > ENOUGH], MOST_PROLONGED)
            stretch[rows] *= again
            slower.durations[rows] *= again[:, None]
        within = np.ones(len(stretch), bool)
        within[rows] = False
        if changed.size:
            put(movements, changed, Movements.of(slower.take(changed)))
        return slower, movements, stretch, within, inside

    def _look_at(self, movements: Movements) -> tuple[Float, Bool]:
        """Return how much slower movements must be to keep the limits, and True within reach and joint ranges."""
        arm, space = self.task.arm, self.task.space
        share = np.linspace(0.0, 1.0, 2 * LIMIT_INSTANTS + 1)
        motion = movements.sample(movements.end * share)
        inside = np.asarray(space.inside(motion.position).all(axis=-1))
        some = Motion(*[np.ascontiguousarray(part[:, ::2]) for part in motion])
        needed = slowdowns(arm.chain, arm.velocity_limit, arm.torque_limit, *space.joint_motion(some))
        return needed, inside

    def _run_until(self, last: Int, references: References) -> None:
        """Run the episodes until a physics step each; obstacles keep their velocity in every piece of it."""
        state = self.metrics
        turns = self._events.steps(self.scenes.course_times())
        while True:
            rows = np.flatnonzero((state.steps < last) & (state.first_contact < 0) & ~state.unstable)
            if not rows.size:
                return
            now = state.steps[rows]
            steps = np.minimum(last[rows], next_step(turns[rows], now)) - now
            for some in _blocks(steps):
                block, number = rows[some], steps[some]
                # A few steps more than needed, so that no control depends on the longest movement of the block.
                self._run(block, number, references(block, int(number.max()) + CONTROL_STRIDE))

    def _run(self, rows: Int, steps: Int, motion: Motion) -> None:
        """Execute references in n episodes of :func:`_blocks`, each for its own number of steps, 1 or more.

        An episode stops at its first contact. Obstacles keep their velocities. The references begin now, and go on for
        CONTROL_STRIDE steps more than the longest episode has.
        """
        state, task, simulator = self.metrics, self.task, self.simulator
        arm, timestep, number = task.arm, simulator.timestep, int(steps.max())
        scenes, begin = self.scenes.take(rows), state.steps[rows]
        obstacles = scenes.obstacles_at(np.asarray(begin * timestep), in_chords=True)
        goal = task.space.coordinates(scenes.goals(np.asarray((begin + steps) * timestep)))
        path, rates, accelerations = task.space.joint_motion(motion)
        controls = arm.controls(path, rates, accelerations, CONTROL_STRIDE)[:, :number]
        centres = None
        if self._moving:
            time = timestep * np.arange(number)[:, None, None]
            centres = obstacles.centre[:, None] + time * obstacles.velocity[:, None]
        resume = not task.whole_movement
        joints, contact, unstable = simulator.rollout(rows, controls, steps, centres, resume=resume)
        body = arm.chain, arm.spheres, arm.reach
        executed = *body, joints, contact, steps, obstacles, timestep, self._placed
        # Contacts between two physics steps
        for i, k, states in risky_steps(*executed, simulator.thinnest):
            if not contact[i, : k + 1].any():
                times = timestep * np.arange(k + 1, k + 3)[:, None, None]
                places = obstacles.centre[i] + times * obstacles.velocity[i]
                ends = joints[i, k : k + 2]
                contact[i, k + 1] = simulator.touches_between(int(rows[i]), ends, places, states)
        wanted = motion.position, path, goal, task.tolerance, task.space.of_hand
        done = measure(*executed, *wanted, arm.joint_range, state, rows)
        for i, row in enumerate(rows):
            end = done[i]
            numbers = begin[i] + np.arange(1, end + 1)
            self._past[row].append(
                (numbers, joints[i, :end], motion.position[i, 1 : end + 1], contact[i, :end])
            )
        state.unstable[rows] |= unstable

    def _references(self, rows: Int, number: int) -> Motion:
        """Return references of plans from now on, shape (n, T + 1, D) each."""
        since = (self.metrics.steps - self._began)[rows]
        times = np.asarray(self.simulator.timestep * (since[:, None] + np.arange(number + 1)))
        return take(self._movements, rows).sample(times)

    # Decisions of one control step

    def _steer(self, wanted: Float, active: Bool) -> Decision:
        """Follow velocities for one control step; where the references leave the reach, the arm stays."""
        task, state = self.task, self.metrics
        steering, first = task.steering, state.steps == 0
        before = self._outcome(np.zeros(len(first), bool))
        begin = state.steps.copy()
        velocity = wanted * np.array(steering.top_speed)
        number = steering.physics_steps
        ahead = steering.follow(self._motion, velocity, number)
        state.reachable[:] = task.space.inside(ahead.position).all(axis=-1)

        def references(some: Int, count: int) -> Motion:
            since = state.steps[some] - begin[some]
            motion = steering.follow(take(self._motion, some), velocity[some], int(since.max()) + count)
            steps = since[:, None] + np.arange(count + 1)
            return Motion(*(part[np.arange(len(some))[:, None], steps] for part in motion))

        moves = state.reachable & active
        rows = np.flatnonzero(moves)
        self._run_until(np.where(moves, begin + number, begin), references)
        if rows.size:
            elapsed = np.asarray((state.steps - begin)[rows] * self.simulator.timestep)
            state.jerk_cost[rows] += steering.jerk_cost(take(self._motion, rows), velocity[rows], elapsed)
            put(self._motion, rows, Motion(*(part[rows, -1] for part in ahead)))
        self.begun[:] = True
        jumps = self._events.steps(self.scenes.jump_times)
        # The target jumps no more before the time is up.
        still = ((jumps <= state.steps[:, None]) | (jumps >= self._events.limit)).all(axis=1)
        settled = still & (state.rest * self.simulator.timestep >= SETTLING - 1e-9)
        event = np.where(settled, Event.ARRIVAL, Event.HORIZON)
        event = np.where(state.steps >= self._events.limit, Event.TIME_LIMIT, event)
        return self._decision(before, begin, first, settled, event)

    # Outcomes

    def _decision(self, before: Outcome, begin: Int, first: Bool, final: Bool, event: Int) -> Decision:
        """Return the results of a decision that ended with an event, if nothing went wrong."""
        state, task = self.metrics, self.task
        event = np.where(state.first_contact >= 0, Event.CONTACT, event)
        event = np.where(state.reachable, event, Event.REACH)
        event = np.where(state.unstable, Event.UNSTABLE, event)
        if not task.stepwise:
            final = final & (event == Event.ARRIVAL)
        after = self._outcome(final)
        ended = final | (event >= Event.CONTACT)  # events of the highest ranks end an episode
        length = norm(task.space.coordinates(self.scenes.goal) - self._start)
        terms = reward_terms(
            before, after, first, ended, length, self._zero_duration, task.tolerance.unit, task.weights
        )
        elapsed = (state.steps - begin) * self.simulator.timestep
        times = {"elapsed": elapsed, "time": self.time, "event": event}
        self._look(np.arange(len(event)))
        info = {**after._asdict(), **terms, **times}
        reward = np.asarray(sum(terms.values()))
        # The time limit terminates, too: the time left is observed, and the end is judged as any other.
        return Decision(self.observe(), reward, ended, np.zeros_like(ended), info)

    def _outcome(self, final: Bool) -> Outcome:
        """Return the metrics so far, where `final` is True for arms that have arrived at their last goal."""
        state, task, timestep = self.metrics, self.task, self.simulator.timestep
        time, touched = self.time, state.first_contact >= 0
        goal = self.goals(time)
        here = state.hand[:, :2] if task.space.of_hand else state.joints
        error = norm(here - goal) if task.space.of_hand else np.abs(here - goal).max(axis=-1)
        arrived = final & (error < task.tolerance.goal) & (state.last_speed < task.tolerance.speed)
        if task.stepwise:
            duration = time - np.where(final, state.rest * timestep, 0.0)
        else:
            ends = self._began * timestep + self.plan.duration
            duration = np.where(self.begun, np.minimum(time, ends), 0.0)
        straight = straight_jerk_cost(self._straight_length(time), np.maximum(duration, timestep))
        same: dict[str, Any] = {}
        for name in set(Outcome._fields).intersection(state._fields):
            same[name] = getattr(state, name).copy()
        return Outcome(
            is_success=arrived & ~touched & state.within & state.reachable & ~state.unstable,
            collision=touched,
            first_contact_time=np.where(touched, state.first_contact * timestep, -1.0),
            goal_error=error,
            duration=duration,
            jerk_ratio=relative_jerk(state.jerk_cost, straight),
            tracking_error=np.sqrt(state.deviation / np.maximum(state.steps, 1)),
            **same,
        )

    def _straight_length(self, time: Float) -> Float:
        """Return the length of the straight lines from target to target until a time for each episode, shape (n,)."""
        before = self.task.space.coordinates(self.scenes.goal)
        length = norm(before - self._start)
        jumps, times = self.scenes.jumps, self.scenes.jump_times
        for k in range(jumps.shape[1]):
            jumped = times[:, k] <= time + 1e-9
            target = self.task.space.coordinates(jumps[:, k, 1:])
            length = length + np.where(jumped, norm(target - before), 0.0)
            before = np.where(jumped[:, None], target, before)
        return length

    # Copies

    def state(self) -> dict[str, Any]:
        """Return the state of the running episodes for :meth:`restore`; scenes and films of the past are not part."""
        return {
            "metrics": as_dict(self.metrics),
            "plan": as_dict(self.plan),
            "motion": as_dict(self._motion),
            "began": self._began.copy(),
            "begun": self.begun.copy(),
            "physics": self.simulator.batch.state.copy(),
            "looks": [part.copy() for part in self.looks or ()],
        }

    def restore(self, state: Mapping[str, Any], scenes: Scenes) -> None:
        """Continue from a state of environments of the same task and number, and their scenes."""
        self.start(np.arange(len(self.begun)), scenes)
        put(self.metrics, slice(None), from_dict(self.metrics, state["metrics"]))
        self.plan = from_dict(self.plan, state["plan"])
        self._movements = Movements.of(self.plan)
        put(self._motion, slice(None), from_dict(self._motion, state["motion"]))
        self._began[:], self.begun[:] = state["began"], state["begun"]
        self.simulator.batch.state[:] = state["physics"]
        now = self.metrics
        for row in np.flatnonzero(now.steps):  # records begin here, at the present time
            self._past[row] = [self._still(now.steps[row], now.joints[[row]])]
        if self.looks is not None:
            self.looks = Looks(*state["looks"])


def _blocks(steps: Int) -> Iterator[Int]:
    """Yield the indices of episodes of similar lengths, shape (n,), which are executed together."""
    order = np.argsort(steps, kind="stable")
    length = steps[order]
    first = 0
    while first < len(order):
        similar = int(np.searchsorted(length, SIMILAR * length[first], side="right"))
        last = min(similar, first + BLOCK)
        yield np.sort(order[first:last])
        first = last
