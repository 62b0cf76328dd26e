"""URDF files as text that MuJoCo reads, and what MuJoCo does not take from them."""

from __future__ import annotations

import functools
import itertools
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from contextlib import suppress
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np

READ_MESHES = (".stl", ".obj", ".msh")  # Suffixes of meshes that MuJoCo reads
# Options of MuJoCo's compiler: links without inertia get little, and fixed links stay bodies
COMPILER = {
    "balanceinertia": "true",
    "boundmass": "1e-4",
    "boundinertia": "1e-7",
    "discardvisual": "false",
    "fusestatic": "false",
    "strippath": "false",
}
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")  # Entries of an inertia
BALL = 0.05  # Radius of the ball whose inertia a link gets that has none, [m]
LIMITED = ("revolute", "prismatic")  # Types of joints that have limits
MOVING = (*LIMITED, "continuous")  # Types of joints that an arm may have
SEVERAL_WAYS = ("floating", "planar")  # Types of joints that move in several ways at once; they are fixed
WARNING = "warning: "  # Beginning of notes that are told as warnings, too
MASSES_GUESSED = "that of its geoms, as if of water"  # End of notes on masses that the file lacks
OBJECT = re.compile(rb"(?m)^[og]\b.*$")  # Line of an OBJ file that begins an object or a group
LEFT_OUT = ("transmission", "gazebo")  # Elements that MuJoCo does not need
# How many numbers attributes have, by the elements
NUMBERS = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "box": {"size": 3},
    "cylinder": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
    "mesh": {"scale": 3},
}
OPTIONAL = ("origin", "mesh")  # Elements whose attributes may be missing

Packages = tuple[str | Path, ...]  # Folders in which packages are looked for
Find = Callable[[str], Path]  # Function that returns the place of a mesh


class Urdf(NamedTuple):
    """Content of a URDF file; nothing of an MJCF file."""

    text: str = ""  # Text for MuJoCo
    name: str = ""  # Name of the robot
    assets: Mapping[str, bytes] = {}  # Meshes that MuJoCo cannot read as they are, by the names in the text
    velocity_limits: Mapping[str, float] = {}  # Velocity limits of joints by name, [rad/s] or [m/s]
    # Pairs of links that an SRDF file beside it does not compare
    never_touch: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()  # Parts that were left out


def read_urdf(path: Path, packages: Packages, visual: bool = False) -> Urdf:
    """Return the content of a URDF file; paths of meshes, which :func:`_find` looks for, become absolute ones.

    Geoms that are only `visual` are kept for drawings, except those that MuJoCo cannot read. Elsewhere they would count
    for links without others.

    Raises:
        ValueError: The file is no URDF, or a mesh for collisions is missing.
    """
    root = _root(path)
    if root.tag != "robot":
        raise ValueError(f"{path} is no URDF: its first element is {root.tag!r}, not 'robot'")
    if not root.findall("link"):
        raise ValueError(f"{path} has no links; expand a xacro file first: xacro FILE > arm.urdf")
    try:
        _check_tree(root)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
    notes: list[str] = []
    assets: dict[str, bytes] = {}
    _remove(root, *LEFT_OUT)
    if not visual:
        _remove(root, "material")
    velocity = {}
    left_out: dict[str, list[str]] = {}  # Names of links by the faults of their collision geoms
    find = functools.partial(_find, path, packages)
    for element in (*root.findall("link"), *root.findall("joint")):
        name = element.get("name", "")
        try:
            if not visual:
                _remove(element, "visual")
            _check_numbers(element)
            if element.tag == "link":
                _mend_inertia(element, notes)
                _prepare_link(element, find, assets, left_out)
            else:
                velocity[name] = _prepare_joint(element, notes)
        except ValueError as error:
            raise ValueError(f"{path.name}, {element.tag} {name!r}: {error}") from None
    for fault, links in left_out.items():
        notes.append(f"{WARNING}collision geoms are left out, of {', '.join(dict.fromkeys(links))}: {fault}")
    extension = root.find("mujoco")
    if extension is None:
        extension = ET.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(extension, "compiler")
    compiler.attrib.pop("meshdir", None)
    compiler.attrib.update(COMPILER)
    text = ET.tostring(root, encoding="unicode")
    never_touch = _srdf(path, root, notes)
    return Urdf(text, root.get("name") or path.stem, assets, velocity, never_touch, tuple(notes))


def _remove(element: ET.Element, *names: str) -> None:
    """Remove the children of some names from an element."""
    for name in names:
        for child in element.findall(name):
            element.remove(child)


def _root(path: Path) -> ET.Element:
    """Return the first element of a file; prefixes without a namespace, as in `xacro:macro`, are ignored.

    Raises:
        ValueError: The file is no XML.
    """
    content = re.sub(
        rb"\sxmlns=(\"[^\"]*\"|'[^']*')", b"", path.read_bytes()
    )  # tags would begin with the namespace
    try:
        return ET.fromstring(content)
    except ET.ParseError as error:
        fault = error
    with suppress(ET.ParseError):
        return ET.fromstring(re.sub(rb"(</?|\s)[\w.-]+:([\w.-]+)(?=[\s=/>])", rb"\1\2", content))
    raise ValueError(f"{path} is not XML: {fault}")


def _check_numbers(element: ET.Element) -> None:
    """Check the numbers of a link or joint; MuJoCo's messages do not name it.

    Raises:
        ValueError: Some are missing, too few, too many, or not finite.
    """
    for part in element.iter():
        for name, count in NUMBERS.get(part.tag, {}).items():
            text = part.get(name, None if part.tag in OPTIONAL else "")
            if text is None:
                continue
            try:
                numbers = list(map(float, text.split()))
            except ValueError:
                numbers = []
            if len(numbers) != count or not np.isfinite(numbers).all():
                raise ValueError(f"{name} of its {part.tag} must have {count} finite numbers, got {text!r}")


def _check_tree(root: ET.Element) -> None:
    """Check that no name is repeated, and that joints connect links to a tree.

    MuJoCo's messages on these do not name the link.

    Raises:
        ValueError: It is not so.
    """
    for tag in ("link", "joint"):
        names = [each.get("name", "") for each in root.findall(tag)]
        for name in dict.fromkeys(names):
            if names.count(name) > 1:
                raise ValueError(f"names of {tag}s must differ, got {name!r} {names.count(name)} times")
    links = {link.get("name") for link in root.findall("link")}
    above: dict[str, str] = {}  # Joints by the links that they lead to
    parents: dict[str, list[str]] = {}
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        ends = {element.tag: element.get("link", "") for element in joint}
        for end in ("parent", "child"):
            link = ends.get(end, "")
            if link not in links:
                raise ValueError(f"the {end} of joint {name!r} must be a link of the file, got {link!r}")
        other = above.setdefault(ends["child"], name)
        if other != name:
            raise ValueError(
                f"link {ends['child']!r} must be the child of one joint, got {other!r} and {name!r}"
            )
        parents[ends["child"]] = [ends["parent"]]
    TopologicalSorter(parents).prepare()  # a ring is an error, which names its links


def _prepare_joint(joint: ET.Element, notes: list[str]) -> float:
    """Return the velocity limit of a joint, 0 for none, and write out limits that are 0 because they are not given.

    Raises:
        ValueError: A limit is not a number, or the lower one is greater than the upper one.
    """
    name, limit, kind = joint.get("name"), joint.find("limit"), joint.get("type")
    if kind in SEVERAL_WAYS:
        joint.set("type", "fixed")
        notes.append(f"fixed: {name}, which is {kind}")
    elif kind not in (*MOVING, "fixed"):
        raise ValueError(f"its type must be {', '.join((*MOVING, *SEVERAL_WAYS))} or fixed, got {kind!r}")
    if kind not in MOVING:
        return 0.0
    given = {} if limit is None else limit.attrib
    lower, upper, velocity = (float(given.get(key, 0.0)) for key in ("lower", "upper", "velocity"))
    limited = kind in LIMITED
    if not np.isfinite((lower, upper, velocity)).all() or (limited and lower > upper):
        raise ValueError(f"limits must be finite, the lower one less than the upper one, got {given}")
    if limited and lower == upper:
        notes.append(f"{WARNING}joint {name} has no limits, or equal ones: it is taken as unlimited")
    elif limited:
        given.update(lower=f"{lower!r}", upper=f"{upper!r}")
    return velocity


def _prepare_link(
    link: ET.Element, find: Find, assets: dict[str, bytes], left_out: dict[str, list[str]]
) -> None:
    """Leave out geoms of a link that cannot be used, and add it to the links of their faults if they collide."""
    for part in (*link.findall("visual"), *link.findall("collision")):
        collides = part.tag == "collision"
        try:
            fault = _prepared(part.find("geometry"), find, assets)
        except ValueError as error:
            if collides:
                raise
            fault = str(error)
        if fault:
            link.remove(part)
            if collides:
                left_out.setdefault(fault, []).append(link.get("name", ""))


def _mend_inertia(link: ET.Element, notes: list[str]) -> None:
    """Replace an inertia that no body has, or that is missing, by that of a ball of the same mass."""
    name, mass = link.get("name"), link.find("inertial/mass")
    if mass is None:
        if link.find("collision") is not None:
            notes.append(f"mass of {name}, which the file lacks: {MASSES_GUESSED}")
        return
    value = float(mass.get("value", 0.0))
    if value <= 0.0:
        notes.append(f"mass of {name}, which is not positive: {COMPILER['boundmass']} kg")
    for inertial in link.findall("inertial"):
        inertia = inertial.find("inertia")
        if inertia is None:
            inertia = ET.SubElement(inertial, "inertia", ixx="nan")
        inertia.attrib.update({each: inertia.get(each, "0") for each in INERTIA})
        xx, xy, xz, yy, yz, zz = entries = [float(inertia.attrib[each]) for each in INERTIA]
        matrix = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        if not np.isfinite(entries).all() or np.linalg.eigvalsh(matrix)[0] < 0.0:
            moment = f"{0.4 * value * BALL**2:g}"
            inertia.attrib.update(dict.fromkeys(INERTIA, "0"), ixx=moment, iyy=moment, izz=moment)
            notes.append(f"inertia of {name}, which is missing or not positive: that of a ball of {BALL:g} m")


def _prepared(geometry: ET.Element | None, find: Find, assets: dict[str, bytes]) -> str:
    """Make the path of a mesh absolute, and return what is wrong with a geometry, empty for nothing."""
    if geometry is None or not len(geometry):
        return "no geometry"
    for element in geometry:
        sizes = " ".join(element.get(name, "") for name in ("size", "radius", "length")).split()
        if any(float(size) <= 0.0 for size in sizes):
            return f"its {element.tag} has no size"
        if element.tag != "mesh":
            continue
        file = element.get("filename", "")
        if not file.lower().endswith(READ_MESHES):
            return (
                f"MuJoCo reads {', '.join(READ_MESHES)}, not {Path(file).suffix!r}: convert it, for example "
                "with trimesh: trimesh.load(FILE, force='mesh').export('x.stl')"
            )
        found = find(file)
        element.set("filename", str(found.resolve()))
        with found.open("rb") as content:
            begin = content.read(84)
        is_binary_stl = found.suffix.lower() == ".stl" and begin[:5].lower() != b"solid"
        if is_binary_stl and not any(begin[80:]):  # the number of triangles
            return f"there is no triangle in {found.name}"
        if not is_binary_stl:
            _add_rewritten(element, found, assets)
    return ""


def _add_rewritten(mesh: ET.Element, file: Path, assets: dict[str, bytes]) -> None:
    """Add a mesh to assets in a form that MuJoCo reads, if it is STL as text, or OBJ with several objects.

    MuJoCo reads STL as binary only, and the faces of the first object only.
    """
    content = file.read_bytes()
    if file.suffix.lower() == ".stl":
        corners = np.array(re.findall(rb"(?i)vertex\s+(\S+)\s+(\S+)\s+(\S+)", content), "<f4").reshape(-1, 9)
        if not len(corners):  # many binary files begin like text
            return
        facets = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", 9), ("spare", "<u2")])
        facets["corners"] = corners
        content = bytes(80) + np.uint32(len(corners)).tobytes() + facets.tobytes()
    elif len(OBJECT.findall(content)) > 1:
        content = OBJECT.sub(b"", content)
    else:
        return
    name = f"rewritten_{len(assets)}{file.suffix.lower()}"
    assets[name] = content
    mesh.set("filename", name)


def _find(path: Path, packages: Packages, file: str) -> Path:
    """Return the place of a mesh of a URDF.

    A relative path begins at the URDF. `package://NAME/REST`, then REST, then what is left without the first folder of
    it, and so on, are looked for in the folders of `packages` and above the URDF: copies often have other names. In
    addresses, a space may be `%20`.

    Raises:
        ValueError: There is no such file.
    """
    in_package = file.startswith("package://")
    written = file.removeprefix("package://").removeprefix("file://")
    folders = [*(Path(each).expanduser() for each in packages), *path.resolve().parents]
    for name in dict.fromkeys((written, unquote(written))):
        parts = name.split("/")
        places = [] if in_package else [path.parent / name]
        for first in range(len(parts)):
            rest = "/".join(part for part in parts[first:] if part != "..")
            places += [folder / rest for folder in folders]
        for place in places:
            if place.is_file():
                return place
    raise ValueError(f"there is no file {file!r}; name folders to look in with packages=")


def _srdf(path: Path, urdf: ET.Element, notes: list[str]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that an SRDF file of the same robot does not compare.

    It is beside the URDF or in the folder srdf beside that folder, and names the same robot. Of several, the one is
    taken that has the name of the URDF.
    """
    folders = path.parent, path.resolve().parent.parent / "srdf"
    places = [place for folder in folders for place in sorted(folder.glob("*.srdf"))]
    roots = {place: _root(place) for place in dict.fromkeys(places)}
    robot = urdf.get("name")
    same = [place for place, root in roots.items() if root.get("name") == robot]
    named = [place for place in same if place.stem == path.stem]
    if not same or (len(same) > 1 and not named):
        for place, root in roots.items():
            why = "it is one of several" if same else f"it is for robot {root.get('name')!r}, not {robot!r}"
            notes.append(f"{place.name} is not used: {why}")
        return ()
    place = (named or same)[0]
    notes.append(f"pairs of links that are not compared: those of {place.name}")
    pairs = [
        (pair.get("link1", ""), pair.get("link2", "")) for pair in roots[place].findall("disable_collisions")
    ]
    links = {link.get("name") for link in urdf.findall("link")}
    unknown = dict.fromkeys(name for name in itertools.chain(*pairs) if name not in links)
    if unknown:
        notes.append(f"{WARNING}{place.name} names links that the URDF lacks: {', '.join(unknown)}")
    return tuple(pairs)
