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
from viapoint.training.planning.movements import INSTANTS, Setting, joints_at, memory_of, place_hand
from viapoint.training.planning.problem import Moves, Problem, movement_of, place_at, setting_of

SCALE = 8.0  # Scale of lengths at the input of the network, [1/m]
UNIT = 0.05  # Length of one output unit of the network, [m]
# Number of the nearest pairs whose closest approach is found between the instants that are looked at
REFINED = 6
STEPS = 2  # Greatest number of instants by which it may lie beside the nearest of them
PARTS = 8  # Parts in which the way to the next instant is looked at
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


class Work(NamedTuple):
    """Memory of compiled functions."""

    position: Float  # Shape (D,)
    joints: Float  # Shape (J,)
    path: Float  # Joints at each instant that is looked at, or positions if the hand is alone, shape (N, J)
    placed: Placed
    places: Float  # A sphere in the frame of an obstacle before, at and after its closest instant, shape (3, 3), [m]
    local: Float  # Shape (3,), [m]


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


@inner
def _place_sphere(
    given: Given, b: int, h: int, row: int, group: int, sphere: int, instant: int, work: Work, local: Float
) -> bool:
    """Fill in a sphere's centre in the frame of an obstacle at an instant, and return True within reach."""
    moves, placed = given.moves, work.placed
    if not place_at(given.setting, moves, b, h, instant, work.position, work.joints, placed):
        return False
    place_group(given.setting.spheres, group, placed)
    _local(given, b, row, placed.centre[sphere], moves.duration[b, h] * instant / (INSTANTS - 1), local)
    return True


@inner
def _go_closest(
    given: Given,
    b: int,
    h: int,
    row: int,
    group: int,
    sphere: int,
    instant: int,
    last: int,
    rounded: int,
    work: Work,
) -> None:
    """Move the middle of the places, a sphere's centre at an instant, to where sphere and obstacle are closest.

    The search goes to the nearest instants beside it, up to the last one that counts, and then along a parabola through
    the places at three instants.
    """
    places, half = work.places, given.half[b, row]
    least = _gap(places[1], half, rounded)
    before, after = False, False  # True if the place beside is known
    for step in range(-1, 2, 2):
        for _ in range(STEPS):
            other = instant + step
            if other < 0 or other > last:
                break
            if not _place_sphere(given, b, h, row, group, sphere, other, work, places[1 + step]):
                break
            beside = _gap(places[1 + step], half, rounded)
            nearer = beside < least
            if nearer:  # the place in the middle becomes the one behind, and this one that in the middle
                for axis in range(3):
                    places[1 - step, axis] = places[1, axis]
                    places[1, axis] = places[1 + step, axis]
            if step < 0:
                before, after = not nearer, after or nearer
            else:
                before, after = before or nearer, not nearer
            if not nearer:
                break
            least, instant = beside, other
    if not (before and after):
        return
    best = 0.0
    for k in range(-PARTS, PARTS + 1):
        _along(places, k / PARTS, work.local)
        apart = _gap(work.local, half, rounded)
        if apart < least:
            least, best = apart, k / PARTS
    _along(places, best, work.local)
    for axis in range(3):
        places[1, axis] = work.local[axis]


@kernel
def _along(places: Float, share: float, local: Float) -> None:
    """Fill in the place on a parabola through three places, at a share of -1 to 1 from the middle."""
    for axis in range(3):
        slope = 0.5 * (places[2, axis] - places[0, axis])
        curve = 0.5 * (places[2, axis] + places[0, axis]) - places[1, axis]
        local[axis] = places[1, axis] + share * (slope + share * curve)


class Nearest(NamedTuple):
    """Nearest pair of each obstacle and group of spheres: by its box, and by this box with round edges."""

    gap: Float  # Gaps between sphere and box, shape (2, n, G), [m]
    sphere: Int  # Spheres, shape (2, n, G)
    instant: Int  # Instants, shape (2, n, G)
    smallest: Float  # Smallest gaps in increasing order, shape (NEAREST,), [m]


@inner
def _largest_seen(nearest: Nearest) -> float:
    """Return the largest gap of the NEAREST pairs so far: the network does not see others, [m]."""
    smallest = nearest.smallest
    smallest[:] = NOWHERE
    for gap in nearest.gap.flat:
        place = NEAREST
        while place > 0 and gap < smallest[place - 1]:
            place -= 1
            if place + 1 < NEAREST:
                smallest[place + 1] = smallest[place]
        if place < NEAREST:
            smallest[place] = gap
    largest: float = smallest[-1]
    return largest


@inner
def _look(
    given: Given,
    b: int,
    row: int,
    group: int,
    instant: int,
    time: float,
    largest: float,
    work: Work,
    nearest: Nearest,
) -> None:
    """Keep the sphere of a group that is nearest to an obstacle at an instant, if it is nearer than those before.

    Gaps above the `largest` that matters may be missed, [m].
    """
    spheres, placed, half = given.setting.spheres, work.placed, given.half[b, row]
    _local(given, b, row, placed.ball[group], time, work.local)
    bound = _gap(work.local, half, 0) - spheres.ball_radius[group]
    if bound >= min(largest, max(nearest.gap[0, row, group], nearest.gap[1, row, group])):
        return
    place_group(spheres, group, placed)
    for sphere in range(spheres.first[group], spheres.first[group + 1]):
        _local(given, b, row, placed.centre[sphere], time, work.local)
        for rounded in range(2):
            apart = _gap(work.local, half, rounded) - spheres.radius[sphere]
            if apart < nearest.gap[rounded, row, group]:
                nearest.gap[rounded, row, group] = apart
                nearest.sphere[rounded, row, group] = sphere
                nearest.instant[rounded, row, group] = instant


@inner
def _number_that_count(
    given: Given, b: int, h: int, instants: Int, until: float, work: Work
) -> tuple[int, bool]:
    """Fill in the path, and return the number of first instants that count, and False if it then leaves the reach."""
    movement = movement_of(given.moves, b, h)
    here = work.position if given.setting.hand_alone else work.joints
    for k in range(len(instants)):
        if k > 0 and movement.duration * instants[k] / (INSTANTS - 1) > until:
            return k, True
        if not joints_at(given.setting, movement, instants[k], work.position, work.joints):
            return k, False
        for axis in range(len(here)):
            work.path[k, axis] = here[axis]
    return len(instants), True


@inner
def _look_at_all(
    given: Given, b: int, h: int, instants: Int, least: Float, work: Work, nearest: Nearest
) -> None:
    """Fill in the nearest pairs of a movement at instants within reach, and its least clearance from itself.

    Neighbours come late, so that most parts of the arm are soon known to be farther away than before, and the start,
    where nothing is near, is last.
    """
    setting, moves, kinds = given.setting, given.moves, given.obstacles.kind
    order, spheres = moves.table.order, setting.spheres
    for i in range(1, len(order) + 1):
        k = order[i % len(order)]
        if k >= len(instants):
            continue
        if setting.hand_alone:
            place_hand(work.path[k], work.placed)
        else:
            place(setting.chain, spheres, work.path[k], work.placed)
        least[b, h] = self_clearance(spheres, work.placed, least[b, h], -CLEAR)
        time = moves.duration[b, h] * instants[k] / (INSTANTS - 1)
        largest = _largest_seen(nearest)
        for row in range(kinds.shape[1]):
            for group in range(len(spheres.link)):
                if kinds[b, row] != ABSENT and spheres.link[group] != 0:
                    _look(given, b, row, group, instants[k], time, largest, work, nearest)


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
    setting, moves, obstacles = given.setting, given.moves, given.obstacles
    number, plans = moves.duration.shape
    memory = memory_of(setting, moves.table, moves.start.shape[1])
    own = memory.position, memory.joints, memory.path, memory.placed
    work = Work(*own, np.empty((3, 3)), np.empty(3))
    gap = np.empty((2, obstacles.kind.shape[1], len(setting.spheres.link)))
    nearest = Nearest(gap, np.empty(gap.shape, np.int64), np.empty(gap.shape, np.int64), np.empty(NEAREST))
    for each in range(number * plans):
        b, h = each // plans, each % plans
        gap[:] = NOWHERE
        count, inside[b, h] = _number_that_count(given, b, h, instants, until[b, h], work)
        last = instants[max(count - 1, 0)]  # instant
        _look_at_all(given, b, h, instants[:count], least, work, nearest)
        for pair in range(NEAREST):
            rounded, row, group = _take_nearest(nearest)
            if row < 0:
                break
            sphere = nearest.sphere[rounded, row, group]
            instant = nearest.instant[rounded, row, group]
            _place_sphere(given, b, h, row, group, sphere, instant, work, work.places[1])
            if pair < REFINED and inside[b, h]:
                _go_closest(given, b, h, row, group, sphere, instant, last, rounded, work)
            half = given.half[b, row]
            gaps[b, h, pair] = _gap(work.places[1], half, 0)
            kind = obstacles.kind[b, row]
            for axis in range(3):
                there = work.places[1, axis]
                # Kinds without a table of vertices or points look the same when an axis is reversed.
                features[b, h, pair, axis] = there if kind in IN_TABLES else abs(there)
                features[b, h, pair, 3 + axis] = half[axis]
            features[b, h, pair, 6] = setting.spheres.radius[sphere]
            features[b, h, pair, LENGTHS + columns[kind]] = 1.0


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
        limits = torch.where(
            self.largest > 0.0, self.largest, NOWHERE
        )  # none where training had no such kind
        spare = (half - kind @ limits).clamp(min=0.0)
        place = torch.where(spare > 0.0, (place - spare).clamp(min=0.0), place)
        lengths = torch.cat((place, half - spare, radius), dim=-1)
        values = self.layers(torch.cat((SCALE * lengths, kind), dim=-1))[..., 0]
        values = values + (pairs.distance - AT_FIRST) / UNIT
        least = torch.where(pairs.present, values * UNIT, NO_OBSTACLE).amin(dim=-1)
        return least.clamp(max=NO_OBSTACLE)
