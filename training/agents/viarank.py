"""ViaRank: an agent that sees obstacles with a sensor, and ranks candidate plans by their predicted success.

It learns with privileged information (D. Chen et al., Learning by cheating, 2020). In training the true obstacles are
known, so that computed geometry labels any number of plans of a scene as clear or not. The network predicts the labels
from the readings alone. For each update new scenes are drawn, which need no simulation; movements in the environment
measure how well the agent does. Where plans are revised on the way, it learns from the present scenes of the
environment instead. Half of the plans that are learned from are those that the network itself prefers: otherwise it
would be right on average, and too sure of those that it chooses.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.optimize import minimize
from scipy.special import expit, logit
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.nn import functional

from viapoint.envs.common.arrays import Float, Observation, Single
from viapoint.envs.common.validation import number_of_at_least
from viapoint.envs.geometry.obstacles import Obstacles, no_obstacles
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sensors import Sensor
from viapoint.envs.task import Task
from viapoint.training.agents.model_io import ALGORITHMS
from viapoint.training.agents.plan_agent import PlanAlgorithm, PlanPolicy
from viapoint.training.planning.beliefs import Sight, thick_points
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.cautious import (
    BELIEFS,
    DEFAULT_BELIEF,
    OUT_OF_VIEW,
    PRIVILEGED,
    instants_of,
    places_of,
)
from viapoint.training.planning.problem import Moves, Numbers, Problem, moves_of, worth_of
from viapoint.training.planning.search import (
    CLEARANCE_MARGIN,
    plan_clearances,
    refined_actions,
)

# Weights beside the probability of success, of the depth that a plan clears and of the reward of a plan that succeeds,
# and the depths to which what is seen may go on behind its front, [m]. They were tuned on scenes that were drawn. In
# space and with later looks, the depth of a plan gained nothing as a weight; as inputs depths were not tried there.
ONE_LOOK_OF_HAND: dict[str, Any] = {
    "caution": 0.3,
    "effort": 0.2,
    "depths": (0.0, 0.015, 0.03, 0.1, 0.16, 0.25),
}
OTHERWISE: dict[str, Any] = {"caution": 0.0, "effort": 0.05, "depths": ()}
# Time up to which a contact counts twice as much as later ones, which a revised plan may still avoid, [s]
SOON = 0.45
KEEP = 2.0  # Reward by which another plan must be better than the one under way, as each change of plan costs jerk
# First part of the seeds of scenes for the calibration, far from those of training, and their number
CALIBRATION, CALIBRATION_SCENES = 3_000_017, 640
BLOCK = 16  # Scenes that are decided together
DEEP, SHALLOW = 0.4, 0.05  # Depths behind a surface at which two of the inputs saturate, [m]
# Pixels in whose square a place is compared with the nearest surface, to find the places that matter
NEIGHBOURS = 7
CLEAR = 0.05  # Clearance at which its input saturates, [m]
FEATURES = 9  # Inputs of a place besides the features of its pixel


class ViaRankPolicy(PlanPolicy):
    """Policy that ranks candidates by the probability of success that a network predicts from a sensor's readings.

    Args:
        observation_space: Observation space of the environment.
        action_space: Action space of the environment.
        lr_schedule: Learning rate as a function of the remaining progress.
        task: Task of the environment as plain values, see :meth:`viapoint.envs.task.Task.as_dict`.
        width: Number of features of a pixel.
        instants: Instants of a plan at which the arm is looked at.
        nearest: Number of places of a plan that the network sees.
        candidates: Number of Sobol points in the action space.
        refinements: Rounds of candidates around the best ones.
        per_refinement: Candidates of each round.
        refine: Number of best candidates that the planner refines around what is seen; they are ranked, too.
        caution: Weight of the greatest of `depths` that a plan clears, relative to the last of them, beside its
            probability of success. Usual are 0.3 with one look in the plane, and 0 elsewhere.
        effort: Weight of the reward of a plan that succeeds, which is greater for smooth and short ones. Usual are 0.2
            with one look in the plane, and 0.05 elsewhere.
        belief: Obstacles whose clearance the network sees beside the readings, one of
            :data:`~viapoint.training.planning.cautious.BELIEFS`. With `known` and `seen` the agent decides only where
            the true obstacles are given, as in evaluations.
        depths: Depths to which all that is seen may go on behind its front, ascending, [m]. The network sees the
            clearance of a plan for each of them, too. Usual are six up to 25 cm with one look in the plane, and none
            elsewhere.
    """

    OWN = (
        "width", "instants", "nearest", "candidates", "refinements", "per_refinement", "refine",
        "caution", "effort", "belief", "depths",
    )  # fmt: skip

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Any,
        *,
        task: Mapping[str, Any],
        width: int = 32,
        instants: int = 32,
        nearest: int = 16,
        candidates: int = 1024,
        refinements: int = 2,
        per_refinement: int = 128,
        refine: int = 0,
        caution: float | None = None,
        effort: float | None = None,
        belief: str = DEFAULT_BELIEF,
        depths: Sequence[float] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, task=task, **kwargs)
        self.width = width
        self.instants = instants
        self.nearest = nearest
        self.candidates = candidates
        self.refinements = refinements
        self.per_refinement = per_refinement
        self.refine = refine
        self.belief = belief
        usual = ONE_LOOK_OF_HAND if self.task.space.of_hand and not self.replanning else OTHERWISE
        if belief in PRIVILEGED:  # nothing is behind what is believed
            usual = {**usual, "caution": 0.0, "depths": ()}
        self.caution: float = usual["caution"] if caution is None else caution
        self.effort: float = usual["effort"] if effort is None else effort
        self.depths: tuple[float, ...] = usual["depths"] if depths is None else tuple(depths)
        sensor = self.task.sensor
        assert sensor is not None
        self.network = SightNetwork(sensor, width=width, beliefs=1 + len(self.depths))
        self._set_up(self.network, lr_schedule)

    def _check_setting(self, name: str, value: Any) -> None:
        super()._check_setting(name, value)
        if name in ("caution", "effort"):
            number_of_at_least(name, value, 0.0)
        if name == "belief" and value not in BELIEFS:
            raise ValueError(f"belief must be one of {', '.join(BELIEFS)}, got {value!r}")
        if name == "depths":
            ascending = list(value) == sorted(set(value)) and all(0.0 <= depth < np.inf for depth in value)
            number = len(getattr(self, "depths", value))
            if not ascending or len(value) != number:
                raise ValueError(f"depths must be {number} of 0 m or more, ascending, got {value!r}")

    def beliefs(self, problem: Problem, sight: Sight) -> list[Problem]:
        """Return a problem with the obstacles that are believed to be there, and with what is seen at each depth."""
        deeper = [thick_points(self.task, sight, depth) for depth in self.depths]
        return [problem, *(problem._replace(obstacles=obstacles) for obstacles in deeper)]

    def inputs(self, beliefs: list[Problem], sight: Sight, actions: Numbers) -> tuple[SightInputs, Numbers]:
        """Return the inputs of the network for actions of shape (B, H, m), and what these are worth, shape (B, H).

        The worth beside the probability of success is `effort` times the reward of an action that succeeds, and
        `caution` times the greatest depth that it clears.
        """
        inputs, reward = sight_inputs(self.task, beliefs, sight, actions, self.instants, self.nearest)
        worth = self.effort * reward
        if self.depths:  # their clearances come after that of the belief
            clear = inputs.plans[..., 1:-1].numpy() * CLEAR >= CLEARANCE_MARGIN
            worth += self.caution * (clear * np.array(self.depths) / self.depths[-1]).max(axis=-1)
        return inputs, worth

    @torch.no_grad()
    def success(self, beliefs: list[Problem], sight: Sight, actions: Numbers) -> tuple[Numbers, Numbers]:
        """Return the probability of success of actions of shape (B, H, m), and what they are worth, shape (B, H)."""
        inputs, worth = self.inputs(beliefs, sight, actions)
        # Geometry is computed on the processor, the network may be on another device.
        return torch.sigmoid(self.network(inputs.to(self.device))).cpu().numpy(), worth

    def rank(self, beliefs: list[Problem], sight: Sight, actions: Numbers) -> Numbers:
        """Return the criterion of decisions for actions: the probability of success and what they are worth."""
        success, worth = self.success(beliefs, sight, actions)
        return np.asarray(success + worth)

    def decide(self, observation: Observation) -> Numbers:
        """Return the best actions, shape (B, m), for parts of B observations."""
        return self.assess(observation)[0]

    def assess(self, observation: Observation, truth: Obstacles | None = None) -> tuple[Float, Float]:
        """Return the best actions of B observations, shape (B, m), and their predicted success, shape (B,)."""
        actions, success = self.best(*self.seen(observation, truth))
        slope, offset = self.network.calibration.tolist()
        return actions, expit(slope * logit(success) + offset)

    def seen(self, observation: Observation, truth: Obstacles | None = None) -> tuple[Problem, Sight]:
        """Return B problems as they are believed to be, and what has been seen.

        Privileged beliefs need the true obstacles of B scenes.
        """
        problem = Problem.of_observation(observation, self.task)  # with the default belief
        sight = Sight.of(observation, self.task)
        if self.belief != DEFAULT_BELIEF:
            problem = problem._replace(obstacles=self.believed(sight, truth))
        return problem, sight

    def believed(self, sight: Sight, truth: Obstacles | None) -> Obstacles:
        """Return the obstacles that are believed to be there.

        Raises:
            ValueError: The belief needs the true obstacles, and they are not given.
        """
        if truth is None and self.belief in PRIVILEGED:
            raise ValueError(f"an agent with the belief {self.belief!r} decides in evaluations only")
        obstacles = no_obstacles(len(sight.ranges)) if truth is None else truth
        return BELIEFS[self.belief](self.task, sight, obstacles)

    def best(self, problem: Problem, sight: Sight) -> tuple[Float, Float]:
        """Return the best actions of B problems, shape (B, m), and probabilities that are too high, shape (B,)."""
        chosen, success = [], []
        for first in range(0, len(problem.start), BLOCK):
            rows = slice(first, first + BLOCK)
            some = sight.take(rows)
            there = problem.take(np.arange(len(problem.start))[rows])
            beliefs = self.beliefs(there, some)
            rank = functools.partial(self.rank, beliefs, some)
            actions, value = self.proposals(len(there.start), rank)
            if self.refine:
                top = np.argsort(-value, axis=1, kind="stable")[:, : self.refine]
                seeds = np.take_along_axis(actions, top[..., None], axis=1)
                refined = refined_actions(self.task, there, seeds)
                actions = np.concatenate((actions, refined), axis=1)
                value = np.concatenate((value, rank(refined)), axis=1)
            best = np.arange(len(value)), self.best_within_reach(there, actions, value)
            chosen.append(actions[best])
            success.append(self.success(beliefs, some, actions[best][:, None])[0][:, 0])
        return np.concatenate(chosen).astype(np.float64), np.concatenate(success).astype(np.float64)


class ViaRank(PlanAlgorithm):
    """Algorithm that learns from labelled plans which movements are clear of obstacles that are seen only in part.

    Args:
        policy: `ViaRankPolicy`.
        env: Environment or vector environment of this package with a sensor, in which an action is a movement, whole or
            revised on the way, and obstacles rest.
        learning_rate: Learning rate, or a function of the remaining progress.
        learning_starts: Number of decisions before the first update.
        batch_size: Scenes that are drawn for each update; where plans are revised, it learns from those of `env`.
        gradient_steps: Updates after each step of all environments.
        explore_candidates: Candidates of each scene during training, of which the best one is executed.
        labels: Plans of each scene that are learned from: the better half are the best candidates, the others random.
        train_freq: Steps of all environments between two rounds of updates.
        policy_kwargs: Arguments of :class:`ViaRankPolicy`; `env` provides the task.
        **kwargs: Arguments that all algorithms of Stable-Baselines3 have, such as `seed`, `device`, `verbose` and
            `tensorboard_log`.

    Raises:
        ValueError: A hyperparameter is out of range, or the environment has no sensor, control steps or moving
            obstacles.

    Example:
        >>> from viapoint.training import ViaRank, ViaVecEnv
        >>> env = ViaVecEnv("viapoint/PlanarSensed-v0", 16, seed=0)
        >>> few = {"candidates": 32, "refinements": 0}
        >>> agent = ViaRank("ViaRankPolicy", env, learning_starts=16, batch_size=16, policy_kwargs=few)
        >>> agent.learn(32).num_timesteps
        32
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"ViaRankPolicy": ViaRankPolicy}
    LARGEST_GRADIENT = 5.0
    policy: ViaRankPolicy

    def __init__(
        self,
        policy: str | type[ViaRankPolicy],
        env: Any,
        learning_rate: float | Schedule = 2e-3,
        *,
        learning_starts: int = 64,
        batch_size: int = 64,
        gradient_steps: int = 3,
        explore_candidates: int = 96,
        labels: int = 24,
        train_freq: int | tuple[int, str] = 1,
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        self.explore_candidates = explore_candidates
        self.labels = labels
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=1,  # it learns from scenes that are new, or under way in the environment
            learning_starts=learning_starts,
            batch_size=batch_size,
            gamma=1.0,
            gradient_steps=gradient_steps,
            buffer=DictReplayBuffer,
            policy_kwargs=policy_kwargs,
            train_freq=train_freq,
            **kwargs,
        )
        if labels > explore_candidates:
            raise ValueError(f"labels must be at most explore_candidates, {explore_candidates}, got {labels}")

    def _task_of(self, env: VecEnv) -> Task:
        task = super()._task_of(env)
        if task.sensor is None or task.moving_obstacles:
            raise ValueError(
                "viarank needs a sensor and obstacles at rest, as in viapoint/PlanarSensed-v0; where the obstacles are "
                "known, viaq learns to place via-points"
            )
        return task

    def _candidates(self, number: int) -> NDArray[np.float32]:
        """Return random candidates of some scenes, shape (number, H, m), of as many as a decision compares."""
        policy = self.policy
        every = candidate_actions(policy.task, policy.all_candidates, replanning=policy.replanning)
        drawn = np.random.uniform(size=(number, len(every))).argsort(axis=1)  # noqa: NPY002 - seeded by SB3
        found = np.array(every[drawn[:, : self.explore_candidates]], np.float32)
        if policy.replanning:
            found[:, 0] = 0.0  # the plan under way
        return found

    def _sample_action(
        self, learning_starts: int, action_noise: Any = None, n_envs: int = 1
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the best of some random candidates; they are only measured, so the belief is the usual one."""
        observation: Any = self._last_obs
        candidates = self._candidates(n_envs)
        policy, task = self.policy, self.policy.task
        sight = Sight.of(observation, task)
        beliefs = policy.beliefs(Problem.of_observation(observation, task), sight)
        value = policy.rank(beliefs, sight, candidates)
        actions = candidates[np.arange(n_envs), value.argmax(axis=1)]
        return actions, actions

    def learn(self, *args: Any, **kwargs: Any) -> Any:
        """Learn, and calibrate the predicted success at the end; the arguments are those of Stable-Baselines3."""
        trained = super().learn(*args, **kwargs)
        self.calibrate()
        return trained

    def _sampled_losses(self, batch_size: int) -> dict[str, Tensor]:
        policy, task = self.policy, self.policy.task
        if policy.replanning:
            truth, believed, sight = self._under_way()
        else:  # new scenes for each update: the network cannot learn them by heart
            seeds = np.random.randint(0, 2**31, size=batch_size)  # noqa: NPY002 - seeded by SB3
            truth, believed, sight = self._drawn(list(seeds))
        # Some plans are labelled: those that the network would choose, and others.
        plans = self._candidates(len(sight.ranges))
        inputs, worth = policy.inputs(policy.beliefs(believed, sight), sight, plans)
        inputs = inputs.to(policy.device)
        chosen = self._chosen(inputs, worth)
        some = np.take_along_axis(plans, chosen[..., None], axis=1)
        # The labels are privileged: they need the true obstacles, which the inputs do not tell.
        clear = _are_clear(task, truth, some)
        if policy.replanning:  # what comes later may still be revised
            clear = 0.5 * (clear + _are_clear(task, truth, some, SOON))
        labels = torch.from_numpy(clear).to(policy.device)
        logits = policy.network(inputs.take(torch.from_numpy(chosen).to(policy.device)))
        return {"loss": functional.binary_cross_entropy_with_logits(logits, labels)}

    def _drawn(self, seeds: list[Any]) -> tuple[Problem, Problem, Sight]:
        """Return new scenes as they are, as they are believed to be, and what is seen of them."""
        scenes = self._sampler([np.random.default_rng(seed) for seed in seeds])
        task = self.policy.task
        truth = Problem.of_scenes(scenes, task)
        sight = Sight.of_scenes(scenes, task)
        return truth, truth._replace(obstacles=self.policy.believed(sight, truth.obstacles)), sight

    def _under_way(self) -> tuple[Problem, Problem, Sight]:
        """Return the scenes of the environment and what has been seen of them so far, as :meth:`_drawn` does."""
        assert self.env is not None
        observation: Any = self._last_obs
        every = self.env.get_attr("scenes")
        # A vector environment of this package has those of all copies, others have one each.
        scenes = every[0] if len(every[0].start) == self.n_envs else Scenes.together(every)
        believed, sight = self.policy.seen(observation, scenes.obstacles)
        return believed._replace(obstacles=scenes.obstacles), believed, sight

    @torch.no_grad()
    def _chosen(self, inputs: SightInputs, worth: NDArray[Any]) -> NDArray[np.int64]:
        """Return the plans to learn from: the best ones by the present network, and others, shape (B, labels)."""
        value = torch.sigmoid(self.policy.network(inputs)).cpu().numpy() + worth
        order = np.argsort(-value, axis=1)
        best = order[:, : self.labels // 2]
        others = np.random.uniform(size=(len(order), order.shape[1] - best.shape[1])).argsort(axis=1)  # noqa: NPY002
        others = best.shape[1] + others[:, : self.labels - best.shape[1]]
        return np.concatenate((best, np.take_along_axis(order, others, axis=1)), axis=1).astype(np.int64)

    def calibrate(self) -> None:
        """Fit predicted success to what geometry says of the chosen plans in scenes that are drawn, always the same.

        The choice of plans does not change. The two numbers are those of J. Platt, Probabilistic outputs for support
        vector machines, 1999.
        """
        policy, task = self.policy, self.policy.task
        policy.set_training_mode(False)
        chances, labels = [], []
        for first in range(0, CALIBRATION_SCENES, BLOCK):
            truth, believed, sight = self._drawn([(CALIBRATION, first + each) for each in range(BLOCK)])
            actions, success = policy.best(believed, sight)
            # In hand space, exact geometry keeps room at a straight elbow that successful movements need not keep.
            exact = not task.space.of_hand
            clearance = plan_clearances(task, truth, actions[:, None], 0.0, 0.0, exact=exact)[:, 0]
            chances.append(logit(success))
            labels.append(clearance >= 0.0)
        x, y = np.concatenate(chances), np.concatenate(labels)

        def loss(numbers: Float) -> float:
            z = numbers[0] * x + numbers[1]
            return float(np.mean(np.logaddexp(0.0, z) - y * z) + 1e-3 * (numbers[0] - 1.0) ** 2)

        slope, offset = minimize(loss, np.array([1.0, 0.0]), bounds=((0.05, 20.0), (-20.0, 20.0))).x
        policy.network.calibration.copy_(torch.tensor([slope, offset]))

    @functools.cached_property
    def _sampler(self) -> SceneSampler:
        """Sampler of the scenes that are learned from."""
        return self.policy.task.sampler()


ALGORITHMS["viarank"] = ViaRank


class SightInputs(NamedTuple):
    """Inputs of the network for H movements in each of B scenes."""

    # Ranges relative to the greatest, hits, and places of the pixels, for all looks, shape (M, 4, rows, columns)
    image: Tensor
    pixel: Tensor  # Pixels of all images in whose direction P places lie, shape (B, H, P), int64
    places: Tensor  # Other inputs of these places, shape (B, H, P, FEATURES)
    plans: Tensor  # Inputs of whole movements: clearance by each of N beliefs, reach, shape (B, H, N + 1)

    def take(self, chosen: Tensor) -> SightInputs:
        """Return the inputs of some of the movements, by indices of shape (B, h)."""
        scenes = torch.arange(len(chosen), device=chosen.device)[:, None]
        return SightInputs(
            self.image, self.pixel[scenes, chosen], self.places[scenes, chosen], self.plans[scenes, chosen]
        )

    def to(self, device: torch.device) -> SightInputs:
        """Return the same inputs on a device."""
        return SightInputs(*(each.to(device) for each in self))


def sight_inputs(
    task: Task, beliefs: list[Problem], sight: Sight, actions: Numbers, instants: int, nearest: int
) -> tuple[SightInputs, Single]:
    """Return the inputs of the network for actions, shape (B, H, m), and the rewards of those that succeed, (B, H).

    The problems differ in the obstacles that are believed to be there. Of all places at some instants, the network sees
    the ones that are nearest to surfaces, or deepest behind them.
    """
    problem = beliefs[0]
    sensor = task.sensor
    assert sensor is not None
    moves = moves_of(task, problem, actions)
    places = places_of(task, problem, moves, sight, instants_of(task, instants))
    number, plans = moves.duration.shape
    depth = places.depth(sight).reshape(number, plans, -1)
    pixel = places.ray.reshape(number, plans, -1)
    radius = np.broadcast_to(places.radius, places.ray.shape).reshape(number, plans, -1)
    distance = places.distance.reshape(number, plans, -1)
    # A place matters if it is behind, or hardly before, one of the surfaces around its pixel.
    around = _nearest_around(sensor, sight)
    beyond = np.take_along_axis(around, np.maximum(pixel, 0).reshape(number, -1), axis=1)
    beyond = distance + radius - beyond.reshape(distance.shape)
    beyond = np.where(pixel == OUT_OF_VIEW, -SHALLOW, beyond)
    nearest = min(nearest, beyond.shape[-1])
    some = np.argpartition(-beyond, nearest - 1, axis=-1)[..., :nearest]

    def chosen(values: Any) -> Any:
        return np.take_along_axis(values, some, axis=-1)

    centre = places.centre.reshape(number, plans, -1, 3)
    centre = np.take_along_axis(centre, some[..., None], axis=2)
    depth, pixel = chosen(depth), chosen(pixel)
    inputs = (
        chosen(distance),
        np.clip(depth, -DEEP, DEEP) / DEEP,
        np.clip(depth, -SHALLOW, SHALLOW) / SHALLOW,
        np.clip(chosen(beyond), -SHALLOW, SHALLOW) / SHALLOW,
        20.0 * chosen(radius),
        pixel == OUT_OF_VIEW,
        *np.moveaxis(centre, -1, 0),
    )
    clearances = [plan_clearances(task, each, actions, CLEAR, -CLEAR) for each in beliefs]
    relative = [np.clip(each / CLEAR, -1.0, 1.0) for each in clearances]
    plans_in = np.stack((*relative, places.inside), axis=-1)
    # Pixels are numbered through all looks that were made.
    made = sight.made
    image = (np.cumsum(made) - 1).reshape(made.shape)
    look = np.maximum(pixel, 0) // sensor.n_rays
    of_image = np.take_along_axis(image, look.reshape(number, -1), axis=1).reshape(look.shape)
    found = SightInputs(
        _image(sensor, sight)[torch.from_numpy(made.ravel())],
        torch.from_numpy(of_image * sensor.n_rays + np.maximum(pixel, 0) % sensor.n_rays),
        torch.from_numpy(np.stack(inputs, axis=-1).astype(np.float32)),
        torch.from_numpy(plans_in.astype(np.float32)),
    )
    return found, _worth(task, problem, actions, moves).astype(np.float32)


def _are_clear(task: Task, truth: Problem, actions: Numbers, until: float = np.inf) -> Single:
    """Return 1 for plans of shape (B, H, m) that are clear of the true obstacles until a time, [s], 0 for others."""
    least = CLEARANCE_MARGIN
    return (plan_clearances(task, truth, actions, least, least, until=until) >= least).astype(np.float32)


def _worth(task: Task, problem: Problem, actions: Numbers, moves: Moves) -> Numbers:
    """Return the rewards of plans that succeed, shape (B, H); an action of zero, which keeps the plan, gains KEEP."""
    worth = worth_of(task, problem, moves)
    if problem.remaining is not None:
        worth = worth + KEEP * (actions == 0.0).all(axis=-1)
    return worth


def _nearest_around(sensor: Sensor, sight: Sight) -> Single:
    """Return the least range around each pixel of each look, shape (B, R), [m]."""
    image = sight.ranges.reshape(-1, sensor.rows, sensor.columns)
    size = 1, min(NEIGHBOURS, sensor.rows), NEIGHBOURS
    return np.asarray(minimum_filter(image, size, mode="nearest").reshape(sight.ranges.shape))


def _image(sensor: Sensor, sight: Sight) -> Tensor:
    """Return the readings as images, one for each look, see :class:`SightInputs`."""
    shape = -1, sensor.rows, sensor.columns
    ranges = (sight.ranges / sensor.range).reshape(shape)
    row, column = np.meshgrid(
        np.linspace(-1.0, 1.0, sensor.rows), np.linspace(-1.0, 1.0, sensor.columns), indexing="ij"
    )
    channels = (
        ranges,
        sight.hit.reshape(shape),
        np.broadcast_to(row, ranges.shape),
        np.broadcast_to(column, ranges.shape),
    )
    return torch.from_numpy(np.stack(channels, axis=1).astype(np.float32))


class SightNetwork(nn.Module):
    """Network that predicts the logit of success of movements from what a sensor sees.

    The readings are an image of one row or several. A convolutional network turns each pixel into `width` features,
    which may hold what usually stands behind such a front. A movement is a set of places of the arm's spheres. Inputs
    of one network for all places are the features of the pixel in whose direction a place lies, its distance, and its
    depth behind the surface (an implicit decoder, as in L. Mescheder et al., Occupancy networks, 2019). The greatest
    and the mean of its `width` outputs (C. R. Qi et al., PointNet, 2017), and the clearances that are computed with
    some beliefs, tell the logit.
    """

    DILATIONS = (2, 4, 8, 1)

    def __init__(self, sensor: Sensor, *, width: int, beliefs: int = 1) -> None:
        super().__init__()
        self.rays, self.columns = sensor.n_rays, sensor.columns
        self.stride = 1 if sensor.rows == 1 else 2
        size = (1, 5) if sensor.rows == 1 else (3, 3)
        margin = size[0] // 2, size[1] // 2
        self.first = nn.Conv2d(4, width, size, padding=margin, stride=self.stride)
        layers = []
        for dilation in self.DILATIONS:
            padding = margin[0] * dilation, margin[1] * dilation
            layers.append(nn.Conv2d(width, width, size, padding=padding, dilation=dilation))
        self.layers = nn.ModuleList(layers)
        # The first layer for places is a sum of two: that of the pixels is computed once for each pixel.
        self.of_pixel = nn.Conv2d(width, 2 * width, 1)
        self.of_place = nn.Linear(FEATURES, 2 * width, bias=False)
        self.each = nn.Sequential(nn.ReLU(), nn.Linear(2 * width, width), nn.ReLU())
        self.last = nn.Sequential(
            nn.Linear(2 * width + beliefs + 1, 2 * width), nn.ReLU(), nn.Linear(2 * width, 1)
        )
        self.calibration: Tensor
        self.register_buffer("calibration", torch.tensor([1.0, 0.0]))
        """Slope and offset of the logit of the plan that is chosen; it is the best of many, and its logit too high."""

    def forward(self, inputs: SightInputs) -> Tensor:
        """Return the logits of success, shape (B, H)."""
        image = functional.relu(self.first(inputs.image))
        for layer in self.layers:
            image = image + functional.relu(layer(image))
        image = self.of_pixel(image)
        rows, columns = image.shape[-2:]
        features = image.flatten(2).transpose(1, 2).flatten(0, 1)  # (all pixels, features)
        ray = inputs.pixel % self.rays
        row = ray // self.columns // self.stride
        column = ray % self.columns // self.stride
        there = functional.embedding((inputs.pixel // self.rays * rows + row) * columns + column, features)
        hidden = self.each(there + self.of_place(inputs.places))
        pooled = torch.cat((hidden.amax(dim=2), hidden.mean(dim=2), inputs.plans), dim=-1)
        logits: Tensor = self.last(pooled)[..., 0]
        return logits
