"""URDF files as text that MuJoCo reads, and what MuJoCo does not take from them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
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

    `package://NAME/REST` is looked for in `packages`, in a folder NAME or in the folder itself, and in the folders
    above the file.

    Raises:
        ValueError: The file is no URDF, or a mesh for collisions is missing.
    """
    try:
        root = ET.fromstring(path.read_bytes())
    except ET.ParseError as error:
        raise ValueError(f"{path} is not XML: {error}") from None
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
            mesh = collision.find("geometry/mesh")
            if mesh is None:
                continue
            found = _find(mesh.get("filename", ""), path, packages)
            if found.suffix.lower() not in READ_MESHES:
                link.remove(collision)
                notes.append(
                    f"the collision mesh {found.name} of {link.get('name')} is left out: MuJoCo reads "
                    f"{', '.join(READ_MESHES)}; convert it, for example with trimesh"
                )
                continue
            mesh.set("filename", str(found))
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


def _find(file: str, path: Path, packages: tuple[str | Path, ...]) -> Path:
    """Return the path of a mesh file.

    Raises:
        ValueError: It is not there.
    """
    tried = []
    if file.startswith("package://"):
        package, _, rest = file.removeprefix("package://").partition("/")
        for folder in (*(Path(each).expanduser() for each in packages), *path.resolve().parents):
            tried += [folder / package / rest, *([folder / rest] if folder.name == package else [])]
            if folder in map(Path, packages):
                tried.append(folder / rest)
    else:
        tried = [path.parent / file.removeprefix("file://")]
    for each in tried:
        if each.is_file():
            return each.resolve()
    hint = "; packages= names folders to look in" if file.startswith("package://") else ""
    raise ValueError(f"{path.name}: there is no file {file!r}{hint}")


def _srdf(path: Path) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that an SRDF file does not compare: one of the same name, or the only one beside it."""
    beside, files = path.with_suffix(".srdf"), list(path.parent.glob("*.srdf"))
    if len(files) == 1:
        beside = files[0]
    if not beside.is_file():
        return ()
    pairs = ET.fromstring(beside.read_bytes()).findall("disable_collisions")
    return tuple((pair.get("link1", ""), pair.get("link2", "")) for pair in pairs)
