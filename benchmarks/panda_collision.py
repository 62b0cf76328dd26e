"""Fit the capsules of the Panda to Franka's collision geometry, and measure how well they contain it.

    git clone https://github.com/frankaemika/franka_ros
    python benchmarks/panda_collision.py franka_ros/franka_description/meshes/collision --out docs/panda-collision.json

The folder holds Franka's collision meshes (Apache-2.0): link0.stl to link7.stl and hand.stl, all of them convex. The
fingers are boxes of the same description; their sizes stand below. They are closed, as in the environments.
`--write` replaces the geoms of `envs/assets/panda.xml`. `--spheres FILE` also measures the spheres of a URDF of the
Panda, such as VAMP's (github.com/KavrakiLab/vamp, Apache-2.0), as if they were the geometry.

Columns, for each link and all that moves with it, the base first:

    outside    greatest distance of a point of the geometry from the capsules, [mm]; 0 if they contain it
    excess     greatest distance of a point of the capsules from the geometry, [mm]

    forearm_and_flange   least distances within reach of geometry and capsules of forearm and flange, which are not
                         compared, [mm], and share of the positions in which their capsules touch, [%]
    not_compared         pairs of bodies that are not compared, by reason

Outside and excess are measured at points on the surfaces. The excess that the fit prints is exact, but that of single
capsules: parts of the same link may fill it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import coal
import numpy as np
from scipy.spatial import ConvexHull

from viapoint.envs import ConvexMesh
from viapoint.envs.arm_import.capsule_fit import cover_points, cut_polytope
from viapoint.envs.arms import PANDA
from viapoint.envs.arms.serial_arm import LinkCapsule, serial_arm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.distance import point_distance_squared

ASSETS = Path(__file__).parents[1] / "envs" / "assets"
TOLERANCE = 0.025
"""Greatest excess of a capsule, [m]."""
TIP, TIP_FOOT, TIP_CUT = np.array([0.0, 0.0, 0.1034]), 0.0915, 0.0905
"""Hand in the frame of the gripper, other end of the capsule that ends there, and the height above which it contains
the fingers, [m]."""
SPACING = 0.003
"""Distance of the points at which surfaces are compared, about, [m]."""
FINGER_BOXES = (
    ((18.5, 11.0), (22.0, 15.0, 20.0), 0.0),
    ((6.8, 2.2), (22.0, 8.8, 3.8), 0.0),
    ((15.9, 28.35), (17.5, 7.0, 23.5), np.pi / 6),
    ((7.58, 45.25), (17.5, 15.2, 18.5), 0.0),
)
"""Boxes of the left finger: y and z of the centre, edge lengths [mm], rotation about x [rad]; the right one mirrors it.

Franka's robot description, franka_description/robots/common/franka_hand.xacro.
"""
FINGER_HEIGHT = 0.0584
"""Height of the fingers' frame in that of the gripper, [m]."""
GRIPPER_TURN = -np.pi / 4
"""Rotation of the gripper's frame about z in that of link 7, [rad]."""
FLANGE = 0.107
"""Height of the gripper's frame in that of link 7, [m]."""
LINKS = ("link0", "link1", "link2", "link3", "link4", "link5", "link6", "link7")
"""Names of links and meshes, the base first."""
BODIES = (*LINKS, "gripper")
"""Names of bodies in the model file; the gripper moves with link 7."""
SELF_BITS, TABLE_BIT = 4, 4
"""First contact bit of bodies among themselves, and bit of the table."""
OFF_TABLE, DARK = BODIES[4:], BODIES[6:]
"""Bodies that must not touch the table, and those with the darker colour."""
FOREARM, FLANGE_LINK = "link5", "link7"
"""Links that are not compared although their capsules touch within reach; :func:`forearm_and_flange` has the reason."""
HOME = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)
"""Configuration in which bodies that touch may touch anywhere, [rad]."""
SAMPLES = 100_000
"""Random configurations; bodies that touch in none of them are not compared."""
REACH_POSITIONS, NEAREST = 300_000, 3000
"""Random positions of the hand, of which those within reach are checked, and those whose meshes are compared."""
COMMENT = """\
  Collision: capsules that contain Franka's collision meshes and the boxes of the closed fingers (franka_description of
  franka_ros, Apache-2.0), written by benchmarks/panda_collision.py. Joints are frictionless, as an inner torque loop
  makes them.

  The base stands at the origin, x points forwards, z up, and the table top is the plane z = 0.
  Contact bits: 1 links against obstacles, 4 links against the table, 16 the base and twice as much for each body after
  it, against the bodies that must not touch it. Neighbours, bodies that never touch, and forearm and flange, whose
  capsules overlap where the real ones are apart, are not compared. The base is a body of its own, which is
  faster than geoms of the world.
-->"""
"""Words on collisions in the model file."""

Bodies = dict[int, list[ConvexMesh]]
"""Convex bodies of each link, by its joint, in the frame of the joint."""


def read_stl(path: Path) -> Float:
    """Return the vertices of a binary STL file, shape (n, 3), [m]."""
    content = path.read_bytes()
    triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    count = int.from_bytes(content[80:84], "little")
    triangles = np.frombuffer(content, triangle, count, offset=84)
    return np.unique(triangles["corners"].reshape(-1, 3).astype(np.float64), axis=0)


def finger_boxes() -> list[Float]:
    """Return the corners of the boxes of both closed fingers in the frame of the gripper, shape (8, 3) each, [m]."""
    found = []
    for (y, z), size, angle in FINGER_BOXES:
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([(1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)])
        signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        corners = 1e-3 * (np.array(size) * signs @ turn.T + (0.0, y, z)) + (0.0, 0.0, FINGER_HEIGHT)
        found += [corners, corners * (1.0, -1.0, 1.0)]
    return found


def on_flange(points: Float) -> Float:
    """Return points of the gripper's frame in the frame of link 7."""
    c, s = np.cos(GRIPPER_TURN), np.sin(GRIPPER_TURN)
    return np.asarray(points @ np.array([(c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)]) + (0.0, 0.0, FLANGE))


def published_bodies(folder: Path) -> Bodies:
    """Return Franka's collision geometry."""
    bodies = {
        joint: [ConvexMesh.hull(read_stl(folder / f"{name}.stl"))] for joint, name in enumerate(LINKS, -1)
    }
    gripper = [read_stl(folder / "hand.stl"), *finger_boxes()]
    return {**bodies, 6: bodies[6] + [ConvexMesh.hull(on_flange(each)) for each in gripper]}


def rounded(ends: Float, radius: float) -> LinkCapsule:
    """Return a capsule with four decimals that contains a given one; the name and the joint are open."""
    first, second = (tuple(map(float, np.round(end, 4) + 0.0)) for end in ends)
    shift = np.abs(np.array((first, second)) - ends)
    return LinkCapsule(
        -1, (first, second), float(np.ceil(1e4 * (radius + np.linalg.norm(shift, axis=-1).max())) / 1e4)
    )


def fingers_at(height: float) -> tuple[Float, Float]:
    """Return points of the fingers below and above a height in the gripper's frame, shape (n, 3) each, [m]."""
    up = np.array([0.0, 0.0, 1.0])
    pieces = [cut_polytope(box, ConvexMesh.hull(box).polytope, up, height) for box in finger_boxes()]
    low, high = (np.concatenate(each) for each in zip(*pieces, strict=True))
    return low, high


def fit(folder: Path) -> dict[str, list[LinkCapsule]]:
    """Return the capsules of each body of the model file, in its frame; print their exact excess."""
    low, high = fingers_at(TIP_CUT)
    parts = {name: read_stl(folder / f"{name}.stl") for name in (*LINKS, "hand")} | {"fingers": low}
    found = {}
    for name, points in parts.items():
        fitted = cover_points(points, TOLERANCE - 2e-4)
        found[name] = [rounded(each.ends, each.radius) for each in fitted]
        body = ConvexMesh.hull(points)
        excess = (each.radius + np.asarray(body.distance(np.array(each.ends))).max() for each in found[name])
        print(f"{name:8s} excess {', '.join(f'{1e3 * each:.1f}' for each in excess)} mm")
    foot = np.array([0.0, 0.0, TIP_FOOT])
    axis = TIP - foot
    along = np.clip((high - foot) @ axis / (axis @ axis), 0.0, 1.0)
    radius = float(np.linalg.norm(high - foot - along[:, None] * axis, axis=1).max())
    found["gripper"] = [*found.pop("hand"), *found.pop("fingers"), rounded(np.stack((foot, TIP)), radius)]
    return found


def skipped_pairs(capsules: dict[str, list[LinkCapsule]]) -> dict[tuple[str, str], str]:
    """Return the pairs of bodies that are not compared, the one nearer to the base first, with the reason."""
    arm = serial_arm(
        model_text(capsules, set()), name="all", joint_names=PANDA.joint_names, hand_site="hand", ik=PANDA.ik,
        workspace=PANDA.workspace,
    )  # fmt: skip
    names = [each.name.split("_")[0] for each in (*arm.shape, *arm.base)]
    joints = np.random.default_rng(0).uniform(*np.array(arm.joint_range).T, (SAMPLES, 7))
    pairs: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for i, j in arm.self_pairs:
        one, other = sorted((names[i], names[j]), key=BODIES.index)
        pairs.setdefault((one, other), []).append((i, j))
    skipped = dict.fromkeys(itertools.pairwise(LINKS), "adjacent")
    skipped |= {(LINKS[-2], "gripper"): "adjacent", (FOREARM, FLANGE_LINK): "only capsules overlap"}
    for bodies, some in pairs.items():
        pair = replace(arm, self_pairs=tuple(some), off_table=())
        if pair.self_clearance(np.array(HOME)) < 0.0:
            skipped.setdefault(bodies, "touch at home")
        elif (pair.self_clearance(joints) > 0.0).all():
            skipped.setdefault(bodies, "never touch")
    return skipped


def model_text(capsules: dict[str, list[LinkCapsule]], skipped: Collection[tuple[str, str]]) -> str:
    """Return `panda.xml` with other capsules; all bodies collide but neighbours and some pairs.

    Body k, counted from the base, has the contact bit SELF_BITS + k, and collides with the bits of the bodies before it
    that it must not touch.

    Args:
        capsules: Capsules of each body, in its frame.
        skipped: Pairs of bodies.
    """
    whole = (ASSETS / "panda.xml").read_text(encoding="utf-8")
    whole = re.sub(r"  Collision: .*?-->", COMMENT, whole, flags=re.DOTALL)
    lines, body = [], ""
    for line in whole.splitlines():
        name = re.search(r'<body name="(\w+)"', line)
        body = name.group(1) if name else body
        if "<geom name=" not in line or "table" in line:
            lines.append(line)
        if '<body name="link0"' in line or "<inertial" in line:
            indent = " " * (len(line) - len(line.lstrip()) + 2 * (body == "link0"))
            lines += [indent + each for each in geom_lines(body, capsules[body], skipped)]
    return "\n".join(lines) + "\n"


def geom_lines(body: str, capsules: list[LinkCapsule], skipped: Collection[tuple[str, str]]) -> list[str]:
    """Return the geoms of a body."""
    place = BODIES.index(body)
    contype = 1 << (SELF_BITS + place) | (place > 0) | (TABLE_BIT if body in OFF_TABLE else 0)
    neighbours = 2 if body == "gripper" else 1  # the gripper is fixed to link 7
    others = [other for other in range(max(place - neighbours, 0)) if (BODIES[other], body) not in skipped]
    conaffinity = sum(1 << (SELF_BITS + other) for other in others)
    shown = ' rgba="0.66 0.71 0.78 1"' if body in DARK else ""
    bits = f'contype="{contype}" conaffinity="{conaffinity}"'
    found = []
    for number, capsule in enumerate(capsules):
        ends = " ".join(f"{x:g}" for end in capsule.ends for x in end)
        name = body if len(capsules) == 1 else f"{body}_{number}"
        found.append(f'<geom name="{name}" fromto="{ends}" size="{capsule.radius:g}" {bits}{shown}/>')
    if body == "gripper":
        place, radius = " ".join(f"{x:g}" for x in TIP), f"{capsules[-1].radius:g}"
        shown = f'rgba="0.16 0.20 0.28 1" {bits}'
        found.append(f'<geom name="hand" type="sphere" pos="{place}" size="{radius}" {shown}/>')
    return found


def rows_of(capsules: list[LinkCapsule]) -> Float:
    """Return centre, half-axis and radius of capsules, shape (n, 7), [m]."""
    ends, radii = np.array([each.ends for each in capsules]), np.array([each.radius for each in capsules])
    return np.concatenate((ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0]), radii[:, None]), axis=-1)


def from_capsules(points: Float, rows: Float) -> Float:
    """Return the signed distance of points, shape (n, 3), from the nearest of some capsules, shape (n,), [m]."""
    return np.asarray((np.sqrt(point_distance_squared(points, rows)) - rows[:, -1:]).min(axis=0))


def capsule_surface(rows: Float) -> Float:
    """Return points on the surface of a union of capsules, shape (n, 3), [m]."""
    found = []
    for row in rows:
        number = int(4.0 * np.pi * (row[-1] / SPACING) ** 2)
        height = 1.0 - (2.0 * np.arange(number) + 1.0) / number  # Fibonacci points of a sphere
        angle = np.pi * (3.0 - 5.0**0.5) * np.arange(number)
        around = np.sqrt(1.0 - height * height)
        ball = row[-1] * np.stack((around * np.cos(angle), around * np.sin(angle), height), axis=-1)
        steps = np.linspace(-1.0, 1.0, 2 + int(2.0 * np.linalg.norm(row[3:6]) / SPACING))
        for step in steps:
            points = row[:3] + step * row[3:6] + ball
            found.append(points[from_capsules(points, rows) > -1e-6])
    return np.concatenate(found)


def mesh_surface(body: ConvexMesh) -> Float:
    """Return points on the surface of a convex mesh, shape (n, 3), [m]."""
    found = []
    for a, b, c in body.vertices[ConvexHull(body.vertices).simplices]:
        count = 1 + int(max(np.linalg.norm(b - a), np.linalg.norm(c - a)) / SPACING)
        u, v = np.meshgrid(*[np.linspace(0.0, 1.0, count + 1)] * 2)
        inside = u + v <= 1.0 + 1e-9
        found.append(a + u[inside][:, None] * (b - a) + v[inside][:, None] * (c - a))
    return np.concatenate(found)


def sphere_capsules(file: Path) -> dict[int, list[LinkCapsule]]:
    """Return the spheres of a URDF of the Panda by their joint, with the fingers closed."""
    found: dict[int, list[LinkCapsule]] = {joint: [] for joint in range(-1, 7)}
    for link in ET.parse(file).getroot().findall("link"):
        name = str(link.get("name")).removeprefix("panda_")
        finger = (0.0, 0.0, FINGER_HEIGHT if "finger" in name else 0.0)
        for each in link.findall("collision"):
            centre = np.array(each.find("origin").get("xyz").split(), float)[None]  # type: ignore[union-attr]
            joint = LINKS.index(name) - 1 if name in LINKS else 6
            (place,) = centre if name in LINKS else on_flange(centre + finger)
            radius = float(each.find("geometry/sphere").get("radius"))  # type: ignore[union-attr, arg-type]
            point = tuple(map(float, place))
            found[joint].append(LinkCapsule(joint, (point, point), radius))
    return found


def measure(bodies: Bodies, spheres: dict[int, list[LinkCapsule]] | None) -> list[dict[str, Any]]:
    """Return a row for each link of the arm."""
    found = []
    for joint in range(-1, 7):
        capsules = [each for each in (*PANDA.shape, *PANDA.base) if each.joint == joint]
        row: dict[str, Any] = {"link": LINKS[joint + 1], "capsules": len(capsules)}
        rows = rows_of(capsules)
        outer, surface = capsule_surface(rows), np.concatenate([mesh_surface(each) for each in bodies[joint]])
        excess = np.min([np.asarray(each.distance(outer)) for each in bodies[joint]], axis=0)
        row |= {"outside": from_capsules(surface, rows).max(), "excess": excess.max()}
        if spheres:
            balls = rows_of(spheres[joint])
            row["spheres_outside"] = from_capsules(capsule_surface(balls), rows).max()
            row["spheres_excess"] = from_capsules(outer, balls).max()
        found.append(
            {name: round(1e3 * max(x, 0.0), 1) if isinstance(x, float) else x for name, x in row.items()}
        )
    return found


def forearm_and_flange(bodies: Bodies) -> dict[str, float]:
    """Return the least distance of forearm and flange within reach, of their geometry and of their capsules, [mm].

    The geometry of the flange includes the hand. It is compared where the capsules are nearest.
    """
    hand = np.random.default_rng(0).uniform((-1.0, -1.0, 0.0), 1.0, (REACH_POSITIONS, 3))
    joints = PANDA.inverse_kinematics(hand[np.asarray(PANDA.reach_margin(hand)) >= 0.0])
    names = [each.name.split("_")[0] for each in PANDA.shape]
    pairs = [
        (i, j)
        for i, one in enumerate(names)
        for j, other in enumerate(names)
        if (one, other) == (FOREARM, FLANGE_LINK)
    ]
    clearance = np.asarray(replace(PANDA, self_pairs=tuple(pairs), off_table=()).self_clearance(joints))
    forearm, *others = (convex(each) for joint in (4, 6) for each in bodies[joint])
    least = np.inf
    for some in joints[np.argsort(clearance)[:NEAREST]]:
        frames = PANDA.chain.frames(some)
        first, second = (placed(frames[joint]) for joint in (4, 6))
        for other in others:
            request, result = coal.DistanceRequest(), coal.DistanceResult()
            least = min(least, coal.distance(forearm, first, other, second, request, result))
    share = 100.0 * float((clearance < 0.0).mean())
    return {
        "geometry": round(1e3 * least, 1),
        "capsules": round(1e3 * float(clearance.min()), 1),
        "touching": round(share, 1),
    }


def convex(body: ConvexMesh) -> coal.ConvexBase:
    """Return a convex mesh for coal."""
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    points.extend(list(np.asarray(body.vertices)))
    triangles.extend([coal.Triangle(*map(int, each)) for each in ConvexHull(body.vertices).simplices])
    return coal.Convex(points, triangles)


def placed(frame: Any) -> coal.Transform3s:
    """Return the pose of a frame for coal."""
    origin, *axes = (np.array(frame.transform(point)) for point in ((0.0, 0.0, 0.0), *np.eye(3)))
    return coal.Transform3s(np.stack(axes, axis=-1) - origin[:, None], origin)


def main() -> None:
    """Fit, measure, and write files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("meshes", type=Path, help="folder of Franka's collision meshes")
    parser.add_argument("--spheres", type=Path, help="URDF with spheres")
    parser.add_argument("--write", action="store_true", help="write envs/assets/panda.xml")
    parser.add_argument("--out", type=Path, help="JSON file of the results")
    options = parser.parse_args()
    capsules, file = fit(options.meshes), ASSETS / "panda.xml"
    skipped = skipped_pairs(capsules)
    not_compared: dict[str, list[str]] = {}
    for pair, reason in sorted(skipped.items()):
        not_compared.setdefault(reason, []).append("-".join(pair))
    print(f"bodies that are not compared: {not_compared}")
    text = model_text(capsules, skipped)
    if options.write:
        file.write_text(text, encoding="utf-8")
    print(
        f"{file.name} is {'the' if text == file.read_text(encoding='utf-8') else 'NOT the'} result of this fit\n"
    )
    bodies = published_bodies(options.meshes)
    spheres = sphere_capsules(options.spheres) if options.spheres else None
    found = measure(bodies, spheres)
    for row in found:
        print("  ".join(f"{name} {x}" for name, x in row.items()))
    apart = forearm_and_flange(bodies)
    print(f"forearm and flange within reach: {apart}")
    if options.out:
        results = {"links": found, "forearm_and_flange": apart, "not_compared": not_compared}
        options.out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
