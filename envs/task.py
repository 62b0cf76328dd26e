"""Task of an environment: everything that defines it."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.kinematics import slowdowns
from viapoint.envs.arms.registry import arm_names, arm_of
from viapoint.envs.common.validation import (
    fewest_and_most,
    finite_array,
    names_of,
    number_of_at_least,
    one_of,
    record_of,
    whole_number,
)
from viapoint.envs.geometry.shapes import PLAIN_KINDS, REGISTERED_MESHES, check_kinds
from viapoint.envs.observation import ObservationLayout
from viapoint.envs.outcome import SETTLING, TOLERANCES, Tolerance
from viapoint.envs.plans import (
    LONGEST_DURATION,
    MOST_VIAS,
    SHORTEST_DURATION,
    ActionLayout,
    SpaceName,
    Steering,
    Timing,
)
from viapoint.envs.rewards import RewardWeights
from viapoint.envs.scenes.families_registry import check_families, default_families
from viapoint.envs.scenes.sampler import MOST_DRAWN, SceneSampler, farthest_reach, is_planar, room_of
from viapoint.envs.scenes.scene import MINIMUM_JERK_PEAK, MOST_JUMPS
from viapoint.envs.sensors import Sensor, named_sensor
from viapoint.envs.spaces import Space, space_of

Trigger = Literal["horizon", "target", "course", "clearance", "sight"]
TRIGGERS: tuple[Trigger, ...] = get_args(Trigger)  # Events that may end a decision before the goal
TELLING: tuple[Trigger, ...] = ("clearance", "course")  # Those that also tell of obstacles that are not seen
COURSES = ("turns", "reaches")  # Courses of obstacles that move; the first is the default
END, STEPS = "end", "steps"  # `decide_at` with one decision, and with one in every control step
MOST_RANGE = 10.0  # Bound of the factor on offsets of via-points
MOST_OBSTACLES = 256  # Greatest number of obstacles in a scene that is given
PLANE_SHAPES = ("cylinder", "box")  # Default shapes of obstacles in the plane
SPACE_SHAPES = ("sphere", "capsule", "cylinder", "box", "half_space")  # Default shapes of obstacles in space
JOINT_MOVEMENT = 5.0  # Least time that a movement in joint space is given where time is limited, [s]
JOINT_WAY = 0.4  # Share of a joint's range for which the slowest action has time, too
# Top speed of the hand where it is steered, [m/s], and bandwidth of the reference, [rad/s]
HAND_SPEED, HAND_BANDWIDTH = 1.5, 25.0
# Top speed of the joints where they are steered, as a share of their limits, and bandwidth, [rad/s]
JOINT_SPEED_SHARE, JOINT_BANDWIDTH = 0.5, 12.0
STEERED = 4096  # Number of states of an arm that is steered in which its torques are looked at
# Default duration range by space: seconds, and multiples of the shortest movement that the limits allow
DURATIONS: dict[str, tuple[float, float]] = {"hand": (0.6, 1.2), "joints": (1.1, 2.5)}


@dataclass(frozen=True, kw_only=True)
class Task:
    """Task of an environment: arm, space, actions, scenes, decisions and rewards.

    Create it with :meth:`of`, which checks the values and fills in those that depend on the arm. The environments
    document the fields, see :class:`~viapoint.envs.vector_env.ReachVectorEnv`.

    Example:
        >>> from viapoint.envs import Task
        >>> task = Task.of(arm="panda", n_via=2)
        >>> task.space_name, task.action.size
        ('joints', 15)
    """

    arm: Arm
    space_name: SpaceName
    n_via: int
    timing: Timing
    duration_range: tuple[float, float]
    via_range: float
    n_obstacles: tuple[int, int]
    shapes: tuple[str, ...]
    families: tuple[str, ...]
    whole_arm: bool
    moving_obstacles: bool
    courses: str
    n_jumps: tuple[int, int]
    decide_at: str | tuple[Trigger, ...]
    horizon: float
    margin: float
    control_step: float
    weights: RewardWeights
    sensor: Sensor | None = None

    @classmethod
    def of(
        cls,
        *,
        arm: Arm | str = "planar",
        space: SpaceName | None = None,
        n_via: int = 1,
        timing: Timing = "optimal",
        duration_range: tuple[float, float] | None = None,
        via_range: float = 1.0,
        n_obstacles: int | tuple[int, int] = (1, 5),
        shapes: str | Sequence[str] | None = None,
        families: str | Sequence[str] | None = None,
        whole_arm: bool = False,
        moving_obstacles: bool = False,
        courses: Literal["turns", "reaches"] = "turns",
        n_jumps: int | tuple[int, int] = 0,
        decide_at: str | Sequence[Trigger] = END,
        horizon: float = 0.3,
        margin: float = 0.02,
        control_step: float = 0.04,
        reward_weights: RewardWeights | Mapping[str, float] | None = None,
        sensor: Sensor | Mapping[str, Any] | str | None = None,
    ) -> Task:
        """Return the task that these keyword arguments of an environment describe.

        Raises:
            TypeError: An argument has another type.
            ValueError: An argument has a value that is not allowed.
        """
        arm = arm_of(arm)
        space = space_of(arm, arm.space if space is None else space).name
        for name, value in (("moving_obstacles", moving_obstacles), ("whole_arm", whole_arm)):
            if not isinstance(value, bool | np.bool_):
                raise TypeError(f"{name} must be True or False, got {value!r}")
        if one_of("courses", courses, COURSES) != COURSES[0] and not moving_obstacles:
            raise ValueError(f"courses={courses!r} needs moving_obstacles=True")
        n_obstacles = fewest_and_most("n_obstacles", n_obstacles, MOST_OBSTACLES, MOST_DRAWN)
        plane = is_planar(arm)
        shapes = (PLANE_SHAPES if plane else SPACE_SHAPES) if shapes is None else shapes
        kinds = check_kinds(names_of("shapes", shapes))
        single = [kind for kind in kinds if kind in PLAIN_KINDS or kind in REGISTERED_MESHES]
        if len(single) < len(kinds):
            raise ValueError(
                f"shapes must be some of {', '.join((*PLAIN_KINDS, *REGISTERED_MESHES))}, got {', '.join(kinds)}; "
                "register_mesh gives a mesh a name, and PointCloud.covering gives the spheres of a cloud"
            )
        families = default_families(plane, kinds, n_obstacles[1]) if families is None else families
        names = names_of("families", families)
        if sensor is not None:
            if not n_obstacles[1]:
                raise ValueError("sensor needs n_obstacles of 1 or more: there is nothing to see")
            room = room_of(arm, kinds, n_obstacles, bool(whole_arm))
            if isinstance(sensor, str):
                sensor = named_sensor(sensor, arm, room.foot, room.scale)
                if decide_at == END:  # only one look at the beginning
                    sensor = dataclasses.replace(sensor, looks=1)
            sensor = record_of("sensor", Sensor, sensor)
            half = room.height if plane else math.inf
            heights = room.foot[2] - half, room.foot[2] + half
            if not sensor.sees(arm, farthest_reach(arm), heights):
                raise ValueError(f"sensor sees no obstacle that the arm {arm.name!r} can meet: {sensor}")
        task = cls(
            arm=arm,
            space_name=space,
            n_via=whole_number("n_via", n_via, 0, MOST_VIAS),
            timing=one_of("timing", timing, get_args(Timing)),
            duration_range=_checked_durations(space, duration_range),
            via_range=number_of_at_least("via_range", via_range, 0.1, MOST_RANGE),
            n_obstacles=n_obstacles,
            shapes=kinds,
            families=check_families(names, plane, kinds, n_obstacles[1]),
            whole_arm=bool(whole_arm),
            moving_obstacles=bool(moving_obstacles),
            courses=courses,
            n_jumps=fewest_and_most("n_jumps", n_jumps, MOST_JUMPS, MOST_JUMPS),
            decide_at=_checked_decisions(decide_at),
            horizon=number_of_at_least("horizon", horizon, 1e-3),
            margin=number_of_at_least("margin", margin, 0.0),
            control_step=number_of_at_least("control_step", control_step, 1e-3),
            weights=record_of(
                "reward_weights", RewardWeights, {} if reward_weights is None else reward_weights
            ),
            sensor=sensor,
        )
        if "sight" in task.decide_at and sensor is None:
            raise ValueError("decide_at with 'sight' needs a sensor")
        telling = [each for each in TELLING if each in task.decide_at]
        if telling and sensor is not None:
            raise ValueError(
                f"decide_at with {telling[0]!r} tells of obstacles that a sensor may not have seen; use 'sight', "
                "'horizon'"
            )
        if task.whole_movement and sensor is not None and sensor.looks > 1:
            raise ValueError(f"looks of the sensor must be 1 with one decision, got {sensor.looks}")
        if not task.whole_movement and timing != "optimal":
            raise ValueError(f"timing must be optimal where plans are revised or steered, got {timing!r}")
        if task.whole_movement and (task.moving_obstacles or task.n_jumps[1]):
            raise ValueError("obstacles that move and targets that jump need decide_at with events")
        if task.stepwise:
            task.steering  # noqa: B018 - making it checks the control step
        return task

    @functools.cached_property
    def whole_movement(self) -> bool:
        """True if an episode is one decision."""
        return self.decide_at == END

    @functools.cached_property
    def stepwise(self) -> bool:
        """True if a decision is made in every control step."""
        return self.decide_at == STEPS

    @functools.cached_property
    def replanning(self) -> bool:
        """True if an episode is several plans, each made while the one before is under way."""
        return not isinstance(self.decide_at, str)

    @functools.cached_property
    def space(self) -> Space:
        """Space in which movements are planned."""
        return space_of(self.arm, self.space_name)

    @functools.cached_property
    def tolerance(self) -> Tolerance:
        """Bounds of success."""
        return TOLERANCES[self.space_name]

    @functools.cached_property
    def action(self) -> ActionLayout:
        """Layout of the actions that are movements."""
        layout = self.arm, self.space_name, self.n_via, self.timing, self.duration_range, self.via_range
        return ActionLayout(*layout)

    @functools.cached_property
    def steering(self) -> Steering:
        """Layout of the actions of control steps."""
        in_hand = self.space_name == "hand"
        timestep = self.arm.timestep
        number = round(self.control_step / timestep)
        if abs(number * timestep - self.control_step) > 1e-6 * self.control_step or number > 500:
            raise ValueError(f"control_step must be 1 to 500 times {timestep} s, got {self.control_step!r}")
        speeds = JOINT_SPEED_SHARE * np.minimum(self.arm.velocity_limit, 10.0)
        usual = Steering(
            names=("x", "y") if in_hand else self.arm.joint_names,
            top_speed=(HAND_SPEED,) * 2 if in_hand else tuple(float(speed) for speed in speeds),
            bandwidth=HAND_BANDWIDTH if in_hand else JOINT_BANDWIDTH,
            physics_steps=number,
            timestep=timestep,
        )
        return usual if in_hand or not self.stepwise else _within_torques(usual, self.arm)

    @property
    def hand_alone(self) -> bool:
        """True if there may be obstacles, and only the hand must clear them."""
        return self.n_obstacles[1] > 0 and self.space.of_hand and not self.whole_arm

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the components of an action."""
        return self.steering.names if self.stepwise else self.action.names

    def of_movements(self) -> Task:
        """Return the same task with decisions on movements in place of control steps."""
        if not self.stepwise:
            return self
        changes = self.moving_obstacles or self.n_jumps[1] > 0
        weights = dataclasses.replace(self.weights, progress=0.0)
        refused = TELLING if self.sensor else ("sight",)
        every = tuple(each for each in TRIGGERS if each not in refused)
        return dataclasses.replace(self, decide_at=every if changes else END, weights=weights)

    @functools.cached_property
    def time_limit(self) -> float:
        """Time limit of an episode, [s]; very long where an episode is one movement."""
        if self.whole_movement:
            return 1e9
        movement = self.duration_range[1]
        if self.space_name == "joints":
            width = self.arm.joint_range[:, 1] - self.arm.joint_range[:, 0]
            way = float((JOINT_WAY * width / self.action.rate_limit).max())
            slower = JOINT_BANDWIDTH / self.steering.bandwidth
            movement = slower * max(JOINT_MOVEMENT, MINIMUM_JERK_PEAK * way * movement)
        changes = self.replanning or self.moving_obstacles or self.n_jumps[1] > 0
        return (2 + self.n_jumps[1] if changes else 1) * movement + SETTLING

    @functools.cached_property
    def observation(self) -> ObservationLayout:
        """Layout of the observations."""
        return ObservationLayout(self)

    def sampler(self) -> SceneSampler:
        """Return a sampler of scenes of the task."""
        return SceneSampler(self)

    def as_dict(self) -> dict[str, Any]:
        """Return the task as plain values for JSON, which :meth:`of` takes again; the arm by its name, or its file."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        values["arm"] = self.arm.file or self.arm.name
        if not self.arm.file and self.arm.name not in arm_names():
            raise ValueError(
                f"the arm {self.arm.name!r} has no file that a task could be read from again: call register_arm with it"
            )
        values["space"] = values.pop("space_name")
        values["reward_weights"] = dataclasses.asdict(values.pop("weights"))
        sensor = values.pop("sensor")
        if sensor is not None:
            values["sensor"] = dataclasses.asdict(sensor)
        # Records of frozen scenes were made without these two.
        if self.courses == COURSES[0]:
            del values["courses"]
        if self.via_range == 1.0:
            del values["via_range"]
        plain: dict[str, Any] = json.loads(json.dumps(values))  # lists in place of tuples
        return plain


def _within_torques(steering: Steering, arm: Arm) -> Steering:
    """Return steering of the joints that is slower by a factor where the torque limits of the arm need it.

    In the states that are looked at, all joints turn round at once, at their greatest speed and acceleration.
    """
    shape = STEERED, 1, len(arm.home)
    rng = np.random.default_rng(0)
    low, high = arm.joint_range.T
    joints = rng.uniform(low, high, shape)
    top = np.array(steering.top_speed)
    velocity, toward = top * rng.choice([-1.0, 1.0], (2, *shape))
    acceleration = 2.0 * steering.bandwidth / np.e * toward  # see Steering.greatest_acceleration
    needed = slowdowns(arm.chain, arm.velocity_limit, arm.torque_limit, joints, velocity, acceleration)
    slower = max(float(np.quantile(needed, arm.steerable_share)), 1.0)
    speeds = tuple((top / slower).tolist())
    return dataclasses.replace(steering, top_speed=speeds, bandwidth=steering.bandwidth / slower)


def _checked_durations(space: SpaceName, given: Any) -> tuple[float, float]:
    """Return the shortest and longest duration of a movement, by default those of the space."""
    pair = DURATIONS[space] if given is None else given
    finite_array("duration_range", pair, (2,))
    # In joint space a duration is relative to the shortest movement that the limits allow.
    least = SHORTEST_DURATION if space == "hand" else 1.0
    low, high = (number_of_at_least("duration_range", each, least) for each in pair)
    if not low < high <= LONGEST_DURATION:
        raise ValueError(f"duration_range must increase, up to {LONGEST_DURATION:g}, got {pair!r}")
    return low, high


def _checked_decisions(decide_at: Any) -> str | tuple[Trigger, ...]:
    """Return when decisions are made."""
    if isinstance(decide_at, str):
        if decide_at in (END, STEPS):
            return decide_at
    elif isinstance(decide_at, Sequence) and all(
        isinstance(each, str) and each in TRIGGERS for each in decide_at
    ):
        return tuple(decide_at)
    raise ValueError(
        f"decide_at must be {END!r}, {STEPS!r} or a list with some of {', '.join(TRIGGERS)}, got {decide_at!r}"
    )
