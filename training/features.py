"""What can be computed of a movement before it is made.

An agent that knows the arm's geometry and the minimum-jerk expansion need not learn them. These features are exact
functions of observation and action, differentiable through the primitives; what the physics adds is left to learning.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from viapoint.envs.action import ActionLayout, frame
from viapoint.envs.clearance import clearance_profile
from viapoint.envs.observation import ObstacleRows
from viapoint.envs.task import Task

Observation = dict[str, Tensor]

PHASES = 24
"""At how many evenly spaced times a planned movement is looked at."""


NEAR = 0.06
"""Clearance at which an obstacle is no longer pushed away from, [m]."""
GEOMETRY = PHASES + 3
"""Numbers that tell clearance and reach of a movement."""


class SceneView(NamedTuple):
    """A scene in the frame of its start and goal, so that equal tasks look equal wherever they are."""

    ends: Tensor
    """Start and goal in the arm's frame, and their distance, shape (B, 2 D + 1)."""
    rows: Tensor
    """Obstacles in the frame along, across and above the straight line, from its middle, shape (B, n, 2 D + 1)."""
    present: Tensor
    """Shape (B, n), bool."""


class Look(NamedTuple):
    """What an actor sees of B scenes before it thinks."""

    scene: SceneView
    anchors: Tensor
    """Actions of the A anchors, shape (B, A, m)."""
    fares: Tensor
    """How each would fare: clearance and reach, and where the nearest obstacle is at each phase, shape (B, A, .)."""

    def at(self, some: Tensor) -> Look:
        """Only some of the anchors, `some` of shape (B, n) in each scene."""
        rows = torch.arange(len(some)).unsqueeze(-1)
        return Look(self.scene, self.anchors[rows, some], self.fares[rows, some])


class Foresight(NamedTuple):
    """What is known of planned movements, shape (B, H, ...) for H actions in each of B scenes."""

    clearance: Tensor
    """At each phase, shape (B, H, PHASES), [m]."""
    reach_margin: Tensor
    """Least over the movement, shape (B, H), [m]."""
    log_jerk: Tensor
    """Log of the jerk cost relative to the straight movement of the same duration, shape (B, H)."""
    known_reward: Tensor
    """The terms of the reward that the plan alone decides: smoothness and duration, shape (B, H)."""

    def vector(self) -> Tensor:
        """The features as a network likes them, of size one, shape (B, H, GEOMETRY + 1)."""
        return torch.cat(
            (_sized(self.clearance, self.reach_margin), 0.3 * self.log_jerk.unsqueeze(-1)), dim=-1
        )


def scene_view(observation: Observation, task: Task) -> SceneView:
    """The scene of an observation, seen along its straight line; `hand` is the start."""
    start, goal = observation["hand"], observation["goal"]
    line = goal - start
    distance = line.norm(dim=-1, keepdim=True)
    ends = torch.cat((start, goal, distance), dim=-1)
    if "obstacles" not in observation:
        empty = start.new_zeros((len(start), 1, 2 * task.arm.dimension + 1))
        return SceneView(ends, empty, empty[..., 0] > 0.0)
    rows = task.observation.obstacles(observation["obstacles"])
    axes = torch.stack(frame(line), dim=-2)
    centre = torch.einsum("bij,bnj->bni", axes, rows.centre - 0.5 * (start + goal).unsqueeze(1))
    half = torch.einsum("bij,bnj->bni", axes, rows.half_axis)
    half = torch.where(half[..., 1:2] < 0.0, -half, half)  # a bar has no sense of direction
    seen = torch.cat((centre, half, rows.radius.unsqueeze(-1)), dim=-1) * 5.0
    return SceneView(ends * 2.0, seen, rows.present > 0.5)


def foresee(observation: Observation, actions: Tensor, task: Task) -> Foresight:
    """What is known of H actions in each of B scenes.

    Args:
        observation: Of B scenes.
        actions: Shape (B, H, m), in [-1, 1].
        task: The environment's.
    """
    shape = (*actions.shape[:2], task.arm.dimension)
    start = observation["hand"].unsqueeze(1).expand(shape)
    goal = observation["goal"].unsqueeze(1).expand(shape)
    plan = task.action.decode(actions, start, goal)
    trajectory = plan.trajectory()
    duration = plan.durations.sum(dim=-1)
    phases = torch.linspace(0.0, 1.0, PHASES + 1, dtype=actions.dtype)[1:]
    hand = trajectory(duration.unsqueeze(-1) * phases)
    straight = 360.0 * (goal - start).square().sum(dim=-1) / duration**5
    log_jerk = torch.log(torch.clamp(trajectory.cost() / straight, min=1.0))
    relative = duration / task.action.centre_duration
    known = -task.weights.smoothness * (log_jerk - 5.0 * torch.log(relative))
    known = known - task.weights.duration * (relative - 1.0)
    margin = task.arm.reach_margin(hand).amin(dim=-1)
    return Foresight(_clearance(observation, hand, task), margin, log_jerk, known)


class Anchors:
    """Fixed movements, a few ways round each, scaled with the distance of start and goal.

    As they scale, their paths are computed once. A policy that sees how each of them would fare needs to improve the
    promising ones only.
    """

    def __init__(self, task: Task) -> None:
        if not task.action.n_via:
            raise ValueError("a policy of via-points needs an environment with n_via of 1 or more")
        d = task.arm.dimension
        layout = ActionLayout(dimension=d, via_scale=(1.0,) * d)
        along, height, turn = np.meshgrid(ALONG, HEIGHT, _turns(d), indexing="ij")
        shape = (along.size, d)
        sideways = (np.cos(turn), np.sin(turn))[: d - 1]
        vias = np.stack([along, *(height * side for side in sideways)], axis=-1).reshape(shape)
        goal = np.eye(d)[0] * np.ones((len(vias), 1))
        plan = layout.decode(np.concatenate((vias, np.zeros((len(vias), 1))), axis=-1), 0.0 * goal, goal)
        trajectory, duration = plan.trajectory(), plan.durations.sum(axis=-1)
        phases = np.linspace(0.0, 1.0, PHASES + 1)[1:]
        self.task = task
        self.paths = torch.as_tensor(trajectory(duration[:, None] * phases), dtype=torch.float32)
        """In the frame of start and goal, shape (A, PHASES, D), for a distance of 1 m."""
        places = np.arange(1, task.action.n_via + 1) / (task.action.n_via + 1)
        on_path = trajectory(duration[:, None] * places) - places[:, None] * goal[:, None]
        if task.action.n_via == 1:
            on_path = vias[:, None]
        scaled = on_path / np.array(task.action.via_scale[:d])
        self.vias = torch.as_tensor(scaled.reshape(len(vias), -1), dtype=torch.float32)
        """Via components of their actions, shape (A, K D), for a distance of 1 m."""

    def __len__(self) -> int:
        return len(self.paths)

    def actions(self, observation: Observation) -> Tensor:
        """Their actions in each of B scenes, shape (B, A, m), inside (-1, 1)."""
        distance = (observation["goal"] - observation["hand"]).norm(dim=-1)[:, None, None]
        vias = self.vias * distance
        rest = vias.new_zeros((*vias.shape[:2], self.task.action.size - vias.shape[-1]))
        return torch.cat((vias, rest), dim=-1).clamp(-0.97, 0.97)

    def look(self, observation: Observation) -> Look:
        """See how they would fare in each of B scenes; nothing here is learnt."""
        start, goal = observation["hand"], observation["goal"]
        axes = torch.stack(frame(goal - start), dim=-2)
        scaled = axes * (goal - start).norm(dim=-1)[:, None, None]
        hand = start[:, None, None] + torch.einsum("apj,bji->bapi", self.paths, scaled)
        margin = self.task.arm.reach_margin(hand).amin(dim=-1)
        parts = [_sized(_clearance(observation, hand, self.task), margin)]
        if "obstacles" in observation:
            away = _away(observation, hand, self.task)
            parts.append(torch.einsum("bji,bapi->bapj", axes, away).flatten(-2))
        else:
            parts.append(hand.new_zeros((*hand.shape[:2], hand.shape[2] * hand.shape[3])))
        return Look(scene_view(observation, self.task), self.actions(observation), torch.cat(parts, dim=-1))


ALONG = (-0.3, -0.15, 0.0, 0.15, 0.3)
HEIGHT = (0.10, 0.22, 0.35, 0.48, 0.62)
"""Where anchors' via-points lie from the middle of the straight line, relative to its length."""


def _turns(dimension: int) -> NDArray[np.float64]:
    """Directions sideways: left and right in the plane, eight all round in space."""
    return np.linspace(0.0, 2.0 * np.pi, 2 if dimension == 2 else 8, endpoint=False)


def _sized(clearance: Tensor, reach_margin: Tensor) -> Tensor:
    least, margin = clearance.amin(dim=-1, keepdim=True), reach_margin.unsqueeze(-1)
    parts = (clearance * 20.0, least * 20.0, least * 150.0, margin * 20.0)
    return torch.cat(parts, dim=-1).clamp(-2.0, 2.0)


def _away(observation: Observation, hand: Tensor, task: Task) -> Tensor:
    """Unit vectors away from the nearest obstacle's axis, the shorter the farther it is, shape (B, A, PHASES, D)."""
    rows: ObstacleRows = task.observation.obstacles(observation["obstacles"])
    centre, axis = (part[:, None, :, None] for part in (rows.centre, rows.half_axis))
    offset = hand.unsqueeze(2) - centre
    along = (offset * axis).sum(dim=-1) / axis.square().sum(dim=-1).clamp(min=1e-12)
    rest = offset - along.clamp(-1.0, 1.0).unsqueeze(-1) * axis
    length = rest.norm(dim=-1)
    clearance = length - rows.radius[:, None, :, None] - task.arm.hand_radius
    clearance = torch.where(
        (rows.present > 0.5)[:, None, :, None], clearance, torch.full_like(clearance, 1.0)
    )
    least, nearest = clearance.min(dim=2, keepdim=True)
    unit = rest / length.clamp(min=1e-9).unsqueeze(-1)
    unit = unit.gather(2, nearest.unsqueeze(-1).expand(-1, -1, -1, -1, unit.shape[-1])).squeeze(2)
    nearness = (1.0 - least.squeeze(2) / NEAR).clamp(0.0, 1.5).unsqueeze(-1)
    return torch.mul(unit, nearness)


def _clearance(observation: Observation, hand: Tensor, task: Task) -> Any:
    if "obstacles" not in observation:
        return torch.full_like(hand[..., 0], 1.0)
    rows: ObstacleRows = task.observation.obstacles(observation["obstacles"])
    obstacles = torch.cat((rows.centre, rows.half_axis, rows.radius.unsqueeze(-1)), dim=-1).unsqueeze(1)
    present = (rows.present > 0.5).unsqueeze(1)
    if not task.whole_arm:
        return clearance_profile(hand, task.arm.hand_radius, obstacles, present)
    links = task.arm.links(task.arm.posture(hand))
    return clearance_profile(hand, task.arm.hand_radius, obstacles, present, links, task.arm.link_radii)
