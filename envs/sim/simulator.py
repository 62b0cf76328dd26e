"""Batch simulator of one arm among obstacles, on MuJoCo's batch engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import batch
from numpy.typing import NDArray

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import in_space, norm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.convex_mesh import NamedMesh
from viapoint.envs.geometry.narrow_phase import LinkPositions
from viapoint.envs.geometry.rows import (
    CAPSULES,
    ShapeColumns,
    dimension_of,
    rotation_axes,
    shape_columns,
)
from viapoint.envs.geometry.shapes import SHAPES

OUT_OF_THE_WAY, UPRIGHT = np.array([0.0, 0.0, -10.0]), np.array([1.0, 0.0, 0.0, 0.0])
"""Position [m] and orientation of absent obstacles."""

MOVING = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_MOCAP_POS)
"""Parts of a control sequence with moving obstacles: controls, then the obstacles' centres."""


class SimulationLog(NamedTuple):
    """Record of n simulations over T physics steps."""

    joints: Float
    """Joint angles after each step, shape (n, T, J), [rad]."""
    contact: NDArray[np.bool_]
    """True where arm and obstacle touch at the state before a step, shape (n, T)."""
    unstable: NDArray[np.bool_]
    """True for simulations that MuJoCo stopped with a warning, shape (n,)."""
    traced: LinkPositions | None
    """Positions of the arm's traced sites before each step; None without such sites."""


class MeshGeom(NamedTuple):
    """Geom of a mesh as MuJoCo compiled it: in a frame of its own, along the axes of inertia of the mesh."""

    mesh: int
    """Index of the mesh in the model."""
    position: Float
    """Origin of the frame in that of the shape, shape (3,), [m]."""
    quaternion: Float
    """Orientation of the frame in that of the shape, shape (4,)."""
    size: Float
    """Shape (3,), [m]."""
    bound: float
    """Radius of the bounding sphere, [m]."""
    box: Float
    """Centre and half lengths of the bounding box, shape (6,), [m]."""

    @classmethod
    def of_model(cls, model: mujoco.MjModel, name: str) -> MeshGeom:
        """Return the geom of a name."""
        geom, i = model.geom(name), model.geom(name).id
        return cls(
            int(geom.dataid[0]), geom.pos.copy(), geom.quat.copy(), geom.size.copy(), float(geom.rbound[0]),
            model.geom_aabb[i].copy(),
        )  # fmt: skip

    def place(self, quaternion: Float) -> tuple[Float, Float]:
        """Return how far the origin of the frame is from the shape's, shape (n, 3), [m], and the frame's orientation.

        Args:
            quaternion: Orientations of the shape, shape (n, 4).
        """
        offset = np.stack(rotation_axes(quaternion), axis=-1) @ self.position
        turned = np.empty_like(quaternion)
        for each, own in zip(turned, quaternion, strict=True):
            mujoco.mju_mulQuat(each, own, self.quaternion)
        return offset, turned


class Simulator:
    """MuJoCo's batch engine with one arm and obstacles of any place, size and shape in each simulation."""

    def __init__(
        self,
        collision_model: CollisionModel,
        *,
        n_obstacles: int,
        num_envs: int,
        threads: int,
        shapes: Sequence[str] = CAPSULES,
    ) -> None:
        """Compile one model and allocate `num_envs` simulations on `threads` threads (0: one for each core)."""
        self.collision_model, self.arm = collision_model, collision_model.arm
        meshes = [name for name in shapes if issubclass(SHAPES[name], NamedMesh)]
        self.model = self.arm.compile(n_obstacles, collision_model.whole_arm, meshes)
        self.timestep = float(self.model.opt.timestep)
        """Length of a physics step, [s]."""
        self.physics_steps = 0
        """Physics steps simulated so far, all simulations together."""
        self.batch = batch.Batch(self.model, num_envs, threads)
        """MuJoCo's batch engine; row i of its state is simulation i."""
        self._rest_state = self.batch.state[0].copy()
        self.recorded = ("qpos", "ncon", "site_xpos") if self.arm.traced else ("qpos", "ncon")
        """Quantities that the engine records at every step."""
        sites = [self.model.site(name).id for name in self.arm.traced]
        self._traced = (sites[0], np.array(sites[1:]).reshape(-1, 2)) if sites else None
        self._geoms = [self.model.geom(f"obstacle_{row}").id for row in range(n_obstacles)]
        if n_obstacles:
            self._sizes = self.batch.expand("geom_size")
            self._bounds = self.batch.expand("geom_rbound")
            self._boxes = self.batch.expand("geom_aabb")
        self._offsets = np.zeros((num_envs, n_obstacles, 3))
        self._types = None
        if n_obstacles and tuple(shapes) != CAPSULES:
            self._types = self.batch.expand("geom_type")
        self.meshes = {name: MeshGeom.of_model(self.model, f"mesh_{name}_0") for name in meshes}
        """Geoms of registered meshes by name."""
        if n_obstacles and meshes:
            self._mesh_ids = self.batch.expand("geom_dataid")

    def place(
        self, sims: NDArray[np.int64], joints: Float, obstacles: Float, present: NDArray[np.bool_]
    ) -> None:
        """Place the arms of n simulations at rest with joint angles (n, J), [rad], and obstacles.

        Obstacles are rows for the simulator's shapes, shape (n, rows, .), [m], see :mod:`viapoint.envs.geometry.rows`.
        """
        self.batch.state[sims] = self._rest_state
        self.batch.bind("qpos")[sims] = joints
        if not self._geoms:
            return
        shape = shape_columns(obstacles)
        self.batch.bind("mocap_quat")[sims] = np.where(present[..., None], shape.quaternion, UPRIGHT)
        if self._types is None:
            # Exact half lengths, which those of boxes round.
            length = norm(in_space(obstacles[..., dimension_of(obstacles) : -1]))
            self._resize_capsules(sims, obstacles[..., -1], length, present)
        else:
            self._reshape(sims, shape, present)
        centre = np.where(present[..., None], shape.centre, np.nan)
        self.batch.bind("mocap_pos")[sims] = self._bodies(sims, centre)

    def rollout(self, sims: NDArray[np.int64], controls: Float) -> SimulationLog:
        """Run simulations, in increasing order, under controls of shape (n, T, U)."""
        steps = controls.shape[1]
        warnings = self._warnings(sims)
        out = self.batch.rollout(steps, controls, record=self.recorded, ids=sims)
        self.physics_steps += steps * len(sims)
        unstable = (self._warnings(sims) > warnings) | ~np.isfinite(out["qpos"]).all(axis=(1, 2))
        traced = LinkPositions(out["site_xpos"], *self._traced) if self._traced else None
        return SimulationLog(out["qpos"], out["ncon"] > 0, unstable, traced)

    def rollout_among_moving(
        self, sims: NDArray[np.int64], controls: Float, places: Float, steps: NDArray[np.int64]
    ) -> SimulationLog:
        """Run simulations as :meth:`rollout`, each for its own number of `steps`, 1 to T, among moving obstacles.

        All run for T steps; then each is set back to its state after its own steps. The centres of the obstacles before
        each step, `places`, have shape (n, T, rows, D), [m]; those of absent ones are NaN.
        """
        number = controls.shape[1]
        warnings = self._warnings(sims)
        where = self._bodies(sims, in_space(places)).reshape(*controls.shape[:2], -1)
        kept = ("qpos", "qvel", "qacc_warmstart", *(("act",) if self.model.na else ()))
        out = self.batch.rollout(
            number, np.concatenate((controls, where), axis=-1), MOVING, record=(*kept, "ncon"), ids=sims
        )
        self.physics_steps += number * len(sims)
        each, last = np.arange(len(sims)), steps - 1
        for name in kept:
            self.batch.bind(name)[sims] = out[name][each, last]
        joints, contact = out["qpos"], out["ncon"] > 0
        # A simulation that stops repeats its record; one that went on after its own steps was sound in them.
        stopped = (joints[each, last] == joints[:, -1]).all(axis=-1)
        unstable = (self._warnings(sims) > warnings) & stopped | ~np.isfinite(joints[each, last]).all(axis=-1)
        return SimulationLog(joints, contact, unstable, None)

    def _warnings(self, sims: NDArray[np.int64]) -> Any:
        return self.batch.warning[sims].reshape(len(sims), -1).sum(axis=-1)

    def _bodies(self, sims: NDArray[np.int64], centre: Float) -> Float:
        """Return the positions of geoms, shape (n, ..., rows, 3), [m], from those of boxes, NaN for absent ones."""
        offset = self._offsets[sims].reshape(len(sims), *(1,) * (centre.ndim - 3), -1, 3)
        return np.where(np.isnan(centre[..., :1]), OUT_OF_THE_WAY, centre + offset)

    def _resize_capsules(
        self, sims: NDArray[np.int64], radius: Float, half: Float, present: NDArray[np.bool_]
    ) -> None:
        """Set the sizes of the capsules and everything that MuJoCo derived from them when it compiled the model."""
        rows = np.ix_(sims, self._geoms)
        radius, half = np.where(present, radius, 0.01), np.where(present, half, 0.0)
        length = half + radius
        self._sizes[rows] = np.stack((radius, half, np.zeros_like(half)), axis=-1)
        self._bounds[rows] = length
        self._boxes[rows] = np.stack((*[np.zeros_like(half)] * 3, radius, radius, length), axis=-1)

    def _reshape(self, sims: NDArray[np.int64], shape: ShapeColumns, present: NDArray[np.bool_]) -> None:
        """Set types and sizes of the geoms, and everything that MuJoCo derived from them; absent ones are capsules."""
        assert self._types is not None
        none = np.zeros(present.shape)
        self._resize_capsules(sims, none, none, np.zeros_like(present))
        geoms = np.array(self._geoms)
        self._types[np.ix_(sims, geoms)] = mujoco.mjtGeom.mjGEOM_CAPSULE
        self._offsets[sims] = 0.0
        for number in np.unique(shape.kind[present]):
            sim, row = np.nonzero(present & (shape.kind == number))
            kind, half, centre = list(SHAPES.values())[number], shape.half[sim, row], shape.centre[sim, row]
            own = kind.from_box(centre, shape.quaternion[sim, row], half)
            placed, sim, geom = sim, sims[sim], geoms[row]
            self._offsets[sim, row] = own.position - centre
            if kind.kind in self.meshes:
                self._put_mesh(self.meshes[kind.kind], sim, row, shape.quaternion[placed, row])
                continue
            unit = kind.from_box(np.zeros(3), UPRIGHT, np.ones(3))
            self._types[sim, geom] = unit.geoms()[0].type
            self._sizes[sim, geom] = kind.geom_size(half)
            axis, radius = kind.bound(half)
            self._bounds[sim, geom] = norm(axis) + radius if kind.sizes else 0.0
            self._boxes[sim, geom] = np.concatenate((np.zeros_like(half), half), axis=-1)

    def _put_mesh(
        self, mesh: MeshGeom, sims: NDArray[np.int64], rows: NDArray[np.intp], quaternion: Float
    ) -> None:
        """Make geoms those of a mesh, whose frame is another one than that of the shape."""
        geoms = np.array(self._geoms)[rows]
        offset, turned = mesh.place(quaternion)
        self._offsets[sims, rows] += offset
        self.batch.bind("mocap_quat")[sims, rows] = turned
        assert self._types is not None
        self._types[sims, geoms] = mujoco.mjtGeom.mjGEOM_MESH
        self._mesh_ids[sims, geoms] = mesh.mesh
        self._sizes[sims, geoms] = mesh.size
        self._bounds[sims, geoms] = mesh.bound
        self._boxes[sims, geoms] = mesh.box
