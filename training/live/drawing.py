"""Display of the live page: a view in three dimensions with handles to drag, and panels on both sides."""

from __future__ import annotations

import dataclasses
import functools
import html
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import trimesh
import viser
from matplotlib.colors import to_hex
from mjviser.conversions import merge_geoms

from viapoint.envs import Arm, Box, Capsule, HalfSpace, Shape, Sphere
from viapoint.envs.arms.load import read_model
from viapoint.envs.common.arrays import Float, frame_matrices, norm, quaternion_to
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.geometry.obstacles import add_to_model, pack
from viapoint.training.live.arena import AGENT, MOTION, OMPL, SAMPLES, SIZES, Arena, State, n_via, profile
from viapoint.training.planning.motion_plan import MotionPlan

PLAN, PROPOSAL, DONE = 0.0050, 0.0028, 0.0032  # Radii of plan, proposals, executed path, [m]
ROD = trimesh.creation.cylinder(1.0, 2.0, sections=8)  # Piece of a tube before it is scaled
ABOVE = np.array([0.0, 0.0, 0.004])  # Shift of the executed path, so that the plan stays visible, [m]
DROP = 0.0015  # Radius of the lines from handles down to the table, [m]
RADII = {"start": 0.018, "goal": 0.018, "via": 0.013}  # Radii of the handles, [m]
HANDLES = {name: trimesh.creation.icosphere(3, radius) for name, radius in RADII.items()}
# First views of the reference arm: place of the camera, point that it looks at, [m], direction up, field of view, [rad]
PLANE = (-0.03, 0.26, 1.75), (-0.03, 0.29, 0.0), (0.0, 1.0, 0.0), math.radians(33.0)
SPACE = (2.6, -2.0, 1.75), (0.15, 0.0, 0.42), (0.0, 0.0, 1.0), math.radians(38.0)
ORIGIN = (0.0, 0.0, 0.0)  # Place of what is drawn where it is, [m]
NARROW = 0.75  # Width of a window relative to its height, below which the view is wider
OPACITY, GHOST = 0.45, 0.16  # Of what hides others, and of the arm at the goal
POINT = 0.005  # Size of the points that a sensor sees, [m]
RAY = 0.0008  # Thickness of the rays that meet them, [m]
MOST_RAYS = 96  # How many of these are drawn at most
LARGE = 0.16  # Greatest size of obstacles in space that are not large, [m]
LOW, TALL = 0.030, 0.060  # Height of obstacles in the plane, [m]: below links, and as tall as links
GRID, PALE = (214, 214, 218), 0.45  # Colour of the lines on the table, and strength of pale colours
FARTHEST = 1.3  # Greatest coordinate to which something can be dragged, [m] of the reference arm
WIDTH = 330  # Width of a panel, [pixels]
RESET = "Reset"  # Name of the button that undoes all changes of a scene
CHECKS = {"none": 0, "16": 16, "64": 64}  # Proposals that are checked with computed geometry
NOTE = '<div style="padding:0.2em 0.9em;font-size:0.8em;color:#6b7078">{}</div>'
MESSAGE = '<div id="viapoint-message" style="padding:0.2em 0.9em;font-size:0.9em;color:{}">{}</div>'
CODE = (
    '<pre id="viapoint-code" style="background:#f5f5f2;padding:1em;overflow:auto;font-size:0.82em">{}</pre>'
    '<button onclick="navigator.clipboard.writeText(this.previousElementSibling.textContent)">Copy</button>'
)
TABLE = (
    "<style>.viapoint{width:100%;padding:0 0.7em;font-size:0.8em;text-align:right!important}"
    ".viapoint th{font-weight:500;color:#6b7078}.viapoint td{border-top:1px solid #e6e6e3}</style>"
)
LINE = {"width": 2, "points": {"show": False}}
# Lines of the plots
LINES: Any = (
    {"label": "time"},
    {**LINE, "label": "plan", "stroke": to_hex(PALETTE.plan)},
    {**LINE, "label": "executed", "stroke": to_hex(PALETTE.executed), "dash": (6, 5)},
)
Act = Callable[..., None]  # Function that does what a user has done, from its name and values


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
    """Return the mesh of an obstacle around its position, cut off at two heights, [m]; a plate is a half-space."""
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

    def __init__(self, arm: Arm, model_file: str | Path | None = None) -> None:
        own = arm.compile(n_obstacles=0)
        drawn = own if model_file is None else read_model(model_file)
        anchors = []  # places of the first joint
        for model in (own, drawn):
            self._model, self._data = model, mujoco.MjData(model)
            mujoco.mj_kinematics(model, self._data)
            anchors.append(self._data.joint(arm.joint_names[0]).xanchor.copy())
        self._offset = anchors[0] - anchors[1]
        if drawn.nkey:
            mujoco.mj_resetDataKeyframe(drawn, self._data, 0)
        self._joints = np.array([drawn.joint(name).qposadr[0] for name in arm.joint_names])
        ground = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        visible = ~np.isin(drawn.geom_type, ground) & (drawn.geom_rgba[:, 3] > 0.0)
        plain = visible & (drawn.geom_group < 3)  # MuJoCo's viewers hide others, which only collide
        alike: dict[tuple[Any, ...], list[int]] = {}
        for geom in np.flatnonzero(plain if plain.any() else visible).tolist():
            key = int(drawn.geom_bodyid[geom]), int(drawn.geom_matid[geom]), *drawn.geom_rgba[geom]
            alike.setdefault(key, []).append(geom)
        self.parts: list[tuple[int, Colour | None, Any]] = []
        """Body, colour (None for textures) and mesh of the parts that move alike and have one material."""
        for (body, *_), geoms in alike.items():
            mesh = merge_geoms(drawn, geoms)
            textured = mesh.visual.kind == "texture"
            self.parts.append((body, None if textured else tuple(mesh.visual.main_color[:3] / 255.0), mesh))

    def posed(self, joints: Float) -> Iterator[tuple[Colour | None, Any, Float, Float]]:
        """Yield colour, mesh, quaternion and position of each part for joint angles, shape (J,), [rad]."""
        self._data.qpos[self._joints] = joints
        mujoco.mj_kinematics(self._model, self._data)
        for body, colour, mesh in self.parts:
            yield colour, mesh, self._data.xquat[body].copy(), self._data.xpos[body] + self._offset


class View:
    """View of one tab, drawn from its state; `act` is called with the name of what a user does and its values.

    All is drawn again after each change: the library sends only what differs from what it sent before.
    """

    def __init__(self, client: viser.ClientHandle, arena: Arena, arm: ArmDrawing, act: Act) -> None:
        self._scene, self._arena, self._arm, self._act = client.scene, arena, arm, act
        self._planar = arena.planar
        if client.camera.aspect < NARROW:
            *_, field = PLANE if self._planar else SPACE
            wider = math.tan(0.5 * field) * NARROW / client.camera.aspect
            client.camera.fov = 2.0 * math.atan(wider)
        self._floor = float(arena.env("own").model.geom("table").pos[2])
        self._levels = (self._floor, TALL if arena.task.whole_arm else LOW) if self._planar else None
        self._nodes: dict[str, Any] = {}
        self._meshes: dict[str, Any] = {}  # what the nodes show
        self._shapes: dict[str, Shape] = {}  # obstacles of these meshes
        centre, side = (-0.03, 0.35) if self._planar else (0.0, 0.0), 2.0 * arena.scale
        place = (*(arena.foot[:2] + arena.scale * np.array(centre)), self._floor)
        self._scene.add_grid(
            "/grid", side, side, position=place, cell_size=0.1, section_size=0.1,
            cell_color=GRID, section_color=GRID, section_thickness=1.0, shadow_opacity=0.0,
            plane_color=_rgb(PALETTE.table), plane_opacity=1.0,
        )  # fmt: skip
        for i, (_, colour, mesh) in enumerate(arm.parts):
            if colour is None and not self._planar:  # with its texture
                self._meshes[f"/arm/{i}"] = mesh
                self._nodes[f"/arm/{i}"] = self._scene.add_mesh_trimesh(f"/arm/{i}", mesh)
        axes = (True, True, not self._planar)
        rings: Any = {"disable_axes": True, "disable_sliders": True, "visible": False, "active_axes": axes}
        self._rings = self._scene.add_transform_controls("/turn", 0.2, **rings)
        self._rings.on_update(lambda _: act("turn", np.array(self._rings.wxyz)))
        points: Any = {"point_size": POINT, "point_shape": "circle"}
        yellow = _rgb(PALETTE.seen)
        self._seen = self._scene.add_point_cloud("/seen", np.zeros((0, 3)), yellow, **points)
        self._rays = self._scene.add_line_segments("/rays", np.zeros((0, 2, 3)), yellow, thickness=RAY)

    def draw(self, state: State) -> None:
        """Draw the scene, the plans and the movement."""
        arena, scene, movement = self._arena, state.scene, state.movement
        self._shown: set[str] = set()  # names of the nodes that are visible
        joints = arena.task.space.joints(scene.start)
        places = [shape.position for shape in scene.obstacles]
        if movement is not None:
            rollout, now = movement.rollout, state.instant
            joints = rollout.joints[now]
            places = movement.scenes.obstacles_at(rollout.time[now : now + 1]).centre[0]
            rows = np.linspace(0, now, SAMPLES).astype(int)
            colour = PALETTE.contact if rollout.contact[: now + 1].any() else PALETTE.executed
            self._show("/done/0", tube(rollout.hand[rows] + ABOVE, DONE), colour)
        self._draw_arm("arm", joints, OPACITY if self._planar else None)
        if not self._planar:
            self._draw_arm("ghost", arena.task.space.joints(scene.goal), GHOST)
        for i, (shape, place) in enumerate(zip(scene.obstacles, places, strict=False)):
            strength = PALE if i == state.selected else 1.0
            key = f"/obstacle/{i}"
            mesh = self._meshes.get(key)
            if self._shapes.get(key) is not shape:  # most stay as they are
                self._shapes[key], mesh = shape, obstacle_mesh(shape, self._levels)
            node = self._show(key, mesh, PALETTE.obstacle, strength, place)
            node.flat_shading = not isinstance(shape, Sphere | Capsule)
            large = isinstance(shape, HalfSpace) or float(shape.packed_size.max()) > LARGE
            node.opacity = OPACITY if large and not self._planar else None
        self._draw_seen(state)
        start, goal = arena.tool(np.stack((scene.start, scene.goal)))
        self._draw_handle("start", 0, start)
        self._draw_handle("goal", 0, goal)
        self._draw_rings(state, goal)
        if state.plan is not None:
            self._draw_plans(state, state.plan)
        for key, node in self._nodes.items():
            node.visible = key in self._shown

    def _draw_plans(self, state: State, plan: MotionPlan) -> None:
        """Draw the plan with its via-points, the proposals, and the plan before the last change."""
        movement = state.movement
        if movement is not None and movement.plan is not None and self._arena.task.replanning:
            self._show("/plan/0", tube(self._arena.path(movement.plan), PLAN), PALETTE.plan)
        else:
            self._draw_plan("/plan/0", plan, PLAN, 1.0)
            for i, place in enumerate(self._arena.tool(plan.waypoints[1:-1])):
                self._draw_handle("via", i, place)
        others = [each.motion for each in state.proposals]
        if state.before is not None:
            others.append(state.before)
        for i, motion in enumerate(others):
            self._draw_plan(f"/proposal/{i}", motion, PROPOSAL, PALE)

    def _draw_plan(self, key: str, motion: MotionPlan, radius: float, strength: float) -> None:
        colour = PALETTE.plan if motion.success else PALETTE.contact
        self._show(key, tube(self._arena.path(motion.plan), radius), colour, strength)

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

    def _draw_arm(self, name: str, joints: Float, opacity: float | None) -> None:
        for i, (colour, mesh, turn, place) in enumerate(self._arm.posed(joints)):
            node = self._show(f"/{name}/{i}", mesh, colour or PALETTE.arm, place=place)
            node.wxyz, node.opacity = turn, opacity

    def _draw_seen(self, state: State) -> None:
        """Draw the points that the sensor of the task sees from the start, and some of the rays that meet them."""
        task = self._arena.task
        if task.sensor is not None:
            joints = task.space.joints(state.scene.start)[None]
            found = task.sensor.read(task.arm, joints, pack([state.scene.obstacles]))
            points = found.points[found.seen >= 0]
            if self._planar:
                points[:, 2] = LOW + 0.002  # on top of the obstacles
            self._seen.points = points
            some = points[:: -(-len(points) // MOST_RAYS) or 1]
            eye = (*found.eye[0, :2], LOW + 0.002) if self._planar else found.eye[0]
            self._rays.points = np.stack((np.broadcast_to(eye, some.shape), some), axis=1).astype(np.float32)

    def _draw_handle(self, name: str, number: int, place: Float) -> None:
        """Draw a handle, and a line down to the table that shows its place."""
        colour = getattr(PALETTE, name)
        self._show(f"/{name}/{number}", HANDLES[name], colour, place=place)
        drop = np.array([place, (*place[:2], min(self._floor, place[2] - 1e-3))])
        self._show(f"/drop-{name}/{number}", tube(drop, DROP), colour, PALE)

    def _show(self, key: str, mesh: Any, colour: Colour, strength: float = 1.0, place: Any = ORIGIN) -> Any:
        """Show a mesh in a colour at a place, [m], and return its node."""
        self._shown.add(key)
        node = self._nodes.get(key)
        if node is None:
            node = self._nodes[key] = self._added(key, mesh)
        elif self._meshes[key] is not mesh:  # many stay as they are
            node.vertices, node.faces = mesh.vertices, np.uint32(mesh.faces)
        self._meshes[key] = mesh
        node.color, node.position = _rgb(colour, strength), place
        return node

    def _added(self, key: str, mesh: Any) -> Any:
        """Add a node, which can be clicked or dragged if it is a proposal, an obstacle or a handle."""
        _, name, number = key.split("/")
        shadow = name in ("arm", "obstacle")
        node = self._scene.add_mesh_simple(
            key, mesh.vertices, mesh.faces, cast_shadow=shadow, receive_shadow=shadow,
            flat_shading=name in ("done", "plan", "proposal"),
        )  # fmt: skip
        if name == "proposal":
            node.on_click(lambda _: self._act("pick", int(number)))
        if name == "obstacle":
            node.on_click(lambda _: self._act("show", "selected", int(number)))
        if name == "obstacle" or name in HANDLES:
            dragged = functools.partial(self._dragged, name, int(number))
            node.on_drag("left")(dragged)
            if not self._planar:
                node.on_drag("left", modifier="shift")(dragged)
        return node

    # Asynchronous functions are called in order.
    async def _dragged(self, kind: str, number: int, event: Any) -> None:
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
        point = eye + share * ray - self._grab
        if upright:
            point = np.array([*place[:2], max(point[2], self._floor)])
        if share > 0.0:
            foot, farthest = self._arena.foot, self._arena.scale * FARTHEST
            self._act("drag", kind, number, np.clip(point, foot - farthest, foot + farthest))


def _rgb(colour: Colour, strength: float = 1.0) -> Any:
    """Return a colour in [0, 255], paler for a strength below 1."""
    return tuple(round(255.0 * (1.0 + strength * (each - 1.0))) for each in colour)


class Panels:
    """Panels of one tab, drawn from its state; `act` is called with the name of what a user does and its values."""

    def __init__(self, client: viser.ClientHandle, arena: Arena, scenes: Iterable[str], act: Act) -> None:
        self._gui, self._arena, self._act = client.gui, arena, act
        self._selection: Any = ()
        self._plots: dict[str, Any] = {}
        self._build_results()
        self._build_controls(scenes)

    def draw(self, state: State) -> None:
        """Show what was decided, and set the controls."""
        remark = state.scene.origin if state.scene is state.drawn else ""
        limit, plan = self._arena.limit(state.scene), state.plan
        if limit and state.method == AGENT:
            remark += f" The agent was trained {limit}, so the geometry search decides."
        message = MESSAGE.format("#1b7f4b" if state.good else "#c4202b", html.escape(state.message))
        self._message.content = message + NOTE.format(html.escape(remark))
        self._execute.label = "Stop" if state.playing else "Execute"
        self._method.value = state.method  # a choice may have been refused
        self._vias.visible = state.method != OMPL  # which takes as many as its path needs
        if self._checks is not None:
            self._checks.visible = state.method == AGENT
            self._checks.value = next(name for name, number in CHECKS.items() if number == state.checks)
        self._vias.min = int(state.method == MOTION)
        self._vias.value = n_via(self._arena, state)
        if plan is not None and state.duration is None:
            low, high = self._duration.min, self._duration.max
            self._duration.value = float(np.clip(round(plan.duration, 2), low, high))
        self._draw_selection(state)
        self._draw_comparison(state)
        if plan is not None and state.before is None and not state.playing:
            self._draw_proposals(state)
            self._draw_plots(state, plan)

    def show_code(self, code: str) -> None:
        """Show Python code with a button that copies it."""
        with self._gui.add_modal("This scene in Python") as modal:
            self._gui.add_html(CODE.format(html.escape(code)))
            self._gui.add_button("Close").on_click(lambda _: modal.close())

    def _draw_proposals(self, state: State) -> None:
        rows = []
        for i, each in enumerate(state.proposals):
            motion = each.motion
            reward = each.reward if motion.success else "fails"
            number = f"#{i + 1}{' shown' * (i == state.picked)}"
            rows.append((number, reward, each.value, _millimetres(motion.clearance), motion.duration))
        names = "plan", "reward", "agent's value", "clearance [mm]", "time [s]"
        first = state.proposals[0]
        kind = f" ({type(self._arena.agent).__name__})" if first.maker == AGENT else ""
        note = f"{first.maker}{kind}, decided in {1e3 * first.seconds:.0f} ms"
        self._table.content = _table(names, rows, note)
        self._pick.visible = len(rows) > 1
        self._pick.options = tuple(f"#{i + 1}" for i in range(len(rows)))

    def _draw_plots(self, state: State, plan: MotionPlan) -> None:
        """Plot the plan, and the executed movement if there is one."""
        executed, until = {}, 0.0
        if state.movement is not None:
            rollout = state.movement.rollout
            until = float(rollout.time[-1])
            executed["speed"] = norm(np.gradient(rollout.hand, rollout.time, axis=0))
            executed["clearance"] = rollout.clearance
        planned = profile(self._arena, state.scene, plan.plan, until)
        time = planned["time"]
        for name, plot in self._plots.items():
            other = np.where(time > 0.0, np.nan, planned[name])  # one number: no line, but a plot
            if name in executed:
                other = np.interp(time, rollout.time, executed[name], right=np.nan)
            lines = np.array([planned[name], other])
            if name == "clearance":  # in millimetres, where it is small
                lines = np.minimum(1e3 * lines, 250.0)
            plot.data = (time, *lines)

    def _draw_comparison(self, state: State) -> None:
        rows = []
        for name, seconds, movement in state.results:
            if movement is None:  # the method refused the scene
                rows.append((name, "no", *4 * [np.nan]))
                continue
            info = movement.info
            success = "yes" if info["is_success"] else "no"
            clearance = _millimetres(info["min_clearance"])
            decided = f"{1e3 * seconds:.0f}"
            rows.append((name, success, movement.reward, clearance, info["jerk_ratio"], decided))
        names = "method", "success", "reward", "clearance [mm]", "jerk", "decided in [ms]"
        note = "Each row is simulated. Jerk is relative to the straight movement."
        self._methods.content = _table(names, rows, note) if rows else NOTE.format(note)

    def _draw_selection(self, state: State) -> None:
        """Show the sizes of the selected obstacle; sliders that the user moves are left alone."""
        row, shapes = state.selected, state.scene.obstacles
        if self._selection == (row, len(shapes), id(state.drawn)):
            return
        self._selection = row, len(shapes), id(state.drawn)
        values = {} if row is None else self._arena.sizes_of(shapes[row])
        for name, slider in self._sizes.items():
            slider.visible = name in values
            slider.value = float(np.clip(values.get(name, 0.0), slider.min, slider.max))
        self._remove.disabled = row is None
        name = "Click an obstacle." if row is None else f"Selected: {shapes[row].name or f'obstacle {row}'}"
        self._selected.content = NOTE.format(html.escape(name))

    def _build_results(self) -> None:
        gui = self._gui
        panel = gui.add_panel()
        with panel.add_tab("Decision"):
            self._table = gui.add_html("")
            self._pick = gui.add_button_group("Show", ("#1",), visible=False)
            self._pick.on_click(lambda event: self._act("pick", int(event.target.value[1:]) - 1))
            unit = "m/s³" if self._arena.task.space.of_hand else "rad/s³"
            titles = "speed of the hand [m/s]", f"jerk of the plan [{unit}]", "clearance of obstacles [mm]"
            for name, title in zip(("speed", "jerk", "clearance"), titles, strict=True):
                self._plots[name] = gui.add_uplot(
                    (np.zeros(2), np.zeros(2), np.zeros(2)), LINES, title=title, height=126,
                    scales={"x": {"time": False}}, legend={"show": False}, cursor={"show": True},
                    axes=({"size": 30}, {"size": 46}), padding=(10, 10, 0, 0),
                )  # fmt: skip
            gui.add_html(NOTE.format("time [s]; solid: plan, dashed: executed"))
        with panel.add_tab("Methods"):
            self._methods = gui.add_html("")
            self._button("Compare in this scene", "compare")
        panel.dock_left()
        panel.set_width(WIDTH)

    def _build_controls(self, scenes: Iterable[str]) -> None:
        gui, arena, act = self._gui, self._arena, self._act
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH - 20)
        arm = arena.task.arm
        title = arena.env_id.removeprefix("viapoint/") + (f", {arm.name}" if arm.file else "")
        gui.add_html(NOTE.format(f"<b>{html.escape(title)}</b>"))
        self._message = gui.add_html("")
        self._execute = self._button("Execute", "execute", color="green", icon="player-play")
        with gui.add_folder("Scene"):
            kinds = gui.add_button_group("", (*scenes, RESET))
            kinds.on_click(lambda event: act("go_to", event.target.value))
        with gui.add_folder("Decision"):
            self._build_decision()
        with gui.add_folder("Obstacles"):
            self._selected, self._sizes = gui.add_html(""), {}
            for name, (*_, least, most) in SIZES.items():
                label = f"{name.capitalize()} [m]"
                self._sizes[name] = gui.add_slider(label, least, most, 0.001, least, visible=False)
                _on_slide(self._sizes[name], functools.partial(act, "resize", name))
            shapes = gui.add_button_group("Add", tuple(arena.new_shapes()))
            shapes.on_click(lambda event: act("add", event.target.value))
            self._remove = self._button("Remove the selected one", "remove", disabled=True)
        hint = "Rings turn the selected obstacle, or the tool at the goal"
        turn = gui.add_checkbox("Turn", False, hint=hint)
        turn.on_update(lambda event: act("show", "turning", event.target.value))
        with gui.add_folder("Files", expand_by_default=False):
            self._button("Save scene (JSON)", "save")
            upload = gui.add_upload_button("Load scene (JSON)", mime_type="application/json")
            upload.on_upload(lambda event: act("load", event.target.value.content))
            self._button("Copy as Python", "show_code")
            self._button("Save picture (PNG)", "save_picture")
        drag = "Drag start, goal, via-point and obstacles with the mouse."
        gui.add_html(NOTE.format(drag + ("" if arena.planar else " Hold Shift to move them up and down.")))

    def _build_decision(self) -> None:
        gui, act, arena, action = self._gui, self._act, self._arena, self._arena.task.action
        anew: dict[str, Any] = {"by_hand": None, "duration": None, "n_via": None}
        low, high = action.duration_range if arena.task.space.of_hand else (0.3, 12.0)
        self._duration = gui.add_slider("Duration [s]", low, high, 0.01, (low * high) ** 0.5)
        _on_slide(self._duration, lambda value: act("change", duration=value))
        hint = "Decides after each change of the scene"
        self._method = gui.add_dropdown("Method", arena.methods, hint=hint)
        _on_choice(self._method, lambda value: act("change", method=value, **anew))
        most = action.n_via if arena.task.replanning else max(3, action.n_via)
        self._vias = gui.add_slider("Via-points", 0, most, 1, action.n_via, disabled=most == action.n_via)
        _on_slide(self._vias, lambda value: act("change", n_via=value, by_hand=None))
        self._checks: Any = None
        if hasattr(arena.policy, "checks"):
            hint = "Proposals whose clearance is computed"
            self._checks = gui.add_dropdown("Exact checks", tuple(CHECKS), hint=hint)
            _on_choice(self._checks, lambda value: act("change", checks=CHECKS[value]))
        gui.add_button("Decide anew").on_click(lambda _: act("change", **anew))

    def _button(self, label: str, name: str, **kwargs: Any) -> Any:
        """Add a button that calls what is done under a name."""
        button = self._gui.add_button(label, **kwargs)
        button.on_click(lambda _: self._act(name))
        return button


def _on_choice(control: Any, function: Callable[[Any], None]) -> None:
    """Call a function with the values that a user gives a control."""

    def call(event: Any) -> None:
        if event.client is not None:  # otherwise the page itself has set it
            function(control.value)

    control.on_update(call)


def _on_slide(slider: Any, function: Callable[[Any], None]) -> None:
    """Call a function with the values that a user gives a slider; a number that is typed may lie outside."""
    _on_choice(slider, lambda value: function(min(max(value, slider.min), slider.max)))


def _table(names: Iterable[str], rows: Iterable[Iterable[Any]], note: str) -> str:
    """Return an HTML table with a note below it; a column without any value is left out."""
    table = pd.DataFrame(rows, columns=list(names)).dropna(axis="columns", how="all")
    number = "{:.2f}".format
    text = table.to_html(index=False, border=0, na_rep="-", float_format=number, classes="viapoint")
    return f"{TABLE}{text}{NOTE.format(note)}"


def _millimetres(length: float) -> str:
    if length < -1.0:
        return "out of reach"
    return "far" if length >= 0.999 else f"{1e3 * length:.0f}"
