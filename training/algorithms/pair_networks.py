"""Learned clearance of a plan as a minimum over obstacles, links of the arm and instants of the plan.

The clearance of a movement is a minimum over time, links and obstacles. A critic with this structure learns from the
outcome of single movements which pair of obstacle and link determined it:

    m(s, a) = min over obstacle parts i, bodies h, instants t of q_h(i seen from h at t)

Each q_h is a small network. Its input is the pose of an obstacle relative to a body, a capsule of the arm; the planned
pose of the body follows from the plan alone. Bodies may share a network, which then also gets their size. The distance
between surfaces is learned, not computed. Long obstacles are cut into parts, because an obstacle is the union of its
parts and short parts resemble each other.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task


PART = {2: 0.0625, 3: 0.15}
"""Maximum half-length of an obstacle part by spatial dimension, [m]."""
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
NEAR = 0.12
"""Distance beyond that of the nearest pair of a plan up to which a pair counts as near, [m]."""


class Parts(NamedTuple):
    """Obstacle parts of B scenes, at most R in each."""

    centre: Tensor
    """Shape (B, R, D), [m]."""
    half_axis: Tensor
    """Shape (B, R, D), [m]."""
    radius: Tensor
    """Shape (B, R), [m]."""
    velocity: Tensor
    """Shape (B, R, D), [m/s]."""
    present: Tensor
    """Shape (B, R), bool."""


class Poses(NamedTuple):
    """Planned poses of L links at T instants of H plans in each of B scenes."""

    centre: Tensor
    """Shape (L, D, B, H, T), [m]."""
    axis: Tensor | None
    """Unit vectors along the links, shape (L, D, B, H, T); None if the only body is the spherical hand."""
    time: Tensor
    """Time since the start of the plan, shape (B, H, T), [s]."""
    half_length: Tensor | None = None
    """Half-lengths of the links, shape (L,), [m]; only needed to find near pairs."""
    radius: Tensor | None = None
    """Radii of the links, shape (L,), [m]; only needed to find near pairs."""


def cut_obstacles(
    rows: NDArray[np.floating], present: NDArray[np.bool_], velocity: NDArray[np.floating] | None = None
) -> Parts:
    """Cut capsules into parts of bounded length.

    Args:
        rows: Centre, half-axis and radius of n obstacles in B scenes, shape (B, n, 2 D + 1), [m].
        present: Mask of the rows that hold an obstacle, shape (B, n).
        velocity: Velocities, shape (B, n, D), [m/s]; zero if not given.
    """
    d = (rows.shape[-1] - 1) // 2
    centre, half = rows[..., :d], rows[..., d : 2 * d]
    length = np.sqrt((half * half).sum(axis=-1))
    count = np.where(present, np.maximum(np.ceil(length / PART[d] - 1e-4), 1.0), 0.0).astype(np.int64)
    scene, obstacle = (np.repeat(index, count.ravel()) for index in np.indices(count.shape).reshape(2, -1))
    place = np.arange(len(scene)) - np.repeat(np.cumsum(count.ravel()) - count.ravel(), count.ravel())
    number = count[scene, obstacle]
    column = np.arange(len(scene)) - np.searchsorted(scene, scene)
    most = max(int(count.sum(axis=1).max(initial=0)), 1)
    offset = ((2.0 * place + 1.0) / number - 1.0)[:, None] * half[scene, obstacle]
    values = {
        "centre": centre[scene, obstacle] + offset,
        "half_axis": half[scene, obstacle] / number[:, None],
        "radius": rows[scene, obstacle, -1],
        "velocity": np.zeros_like(offset) if velocity is None else velocity[scene, obstacle],
        "present": np.ones(len(scene), dtype=bool),
    }
    parts = {}
    for name, value in values.items():
        whole = np.zeros((len(rows), most, *value.shape[1:]), dtype=bool if name == "present" else np.float32)
        whole[scene, column] = value
        parts[name] = torch.from_numpy(whole)
    return Parts(**parts)


def pair_features(
    centre: list[Tensor], axis: list[Tensor] | None, half_axis: list[Tensor], radius: Tensor
) -> list[Tensor]:
    """Return invariants of the pose of an obstacle part relative to a body.

    A capsule is symmetric under rotations about its axis and under reflections, a sphere under all rotations. The
    invariants are the components of centre and half-axis along the axis of the body, in the direction of the centre
    of the part, and perpendicular to both.

    Args:
        centre: D components of the vector from the centre of the body to that of the part, [m].
        axis: D components of the unit axis of the body; None for a sphere.
        half_axis: D components of the half-axis of the part, [m].
        radius: Radius of the part, [m].
    """
    square, across, length = _dot(centre, centre), _dot(half_axis, centre), _dot(half_axis, half_axis)
    if axis is None:
        away = torch.sqrt(square + 1e-12)
        radial = torch.abs(across) / away
        return [away, radial, _root(length - radial * radial), radius.expand_as(away)]
    along, turned = _dot(centre, axis), _dot(half_axis, axis)
    away = _root(square - along * along)
    radial = (across - along * turned) / away
    sign = torch.where(radial < 0.0, -1.0, 1.0)
    features = [along, away, turned * sign, radial * sign]
    if len(centre) == 3:
        features.append(_root(length - turned * turned - radial * radial))
    return [*features, radius.expand_as(away)]


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
    """

    def __init__(self, dimension: int, networks: Sequence[int], width: int) -> None:
        super().__init__()
        inputs = 4 if not networks else 2 * dimension + (1 if dimension == 2 else 0)
        number = networks[-1] + 1 if networks else 1
        self.shared = len(networks) > number
        """True if bodies share networks."""
        self.network_of = list(networks) or [0]
        """Index of the network of each body."""
        self.networks = PairNetworks(number, inputs + 2 * self.shared, width)

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
    def of_near_pairs(self, poses: Poses, parts: Parts) -> Tensor:
        """Return the minimum over near pairs for each plan, shape (B, H), [m]; NO_OBSTACLE without obstacles.

        This takes a fraction of the time of the minimum over all pairs, and is never less. A pair is near if its
        distance exceeds the least one of the plan by at most NEAR. Distance means here that of the part's centre from
        the axis of the body, less both radii and half the half-length of the part.

        Args:
            poses: Planned poses.
            parts: Obstacle parts.
        """
        return torch.stack([self._of_near_pairs(poses, parts, scene) for scene in range(len(parts.present))])

    def _of_near_pairs(self, poses: Poses, parts: Parts, scene: int) -> Tensor:
        """Return the minimum over near pairs for each plan of one scene, shape (H,), [m]."""
        plans, number = poses.centre.shape[3], int(parts.present[scene].sum())
        if not number:
            return torch.full((plans,), NO_OBSTACLE)
        part, half, radius, drift = (
            each[scene, :number, ..., None, None]
            for each in (parts.centre, parts.half_axis, parts.radius, parts.velocity)
        )
        if bool(drift.any()):
            part = part + drift * poses.time[scene]
        dimensions = range(part.shape[1])
        apart = [part[:, i] - poses.centre[:, i, scene, None] for i in dimensions]  # shape (L, R, H, T) each
        axis = None if poses.axis is None else [poses.axis[:, i, scene, None] for i in dimensions]
        size = radius + 0.5 * torch.sqrt((half * half).sum(dim=1))
        distance = _distance_from_axis(apart, axis, poses) - size
        nearest = distance.amin(dim=(0, 1)).amin(dim=1)  # in two steps, as this is three times as fast
        flat = (distance <= (nearest + NEAR)[:, None]).flatten().nonzero()[:, 0]
        _, rows, _, instants = distance.shape
        pose = flat % (plans * instants)  # index of plan and instant
        plan, of_body = pose // instants, flat // (plans * instants)
        body, row = of_body // rows, of_body % rows
        along = body * (plans * instants) + pose
        features = pair_features(
            [each.expand_as(distance).flatten()[flat] for each in apart],
            None if axis is None else [each.flatten()[along] for each in axis],
            [half[:, i, 0, 0][row] for i in dimensions],
            radius[:, 0, 0][row],
        )
        features += self._sizes(poses, body)
        # Pairs are in the order of their bodies, and so of their networks.
        network = torch.tensor(self.network_of)[body]
        counts = torch.bincount(network, minlength=len(self.networks.nearness)).tolist()
        pieces = zip(*(torch.split(each, counts) for each in features), strict=True)
        values = [self._evaluate([each[None] for each in piece], h)[0] for h, piece in enumerate(pieces)]
        least = torch.full((plans,), torch.inf)
        return least.scatter_reduce_(0, plan, torch.cat(values), "amin") * UNIT

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
        part, half = parts.centre[b, k], parts.half_axis[b, k]
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
        halves = [half[:, i, None, None] for i in range(dimension)]
        features = pair_features(centre, axis, halves, parts.radius[b, k][:, None, None])
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
        apart = parts.centre[scene, part] + drift - here
        axis = None
        if poses.axis is not None:
            pointing = poses.axis[body, :, scene, plan, instant]
            axis = [pointing[:, i] for i in range(dimension)]
        half = parts.half_axis[scene, part]
        features = pair_features(
            [apart[:, i] for i in range(dimension)],
            axis,
            [half[:, i] for i in range(dimension)],
            parts.radius[scene, part],
        )
        features += self._sizes(poses, body)
        every = self._evaluate([each.expand(len(self.networks.nearness), -1) for each in features])
        return every.gather(0, torch.tensor(self.network_of)[body][None])[0]

    def _evaluate(self, features: list[Tensor], body: int | None = None) -> Tensor:
        """Return values of shape (L, N) for features of shape (L, ...) each, of all L networks or of one."""
        bodies = features[0].shape[0]
        stacked = torch.stack([each.reshape(bodies, -1) for each in features], dim=1)
        distance = stacked[:, 0] if len(features) == 4 else torch.hypot(stacked[:, 0], stacked[:, 1])
        values: Tensor = self.networks(stacked * SCALE, distance, body)
        return values


def dense(*sizes: int) -> nn.Sequential:
    """Return linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def _distance_from_axis(apart: list[Tensor], axis: list[Tensor] | None, poses: Poses) -> Tensor:
    """Return distances of points from bodies, less the radii of these, shape (L, R, H, T), [m].

    Args:
        apart: D components of the vector from the centres of the bodies.
        axis: D components of the unit axes of the bodies; None for a sphere, whose radius is left out.
        poses: Half-lengths and radii of the bodies.
    """
    square = _dot(apart, apart)
    if axis is None or poses.half_length is None or poses.radius is None:
        return _root(square)
    half_length, radius = (each[:, None, None, None] for each in (poses.half_length, poses.radius))
    along = _dot(apart, axis)
    inside = torch.minimum(torch.maximum(along, -half_length), half_length)
    return _root(square - inside * (2.0 * along - inside)) - radius


def _dot(first: list[Tensor], second: list[Tensor]) -> Tensor:
    total = first[0] * second[0]
    for u, v in zip(first[1:], second[1:], strict=True):
        total = total + u * v
    return total


def _root(square: Tensor) -> Tensor:
    return torch.sqrt(square.clamp_min(1e-10))


def networks_of(task: Task) -> list[int]:
    """Return the index of the network of each capsule that must clear obstacles; empty if only the hand must.

    Up to one capsule for each joint and one for the hand have a network each. Of arms with more capsules, those that
    move with the same joint share one.
    """
    joints = task.arm.link_joints if task.whole_arm else ()
    if len(joints) <= len(task.arm.joint_range) + 1:
        return list(range(len(joints)))
    return [sorted(set(joints)).index(joint) for joint in joints]
