"""Pairs of a sphere of the arm and an obstacle during planned movements, as inputs of one network, and this network.

The clearance of a movement is a minimum over time, spheres of the arm and obstacles. A critic with this structure
learns from the outcome of single movements which pair determined it:

    m(s, a) = min over obstacles i, spheres h, instants t of q(centre of h in the frame of i at t, size and kind of i)

Kinematics places the spheres. For each obstacle and link two pairs stand for all instants: those whose sphere is
nearest to the obstacle's box, and to this box with round edges. Of these, the network sees the nearest ones. The
distance from the surface is learned, not computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import create_mlp
from torch import Tensor, nn

from viapoint.envs.common.arrays import Bool, Float, Int
from viapoint.envs.geometry.clearance import Placed, place, place_group, self_clearance
from viapoint.envs.geometry.compiled import compiled, inner, kernel
from viapoint.envs.geometry.obstacles import ABSENT, KINDS, Obstacles, bounding_boxes
from viapoint.envs.geometry.shapes import IN_TABLES, PLAIN_KINDS
from viapoint.envs.task import Task
from viapoint.training.planning.movements import INSTANTS, Memory, Setting, joints_at, memory_of, place_hand
from viapoint.training.planning.problem import Moves, Problem, movement_of, setting_of

SCALE = 8.0  # Scale of lengths at the input of the network, [1/m]
UNIT = 0.05  # Length of one output unit of the network, [m]
NEAREST = 16  # Number of pairs of a movement that the network sees
CLEAR = 0.1  # Greatest clearance of the arm from itself that matters, [m]
AT_FIRST = 0.1  # Distance from the box at which the margin is about 0 before training, [m]
NO_OBSTACLE = 1.0  # Margin in a scene without obstacles, [m]
NOWHERE = 1e6  # Gap of a pair that does not exist, [m]
# Lengths that describe a pair: centre of the sphere 3, half lengths of the obstacle 3, radius of the sphere 1
LENGTHS = 7


class Pairs(NamedTuple):
    """Nearest pairs of H movements in each of B scenes."""

    features: Tensor  # Lengths and kind of the obstacle, shape (B, H, P, LENGTHS + number of kinds)
    # Signed distances of the spheres' centres from the obstacles' bounding boxes, shape (B, H, P), [m]
    distance: Tensor
    present: Tensor  # True for pairs that exist, shape (B, H, P)
    # Computed clearance of the arm from itself, shape (B, H), at most CLEAR, [m]
    self_clearance: Tensor
    inside: Tensor  # True for movements within reach and joint ranges, shape (B, H)


def pairs_of(
    task: Task,
    problem: Problem,
    moves: Moves,
    instants: Int,
    until: Float | None = None,
    *,
    exact: bool = False,
) -> Pairs:
    """Return the nearest pairs of H movements in each of B problems.

    Args:
        task: Task.
        problem: Problems.
        moves: Movements.
        instants: Instants that are looked at, some of 0 to INSTANTS - 1 in increasing order.
        until: Time after which instants do not count, shape (B, H), [s]; the first instant always counts.
        exact: True for movements as they are executed, see :func:`~viapoint.training.planning.problem.moves_of`.
    """
    obstacles = problem.obstacles
    columns = np.array([task.shapes.index(kind) if kind in task.shapes else 0 for kind in KINDS])
    number, plans = moves.duration.shape
    late = np.full((number, plans), np.inf) if until is None else until
    setting = setting_of(task, obstacles, exact=exact)
    given = Given(setting, moves, obstacles, *bounding_boxes(obstacles))
    features = np.zeros((number, plans, NEAREST, LENGTHS + len(task.shapes)), np.float32)
    gaps = np.full((number, plans, NEAREST), NOWHERE)
    least = np.full((number, plans), CLEAR)
    inside = np.ones((number, plans), np.bool_)
    _gather(given, columns, instants, late, features, gaps, least, inside)
    return Pairs(
        torch.from_numpy(features),
        torch.from_numpy(gaps.astype(np.float32)),
        torch.from_numpy(gaps < NOWHERE),
        torch.from_numpy(least.astype(np.float32)),
        torch.from_numpy(inside),
    )


class Given(NamedTuple):
    """Movements and obstacles, as compiled functions take them."""

    setting: Setting
    moves: Moves
    obstacles: Obstacles
    centre: Float  # Centres of the obstacles' bounding boxes, shape (B, n, 3), [m]
    half: Float  # Their half lengths, shape (B, n, 3), [m]


@inner
def _local(given: Given, b: int, row: int, point: Float, time: float, local: Float) -> None:
    """Fill in a point in the frame of an obstacle at a time, shape (3,), [m]."""
    obstacles = given.obstacles
    for axis in range(3):
        local[axis] = 0.0
        for k in range(3):
            away = point[k] - given.centre[b, row, k] - obstacles.velocity[b, row, k] * time
            local[axis] += obstacles.rotation[b, row, k, axis] * away


@kernel
def _gap(local: Float, half: Float, rounded: int) -> float:
    """Return the signed distance of a point from a box; with `rounded` 1, from one with round edges inside it, [m]."""
    edge = rounded * min(half[0], half[1], half[2])
    largest, outside = -NOWHERE, 0.0
    for axis in range(3):
        over = abs(local[axis]) - half[axis] + edge
        largest = max(largest, over)
        outside += max(over, 0.0) ** 2
    distance: float = np.sqrt(outside) + min(largest, 0.0) - edge
    return distance


class Nearest(NamedTuple):
    """Nearest pair of each obstacle and group of spheres: by its box, and by this box with round edges."""

    gap: Float  # Gaps between sphere and box, shape (2, n, G), [m]
    radius: Float  # Radii of the spheres, shape (2, n, G), [m]
    centre: Float  # Centres of the spheres in the frame of the obstacle, shape (2, n, G, 3), [m]
    smallest: Float  # Smallest gaps in increasing order, shape (NEAREST,), [m]
    local: Float  # Memory for a point in the frame of an obstacle, shape (3,), [m]


@inner
def _largest_seen(nearest: Nearest) -> float:
    """Return the largest gap of the NEAREST pairs so far: the network does not see others, [m]."""
    smallest = nearest.smallest
    smallest[:] = NOWHERE
    for gap in nearest.gap.flat:
        rank = NEAREST
        while rank > 0 and gap < smallest[rank - 1]:
            rank -= 1
            if rank + 1 < NEAREST:
                smallest[rank + 1] = smallest[rank]
        if rank < NEAREST:
            smallest[rank] = gap
    largest: float = smallest[-1]
    return largest


@inner
def _look(
    given: Given, b: int, row: int, group: int, time: float, largest: float, placed: Placed, nearest: Nearest
) -> None:
    """Keep the sphere of a group that is nearest to an obstacle at a time, if it is nearer than those before.

    Gaps above the `largest` that matters may be missed, [m].
    """
    spheres, half, local = given.setting.spheres, given.half[b, row], nearest.local
    _local(given, b, row, placed.ball[group], time, local)
    bound = _gap(local, half, 0) - spheres.ball_radius[group]
    if bound >= min(largest, max(nearest.gap[0, row, group], nearest.gap[1, row, group])):
        return
    place_group(spheres, group, placed)
    for sphere in range(spheres.first[group], spheres.first[group + 1]):
        _local(given, b, row, placed.centre[sphere], time, local)
        for rounded in range(2):
            gap = _gap(local, half, rounded) - spheres.radius[sphere]
            if gap < nearest.gap[rounded, row, group]:
                nearest.gap[rounded, row, group] = gap
                nearest.radius[rounded, row, group] = spheres.radius[sphere]
                for axis in range(3):
                    nearest.centre[rounded, row, group, axis] = local[axis]


@inner
def _number_that_count(
    given: Given, b: int, h: int, instants: Int, until: float, memory: Memory
) -> tuple[int, bool]:
    """Fill in the path, and return the number of first instants that count, and False if it then leaves the reach."""
    movement = movement_of(given.moves, b, h)
    here = memory.position if given.setting.hand_alone else memory.joints
    for k in range(len(instants)):
        if k > 0 and movement.duration * instants[k] / (INSTANTS - 1) > until:
            return k, True
        if not joints_at(given.setting, movement, instants[k], memory.position, memory.joints):
            return k, False
        for axis in range(len(here)):
            memory.path[k, axis] = here[axis]
    return len(instants), True


@inner
def _look_at_all(
    given: Given, b: int, h: int, instants: Int, least: Float, memory: Memory, nearest: Nearest
) -> None:
    """Fill in the nearest pairs of a movement at instants within reach, and its least clearance from itself.

    Neighbours come late, so that most parts of the arm are soon known to be farther away than before, and the start,
    where nothing is near, is last.
    """
    setting, moves, kinds, placed = given.setting, given.moves, given.obstacles.kind, memory.placed
    order, spheres = moves.table.order, setting.spheres
    for i in range(1, len(order) + 1):
        k = order[i % len(order)]
        if k >= len(instants):
            continue
        if setting.hand_alone:
            place_hand(memory.path[k], placed)
        else:
            place(setting.chain, spheres, memory.path[k], placed)
        least[b, h] = self_clearance(spheres, placed, least[b, h], -CLEAR)
        time = moves.duration[b, h] * instants[k] / (INSTANTS - 1)
        largest = _largest_seen(nearest)
        for row in range(kinds.shape[1]):
            for group in range(len(spheres.link)):
                if kinds[b, row] != ABSENT and spheres.link[group] != 0:
                    _look(given, b, row, group, time, largest, placed, nearest)


@inner
def _take_nearest(nearest: Nearest) -> tuple[int, int, int]:
    """Return the nearest pair by its place in the arrays, and remove it; three times -1 if none is left."""
    least, rounded, row, group = NOWHERE, -1, -1, -1
    for way in range(2):
        for i in range(nearest.gap.shape[1]):
            for j in range(nearest.gap.shape[2]):
                if nearest.gap[way, i, j] < least:
                    least, rounded, row, group = nearest.gap[way, i, j], way, i, j
    if row >= 0:
        nearest.gap[rounded, row, group] = NOWHERE
    return rounded, row, group


@compiled
def _gather(
    given: Given,
    columns: Int,
    instants: Int,
    until: Float,
    features: NDArray[np.float32],
    gaps: Float,
    least: Float,
    inside: Bool,
) -> None:
    """Fill in the nearest pairs of movements, see :func:`pairs_of`."""
    setting, moves, kinds = given.setting, given.moves, given.obstacles.kind
    number, plans = moves.duration.shape
    memory = memory_of(setting, moves.table, moves.start.shape[1])
    shape = 2, kinds.shape[1], len(setting.spheres.link)
    centre = np.empty((*shape, 3))
    nearest = Nearest(np.empty(shape), np.empty(shape), centre, np.empty(NEAREST), np.empty(3))
    for each in range(number * plans):
        b, h = each // plans, each % plans
        nearest.gap[:] = NOWHERE
        count, inside[b, h] = _number_that_count(given, b, h, instants, until[b, h], memory)
        _look_at_all(given, b, h, instants[:count], least, memory, nearest)
        for pair in range(NEAREST):
            rounded, row, group = _take_nearest(nearest)
            if row < 0:
                break
            half, kind = given.half[b, row], kinds[b, row]
            for axis in range(3):
                there = nearest.centre[rounded, row, group, axis]
                # Kinds without a table of vertices or points look the same when an axis is reversed.
                features[b, h, pair, axis] = there if kind in IN_TABLES else abs(there)
                features[b, h, pair, 3 + axis] = half[axis]
            features[b, h, pair, 6] = nearest.radius[rounded, row, group]
            features[b, h, pair, LENGTHS + columns[kind]] = 1.0
            gaps[b, h, pair] = _gap(nearest.centre[rounded, row, group], half, 0)


class PairNetwork(nn.Module):
    """Network of a pair, whose minimum over the pairs of a movement is the learned margin.

    The network is added to the distance of the sphere's centre from the bounding box, so that it need not learn how the
    margin grows with it.

    An obstacle that is larger than all of its kind in training is seen as the largest of them, as far from the sphere:
    the distance from a box does not depend on where its other side is.
    """

    largest: Tensor

    def __init__(self, shapes: Sequence[str], width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(*create_mlp(LENGTHS + len(shapes), 1, [width, width]))
        # Greatest half lengths of each kind in training, 0 where there was none, [m]
        self.register_buffer("largest", torch.zeros(len(shapes), 3))
        # Places beside meshes and clouds have signs, so that these kinds stay as they are.
        self.boxlike = torch.tensor([[float(each in PLAIN_KINDS)] for each in shapes])

    def note_sizes(self, pairs: Pairs) -> None:
        """Note the sizes of the obstacles in a batch of training."""
        kind, half = pairs.features[..., LENGTHS:], pairs.features[..., 3:6]
        sizes = (kind[..., None] * half[..., None, :]).flatten(0, -3).amax(dim=0)
        self.largest.copy_(torch.maximum(self.largest, sizes * self.boxlike.to(sizes.device)))

    def forward(self, pairs: Pairs) -> Tensor:
        """Return the margin of each movement, shape (B, H), [m]; NO_OBSTACLE for scenes without obstacles."""
        place, half = pairs.features[..., :3], pairs.features[..., 3:6]
        radius, kind = pairs.features[..., 6:LENGTHS], pairs.features[..., LENGTHS:]
        # Kinds that training did not have are without limit.
        limits = torch.where(self.largest > 0.0, self.largest, NOWHERE)
        spare = (half - kind @ limits).clamp(min=0.0)
        place = torch.where(spare > 0.0, (place - spare).clamp(min=0.0), place)
        lengths = torch.cat((place, half - spare, radius), dim=-1)
        values = self.layers(torch.cat((SCALE * lengths, kind), dim=-1))[..., 0]
        values = values + (pairs.distance - AT_FIRST) / UNIT
        least = torch.where(pairs.present, values * UNIT, NO_OBSTACLE).amin(dim=-1)
        return least.clamp(max=NO_OBSTACLE)
