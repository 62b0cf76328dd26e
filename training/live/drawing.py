"""Three-dimensional view of the live page: arm, obstacles, plans, and handles to drag."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from mjviser.conversions import get_geom_texture_id, merge_geoms

from viapoint.envs import Arm, Box, Capsule, HalfSpace, Shape, Sphere
from viapoint.envs.arms.load import read_model
from viapoint.envs.common.arrays import Float, frame_matrices, norm, quaternion_to
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.geometry.obstacles import add_to_model, pack
from viapoint.training.live.arena import SAMPLES, Arena
from viapoint.training.live.state import State
from viapoint.training.planning.motion_plan import MotionPlan

PLAN, PROPOSAL, DONE = 0.0050, 0.0028, 0.0032  # Radii of plan, proposals, executed path, [m]
ROD = trimesh.creation.cylinder(1.0, 2.0, sections=8)  # Piece of a tube before it is scaled
ABOVE = np.array([0.0, 0.0, 0.004])  # Shift of the executed path, so that the plan stays visible, [m]
RADII = {"start": 0.018, "goal": 0.018, "via": 0.013}  # Radii of the handles, [m]
# First views: position of the camera, point that it looks at, [m], direction up, and field of view, [rad]
PLANE = (-0.03, 0.26, 1.75), (-0.03, 0.29, 0.0), (0.0, 1.0, 0.0), math.radians(33.0)
SPACE = (2.6, -2.0, 1.75), (0.15, 0.0, 0.42), (0.0, 0.0, 1.0), math.radians(38.0)
OPACITY, GHOST = 0.45, 0.16  # Of what hides others, and of the arm at the goal
POINT = 0.005  # Size of the points that a sensor sees, [m]
LARGE = 0.16  # Greatest size of obstacles in space that are not large, [m]
LOW, TALL = 0.030, 0.060  # Height of obstacles in the plane, [m]: below links, and as tall as links
PALE = 0.45  # Strength of pale colours
FARTHEST = 1.2  # Greatest coordinate to which something can be dragged, [m]


def tube(points: Float, radius: float) -> Any:
    """Return a tube along points, shape (n, 3), [m], as a mesh of `trimesh`: a rod for each pair of neighbours."""
    steps = np.diff(points, axis=0)
    middles = points[:-1] + 0.5 * steps
    turns = frame_matrices(np.array([quaternion_to(step) for step in steps]))
    sizes = np.full_like(steps, radius)
    sizes[:, 2] = 0.5 * norm(steps)
    rods = (sizes[:, None] * ROD.vertices) @ np.swapaxes(turns, -1, -2) + middles[:, None]
    faces = ROD.faces + len(ROD.vertices) * np.arange(len(steps))[:, None, None]
    return trimesh.Trimesh(rods.reshape(-1, 3), faces.reshape(-1, 3), process=False)


def obstacle_mesh(shape: Shape, levels: tuple[float, float] | None = None) -> Any:
    """Return the mesh of an obstacle around its position, turned as it is in the world; a plate is a half-space.

    `levels` are the heights between which an obstacle in the plane is cut off, [m].
    """
    place = np.array(shape.position)
    if isinstance(shape, HalfSpace):
        centre = place - 0.02 * shape.rotation[:, 2]
        shape = Box((1.0, 1.0, 0.02), position=centre, quaternion=shape.quaternion)
    spec = mujoco.MjSpec()
    add_to_model(spec, [dataclasses.replace(shape, name="")])
    mesh = merge_geoms(spec.compile(), [0])
    vertices = np.array(mesh.vertices)
    if levels is not None:
        vertices[:, 2] = np.clip(vertices[:, 2], *levels)
    return trimesh.Trimesh(vertices - place, mesh.faces, process=False)


class ArmDrawing:
    """Meshes of an arm, those of its MuJoCo model or the visible geoms of another file, and their poses."""

    def __init__(self, arm: Arm, model: mujoco.MjModel, model_file: str | Path | None = None) -> None:
        drawn = model if model_file is None else read_model(model_file)
        self._offset = _first_anchor(model, arm) - _first_anchor(drawn, arm)
        self._model, self._data = drawn, mujoco.MjData(drawn)
        if drawn.nkey:
            mujoco.mj_resetDataKeyframe(drawn, self._data, 0)
        self._joints = np.array([drawn.joint(name).qposadr[0] for name in arm.joint_names])
        ground = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        visible = ~np.isin(drawn.geom_type, ground) & (drawn.body_mocapid[drawn.geom_bodyid] < 0)
        visible &= drawn.geom_rgba[:, 3] > 0.0
        plain = visible & (drawn.geom_group < 3)  # MuJoCo's viewers hide others, which only collide
        groups: dict[tuple[int, Any], list[int]] = {}
        for geom in np.flatnonzero(plain if plain.any() else visible).tolist():
            material = drawn.geom_matid[geom]
            colour = drawn.geom_rgba[geom] if material < 0 else drawn.mat_rgba[material]
            textured = get_geom_texture_id(drawn, geom) >= 0
            key = int(drawn.geom_bodyid[geom]), None if textured else tuple(colour[:3])
            groups.setdefault(key, []).append(geom)
        self.parts = [(*key, merge_geoms(drawn, geoms)) for key, geoms in groups.items()]
        """Body, colour (None for textures) and mesh of the parts that move alike."""

    def poses(self, joints: Float) -> list[tuple[Float, Float]]:
        """Return quaternion and position of each part for joint angles, shape (J,), [rad]."""
        self._data.qpos[self._joints] = joints
        mujoco.mj_kinematics(self._model, self._data)
        bodies = [body for body, *_ in self.parts]
        return [(self._data.xquat[body].copy(), self._data.xpos[body] + self._offset) for body in bodies]


def _first_anchor(model: mujoco.MjModel, arm: Arm) -> Float:
    """Return the place of the first joint in a model, [m]."""
    data = mujoco.MjData(model)
    joint = model.joint(arm.joint_names[0])
    data.qpos[joint.qposadr[0]] = 0.0
    mujoco.mj_kinematics(model, data)
    return np.array(data.xanchor[joint.id])


class View:
    """View of one tab, drawn from its state; `act` is called with the name of what a user does and its values.

    All is drawn again after each change: the library sends only what differs from what it sent before.
    """

    def __init__(
        self, client: viser.ClientHandle, arena: Arena, arm: ArmDrawing, act: Callable[..., None]
    ) -> None:
        self._scene, self._arena, self._arm, self._act = client.scene, arena, arm, act
        self._planar = arena.planar
        self._floor = float(arena.env("own").model.geom("table").pos[2])
        self._levels = (self._floor, TALL if arena.task.whole_arm else LOW) if self._planar else None
        self._nodes: dict[str, Any] = {}
        self._forms: dict[str, tuple[Any, ...]] = {}  # what the meshes of the obstacles show
        self._grab = np.zeros(3)
        lines = (214, 214, 218)
        centre = (-0.03, 0.35) if self._planar else (0.0, 0.0)
        self._scene.add_grid(
            "/grid", 2.0, 2.0, position=(*centre, self._floor), cell_size=0.1, section_size=0.1,
            cell_color=lines, section_color=lines, section_thickness=1.0, shadow_opacity=0.0,
            plane_color=_rgb(PALETTE.table), plane_opacity=1.0,
        )  # fmt: skip
        for i, (_, colour, mesh) in enumerate(arm.parts):
            if colour is None and not self._planar:
                self._nodes[f"/arm/{i}"] = self._scene.add_mesh_trimesh(f"/arm/{i}", mesh)
            else:
                self._mesh(f"/arm/{i}", mesh, _rgb(colour or PALETTE.arm), OPACITY if self._planar else None)
            if not self._planar:
                self._mesh(f"/ghost/{i}", mesh, _rgb(colour or PALETTE.arm), GHOST)
        axes = (True, True, not self._planar)
        self._rings = self._scene.add_transform_controls(
            "/turn", 0.2, disable_axes=True, disable_sliders=True, visible=False, active_axes=axes
        )
        self._rings.on_update(lambda _: act("turn", np.array(self._rings.wxyz)))

    def draw(self, state: State) -> None:
        """Draw the scene, the plans and the movement."""
        arena, scene, movement = self._arena, state.scene, state.movement
        joints = arena.task.space.joints(scene.start)
        places = [shape.position for shape in scene.obstacles]
        done = []
        if movement is not None:
            rollout, now = movement.rollout, state.instant
            joints = rollout.joints[now]
            places = movement.scenes.obstacles_at(rollout.time[now : now + 1]).centre[0]
            rows = np.linspace(0, now, SAMPLES).astype(int)
            colour = PALETTE.contact if rollout.contact[: now + 1].any() else PALETTE.executed
            done = [(rollout.hand[rows] + ABOVE, _rgb(colour))]
        self._draw_paths("done", done, DONE)
        self._draw_arm("arm", joints)
        if not self._planar:
            self._draw_arm("ghost", arena.task.space.joints(scene.goal))
        self._draw_obstacles(scene.obstacles, places, state.selected)
        self._draw_seen(state)
        start, goal = arena.tool(np.stack((scene.start, scene.goal)))
        self._draw_handles("start", [start])
        self._draw_handles("goal", [goal])
        self._draw_rings(state, goal)
        if state.plan is None:
            return
        vias = arena.tool(state.plan.waypoints[1:-1])
        planned = [self._line(state.plan, 1.0)]
        if movement is not None and movement.plan is not None and arena.task.replanning:
            vias = vias[:0]
            planned = [(arena.path(movement.plan), _rgb(PALETTE.plan))]
        others = [] if state.before is None else [state.before]
        if len(state.proposals) > 1:
            others = [each.motion for each in state.proposals]
        self._draw_handles("via", vias)
        self._draw_paths("plan", planned, PLAN)
        self._draw_paths("proposal", [self._line(motion, PALE) for motion in others], PROPOSAL)

    def _line(self, motion: MotionPlan, strength: float) -> tuple[Float, Any]:
        """Return the path of a plan, and its colour."""
        colour = PALETTE.plan if motion.success else PALETTE.contact
        return self._arena.path(motion.plan), _rgb(colour, strength)

    def _draw_rings(self, state: State, goal: Float) -> None:
        """Draw rings that turn the selected obstacle or the tool at the goal; obstacles in the plane stay upright."""
        self._rings.visible = state.turning and (state.selected is not None or not self._planar)
        if state.selected is not None:
            shape = state.scene.obstacles[state.selected]
            self._rings.wxyz = shape.quaternion
            self._rings.position = shape.position
        elif not self._planar:
            self._rings.wxyz = self._arena.orientation(state.scene.goal)
            self._rings.position = goal

    def _draw_arm(self, name: str, joints: Float) -> None:
        for i, (turn, position) in enumerate(self._arm.poses(joints)):
            node = self._nodes[f"/{name}/{i}"]
            node.wxyz, node.position = turn, position

    def _draw_obstacles(self, shapes: tuple[Shape, ...], places: Any, selected: int | None) -> None:
        for i, (shape, place) in enumerate(zip(shapes, places, strict=False)):
            name = f"/obstacle/{i}"
            form = (shape.kind, *shape.packed_size, *shape.quaternion, id(shape.mesh))
            if self._forms.get(name) != form:  # most stay as they are
                self._forms[name] = form
                self._mesh(name, obstacle_mesh(shape, self._levels), _rgb(PALETTE.obstacle))
            node = self._nodes[name]
            node.flat_shading = not isinstance(shape, Sphere | Capsule)
            large = isinstance(shape, HalfSpace) or float(shape.packed_size.max()) > LARGE
            node.opacity = OPACITY if large and not self._planar else None
            node.color = _rgb(PALETTE.obstacle, PALE if i == selected else 1.0)
            node.position, node.visible = place, True
        self._hide("obstacle", len(shapes))

    def _draw_seen(self, state: State) -> None:
        """Draw the points that the sensor of the task sees from the start."""
        task, scene = self._arena.task, state.scene
        if task.sensor is None:
            return
        joints = task.space.joints(scene.start)[None]
        found = task.sensor.read(task.arm, joints, pack([scene.obstacles]))
        points = found.points[found.seen >= 0]
        if self._planar:
            points[:, 2] = LOW + 0.002  # on top of the obstacles
        if "/seen" not in self._nodes:
            self._nodes["/seen"] = self._scene.add_point_cloud(
                "/seen", points, _rgb(PALETTE.seen), point_size=POINT, point_shape="circle"
            )
        self._nodes["/seen"].points = points

    def _draw_paths(self, name: str, paths: list[tuple[Float, Any]], radius: float) -> None:
        """Draw paths, shape (n, 3), [m], with their colours."""
        for i, (path, colour) in enumerate(paths):
            self._mesh(f"/{name}/{i}", tube(path, radius), colour)
        self._hide(name, len(paths))

    def _draw_handles(self, name: str, places: Float | list[Float]) -> None:
        """Draw handles, and lines down to the table that show their places."""
        colour = getattr(PALETTE, name)
        for i, place in enumerate(places):
            key = f"/{name}/{i}"
            drop = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, self._floor - place[2]]]])
            if key not in self._nodes:
                self._mesh(key, trimesh.creation.icosphere(3, RADII[name]), _rgb(colour))
                self._nodes[f"{key}/drop"] = self._scene.add_line_segments(
                    f"{key}/drop", drop, _rgb(colour, PALE), thickness=0.003
                )
            self._nodes[f"{key}/drop"].points = drop
            self._nodes[key].position, self._nodes[key].visible = place, True
        self._hide(name, len(places))

    def _hide(self, name: str, number: int) -> None:
        """Hide the nodes of a name from a number on."""
        while (node := self._nodes.get(f"/{name}/{number}")) is not None:
            node.visible = False
            number += 1

    def _mesh(self, key: str, mesh: Any, colour: Any, opacity: float | None = None) -> None:
        """Add a mesh, or change the one of this name."""
        _, name, number = key.split("/")
        if key in self._nodes:
            node = self._nodes[key]
            node.vertices, node.faces = mesh.vertices, np.uint32(mesh.faces)
            node.color, node.visible = colour, True
            return
        shadow = name in ("arm", "obstacle")
        node = self._nodes[key] = self._scene.add_mesh_simple(
            key, mesh.vertices, mesh.faces, color=colour, opacity=opacity, cast_shadow=shadow,
            receive_shadow=shadow, flat_shading=name in ("done", "plan", "proposal"),
        )  # fmt: skip
        if name == "proposal":
            node.on_click(lambda _: self._act("pick", int(number)))
        if name == "obstacle":
            node.on_click(lambda _: self._act("show", "selected", int(number)))
        if name == "obstacle" or name in RADII:
            dragged = functools.partial(self._dragged, name, int(number))
            node.on_drag("left")(dragged)
            if not self._planar:
                node.on_drag("left", modifier="shift")(dragged)

    async def _dragged(
        self, kind: str, number: int, event: Any
    ) -> None:  # such functions are called in order
        """Drag a node horizontally, or up and down with Shift, to where the pointer's ray meets its plane."""
        eye = np.asarray(event.client.camera.position)
        place = np.asarray(event.target.position)
        if event.phase == "start":
            self._grab = np.asarray(event.start_position) - place
        upright = event.modifier is not None
        normal = (eye - place) * (1.0, 1.0, 0.0) if upright else np.array([0.0, 0.0, 1.0])
        ray = np.asarray(event.end_position) - eye
        slope = float(normal @ ray)
        share = float(normal @ (place + self._grab - eye)) / slope if abs(slope) > 1e-6 else 0.0
        if share <= 0.0:
            return
        point = eye + share * ray - self._grab
        if upright:
            point = np.array([*place[:2], max(point[2], self._floor)])
        self._act("drag", kind, number, np.clip(point, -FARTHEST, FARTHEST))


def _rgb(colour: Colour, strength: float = 1.0) -> Any:
    """Return a colour in [0, 255], paler for a strength below 1."""
    return tuple(round(255.0 * (1.0 + strength * (each - 1.0))) for each in colour)
