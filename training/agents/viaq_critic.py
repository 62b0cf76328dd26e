"""Critic of viaq: predictions of success, contact, clearance and effort for plans, and their value Q."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from viapoint.envs.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.envs.task import Task
from viapoint.training.agents.pairs import PairNetwork, Pairs

# Number of effort features: log jerk, duration, log duration, and spare time if time is limited
EFFORT = 4
IN_TIME = 20.0  # Logits of arrival for each second of spare time in tasks with a time limit, [1/s]
# Logits of arrival that a movement beyond reach or joint ranges loses: it is not executed
OUTSIDE = 20.0
# Penalty on the merit of plans that are unlikely to succeed; larger than the range of Q
UNLIKELY = 10.0


class Values(NamedTuple):
    """Predictions of the critic for H plans in each of B scenes, shape (B, H) each."""

    margin: Tensor  # Predicted clearance from obstacles, [m]
    self_clearance: Tensor  # Computed clearance of the arm from itself, [m]
    no_contact: Tensor  # Logit of the probability of no contact
    arrival: Tensor  # Logit of the probability of success given no contact
    clearance: Tensor  # Predicted clearance term of the reward
    effort_terms: Tensor  # Predicted sum of the terms for smoothness and duration


class PlanInputs(NamedTuple):
    """Inputs of the critic for H plans in each of B scenes."""

    ends: Tensor  # Start, goal and, in replanning tasks, the present motion, shape (B, E)
    actions: Tensor  # Shape (B, H, m)
    effort: Tensor  # Shape (B, H, EFFORT)
    pairs: Pairs  # Nearest pairs of spheres and obstacles


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
    """Network that predicts the value of plans from their margin and effort.

    The margin m(s, a) is learned (see :mod:`viapoint.training.agents.pairs`). Kinematics says whether the movement
    stays within reach and joint ranges, and how far the arm is from itself, s(a):

        P(clear) = sigmoid(k m + b) sigmoid(k' s + b'),  P(success) = P(clear) sigmoid(d + r(s, a)),
        Q(s, a) = w_s P(success) - w_c (1 - P(clear)) - w_g (1 - P(success)) + w_m clip(min(m, s)) + e(s, a)

    Args:
        task: Task of the environment.
        width: Width of the hidden layers of the pair network.
    """

    def __init__(self, task: Task, *, width: int) -> None:
        super().__init__()
        dimension, size = task.space.dimension, task.action.size
        ends = (4 * dimension + 3) if task.replanning else (2 * dimension + 1)
        self.replanning = task.replanning
        self.pairs = PairNetwork(task.shapes, width)
        self.arrival = nn.Parameter(torch.tensor(2.0))  # Logit d of arrival of a movement within reach
        self.rest = dense(ends + EFFORT + (0 if task.replanning else size), 64, 64, 2)
        for parameter in self.rest[-1].parameters():
            nn.init.zeros_(parameter)
        weights = task.weights
        self.linear = nn.Parameter(torch.tensor([-weights.smoothness, -weights.duration, 0.0, 0.0]))
        """Weights of the effort features, initialised from the reward weights."""
        self.slope = nn.Parameter(torch.tensor([6.0, 0.0]))  # Logarithm of k [1/m], and b
        self.self_slope = nn.Parameter(torch.tensor([6.0, 2.0]))  # Logarithm of k' [1/m], and b'
        self.scales = nn.Parameter(
            torch.tensor([weights.success, weights.collision, weights.goal_error, weights.clearance])
        )
        """w_s, w_c, w_g and w_m, initialised from the reward weights and adapted to the rewards."""

    def forward(self, inputs: PlanInputs) -> Values:
        """Return the predictions for each plan."""
        margin, own = self.pairs(inputs.pairs), inputs.pairs.self_clearance
        reach = self.arrival - OUTSIDE * (~inputs.pairs.inside).to(margin.dtype)
        # Keeping a plan and planning the same movement again have the same value, so the action itself is not an input.
        ends = inputs.ends[:, None].expand(-1, inputs.actions.shape[1], -1)
        known = ends if self.replanning else torch.cat((ends, inputs.actions), dim=-1)
        rest = self.rest(torch.cat((known, inputs.effort), dim=-1))
        obstacles = margin * torch.exp(self.slope[0]) + self.slope[1]
        itself = own * torch.exp(self.self_slope[0]) + self.self_slope[1]
        return Values(
            margin,
            own,
            both(obstacles, itself),
            reach + rest[..., 1] + IN_TIME * inputs.effort[..., 3],
            torch.minimum(self.clearance_term(margin), self.clearance_term(own)),
            rest[..., 0] + inputs.effort @ self.linear,
        )

    def clearance_term(self, clearance: Tensor) -> Tensor:
        """Return the clearance term of the reward for a clearance, [m]."""
        low, high = CLEARANCE_RANGE
        clip: Any = _Saturated.apply
        term: Tensor = clip(clearance, low, high) * (self.scales[3] / CLEARANCE_UNIT)
        return term

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


def both(first: Tensor, second: Tensor) -> Tensor:
    """Return the logit of the product of two probabilities that are given as logits."""
    log = functional.logsigmoid(first) + functional.logsigmoid(second)
    log = log.clamp(max=-1e-6)
    return log - torch.log(-torch.expm1(log))


def dense(*sizes: int) -> nn.Sequential:
    """Return linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
