"""Critic of viaq: predictions of success, contact, clearance and effort for plans, and their value Q."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from viapoint.envs.geometry.rows import CAPSULES
from viapoint.envs.mdp.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.training.agents.obstacle_parts import Parts, Poses, ShapePairs
from viapoint.training.agents.pair_networks import PairMinimum, dense, networks_of

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task

EFFORT = 4
"""Number of effort features: log jerk, duration, log duration, and spare time if time is limited."""
IN_TIME = 20.0
"""Logits of arrival for each second of spare time in tasks with a time limit, [1/s]."""
UNLIKELY = 10.0
"""Penalty on the merit of plans that are unlikely to succeed; larger than the range of Q."""


class Values(NamedTuple):
    """Predictions of the critic for H plans in each of B scenes, shape (B, H) each."""

    margin: Tensor
    """Predicted clearance, [m]."""
    no_contact: Tensor
    """Logit of the probability of no contact."""
    arrival: Tensor
    """Logit of the probability of success given no contact."""
    clearance: Tensor
    """Predicted clearance term of the reward."""
    effort_terms: Tensor
    """Predicted sum of the terms for smoothness and duration."""


class SceneInputs(NamedTuple):
    """Inputs of the critic that depend on B scenes only."""

    ends: Tensor
    """Start, goal and, in replanning tasks, the present motion, shape (B, E)."""
    parts: Parts
    """Parts of the obstacles."""


class PlanInputs(NamedTuple):
    """Inputs of the critic for H plans in each of B scenes."""

    scene: SceneInputs
    actions: Tensor
    """Shape (B, H, m)."""
    effort: Tensor
    """Shape (B, H, EFFORT)."""
    reach: Tensor
    """Minimum reach margin of the planned hand, shape (B, H), [m]; negative if the plan leaves the reach of the arm."""
    poses: Poses
    """Planned poses of the arm."""
    until: Tensor | None = None
    """Time after which contact does not count, shape (B, H), [s]; None if plans are executed to their end."""


class _Saturated(torch.autograd.Function):
    """Clamp whose gradient can move values back into the range, but not farther out of it."""

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
    """Network that predicts the value of plans from their margin, reach and effort.

    The margin m(s, a) is learned (see :mod:`viapoint.training.agents.pair_networks`). The reach margin r(a) of the
    planned hand does not depend on obstacles and is computed:

        P(clear) = sigmoid(k m + b),  P(success) = P(clear) sigmoid(l r + d + c(s, a)),
        Q(s, a) = w_s P(success) - w_c (1 - P(clear)) - w_g (1 - P(success)) + w_m clip(m) + e(s, a)

    Args:
        task: Task of the environment.
        replanning: True if an episode consists of several decisions.
        width: Width of the hidden layers of the pair networks.
    """

    def __init__(self, task: Task, *, replanning: bool, width: int) -> None:
        super().__init__()
        d, size = task.arm.dimension, task.action.size
        ends = (4 * d + 3) if replanning else (2 * d + 1)
        self.replanning = replanning
        networks, shapes = networks_of(task), task.scenes.shapes
        geometry = None if shapes == CAPSULES else ShapePairs(len(shapes), bool(networks))
        self.pairs = PairMinimum(d, networks, width, geometry=geometry)
        self.reach = nn.Parameter(torch.tensor([5.0, 0.0]))
        """Logarithm of l [1/m], and d."""
        self.rest = dense(ends + EFFORT + (0 if replanning else size), 64, 64, 2)
        for parameter in self.rest[-1].parameters():
            nn.init.zeros_(parameter)
        self.linear = nn.Parameter(torch.tensor([-task.weights.smoothness, -task.weights.duration, 0.0, 0.0]))
        """Weights of the effort features, initialised from the reward weights."""
        self.slope = nn.Parameter(torch.tensor([6.0, 0.0]))
        """Logarithm of k [1/m], and b."""
        weights = task.weights
        self.scales = nn.Parameter(
            torch.tensor([weights.success, weights.collision, weights.goal_error, weights.clearance])
        )
        """w_s, w_c, w_g and w_m, initialised from the reward weights and adapted to the rewards."""

    def forward(self, inputs: PlanInputs, *, near: float | None = None) -> Values:
        """Return the predictions for each plan.

        Args:
            inputs: Inputs of the plans.
            near: Gap up to which pairs are evaluated, without gradients, see :meth:`PairMinimum.of_near_pairs`, [m];
                None for all pairs.
        """
        if near is None:
            margin = self.pairs(inputs.poses, inputs.scene.parts, inputs.until)
        else:
            margin = self.pairs.of_near_pairs(inputs.poses, inputs.scene.parts, near)
        reach = inputs.reach.clamp(-0.1, 0.1) * torch.exp(self.reach[0]) + self.reach[1]
        # Keeping a plan and planning the same movement again have the same value, so the action itself is not an input.
        ends = inputs.scene.ends[:, None].expand(-1, inputs.actions.shape[1], -1)
        known = ends if self.replanning else torch.cat((ends, inputs.actions), dim=-1)
        rest = self.rest(torch.cat((known, inputs.effort), dim=-1))
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
        clear = torch.sigmoid(values.no_contact)
        success = clear * torch.sigmoid(values.arrival)
        won, lost, missed, _ = self.scales
        total: Tensor = won * success - lost * (1.0 - clear) - missed * (1.0 - success)
        return total + values.clearance + values.effort_terms

    def merit(self, values: Values) -> Tensor:
        """Return the ranking criterion, shape (B, H): Q if success is more likely than not, otherwise a lower number.

        If no plan is likely to succeed, Q prefers plans out of reach, which are not executed and so touch nothing. The
        probability of success ranks such plans instead.
        """
        success = torch.sigmoid(values.no_contact) * torch.sigmoid(values.arrival)
        merit: Tensor = torch.where(success > 0.5, self.value(values), success - UNLIKELY)
        return merit
