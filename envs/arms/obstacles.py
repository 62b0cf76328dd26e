"""Obstacles of a model: capsules of no fixed place, size or direction, which the simulator sets for each simulation."""

from __future__ import annotations

import mujoco


def add_obstacles(spec: mujoco.MjSpec, number: int) -> None:
    """Add movable capsules `obstacle_0`, `obstacle_1`, ... that collide with geoms of contact type 1."""
    for row in range(number):
        body = spec.worldbody.add_body(name=f"obstacle_{row}", mocap=True, pos=(0.0, 0.0, -10.0))
        body.add_geom(
            name=f"obstacle_{row}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=(0.02, 0.02, 0.0),
            contype=0,
            conaffinity=1,
            condim=1,
            rgba=(0.83, 0.52, 0.30, 1.0),
        )
