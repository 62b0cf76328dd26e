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
from viapoint.envs.geometry.clearance import memory, place_group, self_clearance
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.kernels import kernel
from viapoint.envs.geometry.obstacles import ABSENT, KINDS, MESH, Obstacles, bounding_boxes
from viapoint.envs.task import Task
from viapoint.training.planning.movements import INSTANTS, MovementTable, Setting, place_arm
from viapoint.training.planning.problem import Moves, Problem, setting_of

SCALE = 8.0
"""Scale of lengths at the input of the network, [1/m]."""
UNIT = 0.05
"""Length of one output unit of the network, [m]."""
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
    centre, half = bounding_boxes(obstacles)
    columns = np.array([task.shapes.index(kind) if kind in task.shapes else 0 for kind in KINDS])
    number, plans = moves.duration.shape
    late = np.full((number, plans), np.inf) if until is None else until
    setting = setting_of(task, obstacles)
    wide = LENGTHS + len(task.shapes)
    features = np.zeros((number, plans, NEAREST, wide), np.float32)
    gaps = np.full((number, plans, NEAREST), NOWHERE)
    least, inside = np.full((number, plans), CLEAR), np.ones((number, plans), np.bool_)
    _gather(
        setting,
        moves.table,
        problem.start,
        moves,
        obstacles,
        centre,
        half,
        columns,
        instants,
        late,
        features,
        gaps,
        least,
        inside,
    )
    return Pairs(
        torch.from_numpy(features),
        torch.from_numpy(gaps.astype(np.float32)),
        torch.from_numpy(gaps < NOWHERE),
        torch.from_numpy(least.astype(np.float32)),
        torch.from_numpy(inside),
    )


@kernel
def _box_gap(rotation: Float, dx: float, dy: float, dz: float, half: Float, local: Float) -> float:
    """Fill in a point in the frame of a box, and return its signed distance from the box, [m]."""
    largest, outside = -NOWHERE, 0.0
    for axis in range(3):
        local[axis] = rotation[0, axis] * dx + rotation[1, axis] * dy + rotation[2, axis] * dz
        over = abs(local[axis]) - half[axis]
        largest = max(largest, over)
        if over > 0.0:
            outside += over * over
    distance: float = np.sqrt(outside) + min(largest, 0.0)
    return distance


@compiled
def _gather(
    setting: Setting,
    table: MovementTable,
    start: Float,
    moves: Moves,
    obstacles: Obstacles,
    centre: Float,
    half: Float,
    columns: Int,
    instants: Int,
    until: Float,
    features: NDArray[np.float32],
    gaps: Float,
    least: Float,
    inside: Bool,
) -> None:
    """Fill in the nearest pairs of movements, see :func:`pairs_of`."""
    number, plans = moves.duration.shape
    spheres = setting.spheres
    rows, groups = obstacles.kind.shape[1], len(spheres.link)
    placed = memory(setting.chain, spheres)
    position, joints = np.empty(start.shape[1]), np.empty(len(setting.joint_range))
    gap, away = np.empty((rows, groups)), np.empty((rows, groups))
    point, radius = np.empty((rows, groups, 3)), np.empty((rows, groups))
    local = np.empty(3)
    for b in range(number):
        for h in range(plans):
            gap[:] = NOWHERE
            for k in range(len(instants)):
                instant = instants[k]
                time = moves.duration[b, h] * instant / (INSTANTS - 1)
                if k > 0 and time > until[b, h]:
                    break
                if not place_arm(
                    setting, table, moves.times[b, h], instant, start[b], moves.offsets[b, h], position, joints,
                    placed,
                ):  # fmt: skip
                    inside[b, h] = False
                    break
                least[b, h] = self_clearance(spheres, placed, least[b, h], -CLEAR)
                for row in range(rows):
                    if obstacles.kind[b, row] == ABSENT:
                        continue
                    cx = centre[b, row, 0] + obstacles.velocity[b, row, 0] * time
                    cy = centre[b, row, 1] + obstacles.velocity[b, row, 1] * time
                    cz = centre[b, row, 2] + obstacles.velocity[b, row, 2] * time
                    turn, size = obstacles.rotation[b, row], half[b, row]
                    for group in range(groups):
                        if spheres.link[group] == 0:
                            continue
                        ball = placed.ball[group]
                        bound = _box_gap(turn, ball[0] - cx, ball[1] - cy, ball[2] - cz, size, local)
                        if bound - spheres.ball_radius[group] >= gap[row, group]:
                            continue
                        place_group(spheres, group, placed)
                        for sphere in range(spheres.first[group], spheres.first[group + 1]):
                            here = placed.centre[sphere]
                            apart = _box_gap(turn, here[0] - cx, here[1] - cy, here[2] - cz, size, local)
                            if apart - spheres.radius[sphere] < gap[row, group]:
                                gap[row, group] = apart - spheres.radius[sphere]
                                away[row, group] = apart
                                radius[row, group] = spheres.radius[sphere]
                                for axis in range(3):
                                    point[row, group, axis] = local[axis]
            for pair in range(NEAREST):
                nearest, at_row, at_group = NOWHERE, -1, -1
                for row in range(rows):
                    for group in range(groups):
                        if gap[row, group] < nearest:
                            nearest, at_row, at_group = gap[row, group], row, group
                if at_row < 0:
                    break
                gap[at_row, at_group] = NOWHERE
                gaps[b, h, pair] = away[at_row, at_group]
                kind = obstacles.kind[b, at_row]
                for axis in range(3):
                    there = point[at_row, at_group, axis]
                    # Kinds without a table of vertices or points look the same when an axis is reversed.
                    features[b, h, pair, axis] = abs(there) if kind < MESH else there
                    features[b, h, pair, 3 + axis] = half[b, at_row, axis]
                features[b, h, pair, 6] = radius[at_row, at_group]
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
