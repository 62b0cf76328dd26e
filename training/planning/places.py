"""Places of an arm's spheres during planned movements, as a sensor sees them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Bool, Int, Single
from viapoint.envs.geometry.clearance import place_group
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.task import Task
from viapoint.training.planning.beliefs import Sight
from viapoint.training.planning.movements import INSTANTS, Setting, memory_of
from viapoint.training.planning.problem import Moves, Problem, place_at, setting_of

OUT_OF_VIEW = -1  # Ray of a place that is outside the field of view


class Places(NamedTuple):
    """Places of S spheres at T instants of H movements in each of B scenes."""

    # Number of the ray that passes nearest to the centre, or OUT_OF_VIEW, shape (B, H, T, S)
    ray: NDArray[np.int32]
    distance: Single  # Distance of the centre from the sensor, shape (B, H, T, S), [m]
    centre: Single  # Centre in the world, shape (B, H, T, S, 3), [m]
    radius: Single  # Radius of each sphere, shape (S,), [m]
    inside: Bool  # True for movements within reach and joint ranges, shape (B, H)

    def depth(self, sight: Sight) -> Single:
        """Return how far centres lie behind the surface that is seen in their direction, shape (B, H, T, S), [m].

        Where nothing is seen in this direction, or the place is out of view, it is the negative greatest range.
        """
        number = len(self.ray)
        flat = self.ray.reshape(number, -1)
        rays = np.maximum(flat, 0)
        ranges = np.take_along_axis(sight.ranges, rays, axis=1)
        seen = np.take_along_axis(sight.hit, rays, axis=1) & (flat >= 0)
        depth = np.where(seen, self.distance.reshape(number, -1) - ranges, -sight.ranges.max(initial=1.0))
        return depth.reshape(self.ray.shape).astype(np.float32)


def places_of(task: Task, problem: Problem, moves: Moves, sight: Sight, instants: Int) -> Places:
    """Return where the spheres of the arm are at some instants of H movements in each of B problems.

    The obstacles of the problems tell which spheres of an arm in the plane matter.
    """
    setting = setting_of(task, problem.obstacles)
    number, plans = moves.duration.shape
    links = np.repeat(setting.spheres.link, np.diff(setting.spheres.first))
    some = np.flatnonzero(links > 0)
    shape = number, plans, len(instants), len(some)
    centre = np.zeros((*shape, 3), np.float32)
    inside = np.ones((number, plans), np.bool_)
    _centres(setting, moves, instants, some, centre, inside)
    sensor = task.sensor
    assert sensor is not None
    away = centre.reshape(number, -1, 3) - sight.origin[:, None].astype(np.float32)
    local = away @ sight.rotation.astype(np.float32)
    distance = np.sqrt((local**2).sum(axis=-1))
    ray = sensor.ray_towards(local)
    radius = setting.spheres.radius[some].astype(np.float32)
    return Places(ray.reshape(shape), distance.reshape(shape), centre, radius, inside)


def instants_of(task: Task, number: int) -> Int:
    """Return instants of a movement at which its places are looked at; in joint space not the first and last ones."""
    ends = 0 if task.space.of_hand else 2
    return np.linspace(ends, INSTANTS - 1 - ends, number).round().astype(np.int64)


@compiled
def _centres(setting: Setting, moves: Moves, instants: Int, some: Int, centre: Single, inside: Bool) -> None:
    """Fill in the centres of some spheres, see :func:`places_of`."""
    number, plans = moves.duration.shape
    spheres = setting.spheres
    memory = memory_of(setting, moves.table, moves.start.shape[1])
    position, joints, placed = memory.position, memory.joints, memory.placed
    for b in range(number):
        for h in range(plans):
            for k in range(len(instants)):
                if not place_at(setting, moves, b, h, instants[k], position, joints, placed):
                    inside[b, h] = False
                    break
                for group in range(len(spheres.link)):
                    place_group(spheres, group, placed)
                for i in range(len(some)):
                    for axis in range(3):
                        centre[b, h, k, i, axis] = placed.centre[some[i], axis]
