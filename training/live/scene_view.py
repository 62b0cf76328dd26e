"""Three-dimensional view of the live page in one tab: arm, obstacles, plans, and handles to drag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from viapoint.envs import Capsule, PointCloud, Shape, Sphere
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float
from viapoint.training.live.drawing import ArmDrawing, Triangles, obstacle_mesh, tube

if TYPE_CHECKING:
    import viser

    from viapoint.training.live.setting import Setting

Drag = Callable[[str, Float], None]
"""Function that is called with a handle's name and its new place, shape (3,), [m]."""

FADE_STEPS = 8
"""Steps in which an old plan fades."""
PLAN, PROPOSAL, DONE = 0.0050, 0.0028, 0.0032
"""Radii of the plan, of other proposals, and of the executed path, [m]."""
SHRUNK = 0.05
"""Factor of the vertices of proposals, which their nodes undo. The client outlines what the pointer is over; it merges
the vertices of meshes with radii above 0.1 in cubes of 0.01, which leaves gaps in the outline of a thin tube."""
BELOW, ABOVE = np.array([0.0, 0.0, -0.002]), np.array([0.0, 0.0, 0.004])
"""Shifts of proposals and of the executed path, so that the plan stays visible, [m]."""
RADII = {"start": 0.018, "goal": 0.018, "via": 0.013}
"""Radii of the handles, [m]."""
OPACITY, GHOST = 0.45, 0.16
"""Opacity of a planar arm, which hides what is below it, and of the arm at the goal in space."""
NARROW = 0.75
"""Ratio of width and height of a window in which the first view just shows everything."""
SEE_THROUGH = 0.45
"""Opacity of large obstacles in space, which would hide the others."""
LARGE = 0.16
"""Greatest size of obstacles in space that are not large, [m]."""
LOW, TALL = 0.030, 0.060
"""Height of obstacles in the plane, [m]: below links that pass above them, and where links collide."""
GRID = 0.1
"""Distance of the lines on the table, [m]."""
FARTHEST = 1.2
"""Greatest coordinate to which something can be dragged, [m]."""


class SceneView:
    """View of one tab.

    Args:
        client: Tab.
        setting: Task of the page.
        drawing: Parts of the arm.
        floor: Height of the table, [m].
        on_drag: Function that is called while a handle is dragged.
        on_pick: Function that is called with the index of a proposal that is clicked.
        on_select: Function that is called with the row of an obstacle that is clicked.
        on_turn: Function that is called with the orientation of the goal while it is turned, a quaternion.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        setting: Setting,
        drawing: ArmDrawing,
        floor: float,
        *,
        on_drag: Drag,
        on_pick: Callable[[int], None],
        on_select: Callable[[int], None],
        on_turn: Callable[[Float], None],
    ) -> None:
        self._client, self._drawing, self._floor = client, drawing, floor
        self._on_drag, self._on_pick, self._on_select = on_drag, on_pick, on_select
        self._planar = setting.planar
        top = TALL if setting.task.whole_arm else LOW
        self._levels = (floor, top) if self._planar else None
        self._handles: dict[str, Any] = {}
        self._drops: dict[str, Any] = {}
        self._obstacles: list[tuple[Any, Shape]] = []
        self._paths: dict[str, Any] = {}
        self._count = 0
        self._thin: list[Any] = []
        self._fading: list[tuple[Any, int]] = []
        self._grab: dict[str, Float] = {}
        self._table()
        self._arm = self._add_arm("/arm", OPACITY if self._planar else None)
        self._ghost = [] if self._planar else self._add_arm("/ghost", GHOST)
        self._rings = client.scene.add_transform_controls(
            "/turn", scale=0.2, disable_axes=True, disable_sliders=True, visible=False
        )
        self._rings.on_update(lambda _: on_turn(np.array(self._rings.wxyz)))
        self.look_at_everything()

    def look_at_everything(self) -> None:
        """Move the camera to its first view: the plane from above, space from the side, farther in a narrow window."""
        camera = self._client.camera
        away = max(1.0, NARROW / max(camera.aspect, 0.1))
        if self._planar:
            view: Any = ((-0.03, 0.26, 1.75), (-0.03, 0.29, 0.0), (0.0, 1.0, 0.0), 33.0)
        else:
            view = ((2.60, -2.00, 1.75), (0.15, 0.0, 0.42), (0.0, 0.0, 1.0), 38.0)
        target = np.array(view[1])
        camera.up_direction = view[2]
        camera.position = target + away * (np.array(view[0]) - target)
        camera.look_at = target  # after the position, which takes the target along
        camera.fov = float(np.radians(view[3]))

    def pose(self, joints: Float) -> None:
        """Show the arm in a configuration, shape (J,), [rad]."""
        self._place_arm(self._arm, joints)

    def show_ends(self, start: Float, goal: Float, joints: Float) -> None:
        """Show start and goal, shape (3,) each, [m], and the arm at the goal, joint positions of shape (J,), [rad]."""
        self._place_handle("start", start)
        self._place_handle("goal", goal)
        self._place_arm(self._ghost, joints)
        self._rings.position = goal

    def show_rings(self, orientation: Float | None) -> None:
        """Show the rings that turn the goal, a quaternion, or hide them (None)."""
        self._rings.visible = orientation is not None
        if orientation is not None:
            self._rings.wxyz = orientation

    def show_obstacles(self, shapes: Sequence[Shape], selected: int | None = None) -> None:
        """Show obstacles; those whose shape is the same only move."""
        while len(self._obstacles) > len(shapes):
            self._obstacles.pop()[0].remove()
        for i, shape in enumerate(shapes):
            colour = _rgb(PALETTE.obstacle if i != selected else _lighter(PALETTE.obstacle))
            if i < len(self._obstacles):
                handle, before = self._obstacles[i]
                if not _same_mesh(before, shape):
                    handle.vertices, handle.faces = _single(obstacle_mesh(shape, self._levels))
                if tuple(handle.color) != colour:
                    handle.color = colour
            else:
                handle = self._add_mesh(f"/obstacles/{i}", obstacle_mesh(shape, self._levels), colour)
                self._make_draggable(handle, f"obstacle {i}")
                handle.on_click(lambda _, row=i: self._on_select(row))
                self._obstacles.append((handle, shape))
            handle.flat_shading = not isinstance(shape, Sphere | Capsule | PointCloud)
            large = shape.kind == "half_space" or float(shape.packed_size.max()) > LARGE
            handle.opacity = SEE_THROUGH if large and not self._planar else None
            handle.position = np.array(shape.position)
            self._obstacles[i] = handle, shape

    def move_obstacles(self, places: Float) -> None:
        """Move the obstacles to other places, shape (n, 3), [m]."""
        for (handle, _), place in zip(self._obstacles, places, strict=False):
            handle.position = place

    def show_plan(self, path: Float | None, vias: Float, *, clear: bool) -> None:
        """Show a plan; the one before fades.

        Args:
            path: Shape (P, 3), [m]; None for no plan.
            vias: Via-points, shape (K, 3), [m].
            clear: False if the plan touches something, which is shown in red.
        """
        old = self._paths.pop("plan", None)
        if old is not None:
            self._fading.append((old, FADE_STEPS))
        names = [name for name in self._handles if name.startswith("via")]
        for name in names[len(vias) :]:
            self._handles.pop(name).remove()
            if name in self._drops:
                self._drops.pop(name).remove()
        for i, via in enumerate(vias):
            self._place_handle(f"via {i}", via)
        if path is not None:
            self._count += 1
            colour = _rgb(PALETTE.plan if clear else PALETTE.contact)
            self._paths["plan"] = self._add_mesh(
                f"/plans/{self._count}", tube(path, PLAN), colour, shadow=False
            )

    def show_proposals(self, paths: Sequence[Float], clear: Sequence[bool] = ()) -> None:
        """Show proposals as thin lines that can be clicked, those that touch something in red.

        The client outlines the line under the pointer.
        """
        for handle in self._thin[len(paths) :]:
            handle.remove()
        del self._thin[len(paths) :]
        for i, (path, free) in enumerate(zip(paths, clear, strict=False)):
            mesh = tube(SHRUNK * (path + BELOW), SHRUNK * PROPOSAL)
            colour = _rgb(_lighter(PALETTE.plan if free else PALETTE.contact))
            if i == len(self._thin):
                handle = self._add_mesh(f"/proposals/{i}", mesh, colour, opacity=0.8, shadow=False)
                handle.scale = 1.0 / SHRUNK
                handle.on_click(lambda _, index=i: self._on_pick(index))
                self._thin.append(handle)
            else:
                self._thin[i].vertices, self._thin[i].color = _single(mesh)[0], colour

    def show_executed(self, hand: Float | None, *, contact: bool = False) -> None:
        """Show the executed path, shape (T, 3), [m]; None for none."""
        handle = self._paths.pop("executed", None)
        if handle is not None and hand is None:
            handle.remove()
        if hand is None or len(hand) < 2:
            return
        rows = np.unique(np.linspace(0, len(hand) - 1, 40).astype(int))
        colour = _rgb(PALETTE.contact if contact else PALETTE.executed)
        mesh = tube(hand[rows] + ABOVE, DONE)
        self._paths["executed"] = self._add_mesh("/executed", mesh, colour, shadow=False)

    def fade(self) -> bool:
        """Fade old plans by one step, and return True while there are any."""
        left = []
        for handle, steps in self._fading[-4:]:
            if steps > 1:
                handle.opacity = 0.5 * (steps - 1) / FADE_STEPS
                left.append((handle, steps - 1))
            else:
                handle.remove()
        for handle, _ in self._fading[:-4]:
            handle.remove()
        self._fading = left
        return bool(left)

    def move_handle(self, name: str, place: Float) -> None:
        """Move a handle to a place, shape (3,), [m]."""
        self._handles[name].position = place
        if name in self._drops:
            foot = np.array([*place[:2], self._floor])
            self._drops[name].points = np.stack((place, foot))[None].astype(np.float32)

    def _table(self) -> None:
        scene = self._client.scene
        centre = (-0.03, 0.35) if self._planar else (0.0, 0.0)
        width, depth = (1.7, 1.5) if self._planar else (2.0, 2.0)
        scene.add_box(
            "/table",
            dimensions=(width, depth, 0.01),
            color=_rgb(PALETTE.table),
            cast_shadow=False,
            receive_shadow=False,
            position=(*centre, self._floor - 0.008),
        )
        ends = []
        for x in np.arange(-width / 2, width / 2 + 1e-9, GRID):
            ends.append(((x, -depth / 2, 0.0), (x, depth / 2, 0.0)))
        for y in np.arange(-depth / 2, depth / 2 + 1e-9, GRID):
            ends.append(((-width / 2, y, 0.0), (width / 2, y, 0.0)))
        place = (*centre, self._floor)
        scene.add_line_segments("/grid", np.array(ends), (214, 214, 218), thickness=0.0016, position=place)

    def _add_arm(self, name: str, opacity: float | None) -> list[Any]:
        """Add the parts of the arm, and return them."""
        handles: list[Any] = []
        for i, part in enumerate(self._drawing.parts):
            if part.colour is None and opacity is None:
                handles.append(self._client.scene.add_mesh_trimesh(f"{name}/{i}", part.mesh))
                continue
            mesh = Triangles(part.mesh.vertices, part.mesh.faces)
            colour = part.colour or _rgb(PALETTE.arm)
            shadow = opacity != GHOST
            handles.append(self._add_mesh(f"{name}/{i}", mesh, colour, opacity=opacity, shadow=shadow))
        return handles

    def _place_arm(self, handles: list[Any], joints: Float) -> None:
        """Move the parts of an arm to a configuration."""
        for handle, (turn, position) in zip(handles, self._drawing.poses(joints), strict=False):
            handle.wxyz, handle.position = turn, position

    def _add_mesh(
        self,
        name: str,
        mesh: Triangles,
        colour: tuple[int, int, int],
        *,
        opacity: float | None = None,
        shadow: bool = True,
    ) -> Any:
        vertices, faces = _single(mesh)
        return self._client.scene.add_mesh_simple(
            name, vertices, faces, color=colour, opacity=opacity, cast_shadow=shadow, receive_shadow=shadow
        )

    def _place_handle(self, name: str, place: Float) -> None:
        if name not in self._handles:
            kind = name.split()[0]
            colour = {"start": PALETTE.start, "goal": PALETTE.goal, "via": PALETTE.via}[kind]
            handle = self._client.scene.add_icosphere(
                f"/handles/{name}", radius=RADII[kind], color=_rgb(colour), subdivisions=3, cast_shadow=False
            )
            self._make_draggable(handle, name)
            self._handles[name] = handle
            if not self._planar:  # a line down to the table shows the place of the handle in space
                self._drops[name] = self._client.scene.add_line_segments(
                    f"/drops/{name}", np.zeros((1, 2, 3)), _rgb(_lighter(colour)), thickness=0.003
                )
        self.move_handle(name, place)

    def _make_draggable(self, handle: Any, name: str) -> None:
        """Make a handle draggable: horizontally, or vertically in space while Shift is held."""

        async def level(event: Any) -> None:
            self._dragged(event, name, upright=False)

        async def upright(event: Any) -> None:
            self._dragged(event, name, upright=True)

        handle.on_drag("left")(level)
        if not self._planar:
            handle.on_drag("left", modifier="shift")(upright)

    def _dragged(self, event: Any, name: str, *, upright: bool) -> None:
        """Tell the new position of a handle: where the pointer's ray meets its plane."""
        eye = np.asarray(event.client.camera.position)
        place = np.asarray(event.target.position, dtype=np.float64)
        if event.phase == "start":
            self._grab[name] = np.asarray(event.start_position) - place
        grab = self._grab.get(name, np.zeros(3))
        through, ray = place + grab, np.asarray(event.end_position) - eye
        normal = np.array([0.0, 0.0, 1.0])
        if upright:
            normal = np.array([*(eye - through)[:2], 0.0])
        slope = float(normal @ ray)
        if abs(slope) < 1e-6 * float(np.linalg.norm(normal) * np.linalg.norm(ray)):
            return
        share = float(normal @ (through - eye)) / slope
        if share <= 0.0:
            return
        point = eye + share * ray - grab
        if upright:
            point = np.array([*place[:2], max(point[2], self._floor)])
        self._on_drag(name, np.clip(point, -FARTHEST, FARTHEST))


def _same_mesh(first: Shape, second: Shape) -> bool:
    """Return True for shapes that differ in their place and motion only."""
    alike = type(first) is type(second) and first.mesh is second.mesh and first.cloud is second.cloud
    sizes = np.array_equal(first.packed_size, second.packed_size)
    return alike and sizes and np.array_equal(first.quaternion, second.quaternion)


def _single(mesh: Triangles) -> tuple[Any, Any]:
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.uint32)


def _rgb(colour: Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * each) for each in colour)
    return red, green, blue


def _lighter(colour: Colour) -> Colour:
    red, green, blue = (0.45 * each + 0.55 for each in colour)
    return red, green, blue
