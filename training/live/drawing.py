"""Three-dimensional view of the live page: arm, obstacles, plans, and handles to drag."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import trimesh
from mjviser.conversions import get_geom_texture_id, merge_geoms

from viapoint.envs import Arm, Box, Capsule, HalfSpace, Shape, Sphere
from viapoint.envs.arms.load import read_model
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.obstacles import add_to_model, pack
from viapoint.training.live.arena import Arena
from viapoint.training.live.state import State
from viapoint.training.planning.motion_plan import MotionPlan

if TYPE_CHECKING:
    import viser

SIDES = 8  # Sides of a tube
PLAN, PROPOSAL, DONE = 0.0050, 0.0028, 0.0032  # Radii of plan, proposals, executed path, [m]
SHRUNK = 0.05
"""Factor of the vertices of proposals, which their nodes undo. The client outlines what the pointer is over; it merges
the vertices of meshes with radii above 0.1 in cubes of 0.01, which leaves gaps in the outline of a thin tube."""
# Shifts of proposals and of the executed path, so that the plan stays visible, [m]
BELOW, ABOVE = np.array([0.0, 0.0, -0.002]), np.array([0.0, 0.0, 0.004])
RADII = {"start": 0.018, "goal": 0.018, "via": 0.013}  # Radii of the handles, [m]
PLANE = (-0.03, 0.26, 1.75), (-0.03, 0.29, 0.0), (0.0, 1.0, 0.0), 33.0
# First views: position of the camera, point that it looks at, [m], direction up, and field of view, [degrees]
SPACE = (2.6, -2.0, 1.75), (0.15, 0.0, 0.42), (0.0, 0.0, 1.0), 38.0
OPACITY, GHOST, PALE = 0.45, 0.16, 0.25  # Of what hides others, the arm at the goal, an old plan
POINT = 0.005  # Size of the points that a sensor sees, [m]
LARGE = 0.16  # Greatest size of obstacles in space that are not large, [m]
LOW, TALL = 0.030, 0.060  # Height of obstacles in the plane, [m]: below links, and as tall as links
FARTHEST = 1.2  # Greatest coordinate to which something can be dragged, [m]


def tube(points: Float, radius: float) -> Any:
    """Return a closed tube along points, shape (n, 3), [m], as a mesh of `trimesh`."""
    along = np.gradient(points, axis=0)
    along = along / np.maximum(norm(along), 1e-12)[:, None]
    sides = np.empty_like(points)
    side = np.eye(3)[np.abs(along[0]).argmin()]
    for i, direction in enumerate(along):  # parallel transport: the tube does not twist
        side = side - (side @ direction) * direction
        side = side / max(float(np.sqrt(side @ side)), 1e-12)
        sides[i] = side
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    across = np.cross(along, sides)
    ring = np.cos(angle)[:, None] * sides[:, None] + np.sin(angle)[:, None] * across[:, None]
    # The first and the last ring have no extent, which closes the tube.
    extents = np.pad(radius * ring, ((1, 1), (0, 0), (0, 0)))
    vertices = np.pad(points, ((1, 1), (0, 0)), mode="edge")[:, None] + extents
    first = SIDES * np.arange(len(points) + 1)[:, None]
    here = first + np.arange(SIDES)
    there = first + (np.arange(SIDES) + 1) % SIDES
    faces = np.stack((here, there, there + SIDES, here, there + SIDES, here + SIDES), axis=-1)
    return trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)


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
    """Meshes of an arm, and their poses.

    They are those of a MuJoCo model, or of the visible geoms of the file that the arm was loaded from. A file that
    cannot be read raises ValueError.
    """

    def __init__(self, arm: Arm, model: mujoco.MjModel, model_file: str | Path | None = None) -> None:
        self._offset = np.zeros(3)
        if model_file is not None:
            own = _first_anchor(model, arm)
            try:
                model = read_model(model_file)
            except (OSError, ValueError) as error:
                raise ValueError(f"{model_file} cannot be drawn: {' '.join(str(error).split())}") from None
            self._offset = own - _first_anchor(model, arm)
        self._model, self._data = model, mujoco.MjData(model)
        if model_file is not None and model.nkey:
            mujoco.mj_resetDataKeyframe(model, self._data, 0)
        self._joints = np.array([model.joint(name).qposadr[0] for name in arm.joint_names])
        ground = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        visible = ~np.isin(model.geom_type, ground) & (model.body_mocapid[model.geom_bodyid] < 0)
        visible &= model.geom_rgba[:, 3] > 0.0
        drawn_only = visible & (model.geom_group < 3)  # MuJoCo's viewers hide others, which only collide
        groups: dict[tuple[int, Any], list[int]] = {}
        for geom in np.flatnonzero(drawn_only if model_file is not None and drawn_only.any() else visible):
            material = model.geom_matid[geom]
            colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            textured = get_geom_texture_id(model, int(geom)) >= 0
            key = int(model.geom_bodyid[geom]), None if textured else tuple(colour[:3])
            groups.setdefault(key, []).append(int(geom))
        self.parts = [(*key, merge_geoms(model, geoms)) for key, geoms in groups.items()]
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
    """View of one tab, drawn from its state; `act` is called with the name of what a user does and its values."""

    def __init__(
        self, client: viser.ClientHandle, arena: Arena, arm: ArmDrawing, act: Callable[..., None]
    ) -> None:
        self._client, self._arena, self._arm, self._act = client, arena, arm, act
        self._scene, self._planar = client.scene, arena.planar
        self._floor = float(arena.env("own").model.geom("table").pos[2])
        self._levels = (self._floor, TALL if arena.task.whole_arm else LOW) if self._planar else None
        self._nodes: dict[str, Any] = {}
        self._drawn: dict[str, tuple[Any, ...]] = {}
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
                self._mesh(f"/arm/{i}", mesh, colour or PALETTE.arm, OPACITY if self._planar else None)
            if not self._planar:
                self._mesh(f"/ghost/{i}", mesh, colour or PALETTE.arm, GHOST)
        axes = (True, True, not self._planar)
        self._rings = self._scene.add_transform_controls(
            "/turn", 0.2, disable_axes=True, disable_sliders=True, visible=False, active_axes=axes
        )
        self._rings.on_update(lambda _: act("turn", np.array(self._rings.wxyz)))
        self.look_at_everything()

    def look_at_everything(self) -> None:
        """Move the camera to its first view: the plane from above, space from the side, farther in a narrow window."""
        camera, (eye, target, up, angle) = self._client.camera, PLANE if self._planar else SPACE
        away = max(1.0, 0.75 / max(camera.aspect, 0.1)) * np.subtract(eye, target)
        camera.up_direction = up
        camera.position = target + away
        camera.look_at = target  # after the position, which takes the target along
        camera.fov = float(np.radians(angle))

    def draw(self, state: State) -> None:
        """Draw the scene, the plans and the movement; only what has changed is sent."""
        arena, scene, movement, plan = self._arena, state.scene, state.movement, state.plan
        joints = arena.task.space.joints(scene.start)
        places = [shape.position for shape in scene.obstacles]
        done = []
        if movement is not None:
            rollout, now = movement.rollout, state.instant
            joints = rollout.joints[now]
            places = movement.scenes.obstacles_at(rollout.time[now : now + 1]).centre[0]
            rows = np.unique(np.linspace(0, now, 40).astype(int))
            colour = PALETTE.contact if rollout.contact[: now + 1].any() else PALETTE.executed
            if now > 1:
                done = [(rollout.hand[rows] + ABOVE, colour)]
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
        if plan is None:
            return
        planned = [self._line(plan)]
        vias = arena.tool(plan.waypoints[1:-1])
        if movement is not None and movement.plan is not None and arena.task.replanning:
            planned = [(arena.path(movement.plan), PALETTE.plan)]
            vias = vias[:0]
        pale = []
        for each in state.proposals if len(state.proposals) > 1 else ():
            path, colour = self._line(each.motion)
            pale.append((path, _lighter(colour)))
        self._draw_handles("via", vias)
        if state.before is not None and self._is_new("before", state.before.waypoints):
            colour = PALETTE.plan if state.before.success else PALETTE.contact
            self._mesh("/before/0", self._nodes["/plan/0"], colour, PALE)  # it still shows the plan before
        if "/before/0" in self._nodes:
            self._nodes["/before/0"].visible = state.before is not None
        self._draw_paths("plan", planned, PLAN)
        self._draw_paths("proposal", pale, PROPOSAL, 0.8)

    def _line(self, motion: MotionPlan) -> tuple[Float, Colour]:
        """Return the path of a plan, and its colour."""
        return self._arena.path(motion.plan), PALETTE.plan if motion.success else PALETTE.contact

    def _draw_rings(self, state: State, goal: Float) -> None:
        """Draw rings that turn the selected obstacle or the tool at the goal; obstacles in the plane stay upright."""
        shape = None if state.selected is None else state.scene.obstacles[state.selected]
        self._rings.visible = state.turning and (shape is not None or not self._planar)
        if self._rings.visible:
            turn = self._arena.orientation(state.scene.goal) if shape is None else shape.quaternion
            self._rings.wxyz = turn
            self._rings.position = goal if shape is None else shape.position

    def _draw_arm(self, name: str, joints: Float) -> None:
        if self._is_new(name, joints):
            for i, (turn, position) in enumerate(self._arm.poses(joints)):
                node = self._nodes[f"/{name}/{i}"]
                node.wxyz, node.position = turn, position

    def _draw_obstacles(self, shapes: tuple[Shape, ...], places: Any, selected: int | None) -> None:
        for i, (shape, place) in enumerate(zip(shapes, places, strict=False)):
            name = f"/obstacle/{i}"
            form = shape.kind, shape.packed_size, shape.quaternion, id(shape.mesh)
            if not self._is_new(name, *form, place, i == selected):
                continue  # there may be many, and most stay in a drag
            if self._is_new(f"{name}/form", *form):
                self._mesh(name, obstacle_mesh(shape, self._levels), PALETTE.obstacle)
            node = self._nodes[name]
            node.flat_shading = not isinstance(shape, Sphere | Capsule)
            large = isinstance(shape, HalfSpace) or float(shape.packed_size.max()) > LARGE
            node.opacity = OPACITY if large and not self._planar else None
            node.color = _rgb(PALETTE.obstacle if i != selected else _lighter(PALETTE.obstacle))
            node.position, node.visible = place, True
        self._hide("obstacle", len(shapes))

    def _draw_seen(self, state: State) -> None:
        """Draw the points that the sensor of the task sees from the start."""
        task, scene = self._arena.task, state.scene
        if task.sensor is None:
            return
        joints = task.space.joints(scene.start)[None]
        found = task.sensor.read(task.arm, joints, pack([scene.obstacles]))
        points = found.points[found.seen >= 0].astype(np.float32)
        if self._planar:
            points[:, 2] = LOW + 0.002  # on top of the obstacles
        if self._is_new("seen", points):
            self._scene.add_point_cloud(
                "/seen", points, _rgb(PALETTE.seen), point_size=POINT, point_shape="circle"
            )

    def _draw_paths(
        self, name: str, paths: list[tuple[Float, Colour]], radius: float, opacity: float | None = None
    ) -> None:
        """Draw paths, shape (n, 3), [m], with their colours."""
        scale = SHRUNK if name == "proposal" else 1.0
        for i, (path, colour) in enumerate(paths):
            key = f"/{name}/{i}"
            if self._is_new(key, path, colour):
                shift = BELOW if name == "proposal" else 0.0
                self._mesh(key, tube(scale * (path + shift), scale * radius), colour, opacity)
            self._nodes[key].scale, self._nodes[key].visible = 1.0 / scale, True
        self._hide(name, len(paths))

    def _draw_handles(self, name: str, places: Float | list[Float]) -> None:
        """Draw handles; in space, lines down to the table show their places."""
        colour = getattr(PALETTE, name)
        for i, place in enumerate(places):
            key = f"/{name}/{i}"
            if key not in self._nodes:
                self._mesh(key, trimesh.creation.icosphere(3, RADII[name]), colour)
            self._nodes[key].position, self._nodes[key].visible = place, True
            if not self._planar and self._is_new(f"{key}/drop", place):
                down = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, self._floor - place[2]]]], np.float32)
                if f"{key}/drop" in self._nodes:
                    self._nodes[f"{key}/drop"].points = down
                else:
                    self._nodes[f"{key}/drop"] = self._scene.add_line_segments(
                        f"{key}/drop", down, _rgb(_lighter(colour)), thickness=0.003
                    )
        self._hide(name, len(places))

    def _is_new(self, name: str, *values: Any) -> bool:
        """Return True if something differs from what was drawn last under this name."""
        before, self._drawn[name] = self._drawn.get(name), values
        return before is None or not all(map(np.array_equal, before, values))

    def _hide(self, name: str, number: int) -> None:
        """Hide the nodes of a name from a number on."""
        while (node := self._nodes.get(f"/{name}/{number}")) is not None:
            node.visible = False
            self._drawn.pop(f"/{name}/{number}", None)  # to be shown again even if it is the same
            number += 1

    def _mesh(self, key: str, mesh: Any, colour: Any, opacity: float | None = None) -> None:
        """Add a mesh, or change the one of this name."""
        vertices = np.float32(mesh.vertices)
        faces = np.uint32(mesh.faces)
        node = self._nodes.get(key)
        if node is not None:
            node.vertices, node.faces, node.color = vertices, faces, _rgb(colour)
            return
        _, name, number = key.split("/")
        shadow = name in ("arm", "obstacle")
        node = self._nodes[key] = self._scene.add_mesh_simple(
            key,
            vertices,
            faces,
            color=_rgb(colour),
            opacity=opacity,
            cast_shadow=shadow,
            receive_shadow=shadow,
        )
        if name == "proposal":
            node.on_click(lambda _: self._act("pick", int(number)))
        if name == "obstacle":
            node.on_click(lambda _: self._act("show", "selected", int(number)))
        if name == "obstacle" or name in RADII:
            self._make_draggable(node, name, int(number))

    def _make_draggable(self, node: Any, kind: str, number: int) -> None:
        """Make a node draggable: horizontally, or vertically in space while Shift is held."""

        async def level(event: Any) -> None:  # asynchronous functions are called in order
            self._dragged(event, kind, number, np.array([0.0, 0.0, 1.0]))

        async def upright(event: Any) -> None:
            away = np.asarray(event.client.camera.position) - event.target.position
            self._dragged(event, kind, number, away * (1.0, 1.0, 0.0))

        node.on_drag("left")(level)
        if not self._planar:
            node.on_drag("left", modifier="shift")(upright)

    def _dragged(self, event: Any, kind: str, number: int, normal: Float) -> None:
        """Tell the new position of a node: where the pointer's ray meets the plane in which it moves."""
        eye = np.asarray(event.client.camera.position)
        place = np.asarray(event.target.position)
        if event.phase == "start":
            self._grab = np.asarray(event.start_position) - place
        ray = np.asarray(event.end_position) - eye
        through = place + self._grab
        slope = float(normal @ ray)
        share = float(normal @ (through - eye)) / slope if abs(slope) > 1e-6 else 0.0
        if share <= 0.0:
            return
        point = eye + share * ray - self._grab
        if normal[2] == 0.0:
            point = np.array([*place[:2], max(point[2], self._floor)])
        self._act("drag", kind, number, np.clip(point, -FARTHEST, FARTHEST))


def _rgb(colour: Any) -> tuple[int, int, int]:
    red, green, blue = (round(255 * float(each)) for each in colour)
    return red, green, blue


def _lighter(colour: Colour) -> Colour:
    red, green, blue = (0.45 * each + 0.55 for each in colour)
    return red, green, blue
