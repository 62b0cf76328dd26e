"""Policy of viaq: candidates, a critic that orders them, and exact checks of the most promising ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor, nn

from viapoint.envs.actions.via_points import frame
from viapoint.envs.arms import ARMS
from viapoint.envs.mdp.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.envs.mdp.task import Task
from viapoint.envs.sim.executor import SETTLING
from viapoint.training.algorithms.critic import PairMinimum, Parts, Poses, bodies_of, cut_obstacles, dense
from viapoint.training.search.candidates import candidate_actions, normal_steps
from viapoint.training.search.geometry_search import worth_of_plans
from viapoint.training.search.plan_checks import CLEARANCE_MARGIN, REACH_MARGIN
from viapoint.training.search.planned_movements import Observation, direction, is_replanning, part, planned

Form = Literal["places", "action"]
Pooling = Literal["minimum", "sum"]
Numbers = NDArray[np.floating[Any]]

EFFORT = 4
"""Numbers that tell the effort of a plan: log jerk, duration, log duration, and time to spare where that is limited."""
IN_TIME = 20.0
"""Logits of success for each second to spare, where time is limited, at the beginning."""
UNLIKELY = 10.0
"""Merit that is taken off where success is unlikely: more than the range of Q."""
KEEP = 0.1
"""Difference of Q for which a plan under way is revised."""
BEST = 8
"""Number of the best candidates that are refined in each round."""
SPREAD = 0.15
"""Standard deviation of the first round of refinement; each further round halves it."""
CHECKED_INSTANTS = 16
"""Instants of a plan that are enough to rank it where the best plans are checked exactly."""
PLACES = 1 << 16
"""Places of plans that are computed together, so that temporary arrays stay in the cache."""


class Values(NamedTuple):
    """Predictions of the critic for H plans in each of B scenes, shape (B, H) each."""

    margin: Tensor
    """Predicted clearance, [m]."""
    clear: Tensor
    """Logit of the probability that nothing is touched."""
    arrives: Tensor
    """Logit of the probability of success where nothing is touched."""
    clearance: Tensor
    """Predicted clearance term of the reward."""
    rest: Tensor
    """Predicted sum of the terms for smoothness and duration."""


class SceneInputs(NamedTuple):
    """Inputs of the critic that belong to B scenes."""

    ends: Tensor
    """Start, goal and, on the way, the present motion, shape (B, E)."""
    rows: Tensor
    """Obstacles in the frame of start and goal, shape (B, n, F)."""
    present: Tensor
    """Shape (B, n), bool."""
    parts: Parts | None
    """Parts of the obstacles; None where the critic takes the action itself."""


class PlanInputs(NamedTuple):
    """Inputs of the critic: H plans in each of B scenes."""

    scene: SceneInputs
    actions: Tensor
    """Shape (B, H, m)."""
    effort: Tensor
    """Shape (B, H, EFFORT)."""
    reach: Tensor
    """Least distance of the hand inside the arm's reach, shape (B, H), [m]; negative where the plan leaves it."""
    poses: Poses | None
    """Planned poses of the arm's bodies; None where the critic takes the action itself."""
    until: Tensor | None = None
    """Time after which contact does not count, shape (B, H), [s]: a plan may have been carried out in part."""


class _Saturated(torch.autograd.Function):
    """Clamp whose gradient pulls values back into the range, but never pushes them farther out."""

    @staticmethod
    def forward(context: Any, values: Tensor, low: float, high: float) -> Tensor:
        context.save_for_backward(values)
        context.bounds = low, high
        return values.clamp(low, high)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (values,), (low, high) = context.saved_tensors, context.bounds
        outwards = ((values > high) & (gradient < 0.0)) | ((values < low) & (gradient > 0.0))
        return torch.where(outwards, 0.0, gradient), None, None


class ViaQCritic(nn.Module):
    """Value of plans: effort, and success as it follows from the least margin of all pairs.

    The margin m(s, a) is learned (see :mod:`viapoint.training.algorithms.critic`); the reach r(a), the least distance
    of the planned hand inside the arm's reach, belongs to the plan and is computed:

        P(clear) = sigmoid(k m + b),  P(success) = P(clear) sigmoid(l r + d + c(s, a)),
        Q(s, a) = w_s P(success) - w_c (1 - P(clear)) - w_g (1 - P(success)) + w_m clip(m) + e(s, a)

    Args:
        task: Of the environment.
        replanning: Whether episodes are several decisions.
        form: Input of the pair networks: the arm's planned `places`, or the `action` itself.
        pooling: `minimum` over obstacles, or `sum` of their features (Deep Sets).
        heads: Networks for the action form, of which the minimum is taken.
        width: Of the hidden layers of the pair networks.
    """

    def __init__(
        self, task: Task, *, replanning: bool, form: Form, pooling: Pooling, heads: int, width: int
    ) -> None:
        super().__init__()
        d, size = task.arm.dimension, task.action.size
        ends = (4 * d + 3) if replanning else (2 * d + 1)
        row = (3 * d + 1) if replanning else (2 * d + 1)
        self.form, self.pooling, self.replanning = form, pooling, replanning
        self.pairs: Any = None
        if form == "places":
            self.pairs = PairMinimum(d, bodies_of(task), width)
        else:
            outputs = heads if pooling == "minimum" else width
            self.pairs = dense(ends + row + size, width, width, outputs)
            self.pooled = dense(width + ends + size, width, 1) if pooling == "sum" else None
        self.reach = nn.Parameter(torch.tensor([5.0, 0.0]))
        """Logarithm of l in 1/m, and d."""
        self.rest = dense(ends + EFFORT + (0 if replanning else size), 64, 64, 2)
        for parameter in self.rest[-1].parameters():
            nn.init.zeros_(parameter)
        self.linear = nn.Parameter(torch.tensor([-task.weights.smoothness, -task.weights.duration, 0.0, 0.0]))
        """Weights of the numbers of effort: at the beginning those of the task."""
        self.slope = nn.Parameter(torch.tensor([6.0, 0.0]))
        """Logarithm of k in 1/m, and b."""
        weights = task.weights
        self.scales = nn.Parameter(
            torch.tensor([weights.success, weights.collision, weights.goal_error, weights.clearance])
        )
        """w_s, w_c, w_g and w_m: at the beginning the environment's, then adapted to the rewards."""

    def forward(self, inputs: PlanInputs) -> Values:
        """Return the predictions for each plan."""
        ends = inputs.scene.ends[:, None].expand(-1, inputs.actions.shape[1], -1)
        plan = torch.cat((ends, inputs.actions), dim=-1)
        if self.form == "places":
            margin = self.pairs(inputs.poses, inputs.scene.parts, inputs.until)
        else:
            margin = self._of_actions(plan, inputs.scene)
        reach = inputs.reach.clamp(-0.1, 0.1) * torch.exp(self.reach[0]) + self.reach[1]
        # On the way, keeping a plan and making the same plan anew are worth the same: the action itself is not seen.
        rest = self.rest(torch.cat((ends if self.replanning else plan, inputs.effort), dim=-1))
        low, high = CLEARANCE_RANGE
        clip: Any = _Saturated.apply
        clearance = clip(margin, low, high) * (self.scales[3] / CLEARANCE_UNIT)
        return Values(
            margin,
            margin * torch.exp(self.slope[0]) + self.slope[1],
            reach + rest[..., 1] + IN_TIME * inputs.effort[..., 3],
            clearance,
            rest[..., 0] + inputs.effort @ self.linear,
        )

    def value(self, values: Values) -> Tensor:
        """Return Q, shape (B, H)."""
        clear = torch.sigmoid(values.clear)
        success = clear * torch.sigmoid(values.arrives)
        won, lost, missed, _ = self.scales
        total: Tensor = won * success - lost * (1.0 - clear) - missed * (1.0 - success)
        return total + values.clearance + values.rest

    def merit(self, values: Values) -> Tensor:
        """Return Q where success is more likely than not, elsewhere less than any such Q, shape (B, H).

        Where nothing is likely to succeed, Q prefers plans out of reach, which touch nothing as they are not carried
        out. The probability of success counts there instead.
        """
        success = torch.sigmoid(values.clear) * torch.sigmoid(values.arrives)
        merit: Tensor = torch.where(success > 0.5, self.value(values), success - UNLIKELY)
        return merit

    def _of_actions(self, plan: Tensor, scene: SceneInputs) -> Tensor:
        """Return the margin from actions and obstacles, shape (B, H), [m]."""
        plans, rows = plan.shape[1], scene.rows.shape[1]
        pairs = torch.cat(
            (
                plan[:, :, None].expand(-1, -1, rows, -1),
                scene.rows[:, None].expand(-1, plans, -1, -1),
            ),
            dim=-1,
        )
        values = self.pairs(pairs)
        present = scene.present[:, None, :, None]
        if self.pooled is not None:
            summed = (values.relu() * present).sum(dim=2)
            pooled: Tensor = 0.05 * self.pooled(torch.cat((summed, plan), dim=-1))[..., 0]
            return pooled
        far = torch.where(present, values, torch.full_like(values, 20.0))
        margin: Tensor = 0.05 * far.amin(dim=(2, 3)) if rows else torch.ones_like(plan[..., 0])
        return margin


class ViaQPolicy(BasePolicy):
    """Choose the best of many candidates by a critic and, if wanted, by exact checks of the most promising ones.

    Args:
        observation_space: Of the environment.
        action_space: Of the environment.
        lr_schedule: Learning rate against the progress that remains.
        task: The environment's task as plain values, see :meth:`viapoint.envs.mdp.task.Task.as_dict`.
        form: Input of the critic's pair networks: `places` or `action`.
        pooling: `minimum` over obstacles, or `sum` (only with the form `action`).
        heads: Networks for the action form, of which the minimum is taken.
        width: Of the hidden layers of the pair networks; if not given, 32 for planned places where every link must
            clear, 16 where the hand alone must, and 160 for the action itself.
        instants: Instants of a plan at which the arm's planned places are taken; if not given, 16 where every link
            must clear, and 32 where the hand alone must.
        candidates: Actions that are spread evenly over the action space (Sobol points).
        refinements: Rounds of candidates around the best ones.
        per_refinement: Candidates of each round.
        checks: How many of the most promising candidates are checked by exact geometry; 0 for none.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Any,
        *,
        task: Mapping[str, Any],
        form: Form = "places",
        pooling: Pooling = "minimum",
        heads: int = 1,
        width: int | None = None,
        instants: int | None = None,
        candidates: int = 256,
        refinements: int = 2,
        per_refinement: int = 64,
        checks: int = 0,
        optimizer_class: type[torch.optim.Optimizer] = torch.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )
        self.task = Task.from_dict(task, ARMS)
        self.replanning = is_replanning(observation_space.spaces)
        self.candidates, self.refinements, self.per_refinement = candidates, refinements, per_refinement
        self.checks = checks
        self.instants = instants or (16 if self.task.whole_arm else 32)
        self.shares = instants_of(self.instants)
        width = width or (160 if form == "action" else 32 if self.task.whole_arm else 16)
        self.settings: dict[str, Any] = {"form": form, "pooling": pooling, "heads": heads, "width": width}
        self.critic = self.make_critic()
        self.critic_target = self.make_critic() if self.replanning else None
        if self.critic_target is not None:
            self.critic_target.load_state_dict(self.critic.state_dict())
            self.critic_target.requires_grad_(False)
        self.optimizer = self.optimizer_class(
            self.critic.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def make_critic(self) -> ViaQCritic:
        """Return a new critic for the task."""
        return ViaQCritic(self.task, replanning=self.replanning, **self.settings)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            **self.settings,
            "task": self.task.as_dict(),
            "lr_schedule": self._dummy_schedule,
            "instants": self.instants,
            "candidates": self.candidates,
            "refinements": self.refinements,
            "per_refinement": self.per_refinement,
            "checks": self.checks,
        }

    def scene(self, observation: Observation) -> SceneInputs:
        """Return what the critic sees of B scenes, whatever the plan."""
        ends, rows, present = seen_from_line(observation, self.task)
        parts = None
        if self.settings["form"] == "places" and "obstacles" in observation:
            obstacles = self.task.observation.obstacles(observation["obstacles"])
            whole = np.concatenate(
                (obstacles.centre, obstacles.half_axis, obstacles.radius[..., None]), axis=-1
            )
            velocity = observation.get("obstacle_velocities")
            moving = None if velocity is None else velocity.reshape(obstacles.centre.shape)
            parts = cut_obstacles(whole, obstacles.present > 0.5, moving)
        elif self.settings["form"] == "places":
            none = np.zeros((len(ends), 1, 2 * self.task.arm.dimension + 1))
            parts = cut_obstacles(none, np.zeros((len(ends), 1), dtype=bool))
        return SceneInputs(_tensor(ends), _tensor(rows), torch.from_numpy(present), parts)

    def inputs(
        self,
        observation: Observation,
        actions: Numbers,
        scene: SceneInputs | None = None,
        shares: Numbers | None = None,
    ) -> PlanInputs:
        """Return the critic's inputs for H actions in each of B scenes.

        Args:
            observation: Parts of B observations, shape (B, .) each.
            actions: Shape (B, H, m).
            scene: Inputs that belong to the scenes; computed if not given.
            shares: Shares of the duration at which the arm's planned places are taken; those of training if not given.
        """
        shares = self.shares if shares is None else shares
        moves = planned(observation, actions, self.task, shares)
        relative = moves.duration / self.task.action.centre_duration
        spare = np.zeros_like(relative)
        if self.replanning:
            spare = np.clip(observation["time_left"] - moves.duration - SETTLING, -0.2, 0.2)
        effort = np.stack((moves.effort, relative - 1.0, np.log(relative), spare), axis=-1)
        reach = np.asarray(self.task.arm.reach_margin(moves.path)).min(axis=-1)
        poses = None
        if self.settings["form"] == "places":
            poses = planned_poses(self.task, moves.path, moves.duration[..., None] * shares)
        scene = scene or self.scene(observation)
        return PlanInputs(scene, _tensor(actions), _tensor(effort), _tensor(reach), poses)

    @torch.no_grad()
    def values(
        self,
        observation: Observation,
        actions: Numbers,
        scene: SceneInputs | None = None,
        shares: Numbers | None = None,
    ) -> Numbers:
        """Return the critic's merit of H actions in each of B scenes, shape (B, H): Q, but where success is unlikely.

        On the way the first action, which keeps the plan, is worth KEEP more: a plan is not revised for less.
        """
        values: Numbers = self.critic.merit(self.critic(self.inputs(observation, actions, scene, shares))).numpy()
        if self.replanning:
            values[:, 0] += np.where((actions[:, 0] == 0.0).all(axis=-1), KEEP, 0.0)
        return values

    def propose(self, observation: Observation) -> tuple[Numbers, Numbers]:
        """Return candidates, shape (B, N, m), the first of them the zero action, and their merits, shape (B, N)."""
        block = max(PLACES // (self.candidates * self.instants), 1)
        number = len(observation["hand"])
        if number > block:
            pieces = [self.propose(part(observation, slice(i, i + block))) for i in range(0, number, block)]
            actions, values = (np.concatenate(each) for each in zip(*pieces, strict=True))
            return actions, values
        spread = candidate_actions(self.task, self.candidates, replanning=self.replanning)
        actions, scene = np.broadcast_to(spread, (number, *spread.shape)), self.scene(observation)
        shares = self.shares[:: max(self.instants // CHECKED_INSTANTS, 1)] if self.checks else self.shares
        values = self.values(observation, actions, scene, shares)
        for each in range(self.refinements):
            near = self._near(actions, values, each)
            actions = np.concatenate((actions, near), axis=1)
            values = np.concatenate((values, self.values(observation, near, scene, shares)), axis=1)
        return actions, values

    def _near(self, actions: Numbers, values: Numbers, each: int) -> Numbers:
        """Return candidates around the best ones, shape (B, per_refinement, m)."""
        best = min(BEST, actions.shape[1])
        top = np.argpartition(-values, best - 1, axis=1)[:, :best]
        chosen = np.take_along_axis(actions, top[..., None], axis=1)
        steps = normal_steps(self.per_refinement, self.task.action.size, each) * (SPREAD * 0.5**each)
        around = chosen[:, np.arange(self.per_refinement) % best]
        return np.clip(around + steps, -1.0, 1.0).astype(np.float32)

    def decide(self, observation: Observation) -> Numbers:
        """Return the chosen actions, shape (B, m)."""
        actions, values = self.propose(observation)
        rows = np.arange(len(actions))
        if not self.checks:
            return np.asarray(actions[rows, values.argmax(axis=1)])
        checked = np.take_along_axis(actions, self._promising(values)[..., None], axis=1)
        worth = worth_of_plans(observation, checked, self.task, (CLEARANCE_MARGIN, REACH_MARGIN))
        return np.asarray(checked[rows, worth.argmax(axis=1)])

    def _promising(self, values: Numbers) -> NDArray[np.intp]:
        """Return indices of the candidates to check, shape (B, checks), from their Q, shape (B, N).

        Refined candidates resemble each other, so at least half are the best of those that are spread evenly.
        """
        if self.replanning:  # keeping the plan is always the first of them
            values = np.concatenate((np.full_like(values[:, :1], np.inf), values[:, 1:]), axis=1)
        count = min(self.checks, values.shape[1])
        refined = min(count // 2, values.shape[1] - self.candidates)
        spread = min(count - refined, self.candidates)
        first = np.argsort(-values[:, : self.candidates], axis=1)[:, :spread]
        last = np.argsort(-values[:, self.candidates :], axis=1)[:, :refined]
        return np.concatenate((first, last + self.candidates), axis=1)

    def forward(self, observation: Any, deterministic: bool = True) -> Tensor:
        """Return the chosen actions, shape (B, m)."""
        return self._predict(observation, deterministic)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        arrays = {name: each.cpu().numpy() for name, each in observation.items()}
        return torch.from_numpy(np.ascontiguousarray(self.decide(arrays), dtype=np.float32))

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """Return actions for one observation or a batch, as SB3's policies do.

        Raises:
            ValueError: The observation is not a dict with the parts of the observation space, is not finite, or the
                hand is in the goal already, to which there is no movement.
        """
        if not isinstance(observation, tuple):
            self._check_parts(observation)
        return super().predict(observation, state, *args, **kwargs)

    def _check_parts(self, observation: Any) -> None:
        space: Any = self.observation_space
        wanted = ", ".join(space.spaces)
        if not isinstance(observation, dict):
            raise ValueError(f"observation must be a dict of {wanted}; got {type(observation).__name__}")
        if observation.keys() != space.spaces.keys():
            raise ValueError(
                f"observation must have the parts {wanted}; got {', '.join(map(str, observation))}"
            )
        for name, each in observation.items():
            if not np.isfinite(np.asarray(each)).all():
                raise ValueError(f"observation must be finite; {name} is {np.asarray(each)}")
        apart = np.asarray(observation["goal"]) != np.asarray(observation["hand"])
        if not self.replanning and not apart.any(axis=-1).all():
            raise ValueError("hand and goal must be apart: where they are the same there is no movement")


def planned_poses(task: Task, path: Numbers, time: Numbers) -> Poses:
    """Return the planned poses of the arm's bodies for paths of the hand, shape (B, H, T, D), [m]."""
    if not task.whole_arm:
        return Poses(_tensor(np.moveaxis(path, -1, 0)[None]), None, _tensor(time))
    links = np.asarray(task.arm.links(task.arm.inverse_kinematics(path)))
    first, last = (np.moveaxis(links[..., end, :], (-2, -1), (0, 1)) for end in (0, 1))
    axis = last - first
    axis = axis / np.sqrt((axis * axis).sum(axis=1, keepdims=True))
    return Poses(_tensor(0.5 * (first + last)), _tensor(axis), _tensor(time))


def seen_from_line(observation: Observation, task: Task) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    """Return ends, obstacle rows and their presence in the frame of the line from hand to goal.

    Returns:
        Start, goal, distance and, on the way, the present motion, shape (B, E); rows of centre, half-axis, radius and,
        on the way, velocity, shape (B, n, F); presence, shape (B, n). Numbers are of order one.
    """
    start, goal, line = observation["hand"], observation["goal"], direction(observation)
    axes = np.stack(frame(line), axis=-1)
    ends = [2.0 * start, 2.0 * goal, 2.0 * np.sqrt((line * line).sum(axis=-1, keepdims=True))]
    if is_replanning(observation):
        for name, scale in (("velocity", 1.0), ("acceleration", 0.1)):
            ends.append((observation[name][:, None] @ axes)[:, 0] * scale)
        ends += [observation["remaining"], observation["time_left"]]
    together = np.concatenate(ends, axis=-1)
    width = 2 * task.arm.dimension + 1 + (task.arm.dimension if is_replanning(observation) else 0)
    if "obstacles" not in observation:
        return together, np.zeros((len(start), 1, width)), np.zeros((len(start), 1), dtype=bool)
    rows = task.observation.obstacles(observation["obstacles"])
    centre = (rows.centre - 0.5 * (start + goal)[:, None]) @ axes
    half = rows.half_axis @ axes
    half = np.where(half[..., 1:2] < 0.0, -half, half)  # a capsule has no sense of direction
    seen = [5.0 * centre, 5.0 * half, 5.0 * rows.radius[..., None]]
    if is_replanning(observation):
        seen.append(3.0 * observation["obstacle_velocities"].reshape(centre.shape) @ axes)
    return together, np.concatenate(seen, axis=-1), np.asarray(rows.present > 0.5)


def instants_of(number: int) -> NDArray[np.float32]:
    """Return shares of a movement's duration, shape (number,), closer together where the hand is fast."""
    share = np.linspace(0.0, 1.0, 2001)
    gone = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return np.interp((np.arange(number) + 0.5) / number, 0.7 * gone + 0.3 * share, share).astype(np.float32)


def _tensor(values: Any) -> Tensor:
    """Return a tensor of single precision; constants that many calls share are copied."""
    return torch.from_numpy(np.require(values, dtype=np.float32, requirements=["C", "W"]))
