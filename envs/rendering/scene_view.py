"""The scene that a camera sees: arm, table, obstacles, and a movement drawn over them."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float
from viapoint.envs.rendering.overlay import Movement
from viapoint.envs.rendering.shapes import GLOWING, Pencil, in_space, resampled
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.simulator import Simulator

CAMERA = "view"
HIDDEN = 5
"""MuJoCo's group of geoms that nobody sees."""
OVERHEAD, AMONG = 0.5, 0.7
"""How opaque links are that pass above the obstacles, or stand among them."""
LOW, TALL = 0.030, 0.060
"""Height of the obstacles over the hand: below the links that pass above, or in the way of the links, [m]."""
PLAN, DONE = 0.0065, 0.0030
"""Radius of a planned and of an executed path, [m]: the one shows as a rim of the other."""
SPACING = 0.011
"""Between the points of a drawn path, [m]."""
ROOM = 2000
"""Most shapes in a scene."""


class Stage:
    """Puts the arm and everything around it into a MuJoCo scene."""

    def __init__(self, simulator: Simulator, width: int, height: int) -> None:
        """Copy the model, so that looks can be set without a trace in the simulation."""
        self.arm = simulator.arm
        self.model = copy.copy(simulator.model)
        self._data = mujoco.MjData(self.model)
        self._option = mujoco.MjvOption()
        self._hand = self.model.geom("hand").id
        self._links = self._geoms_of_links()
        self.whole_arm = any(self.model.geom_contype[g] for g in self._links)
        """Whether the links collide, too."""
        self._floor = self._level_table()
        self._aim(width, height)
        if self.arm.dimension == 2:
            self.model.geom_rgba[self._links, 3] = AMONG if self.whole_arm else OVERHEAD
        self.scene = mujoco.MjvScene(self.model, ROOM)
        """What is to be seen, once it is set."""

    def set(
        self, scene: Scenes, joints: Float, movement: Movement | None = None, step: int = 0
    ) -> mujoco.MjvScene:
        """Set up the scene for one picture.

        Args:
            scene: Start, goal and obstacles, one row.
            joints: Posture of the arm, shape (J,), [rad].
            movement: What to draw of a movement: its whole plan, and what was done of it up to `step`.
            step: Index into the movement's states.
        """
        touch = None
        if movement is not None and movement.touch is not None and step >= movement.touch.step:
            touch = movement.touch
        self._pose(joints)
        if touch is not None:
            self._paint(self._hand if touch.link is None else self._links[touch.link], PALETTE.contact)
        pencil = Pencil(self.scene)
        self._draw_fittings(pencil)
        self._draw_ends(pencil, scene)
        self._draw_obstacles(pencil, scene, None if touch is None else touch.obstacle)
        if movement is not None:
            self._draw_movement(pencil, movement, step)

    def _pose(self, joints: Float) -> None:
        """Begin the scene anew with the arm in a posture."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        self._data.qpos[: len(joints)] = joints
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        mujoco.mjv_updateScene(
            self.model, self._data, self._option, None, self._camera, everything, self.scene
        )  # fmt: skip
        for geom in self._shown(self.model.geom("table").id):
            geom.castshadow = False  # it has none to throw them on, and would speckle itself

    def _geoms_of_links(self) -> list[int]:
        """The geoms of the moving bodies but the hand, in order; hides the obstacles' own geoms."""
        links = []
        for geom in range(self.model.ngeom):
            body = self.model.geom_bodyid[geom]
            if self.model.body_mocapid[body] >= 0:
                self.model.geom_group[geom] = HIDDEN
            elif self.model.body_weldid[body] > 0 and geom != self._hand:
                links.append(geom)
        return links

    def _level_table(self) -> float:
        """Put the table right under the lowest moving part of a planar arm; its height, [m]."""
        table = self.model.geom("table").id
        if self.arm.dimension == 2 and self.whole_arm:
            self.model.geom_pos[table, 2] = -max(self.arm.link_radii) - 0.003
        return float(self.model.geom_pos[table, 2])

    def _aim(self, width: int, height: int) -> None:
        """Widen the camera's angle for upright pictures, so that the whole workspace stays in view."""
        camera = self.model.camera(CAMERA).id
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        if width < height:
            half = np.tan(np.radians(self.model.cam_fovy[camera]) / 2.0)
            self.model.cam_fovy[camera] = 2.0 * np.degrees(np.arctan(half * height / width))

    def _paint(self, part: int, colour: Colour) -> None:
        """Give one geom of the model a colour."""
        for geom in self._shown(part):
            geom.rgba = np.array((*colour, 1.0), dtype=np.float32)

    def _shown(self, number: int) -> list[Any]:
        """A geom of the model as it stands in the scene."""
        geoms = self.scene.geoms[: self.scene.ngeom]
        return [g for g in geoms if g.objtype == mujoco.mjtObj.mjOBJ_GEOM and g.objid == number]

    def _draw_fittings(self, pencil: Pencil) -> None:
        """The base and the joints of a planar arm, and the handle where the hand is below the links."""
        if self.arm.dimension != 2:
            return
        for geom, radius in zip(self._links, self.arm.link_radii, strict=True):
            joint = self._data.xpos[self.model.geom_bodyid[geom]]
            pencil.disc(joint, 0.55 * radius, radius + 0.004, PALETTE.joint)
        base = np.array([0.0, 0.0, self._floor])
        pencil.disc(base, 1.25 * self.arm.link_radii[0], self._data.xpos[1, 2] - self._floor, PALETTE.joint)
        hand = self._data.geom_xpos[self._hand]
        grip = np.array([*hand[:2], self._data.xpos[self.model.geom_bodyid[self._hand], 2]])
        if grip[2] - hand[2] > self.arm.hand_radius:
            pencil.rod(hand, grip, 0.5 * self.arm.hand_radius, PALETTE.joint)

    def _draw_ends(self, pencil: Pencil, scene: Scenes) -> None:
        """Start and goal."""
        start, goal = in_space(scene.start[0], self._floor), in_space(scene.goal[0], self._floor)
        if self.arm.dimension == 2:
            pencil.ring(start, 0.021, 0.004, PALETTE.start)
            pencil.ring(goal, 0.031, 0.005, PALETTE.goal)
            pencil.disc(goal, 0.018, 0.003, PALETTE.goal, GLOWING)
        else:
            pencil.ball(goal, 0.018, PALETTE.goal, GLOWING)
            pencil.ball(start, 0.010, PALETTE.start, GLOWING)

    def _draw_obstacles(self, pencil: Pencil, scene: Scenes, touched: int | None) -> None:
        """Capsules; those of the plane with the same footprint, but upright: rounded posts and walls."""
        dimension, top = self.arm.dimension, TALL if self.whole_arm else LOW
        for row in np.flatnonzero(scene.present[0]):
            numbers = scene.obstacles[0, row]
            centre, radius = in_space(numbers[:dimension], self._floor), float(numbers[-1])
            half_axis = in_space(numbers[dimension : 2 * dimension], 0.0)
            colour: Colour = PALETTE.contact if row == touched else PALETTE.obstacle
            if dimension == 3 and half_axis.any():
                pencil.rod(centre - half_axis, centre + half_axis, radius, colour)
            elif dimension == 3:
                pencil.ball(centre, radius, colour)
            elif half_axis.any():
                pencil.wall(centre, half_axis, top, radius, colour)
            else:
                pencil.post(centre, top, radius, colour)

    def _draw_movement(self, pencil: Pencil, movement: Movement, step: int) -> None:
        """The planned path, its via-points, and the executed path up to `step`, red from contact on."""
        level = self._floor + 0.001
        planned = in_space(resampled(movement.planned, SPACING), level)
        pencil.line(planned, PLAN, PALETTE.plan)
        for via in in_space(movement.vias, level):
            pencil.ball(via, 0.011, PALETTE.via, GLOWING)
        free = step if movement.touch is None else min(step, movement.touch.step)
        for first, last, colour in ((0, free, PALETTE.executed), (free, step, PALETTE.contact)):
            if last > first:
                done = in_space(resampled(movement.hand[first : last + 1], SPACING), level + PLAN)
                pencil.line(done, DONE, colour)
