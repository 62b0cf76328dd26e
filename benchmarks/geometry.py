"""Measure the distances of `viapoint.envs.geometry`: agreement with coal and MuJoCo, and time for each distance.

    OMP_NUM_THREADS=1 python benchmarks/geometry.py --out docs/geometry.json

Rows are shapes, each against spheres and capsules of random sizes and poses; a tenth of the capsules are parallel to
an axis of the shape. Columns of agreement:

    coal       greatest difference of the distance from that of coal, where the bodies do not touch, [m]
    MuJoCo     the same of mj_geomDistance
    depth      the same of mj_geomDistance where spheres touch; of capsules it is another quantity, the translation
               that separates the bodies (and coal's depth of a sphere whose centre is inside a cylinder is too large)
    contacts   poses with contact in MuJoCo
    wrong      poses whose contact in MuJoCo differs from the sign of the clearance, if that is over 0.1 mm
    through    further such poses in which the axis of the capsule enters the shape: MuJoCo's method for capsules and
               boxes misses some of them

Columns of time, for batches of 10,000 distances, [ns] each:

    engine     this package
    plain      a NumPy expression of the same formula, written out; none for formulas that take a page
    ratio      engine / plain
    coal       coal.distance in a loop, with the probes' shapes and poses made in Python
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs import (
    SHAPES,
    Box,
    Capsule,
    ConvexMesh,
    Cylinder,
    HalfSpace,
    PointCloud,
    Shape,
    Sphere,
    add_to_model,
)
from viapoint.envs.common.types import Bool, Float

BATCH = 10_000
POSES_PER_SHAPE = 100
NEAR = 0.005
"""Clearance within which half of the poses are, [m]."""
CONTACT_TOLERANCE = 1e-4
"""Clearance below which contact may differ, [m]."""


def random_shape(kind: str, generator: np.random.Generator) -> Shape:
    """Return a shape of random size and pose."""
    quaternion = generator.normal(size=4)
    pose: dict[str, Any] = {
        "position": generator.uniform(-0.2, 0.2, 3),
        "quaternion": quaternion / np.linalg.norm(quaternion),
    }
    numbers = generator.uniform(0.02, 0.2, 3)
    if kind == "convex_mesh":
        return ConvexMesh.hull(0.1 * generator.normal(size=(20, 3)), **pose)
    if kind == "point_cloud":
        return PointCloud(0.1 * generator.normal(size=(40, 3)), 0.3 * numbers[0], **pose)
    values, left = {}, list(numbers)
    for name, shape in SHAPES[kind].sizes.items():
        values[name] = np.reshape([left.pop(0) for _ in range(math.prod(shape))], shape)
    return SHAPES[kind](**values, **pose)


class Probes(NamedTuple):
    """Spheres, whose ends are equal, or capsules."""

    first: Float
    """Shape (N, 3), [m]."""
    second: Float
    """Shape (N, 3), [m]."""
    radius: Float
    """Shape (N,), [m]."""

    @classmethod
    def around(cls, shape: Shape, number: int, generator: np.random.Generator, *, long: bool) -> Probes:
        """Return probes near a shape; half of them are nearly in contact, and a tenth parallel to one of its axes."""
        first = np.asarray(shape.position) + generator.uniform(-0.4, 0.4, (number, 3))
        ways = generator.uniform(-0.4, 0.4, (number, 3))
        for axis, way in enumerate(shape.rotation.T):
            ways[10 * axis :: 30] = ways[10 * axis :: 30, :1] * way
        second = first + long * ways
        radius = generator.uniform(0.01, 0.1, number)
        gap = shape.segment_distance(first, second) - generator.uniform(-NEAR, NEAR, number)
        return cls(first, second, np.where((np.arange(number) % 2 == 0) & (gap > 0.005), gap, radius))

    def clearance(self, shape: Shape) -> Float:
        """Return the clearance by this package, shape (N,), [m]."""
        if (self.first == self.second).all():
            return np.asarray(shape.distance(self.first, self.radius))
        return np.asarray(shape.segment_distance(self.first, self.second, self.radius))

    def poses(self) -> tuple[Float, Float, Float]:
        """Return centres, quaternions that turn z along the axes, and half lengths."""
        half, turns = 0.5 * (self.second - self.first), np.zeros((len(self.radius), 4))
        for turn, way in zip(turns, half, strict=True):
            mujoco.mju_quatZ2Vec(turn, way)
        return 0.5 * (self.first + self.second), turns, np.linalg.norm(half, axis=-1)


def coal_bodies(shape: Shape) -> list[tuple[Any, Any]]:
    """Return the shape as geometries and poses of coal."""
    import coal

    turn, place = shape.rotation, np.asarray(shape.position)
    at = coal.Transform3s(turn, place)
    match shape:
        case Sphere():
            return [(coal.Sphere(float(shape.radius)), at)]
        case Capsule():
            return [(coal.Capsule(float(shape.radius), 2.0 * float(shape.half_length)), at)]
        case Cylinder():
            return [(coal.Cylinder(float(shape.radius), 2.0 * float(shape.half_length)), at)]
        case Box():
            return [(coal.Box(*(2.0 * shape.size)), at)]
        case HalfSpace():
            return [(coal.Halfspace(turn[:, 2], float(turn[:, 2] @ place)), coal.Transform3s())]
        case ConvexMesh():
            points = coal.StdVec_Vec3s()
            points.extend(list(shape.vertices))
            return [(coal.Convex.convexHull(points, False, "Qt"), at)]
        case PointCloud():
            ball = coal.Sphere(float(shape.radius))
            return [(ball, coal.Transform3s(np.eye(3), turn @ point + place)) for point in shape.points]
    raise TypeError(f"coal has no {shape.kind}")


def coal_distances(shape: Shape, probes: Probes) -> Float:
    """Return the clearance by coal, shape (N,), [m]."""
    import coal

    bodies, request, result = coal_bodies(shape), coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = request.epa_tolerance = 1e-9
    request.gjk_max_iterations = request.epa_max_iterations = 1000
    found = np.empty(len(probes.radius))
    for i, (centre, turn, half) in enumerate(zip(*probes.poses(), strict=True)):
        radius, matrix = float(probes.radius[i]), np.empty(9)
        mujoco.mju_quat2Mat(matrix, turn)
        probe = coal.Capsule(radius, 2.0 * float(half)) if half > 0.0 else coal.Sphere(radius)
        pose = coal.Transform3s(matrix.reshape(3, 3), centre)
        each = []
        for body, place in bodies:
            result.clear()
            each.append(coal.distance(body, place, probe, pose, request, result))
        found[i] = min(each)
    return found


def mujoco_distances(shape: Shape, probes: Probes) -> tuple[Float, Bool]:
    """Return the clearance by mj_geomDistance and contact in a simulation, shape (N,) each."""
    spec = mujoco.MjSpec()
    (names,) = add_to_model(spec, [shape])
    body = spec.worldbody.add_body(name="probe")
    body.add_freejoint()
    long = bool((probes.first != probes.second).any())
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE if long else mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(name="probe", type=kind, size=(0.1, 0.1, 0.0))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # its boxes are those of the first size
    model = spec.compile()
    data, probe = mujoco.MjData(model), model.geom("probe").id
    distance, contact = np.empty(len(probes.radius)), np.zeros(len(probes.radius), dtype=bool)
    for i, (centre, turn, half) in enumerate(zip(*probes.poses(), strict=True)):
        model.geom_size[probe] = (probes.radius[i], half, 0.0)
        model.geom_rbound[probe] = probes.radius[i] + half
        data.qpos[:3], data.qpos[3:] = centre, turn
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        contact[i] = data.ncon > 0
        distance[i] = min(
            mujoco.mj_geomDistance(model, data, model.geom(name).id, probe, 10.0, None) for name in names
        )
    return distance, contact


class Agreement(NamedTuple):
    """Differences from coal and MuJoCo on some poses."""

    coal: float
    mujoco: float
    depth: float
    contacts: int
    wrong: int
    through: int


def agreement(kind: str, number: int, seed: int, *, long: bool) -> Agreement:
    """Compare the distances of random shapes of a kind from random spheres, or capsules if `long`."""
    generator, found = np.random.default_rng(seed), []
    while number > 0:
        shape = random_shape(kind, generator)
        probes = Probes.around(shape, min(number, POSES_PER_SHAPE), generator, long=long)
        clearance, by_coal = probes.clearance(shape), coal_distances(shape, probes)
        by_mujoco, contact = mujoco_distances(shape, probes)
        apart, enters = clearance > 0.0, clearance + probes.radius < 0.0
        wrong = (contact != (clearance < 0.0)) & (np.abs(clearance) > CONTACT_TOLERANCE)
        difference = np.abs(clearance - by_mujoco)
        found.append(
            Agreement(
                coal=float(np.abs(clearance - by_coal)[apart].max(initial=0.0)),
                mujoco=float(difference[apart].max(initial=0.0)),
                depth=0.0 if long else float(difference[~apart].max(initial=0.0)),
                contacts=int(contact.sum()),
                wrong=int((wrong & ~(enters & long)).sum()),
                through=int((wrong & enters & long).sum()),
            )
        )
        number -= len(clearance)
    columns = list(zip(*found, strict=True))
    return Agreement(*map(max, columns[:3]), *map(sum, columns[3:]))


def plain_point(shape: Shape) -> Callable[[Float], Float] | None:
    """Return the formula of the distance of points, shape (M, 3), as a user would write it; None if it takes a page."""
    c, turn, zero = np.asarray(shape.position), shape.rotation, 0.0
    norm = np.linalg.norm
    match shape:
        case Sphere():
            return lambda p: norm(p - c, axis=-1) - shape.radius
        case Capsule():
            axis = shape.half_axis

            def capsule(p: Float) -> Float:
                offset = p - c
                along = np.clip(offset @ axis / (axis @ axis), -1.0, 1.0)
                return norm(offset - along[:, None] * axis, axis=-1) - shape.radius

            return capsule
        case Cylinder():

            def cylinder(p: Float) -> Float:
                x, y, z = ((p - c) @ turn).T
                side, end = np.hypot(x, y) - shape.radius, np.abs(z) - shape.half_length
                outside = np.hypot(np.maximum(side, zero), np.maximum(end, zero))
                return outside + np.minimum(np.maximum(side, end), zero)

            return cylinder
        case Box():

            def box(p: Float) -> Float:
                q = np.abs((p - c) @ turn) - shape.size
                return norm(np.maximum(q, zero), axis=-1) + np.minimum(q.max(axis=-1), zero)

            return box
        case HalfSpace():
            return lambda p: (p - c) @ turn[:, 2]
        case PointCloud():
            points = shape.points @ turn.T + c
            return lambda p: norm(p[:, None] - points, axis=-1).min(axis=-1) - shape.radius
    return None


def plain_segment(shape: Shape) -> Callable[[Float, Float], Float] | None:
    """Return the formula of the distance of segments, shape (M, 3) each end; None if it takes a page."""
    c, norm = np.asarray(shape.position), np.linalg.norm
    match shape:
        case Sphere():

            def sphere(p: Float, q: Float) -> Float:
                way, offset = q - p, c - p
                along = np.clip((offset * way).sum(axis=-1) / (way * way).sum(axis=-1), 0.0, 1.0)
                return norm(offset - along[:, None] * way, axis=-1) - shape.radius

            return sphere
        case Capsule():
            v = 2.0 * shape.half_axis
            start = c - shape.half_axis

            def capsule(p: Float, q: Float) -> Float:
                u, gap = q - p, p - start
                a, e, b = (u * u).sum(axis=-1), v @ v, u @ v
                d, f = (u * gap).sum(axis=-1), gap @ v
                crossing = np.maximum(a * e - b * b, 1e-12 * a * e)  # of parallel segments, any point will do
                s = np.clip((b * f - d * e) / crossing, 0.0, 1.0)
                t = np.clip((b * s + f) / e, 0.0, 1.0)
                s = np.clip((b * t - d) / a, 0.0, 1.0)
                return norm(gap + s[:, None] * u - t[:, None] * v, axis=-1) - shape.radius

            return capsule
        case HalfSpace():
            normal = shape.rotation[:, 2]
            return lambda p, q: np.minimum((p - c) @ normal, (q - c) @ normal)
        case PointCloud():
            points = shape.points @ shape.rotation.T + c

            def cloud(p: Float, q: Float) -> Float:
                way, offset = (q - p)[:, None], points - p[:, None]
                along = np.clip((offset * way).sum(axis=-1) / (way * way).sum(axis=-1), 0.0, 1.0)
                return norm(offset - along[..., None] * way, axis=-1).min(axis=-1) - shape.radius

            return cloud
    return None


def nanoseconds(function: Callable[[], Any], number: int, repeats: int) -> float:
    """Return the least time of a call for each of `number` distances, [ns]."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return 1e9 * min(times) / number


class Speed(NamedTuple):
    """Times of one distance, [ns]."""

    engine: float
    plain: float | None
    coal: float


def speed(kind: str, *, long: bool, repeats: int = 30) -> Speed:
    """Measure the distances of a random shape of a kind from spheres, or from capsules if `long`."""
    generator = np.random.default_rng(0)
    shape = random_shape(kind, generator)
    probes = Probes.around(shape, BATCH, generator, long=long)
    ends = (probes.first, probes.second) if long else (probes.first,)
    formula: Callable[..., Any] | None = (plain_segment if long else plain_point)(shape)
    ours: Callable[..., Any] = shape.segment_distance if long else shape.distance
    engine = nanoseconds(lambda: ours(*ends), BATCH, repeats)
    few = Probes(*(each[:1000] for each in probes))
    coal = nanoseconds(lambda: coal_distances(shape, few), 1000, 3)
    if formula is None:
        return Speed(engine, None, coal)
    np.testing.assert_allclose(ours(*ends), formula(*ends), atol=1e-9)
    return Speed(engine, nanoseconds(lambda: formula(*ends), BATCH, repeats), coal)


def main() -> None:
    """Print both tables, and write them to a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=10_000, help="poses of each row; 0 for no agreement")
    parser.add_argument("--out", type=Path, help="JSON file of the results")
    options = parser.parse_args()
    rows = [(kind, long) for kind in SHAPES for long in (False, True)]
    found: dict[str, list[dict[str, Any]]] = {"agreement": [], "times": []}
    if options.poses:
        print(f"{'shape':14s} {'':8s} {'coal':>9s} {'MuJoCo':>9s} {'depth':>9s} contacts wrong through")
    for kind, long in rows if options.poses else ():
        agreed, probe = agreement(kind, options.poses, 0, long=long), "capsules" if long else "spheres"
        found["agreement"].append({"shape": kind, "probe": probe, "poses": options.poses, **agreed._asdict()})
        print(
            f"{kind:14s} {probe:8s} {agreed.coal:9.1e} {agreed.mujoco:9.1e} {agreed.depth:9.1e} "
            f"{agreed.contacts:8d} {agreed.wrong:5d} {agreed.through:7d}"
        )
    print(f"\n{'shape':14s} {'':8s} {'engine':>9s} {'plain':>9s} {'ratio':>6s} {'coal':>9s}")
    for kind, long in rows:
        took, probe = speed(kind, long=long), "capsules" if long else "spheres"
        found["times"].append({"shape": kind, "probe": probe, **took._asdict()})
        plain = f"{'-':>9s} {'-':>6s}"
        if took.plain is not None:
            plain = f"{took.plain:9.1f} {took.engine / took.plain:6.2f}"
        print(f"{kind:14s} {probe:8s} {took.engine:9.1f} {plain} {took.coal:9.0f}")
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
