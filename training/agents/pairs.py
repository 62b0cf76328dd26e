"""Pairs of a sphere of the arm and an obstacle during planned movements, as inputs of one network, and this network.

The clearance of a movement is a minimum over time, spheres of the arm and obstacles. A critic with this structure
learns from the outcome of single movements which pair determined it:

    m(s, a) = min over obstacles i, spheres h, instants t of q(centre of h in the frame of i at t, size and kind of i)

Kinematics places the spheres. For each obstacle and link the pair whose sphere is nearest to the obstacle's box
stands for all instants; of these, the network sees the nearest ones. The distance from the surface is learned, not
computed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.clearance import Placed, place_group, self_clearance
from viapoint.envs.geometry.clearance import memory as memory_of
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.kernels import kernel
from viapoint.envs.geometry.obstacles import ABSENT, KINDS, MESH, Obstacles, bounding_boxes
from viapoint.envs.task import Task
from viapoint.training.planning.movements import INSTANTS, Setting, place_arm
from viapoint.training.planning.problem import Moves, Problem, setting_of

SCALE = 8.0
"""Scale of lengths at the input of the network, [1/m]."""
UNIT = 0.05
"""Length of one output unit of the network, [m]."""
REFINED = 4
"""Number of the nearest pairs whose closest approach is found between the instants that are looked at."""
STEPS = 2
"""Greatest number of instants by which it may lie beside the nearest of them."""
NEAREST = 12
"""Number of pairs of a movement that the network sees."""
CLEAR = 0.1
"""Greatest clearance of the arm from itself that matters, [m]."""
NO_OBSTACLE = 1.0
"""Margin in a scene without obstacles, [m]."""
NOWHERE = 1e6
"""Gap of a pair that does not exist, [m]."""
LENGTHS = 7
"""Lengths that describe a pair: centre of the sphere 3, half lengths of the obstacle 3, radius of the sphere 1."""


class Pairs(NamedTuple):
    """Nearest pairs of H movements in each of B scenes."""

    features: Tensor
    """Lengths and kind of the obstacle, shape (B, H, P, LENGTHS + number of kinds)."""
    distance: Tensor
    """Signed distances of the spheres' centres from the obstacles' bounding boxes, shape (B, H, P), [m]."""
    present: Tensor
    """True for pairs that exist, shape (B, H, P)."""
    self_clearance: Tensor
    """Computed clearance of the arm from itself, shape (B, H), at most CLEAR, [m]."""
    inside: Tensor
    """True for movements within reach and joint ranges, shape (B, H)."""


def pairs_of(task: Task, problem: Problem, moves: Moves, instants: Int, until: Float | None = None) -> Pairs:
    """Return the nearest pairs of movements.

    Args:
        task: Task.
        problem: B problems.
        moves: H movements in each of them.
        instants: Instants that are looked at, some of 0 to INSTANTS - 1 in increasing order.
        until: Time after which instants do not count, shape (B, H), [s]; the first instant always counts.
    """
    obstacles = problem.obstacles
    columns = np.array([task.shapes.index(kind) if kind in task.shapes else 0 for kind in KINDS])
    number, plans = moves.duration.shape
    late = np.full((number, plans), np.inf) if until is None else until
    given = Given(setting_of(task, obstacles), problem.start, moves, obstacles, *bounding_boxes(obstacles))
    features = np.zeros((number, plans, NEAREST, LENGTHS + len(task.shapes)), np.float32)
    gaps = np.full((number, plans, NEAREST), NOWHERE)
    least, inside = np.full((number, plans), CLEAR), np.ones((number, plans), np.bool_)
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
    start: Float
    """Present references, shape (B, D)."""
    moves: Moves
    obstacles: Obstacles
    centre: Float
    """Centres of the obstacles' bounding boxes, shape (B, n, 3), [m]."""
    half: Float
    """Their half lengths, shape (B, n, 3), [m]."""


class Memory(NamedTuple):
    """Memory of compiled functions."""

    position: Float
    """Shape (D,)."""
    joints: Float
    """Shape (J,)."""
    placed: Placed
    places: Float
    """Places of a sphere in the frame of an obstacle: before, at and after its closest instant, shape (3, 3), [m]."""


@kernel
def _arm_at(given: Given, b: int, h: int, instant: int, memory: Memory) -> bool:
    """Place the arm at an instant of a movement, and return True within reach and joint ranges."""
    setting, moves = given.setting, given.moves
    position, joints, placed = memory.position, memory.joints, memory.placed
    offsets, times = moves.offsets[b, h], moves.times[b, h]
    return bool(
        place_arm(setting, moves.table, times, instant, given.start[b], offsets, position, joints, placed)
    )


@kernel
def _gap(given: Given, b: int, row: int, point: Float, time: float, local: Float) -> float:
    """Fill in a point in the frame of an obstacle, and return its signed distance from the obstacle's box, [m]."""
    obstacles, half = given.obstacles, given.half[b, row]
    largest, outside = -NOWHERE, 0.0
    for axis in range(3):
        local[axis] = 0.0
        for k in range(3):
            away = point[k] - given.centre[b, row, k] - obstacles.velocity[b, row, k] * time
            local[axis] += obstacles.rotation[b, row, k, axis] * away
        over = abs(local[axis]) - half[axis]
        largest = max(largest, over)
        if over > 0.0:
            outside += over * over
    distance: float = np.sqrt(outside) + min(largest, 0.0)
    return distance


@kernel
def _gap_at(
    given: Given,
    b: int,
    h: int,
    row: int,
    group: int,
    sphere: int,
    instant: int,
    memory: Memory,
    local: Float,
) -> float:
    """Fill in a sphere's centre in the frame of an obstacle at an instant, and return its distance from the box, [m].

    Out of reach the distance is NOWHERE.
    """
    if not _arm_at(given, b, h, instant, memory):
        return NOWHERE
    place_group(given.setting.spheres, group, memory.placed)
    time = given.moves.duration[b, h] * instant / (INSTANTS - 1)
    return float(_gap(given, b, row, memory.placed.centre[sphere], time, local))


@kernel
def _closest(
    given: Given, b: int, h: int, row: int, group: int, sphere: int, instant: int, last: int, memory: Memory
) -> float:
    """Fill in the middle of the places with that where sphere and box are closest, and return the distance, [m].

    From an instant the search goes to the nearest ones beside it, up to the last one that counts, and between these
    along a parabola through three places.
    """
    places = memory.places
    least = _gap_at(given, b, h, row, group, sphere, instant, memory, places[1])
    before, after = NOWHERE, NOWHERE
    for step in range(-1, 2, 2):
        for _ in range(STEPS):
            other = instant + step
            if other < 0 or other > last:
                break
            beside = _gap_at(given, b, h, row, group, sphere, other, memory, places[1 + step])
            nearer = beside < least
            if nearer:  # the place in the middle becomes the one behind, and this one that in the middle
                for axis in range(3):
                    places[1 - step, axis] = places[1, axis]
                    places[1, axis] = places[1 + step, axis]
            if step < 0:
                before, after = (NOWHERE, least) if nearer else (beside, after)
            else:
                before, after = (least, NOWHERE) if nearer else (before, beside)
            if not nearer:
                break
            least, instant = beside, other
    bend = before - 2.0 * least + after
    if max(before, after) >= NOWHERE or bend <= 0.0:
        return least
    share = min(max(0.5 * (before - after) / bend, -0.5), 0.5)
    outside, largest = 0.0, -NOWHERE
    for axis in range(3):
        slope = 0.5 * (places[2, axis] - places[0, axis])
        curve = 0.5 * (places[2, axis] + places[0, axis]) - places[1, axis]
        places[1, axis] += share * (slope + share * curve)
        over = abs(places[1, axis]) - given.half[b, row, axis]
        largest = max(largest, over)
        outside += max(over, 0.0) ** 2
    closest: float = np.sqrt(outside) + min(largest, 0.0)
    return closest


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
    moves, obstacles, spheres = given.moves, given.obstacles, given.setting.spheres
    number, plans = moves.duration.shape
    rows, groups = obstacles.kind.shape[1], len(spheres.link)
    placed = memory_of(given.setting.chain, spheres)
    position, joints = np.empty(given.start.shape[1]), np.empty(len(given.setting.joint_range))
    memory = Memory(position, joints, placed, np.empty((3, 3)))
    gap, local = np.empty((rows, groups)), np.empty(3)
    nearest_sphere, nearest_instant = np.empty((rows, groups), np.int64), np.empty((rows, groups), np.int64)
    for b in range(number):
        for h in range(plans):
            gap[:] = NOWHERE
            last = 0  # instant that counts
            for k in range(len(instants)):
                instant = instants[k]
                time = moves.duration[b, h] * instant / (INSTANTS - 1)
                if k > 0 and time > until[b, h]:
                    break
                if not _arm_at(given, b, h, instant, memory):
                    inside[b, h] = False
                    break
                last = instant
                least[b, h] = self_clearance(spheres, placed, least[b, h], -CLEAR)
                for row in range(rows):
                    if obstacles.kind[b, row] == ABSENT:
                        continue
                    for group in range(groups):
                        if spheres.link[group] == 0:
                            continue
                        bound = _gap(given, b, row, placed.ball[group], time, local)
                        if bound - spheres.ball_radius[group] >= gap[row, group]:
                            continue
                        place_group(spheres, group, placed)
                        for sphere in range(spheres.first[group], spheres.first[group + 1]):
                            apart = _gap(given, b, row, placed.centre[sphere], time, local)
                            if apart - spheres.radius[sphere] < gap[row, group]:
                                gap[row, group] = apart - spheres.radius[sphere]
                                nearest_sphere[row, group], nearest_instant[row, group] = sphere, instant
            for pair in range(NEAREST):
                nearest, row, group = NOWHERE, -1, -1
                for i in range(rows):
                    for j in range(groups):
                        if gap[i, j] < nearest:
                            nearest, row, group = gap[i, j], i, j
                if row < 0:
                    break
                gap[row, group] = NOWHERE
                sphere, instant = nearest_sphere[row, group], nearest_instant[row, group]
                if pair < REFINED and inside[b, h]:
                    gaps[b, h, pair] = _closest(given, b, h, row, group, sphere, instant, last, memory)
                else:
                    gaps[b, h, pair] = _gap_at(
                        given, b, h, row, group, sphere, instant, memory, memory.places[1]
                    )
                kind = obstacles.kind[b, row]
                for axis in range(3):
                    there = memory.places[1, axis]
                    # Kinds without a table of vertices or points look the same when an axis is reversed.
                    features[b, h, pair, axis] = abs(there) if kind < MESH else there
                    features[b, h, pair, 3 + axis] = given.half[b, row, axis]
                features[b, h, pair, 6] = spheres.radius[sphere]
                features[b, h, pair, LENGTHS + columns[kind]] = 1.0


class PairNetwork(nn.Module):
    """Network of a pair, whose minimum over the pairs of a movement is the learned margin.

    Args:
        kinds: Number of kinds of obstacles.
        width: Width of the two hidden layers.
    """

    def __init__(self, kinds: int, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(LENGTHS + kinds, width),
            nn.ReLU(),
            nn.Linear(width, width),
            nn.ReLU(),
            nn.Linear(width, 1),
        )
        self.nearness = nn.Parameter(torch.tensor([1.0, -2.0]))
        """Slope and offset of a skip connection from the distance of the bounding box. It makes the nearest pair the
        minimum at the start of training."""

    def forward(self, pairs: Pairs) -> Tensor:
        """Return the margin of each movement, shape (B, H), [m]; NO_OBSTACLE for scenes without obstacles."""
        lengths, kind = pairs.features[..., :LENGTHS], pairs.features[..., LENGTHS:]
        values = self.layers(torch.cat((SCALE * lengths, kind), dim=-1))[..., 0]
        values = values + self.nearness[0] * (pairs.distance / UNIT) + self.nearness[1]
        least = torch.where(pairs.present, values * UNIT, NO_OBSTACLE).amin(dim=-1)
        return torch.minimum(least, torch.full_like(least, NO_OBSTACLE))
