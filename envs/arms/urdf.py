"""URDF files as text that MuJoCo reads, and what MuJoCo does not take from them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

READ_MESHES = (".stl", ".obj", ".msh")
"""Suffixes of meshes that MuJoCo reads."""
COMPILER = {
    "balanceinertia": "true",
    "boundmass": "1e-4",
    "boundinertia": "1e-7",
    "discardvisual": "true",
    "fusestatic": "false",
    "strippath": "false",
}
"""Options of MuJoCo's compiler: links without inertia get little, and fixed links stay bodies."""
LEFT_OUT = ("transmission", "gazebo", "material")
"""Elements that MuJoCo does not need."""


class Urdf(NamedTuple):
    """Content of a URDF file."""

    text: str
    """Text for MuJoCo."""
    name: str
    """Name of the robot."""
    velocity_limits: dict[str, float]
    """Velocity limits of joints by name, [rad/s] or [m/s]."""
    never_touch: tuple[tuple[str, str], ...]
    """Pairs of links that are not compared, from an SRDF file beside it."""
    notes: tuple[str, ...]
    """Parts that were left out."""


def read_urdf(path: Path, packages: tuple[str | Path, ...] = ()) -> Urdf:
    """Return the content of a URDF file; paths of meshes become absolute ones.

    See :func:`_places` for where meshes are looked for.

    Raises:
        ValueError: The file is no URDF, or a mesh for collisions is missing.
    """
    root = _root(path)
    if root.tag != "robot":
        raise ValueError(f"{path} is no URDF: its first element is {root.tag!r}, not 'robot'")
    if not root.findall("link"):
        raise ValueError(f"{path} has no links; expand a xacro file first: xacro FILE > arm.urdf")
    notes = []
    for name in LEFT_OUT:
        for element in root.findall(name):
            root.remove(element)
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for collision in link.findall("collision"):
            geometry = collision.find("geometry")
            fault = "no geometry" if geometry is None else _prepared(geometry, path, packages)
            if fault:
                link.remove(collision)
                notes.append(f"a collision geom of {link.get('name')} is left out: {fault}")
    velocity = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None and float(limit.get("velocity", 0.0)) > 0.0:
            velocity[joint.get("name", "")] = float(limit.get("velocity", 0.0))
    extension = root.find("mujoco")
    if extension is None:
        extension = ET.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(extension, "compiler")
    compiler.attrib.pop("meshdir", None)
    compiler.attrib.update(COMPILER)
    text = ET.tostring(root, encoding="unicode")
    return Urdf(text, root.get("name") or path.stem, velocity, _srdf(path), tuple(notes))


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


def _prepared(geometry: ET.Element, path: Path, packages: tuple[str | Path, ...]) -> str:
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
            raise ValueError(f"{path.name}: there is no file {file!r}; packages= names folders to look in")
        element.set("filename", str(found.resolve()))
    return ""


def _places(file: str, path: Path, packages: tuple[str | Path, ...]) -> Iterator[Path]:
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


def _srdf(path: Path) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that an SRDF file does not compare.

    It has the same name and is beside the URDF or in the folder srdf beside that folder; or it is the only one beside.
    """
    beside = list(path.parent.glob("*.srdf"))
    places = [path.with_suffix(".srdf"), path.resolve().parents[1] / "srdf" / f"{path.stem}.srdf"]
    places += beside if len(beside) == 1 else []
    for place in places:
        if place.is_file():
            pairs = _root(place).findall("disable_collisions")
            return tuple((pair.get("link1", ""), pair.get("link2", "")) for pair in pairs)
    return ()
