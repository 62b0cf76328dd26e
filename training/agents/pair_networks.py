"""Learned clearance of a plan as a minimum over obstacles, links of the arm and instants of the plan.

The clearance of a movement is a minimum over time, links and obstacles. A critic with this structure learns from the
outcome of single movements which pair of obstacle and link determined it:

    m(s, a) = min over obstacle parts i, bodies h, instants t of q_h(i seen from h at t)

Each q_h is a small network. Its input is the pose of an obstacle relative to a body, a capsule of the arm
(:mod:`viapoint.training.agents.obstacle_parts`); the planned pose of the body follows from the plan alone. Bodies
may share a network, which then also gets their size. The distance between surfaces is learned, not computed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from viapoint.training.agents.obstacle_parts import CapsulePairs, PairGeometry, Parts, Poses

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task


SCALE = 8.0
"""Scale of lengths at the input of the networks, [1/m]."""
HIDDEN = 1 << 17
"""Hidden units times pairs that are computed in one matrix product, so that they stay in the cache."""
UNIT = 0.05
"""Length of one output unit of a pair network, [m]."""
NO_OBSTACLE = 1.0
"""Margin in a scene without obstacles, [m]."""
ROWS = 65_536
"""Pairs whose inputs are computed together, so that they stay in the cache."""


class PairNetworks(nn.Module):
    """Networks of the same shape, one for each body or link of the arm, evaluated in batched matrix products.

    Args:
        bodies: Number of networks.
        inputs: Number of inputs F.
        width: Width of the two hidden layers.
    """

    def __init__(self, bodies: int, inputs: int, width: int) -> None:
        super().__init__()
        sizes = (inputs, width, width, 1)
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(sizes):
            scale = (2.0 / fan_in) ** 0.5 if fan_out > 1 else 0.3 / fan_in**0.5
            self.weights.append(nn.Parameter(scale * torch.randn(bodies, fan_out, fan_in)))
            self.biases.append(nn.Parameter(torch.zeros(bodies, fan_out, 1)))
        self.nearness = nn.Parameter(torch.tensor([1.0, -2.0]).repeat(bodies, 1))
        """Slope and offset of a skip connection from the distance of the centres. It makes the nearest pair the
        minimum at the start of training; without it the loss stays on a plateau for some 4,000 updates."""

    def forward(self, features: Tensor, distance: Tensor, body: int | None = None) -> Tensor:
        """Return values of shape (L, N) for features (L, F, N) and distances of the centres (L, N), [m].

        If a body is given, features and distances are those of this body alone, L = 1.
        """
        layers = list(zip(self.weights, self.biases, strict=True))
        nearness: Tensor = self.nearness
        if body is not None:
            one = slice(body, body + 1)
            layers, nearness = [(weight[one], bias[one]) for weight, bias in layers], nearness[one]
        columns = features.shape[2]
        if not torch.is_grad_enabled():
            columns = min(columns, HIDDEN // layers[0][0].shape[1])
        pieces = []
        for hidden in torch.split(features, max(columns, 1), dim=2):
            for weight, bias in layers[:-1]:
                hidden = torch.baddbmm(bias, weight, hidden)
                hidden = hidden.relu_() if not hidden.requires_grad else hidden.relu()
            pieces.append(torch.baddbmm(layers[-1][1], layers[-1][0], hidden))
        values = torch.cat(pieces, dim=2)[:, 0] if len(pieces) > 1 else pieces[0][:, 0]
        slope, offset = nearness[:, :1], nearness[:, 1:]
        return values + slope * (distance / UNIT) + offset


class PairMinimum(nn.Module):
    """Minimum of the pair networks over obstacle parts, bodies and instants.

    Args:
        dimension: Spatial dimension D.
        networks: Index of the network of each body, in increasing order; empty for the spherical hand alone. Networks
            that several bodies share have their half-length and radius as further inputs.
        width: Width of the hidden layers.
        geometry: Description of the parts; by default that of capsules.
    """

    def __init__(
        self, dimension: int, networks: Sequence[int], width: int, *, geometry: PairGeometry | None = None
    ) -> None:
        super().__init__()
        self.geometry = geometry or CapsulePairs(dimension, bool(networks))
        number = networks[-1] + 1 if networks else 1
        self.shared = len(networks) > number
        """True if bodies share networks."""
        self.network_of = list(networks) or [0]
        """Index of the network of each body."""
        self.networks = PairNetworks(number, self.geometry.inputs + 2 * self.shared, width)

    def forward(self, poses: Poses, parts: Parts, until: Tensor | None = None) -> Tensor:
        """Return the minimum for each plan, shape (B, H), [m]; NO_OBSTACLE for scenes without obstacles.

        The minimising pair is found without gradients; gradients flow through this pair alone.

        Args:
            poses: Planned poses.
            parts: Obstacle parts.
            until: Time after which instants do not count, shape (B, H), [s]; the first instant always counts.
        """
        late = None
        if until is not None:
            late = poses.time > until[..., None]
            late[..., 0] = False
        if not torch.is_grad_enabled():
            least = self._least(poses, parts, late)
        else:
            least, where = self._search(poses, parts, late)
            scene, plan = (each.reshape(-1) for each in torch.meshgrid(
                *(torch.arange(n) for n in least.shape), indexing="ij"))  # fmt: skip
            body, part, instant = (each.reshape(-1) for each in where)
            picked = self._picked(poses, parts, scene, plan, body, part, instant)
            values = picked.reshape(least.shape)
            least = torch.where(parts.present.any(dim=1)[:, None], values, least)
        return torch.where(
            parts.present.any(dim=1)[:, None], least * UNIT, torch.full_like(least, NO_OBSTACLE)
        )

    @torch.no_grad()
    def of_near_pairs(self, poses: Poses, parts: Parts, near: float) -> Tensor:
        """Return the minimum over near pairs for each plan, shape (B, H), [m]; NO_OBSTACLE without obstacles.

        This takes a fraction of the time of the minimum over all pairs, and is never less. A pair is near if its
        distance exceeds the least one of the plan by at most `near`, [m]. Distance means here the rough one of
        :meth:`~viapoint.training.agents.obstacle_parts.PairGeometry.gap`.
        """
        scenes = range(len(parts.present))
        return torch.stack([self._of_near_pairs(poses, parts, near, scene) for scene in scenes])

    def _of_near_pairs(self, poses: Poses, parts: Parts, near: float, scene: int) -> Tensor:
        """Return the minimum over near pairs for each plan of one scene, shape (H,), [m]."""
        plans, number = poses.centre.shape[3], int(parts.present[scene].sum())
        if not number:
            return torch.full((plans,), NO_OBSTACLE)
        part, columns, drift = (
            each[scene, :number].T[..., None, None] for each in (parts.centre, parts.columns, parts.velocity)
        )  # shape (., R, 1, 1) each
        moves, time, instants = bool(drift.any()), poses.time[scene], poses.time.shape[-1]
        vectors = (poses.centre,) if poses.axis is None else (poses.centre, poses.axis)
        centre, *axes = (each[:, :, scene].transpose(0, 1) for each in vectors)  # shape (D, L, H, T) each
        part, drift = part[: len(centre)], drift[: len(centre)]
        every = self.geometry.every
        sampled = [each[..., ::every].contiguous()[:, :, None] for each in (centre, *axes)]
        place = part + drift * time[..., ::every] if moves else part
        gap = self.geometry.gap(  # shape (L, R, H, .)
            [here - there for here, there in zip(place, sampled[0], strict=True)],
            [*sampled[1]] if axes else None,
            [*columns],
            poses,
        )
        nearest = gap.amin(dim=(0, 1)).amin(dim=1)  # in two steps, as this is three times as fast
        is_near = gap <= (nearest + near)[:, None]
        if every == 2:
            is_near = is_near.repeat_interleave(2, dim=-1)[..., :instants]
            is_near[..., 1:-1:2] |= is_near[..., 2::2]
        bodies, rows = is_near.shape[:2]
        of_body, plan, instant = is_near.flatten(0, 1).nonzero(as_tuple=True)
        pose = plan * instants + instant
        body, row = (of_body // rows, of_body % rows) if bodies > 1 else (torch.zeros_like(plan), of_body)
        along = body * (plans * instants) + pose
        place = part[..., 0, 0].index_select(1, row)
        if moves:
            place = place + drift[..., 0, 0].index_select(1, row) * time.flatten().index_select(0, pose)
        features = self.geometry.features(
            [*(place - centre.flatten(1).index_select(1, along))],
            [*axes[0].flatten(1).index_select(1, along)] if axes else None,
            [*columns[..., 0, 0].index_select(1, row)],
        )
        features += self._sizes(poses, body)
        if len(self.networks.nearness) == 1:
            values = self._evaluate([each[None] for each in features])[0]
        else:  # pairs are in the order of their bodies, and so of their networks
            network = torch.tensor(self.network_of)[body]
            counts = torch.bincount(network, minlength=len(self.networks.nearness)).tolist()
            pieces = zip(*(torch.split(each, counts) for each in features), strict=True)
            values = torch.cat(
                [self._evaluate([each[None] for each in piece], h)[0] for h, piece in enumerate(pieces)]
            )
        least = torch.full((plans,), torch.inf)
        return least.scatter_reduce_(0, plan, values, "amin") * UNIT

    def _least(self, poses: Poses, parts: Parts, late: Tensor | None) -> Tensor:
        """Return the least value of each plan, shape (B, H)."""
        least = torch.full((*parts.present.shape, poses.centre.shape[3]), torch.inf)
        for b, k, values in self._blocks(poses, parts, late):
            least[b, k] = values.amin(dim=(2, 3))
        return least.amin(dim=1)

    @torch.no_grad()
    def _search(
        self, poses: Poses, parts: Parts, late: Tensor | None
    ) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Find the least value of each plan, shape (B, H), and its body, part and instant."""
        plans, instants = poses.centre.shape[3:]
        least = torch.full((*parts.present.shape, plans), torch.inf)
        at = torch.zeros(least.shape, dtype=torch.long)
        for b, k, values in self._blocks(poses, parts, late):
            least[b, k], at[b, k] = values.reshape(len(b), plans, -1).min(dim=-1)
        lowest, nearest = least.min(dim=1)
        found = at.gather(1, nearest[:, None])[:, 0]
        return lowest, (found // instants, nearest, found % instants)

    def _blocks(
        self, poses: Poses, parts: Parts, late: Tensor | None
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yield scenes b and parts k, shape (P,), with the values of their pairs, shape (P, H, L, T)."""
        bodies, _, _, plans, instants = poses.centre.shape
        scene, part = torch.nonzero(parts.present, as_tuple=True)
        several = max(ROWS // (bodies * plans * instants), 1)
        for first in range(0, len(scene), several):
            b, k = scene[first : first + several], part[first : first + several]
            values = self._values(poses, parts, b, k)
            yield b, k, values if late is None else values.masked_fill(late[b][:, :, None], torch.inf)

    def _values(self, poses: Poses, parts: Parts, b: Tensor, k: Tensor) -> Tensor:
        """Return values of part k in scene b for every plan, body and instant, shape (P, H, L, T)."""
        bodies, dimension, _, plans, instants = poses.centre.shape
        here = poses.centre[:, :, b]
        part, described = parts.centre[b, k], parts.columns[b, k]
        drift = parts.velocity[b, k]
        moves = bool(drift.any())
        time = poses.time[b] if moves else None
        centre = []
        for i in range(dimension):
            place = part[:, i, None, None]
            if time is not None:
                place = place + drift[:, i, None, None] * time
            centre.append(place - here[:, i])
        axis = None
        if poses.axis is not None:
            pointing = poses.axis[:, :, b]
            axis = [pointing[:, i] for i in range(dimension)]
        columns = [described[:, i, None, None] for i in range(described.shape[1])]
        features = self.geometry.features(centre, axis, columns)
        if self.shared:
            every = (size[:, None, None, None].expand_as(features[0]) for size in self._sizes(poses))
            features = [each.reshape(bodies, -1) for each in (*features, *every)]
            counts = torch.bincount(torch.tensor(self.network_of)).tolist()
            pieces = zip(*(torch.split(each, counts) for each in features), strict=True)
            values = torch.cat(
                [
                    self._evaluate([each.reshape(1, -1) for each in piece], h)[0]
                    for h, piece in enumerate(pieces)
                ]
            )
        else:
            values = self._evaluate(features)
        return values.reshape(bodies, len(b), plans, instants).permute(1, 2, 0, 3)

    def _sizes(self, poses: Poses, body: Tensor | slice = slice(None)) -> list[Tensor]:
        """Return half-lengths and radii of bodies, [m], if bodies share networks; otherwise nothing."""
        if not self.shared:
            return []
        assert poses.half_length is not None
        assert poses.radius is not None
        return [poses.half_length[body], poses.radius[body]]

    def _picked(
        self,
        poses: Poses,
        parts: Parts,
        scene: Tensor,
        plan: Tensor,
        body: Tensor,
        part: Tensor,
        instant: Tensor,
    ) -> Tensor:
        """Return values of single pairs with gradients, shape (N,)."""
        dimension = poses.centre.shape[1]
        here = poses.centre[body, :, scene, plan, instant]
        drift = parts.velocity[scene, part] * poses.time[scene, plan, instant][:, None]
        apart = (parts.centre[scene, part] + drift)[:, :dimension] - here
        axis = None
        if poses.axis is not None:
            pointing = poses.axis[body, :, scene, plan, instant]
            axis = [pointing[:, i] for i in range(dimension)]
        described = parts.columns[scene, part]
        features = self.geometry.features(
            [apart[:, i] for i in range(dimension)],
            axis,
            [described[:, i] for i in range(described.shape[1])],
        )
        features += self._sizes(poses, body)
        every = self._evaluate([each.expand(len(self.networks.nearness), -1) for each in features])
        return every.gather(0, torch.tensor(self.network_of)[body][None])[0]

    def _evaluate(self, features: list[Tensor], body: int | None = None) -> Tensor:
        """Return values of shape (L, N) for features of shape (L, ...) each, of all L networks or of one."""
        bodies = features[0].shape[0]
        stacked = torch.stack([each.reshape(bodies, -1) for each in features], dim=1)
        values: Tensor = self.networks(stacked * SCALE, self.geometry.distance(stacked), body)
        return values


def dense(*sizes: int) -> nn.Sequential:
    """Return linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def networks_of(task: Task) -> list[int]:
    """Return the index of the network of each capsule that must clear obstacles; empty if only the hand must.

    Up to one capsule for each joint and one for the hand have a network each. Of arms with more capsules, those that
    move with the same joint share one.
    """
    joints = task.arm.link_joints if task.whole_arm else ()
    if len(joints) <= len(task.arm.joint_range) + 1:
        return list(range(len(joints)))
    return [sorted(set(joints)).index(joint) for joint in joints]
