"""URDF files as text that MuJoCo reads, and what MuJoCo does not take from them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

READ_MESHES = (".stl", ".obj", ".msh")  # Suffixes of meshes that MuJoCo reads
# Options of MuJoCo's compiler: links without inertia get little, and fixed links stay bodies
COMPILER = {
    "balanceinertia": "true",
    "boundmass": "1e-4",
    "boundinertia": "1e-7",
    "discardvisual": "true",
    "fusestatic": "false",
    "strippath": "false",
}
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")  # Entries of an inertia
BALL = 0.05  # Radius of the ball whose inertia a link gets that has none, [m]
LIMITED = ("revolute", "prismatic")  # Types of joints that have limits
MOVING = (*LIMITED, "continuous")  # Types of joints that an arm may have
WARNING = "warning: "  # Beginning of notes that are told as warnings, too
LEFT_OUT = ("transmission", "gazebo", "material")  # Elements that MuJoCo does not need

Packages = tuple[str | Path, ...]  # Folders in which packages are looked for


class Urdf(NamedTuple):
    """Content of a URDF file."""

    text: str  # Text for MuJoCo
    name: str  # Name of the robot
    assets: dict[str, bytes]  # Meshes that MuJoCo cannot read as they are, by the names in the text
    velocity_limits: dict[str, float]  # Velocity limits of joints by name, [rad/s] or [m/s]
    # Pairs of links that are not compared, from an SRDF file beside it
    never_touch: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]  # Parts that were left out


def read_urdf(path: Path, packages: Packages) -> Urdf:
    """Return the content of a URDF file; paths of meshes, which :func:`_places` looks for, become absolute ones.

    Raises:
        ValueError: The file is no URDF, or a mesh for collisions is missing.
    """
    root = _root(path)
    if root.tag != "robot":
        raise ValueError(f"{path} is no URDF: its first element is {root.tag!r}, not 'robot'")
    if not root.findall("link"):
        raise ValueError(f"{path} has no links; expand a xacro file first: xacro FILE > arm.urdf")
    notes: list[str] = []
    assets: dict[str, bytes] = {}
    for name in LEFT_OUT:
        for element in root.findall(name):
            root.remove(element)
    velocity = {}
    for element in (*root.findall("link"), *root.findall("joint")):
        name = element.get("name", "")
        try:
            if element.tag == "link":
                _prepare_link(element, path, packages, assets, notes)
            else:
                velocity[name] = _prepare_joint(element, notes)
        except ValueError as error:
            raise ValueError(f"{path.name}, {element.tag} {name!r}: {error}") from None
    extension = root.find("mujoco")
    if extension is None:
        extension = ET.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(extension, "compiler")
    compiler.attrib.pop("meshdir", None)
    compiler.attrib.update(COMPILER)
    text = ET.tostring(root, encoding="unicode")
    never_touch = _srdf(path, root.get("name"), notes)
    return Urdf(text, root.get("name") or path.stem, assets, velocity, never_touch, tuple(notes))


def _root(path: Path) -> ET.Element:
    """Return the first element of a file; prefixes without a namespace, as in `xacro:macro`, are ignored.

    Raises:
        ValueError: The file is no XML.
    """
    content = path.read_bytes()
    try:
        return ET.fromstring(content)
    except ET.ParseError as error:
        if "unbound prefix" not in str(error):
            raise ValueError(f"{path} is not XML: {error}") from None
    return ET.fromstring(re.sub(rb"(</?|\s)[\w.-]+:([\w.-]+)(?=[\s=/>])", rb"\1\2", content))


def _prepare_joint(joint: ET.Element, notes: list[str]) -> float:
    """Return the velocity limit of a joint, 0 for none, and write out limits that are 0 because they are not given.

    Raises:
        ValueError: A limit is not a number, or the lower one is greater than the upper one.
    """
    name, limit = joint.get("name"), joint.find("limit")
    if joint.get("type") == "floating":  # MuJoCo has such joints of the first body only
        joint.set("type", "fixed")
        notes.append(f"fixed: {name}, which floats")
    if joint.get("type") not in MOVING:
        return 0.0
    given = {} if limit is None else limit.attrib
    lower, upper, velocity = (float(given.get(key, 0.0)) for key in ("lower", "upper", "velocity"))
    limited = joint.get("type") in LIMITED
    if not np.isfinite((lower, upper, velocity)).all() or (limited and lower > upper):
        raise ValueError(f"limits must be finite, the lower one less than the upper one, got {given}")
    if limited and lower == upper:
        notes.append(f"{WARNING}joint {name} has no limits, or equal ones: it is taken as unlimited")
    elif limited:
        given.update(lower=f"{lower!r}", upper=f"{upper!r}")
    return velocity


def _prepare_link(
    link: ET.Element, path: Path, packages: Packages, assets: dict[str, bytes], notes: list[str]
) -> None:
    """Mend the inertia of a link, and leave out its visual geoms and those for collisions that cannot be used."""
    _mend_inertia(link, notes)
    for visual in link.findall("visual"):
        link.remove(visual)
    for collision in link.findall("collision"):
        geometry = collision.find("geometry")
        fault = "no geometry" if geometry is None else _prepared(geometry, path, packages, assets)
        if fault:
            link.remove(collision)
            notes.append(f"{WARNING}a collision geom of {link.get('name')} is left out: {fault}")


def _mend_inertia(link: ET.Element, notes: list[str]) -> None:
    """Replace an inertia that no body has, or that is missing, by that of a ball of the same mass."""
    name, mass = link.get("name"), link.find("inertial/mass")
    if mass is None:
        if link.find("collision") is not None:
            notes.append(f"mass of {name}, which the file lacks: that of its geoms, as if of water")
        return
    value = float(mass.get("value", 0.0))
    if value <= 0.0:
        notes.append(f"mass of {name}, which is not positive: {COMPILER['boundmass']} kg")
    for inertial in link.findall("inertial"):
        inertia = inertial.find("inertia")
        if inertia is None:
            inertia = ET.SubElement(inertial, "inertia", ixx="nan")
        xx, xy, xz, yy, yz, zz = entries = [float(inertia.get(each, 0.0)) for each in INERTIA]
        matrix = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        if not np.isfinite(entries).all() or np.linalg.eigvalsh(matrix)[0] < 0.0:
            moment = f"{0.4 * value * BALL**2:g}"
            inertia.attrib.update(dict.fromkeys(INERTIA, "0"), ixx=moment, iyy=moment, izz=moment)
            notes.append(f"inertia of {name}, which is missing or not positive: that of a ball of {BALL:g} m")


def _prepared(geometry: ET.Element, path: Path, packages: Packages, assets: dict[str, bytes]) -> str:
    """Make the path of a mesh absolute, and return what is wrong with a geometry, empty for nothing."""
    for element in geometry:
        sizes = " ".join(element.get(name, "") for name in ("size", "radius", "length")).split()
        if any(float(size) <= 0.0 for size in sizes):
            return f"its {element.tag} has no size"
        if element.tag != "mesh":
            continue
        file = element.get("filename", "")
        if not file.lower().endswith(READ_MESHES):
            return (
                f"MuJoCo reads {', '.join(READ_MESHES)}, not {Path(file).name}; convert it, for example with "
                "trimesh: trimesh.load(FILE, force='mesh').export('x.stl')"
            )
        found = next((place for place in _places(file, path, packages) if place.is_file()), None)
        if found is None:
            raise ValueError(f"there is no file {file!r}; packages= names folders to look in")
        element.set("filename", str(found.resolve()))
        if found.suffix.lower() == ".stl":
            content = found.read_bytes()
            if content[:5].lower() == b"solid":
                _add_text_stl(element, content, assets)
            elif not any(content[80:84]):  # the number of triangles
                return f"there is no triangle in {found.name}"
    return ""


def _add_text_stl(mesh: ET.Element, content: bytes, assets: dict[str, bytes]) -> None:
    """Add a mesh to assets as binary STL, which MuJoCo reads, if its file is text."""
    corners = np.array(re.findall(rb"(?i)vertex\s+(\S+)\s+(\S+)\s+(\S+)", content), "<f4").reshape(-1, 9)
    if len(corners):  # many binary files begin like text
        facets = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", 9), ("spare", "<u2")])
        facets["corners"] = corners
        name = f"text_{len(assets)}.stl"
        assets[name] = bytes(80) + np.uint32(len(corners)).tobytes() + facets.tobytes()
        mesh.set("filename", name)


def _places(file: str, path: Path, packages: Packages) -> Iterator[Path]:
    """Yield the places where a mesh of a URDF may be.

    A relative path begins at the file. `package://NAME/REST`, then REST, then what is left without the first folder of
    it, and so on, are looked for in the folders of `packages` and above the file: copies often have other names.
    """
    parts = file.removeprefix("package://").removeprefix("file://").split("/")
    if not file.startswith("package://"):
        yield path.parent / "/".join(parts)
    folders = [*(Path(each).expanduser() for each in packages), *path.resolve().parents]
    for first in range(len(parts)):
        for folder in folders:
            yield folder / "/".join(part for part in parts[first:] if part != "..")


def _srdf(path: Path, robot: str | None, notes: list[str]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that an SRDF file of the same robot does not compare.

    It has the same name and is beside the URDF or in the folder srdf beside that folder; or it is the only one beside.
    """
    beside = list(path.parent.glob("*.srdf"))
    places = [path.with_suffix(".srdf"), path.resolve().parents[1] / "srdf" / f"{path.stem}.srdf"]
    places += beside if len(beside) == 1 else []
    for place in dict.fromkeys(places):
        if not place.is_file():
            continue
        root = _root(place)
        if root.get("name") == robot:
            notes.append(f"pairs of links that are not compared: those of {place.name}")
            pairs = root.findall("disable_collisions")
            return tuple((pair.get("link1", ""), pair.get("link2", "")) for pair in pairs)
        notes.append(f"{place.name} is not used: it is for robot {root.get('name')!r}, not {robot!r}")
    return ()
