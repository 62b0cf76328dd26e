"""Arms from MJCF and URDF files."""

from __future__ import annotations

import copy
import itertools
import os
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs.arms.arm import HIDDEN_GROUP, VIEWS, Arm, arm_from_xml, asset, greatest_loads, move
from viapoint.envs.arms.capsule_fit import FittedCapsule, cover_geom, split
from viapoint.envs.arms.choices import (
    GROUNDS,
    KNOWN_TORQUES,
    KNOWN_VELOCITIES,
    MOVES,
    Tool,
    ancestors,
    arm_joints,
    chain_joints,
    choose_tool,
    collision_geoms,
    known_limits,
)
from viapoint.envs.arms.kinematics import torques
from viapoint.envs.arms.stored import cached_arm, read_arm
from viapoint.envs.arms.urdf import MASSES_GUESSED, WARNING, Packages, Urdf, read_urdf
from viapoint.envs.common.arrays import Float, frame_matrices, norm
from viapoint.envs.common.validation import finite_array, number_of_at_least
from viapoint.envs.geometry.obstacles import quaternions_of

HOMES = 64  # Number of random configurations among which a home is looked for
INSET = 0.1  # Least distance of home from the joint limits, as a share of the ranges
FLUSH = 1e-7  # Distance of bodies that counts as contact, as it may be a rounding error, [m]
LEAST_GAP = 0.002  # Distance of bodies at home below which another home is looked for, [m]
DEFAULT_VELOCITY_LIMIT = 2.0  # Velocity limit of joints without one, [rad/s] or [m/s]
WEIGHTS, ACCELERATION, LEAST_TORQUE = 3.0, 5.0, 1.0
"""Torque limit of joints without one: multiple of what gravity needs, acceleration [rad/s^2], and least one, [N m]."""
WEIGHED = 200  # Number of configurations in which an arm of guessed masses is weighed
NEAR_LOOKED_AT = 1000  # Number of configurations in which bodies that are always near are looked at
NEAR = 0.03  # Distance within which bodies are near in at least half of the configurations, [m]
LEAST_TOLERANCE = 0.005  # Least tolerance of fitted capsules, [m]
STUCK = 100.0  # Damping beyond which a joint hardly moves: torque at full speed over the limit
# Greatest range of a hinge, [rad], and length of an arm, [m], that are not taken for degrees or millimetres
MOST_TURNS, LONGEST = 8.0 * np.pi, 20.0
FAR_TOO_LONG = 100.0  # Distance of joints above which an arm is refused, [m]
ENDLESS = 1e3  # Range of a joint above which it counts as unlimited, [rad] and [m]
# Names of files that do not tell the arm; it gets the name of the model
GENERIC_NAMES = ("arm", "model", "robot", "scene")
MIN_JOINTS = 2  # Least number of joints
MAX_TOLERANCE = 1.0  # Greatest tolerance of fitted capsules, [m]
# Distance at home that capsules leave between bodies, as a share of that of the geoms, and at most, [m]
LEFT_SHARE, LEFT_MOST = 0.25, 0.002
LEAST_EXCESS = 0.001  # Excess of capsules below which they are not split, [m]
# Distance of bodies in other configurations at which their capsules are split, too, and least excess for that, [m]
PASSING, WORTH = 0.005, 0.004
# Share of configurations in which bodies may be apart though their capsules are not
WRONG = 0.125
ROUNDED = 1e-3  # Relative error of limits that are written with three digits
SHORT = 1e-5  # Length of a capsule that is written as a sphere around it, [m]
# Least principal moment of inertia of a body, [kg m^2], and mass of a body that stands for a joint, [kg]
MIN_INERTIA = 1e-12
INERTIA_MARGIN = 2e-5  # Relative margin of the triangle inequality of principal moments
# Transmissions of actuators that drive a joint directly
JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
RESERVED = ("", "world", "meshes")  # Names that bodies of the arm cannot have, beside those of obstacles

Names = tuple[str, ...]  # Names of joints, from the base to the tool
Pair = tuple[int, int]  # Numbers of two bodies, that of the lower link first


class Parsed(NamedTuple):
    """Arm in the form of its file."""

    model: mujoco.MjModel  # Model of the file
    # Places with the arm's joints at 0, and all others as in the first keyframe or at their reference
    rest: mujoco.MjData
    moved: mujoco.MjData  # Places in any configuration
    joints: Names
    carriers: list[int]  # Body of each joint
    tool: Tool
    links: dict[int, int]  # Link of each body of the arm, 0 for the base, in the order of the file
    # Names of these bodies in the model of the arm: those of the file, where it has free ones
    names: dict[int, str]
    # Geoms of each of these bodies that count for collisions, by links; bodies without any are left out
    geoms: dict[int, list[int]]
    pairs: list[Pair]  # Pairs of bodies with geoms, of different links

    def named(self, pair: Pair) -> frozenset[str]:
        """Return the names of a pair of bodies."""
        return frozenset(self.names[body] for body in pair)

    def link_below(self, body: int) -> int:
        """Return the link that carries the one of a body: the one before the first joint of its carrier."""
        return self.carriers.index(self.carriers[self.links[body] - 1])


class View(NamedTuple):
    """Configuration of the arm in which capsules are looked at."""

    configuration: Float  # Positions of the joints, shape (J,)
    distances: dict[Pair, float]  # Distances of the pairs of bodies that are compared there, [m]


def load_arm(
    file: str | Path | mujoco.MjSpec,
    *,
    tool: Any = None,
    joints: Sequence[str] | None = None,
    base: str | None = None,
    packages: str | Path | Sequence[str | Path] = (),
    name: str | None = None,
    home: Any = None,
    origin: Any = None,
    joint_range: Any = None,
    torque_limit: Any = None,
    velocity_limit: Any = None,
    tolerance: float = 0.02,
) -> Arm:
    """Load an arm from an MJCF or URDF file.

    The arm keeps the file's joints, inertias, damping and limits, and the spheres and capsules of its bodies. Capsules
    cover the other geoms: nothing sticks out of them. Other joints are fixed as in the file's first keyframe. The base
    is what is fixed to the world and carries the arm; everything else is left out. `arm.notes` tells what was chosen
    where no argument was given. The arm is stored in a cache folder, so that it loads faster the next time. A file of
    :func:`write_arm` is the arm that was written; of the choices, only limits and name may be given anew.

    Args:
        file: MJCF or URDF file, the text of an MJCF file, or a specification.
        tool: Site or body of the tool, or a pair of body and point, (3,), [m]; by default a site or body with a usual
            name, or else the tip of the last link.
        joints: Names of the hinges and slides from the base to the tool, two or more; by default all of the chain.
        base: Body that the chain begins at; needed where a file has two arms.
        packages: Folder or folders for `package://` in a URDF; the folders above the file are always looked in.
        name: Name of the arm; by default that of the file or the model.
        home: Home configuration, shape (J,); by default the file's first keyframe if it is free, or else one that is
            looked for.
        origin: Point of the file's world that becomes the origin, [m]; by default its origin.
        joint_range: Lowest and highest position of each joint, shape (J, 2); by default those of the file, and +-pi for
            continuous joints.
        torque_limit: Torque limit of each joint or of all; by default those of the file's joints or actuators, those of
            a well-known arm, or what the arm's weight and inertia need with a warning.
        velocity_limit: Velocity limit of each joint or of all; by default that of the URDF, the file's custom number of
            that name, that of a well-known arm, or 2 with a warning. Limits above those of the file are warned of, too.
        tolerance: Greatest distance by which the capsules that cover a geom reach beyond it, 0.005 or more, [m]; where
            that takes too many, and for large geoms of the base, they reach farther. `arm.excess` tells how far.

    Raises:
        TypeError: The file is neither a name, nor text, nor a specification.
        ValueError: An argument is invalid, the file lacks something, or the arm cannot hold its weight at home.

    Example:
        >>> from viapoint.envs.arms.load import load_arm
        >>> arm = load_arm("docs/ur5e.xml")
        >>> arm.joint_names[:3], arm.notes[0]
        (('shoulder_pan', 'shoulder_lift', 'elbow'), "tool: 'hand'")
    """
    if not isinstance(packages, str | Path | Sequence):
        raise ValueError(f"packages must be a folder or several, got {packages!r}")
    folders = (packages,) if isinstance(packages, str | Path) else tuple(packages)
    if name is not None and (not isinstance(name, str) or not name):
        raise ValueError(f"name must be a string of one or more characters, got {name!r}")
    given = {
        "tool": tool,
        "joints": None if joints is None else _joint_names(joints),
        "base": base,
        "home": home,
        "origin": origin,
        "joint_range": joint_range,
        "torque_limit": torque_limit,
        "velocity_limit": velocity_limit,
        "tolerance": number_of_at_least("tolerance", tolerance, LEAST_TOLERANCE, MAX_TOLERANCE),
    }
    written = read_arm(file)
    if written is None:
        spec, own_name, urdf = _read(file, folders)
        name = name or own_name
        notes = list(urdf.notes)
        whole = _compiled(spec, notes)
        known_as = f"{name} {spec.modelname}"
        arguments = {**given, "name": name, "notes": notes, "urdf": urdf[3:]}
        arm = cached_arm(whole, arguments, lambda: _load(whole, name, known_as, urdf, notes, given))
    else:
        arm = _with_limits(replace(written, name=name or written.name), given)
    weak = np.abs(torques(arm.chain, arm.home, np.zeros(1), np.zeros(1))) > arm.torque_limit
    if given["torque_limit"] is not None and weak.any():
        some = ", ".join(itertools.compress(arm.joint_names, weak))
        raise ValueError(f"torque limits of {some} do not hold the arm's weight at home; raise torque_limit")
    for note in arm.notes:
        if note.startswith(WARNING) and (written is None or note not in written.notes):
            warnings.warn(note.removeprefix(WARNING), stacklevel=2)
    return arm


def _with_limits(arm: Arm, given: Mapping[str, Any]) -> Arm:
    """Return an arm that :func:`write_arm` wrote, with given limits; other choices raise ValueError."""
    for name in ("tool", "joints", "base", "home", "origin", "joint_range"):
        if given[name] is not None:
            raise ValueError(f"leave out {name}=, write_arm wrote this file: it is a whole arm")
    limits: dict[str, Any] = {}
    notes = list(arm.notes)
    for name, own in (("torque_limit", arm.torque_limit), ("velocity_limit", arm.velocity_limit)):
        if given[name] is not None:
            notes = [note for note in notes if name.replace("_", " ") not in note]
            limits[name] = _given_limits(name, given[name], own, arm.joint_names, notes)
    return replace(arm, notes=tuple(notes), **limits)


def _load(
    whole: mujoco.MjModel, name: str, known_as: str, urdf: Urdf, notes: list[str], given: Mapping[str, Any]
) -> Arm:
    """Return the arm of a model and the given arguments; see :func:`load_arm`."""
    whole.jnt_limited[np.ptp(whole.jnt_range, axis=1) > ENDLESS] = 0
    chosen = choose_tool(whole, given["tool"], given["base"], notes)
    notes.insert(0, f"tool: {chosen.name!r}")
    names = given["joints"] or _usual_joints(whole, chosen, given["base"], notes)
    try:
        numbers = [whole.joint(each).id for each in names]
    except KeyError as error:  # the message tells the names that there are
        raise ValueError(f"joints: {error.args[0]}") from None
    ranges = _ranges(whole, names, given["joint_range"], notes)
    velocity = _velocities(whole, names, given["velocity_limit"], urdf.velocity_limits, known_as, notes)
    torque = _torques(whole, names, ranges, given["torque_limit"], known_as, notes)
    dofs = whole.jnt_dofadr[numbers]
    # Models that are moved by other means than motors have such damping.
    stuck = whole.dof_damping[dofs].reshape(len(names), -1)[:, 0] * velocity > STUCK * torque
    if stuck.any():
        some = ", ".join(itertools.compress(names, stuck))
        notes.append(f"{WARNING}damping of {some} is left out: it takes {STUCK:g} times the torque limit")
        whole.dof_damping[dofs[stuck]] = 0.0
    parsed = _parse(whole, names, chosen, notes)
    places = parsed.rest.xpos[parsed.carriers]
    length = float(np.linalg.norm(places - places[0], axis=1).max())
    if length > FAR_TOO_LONG:  # to cover it within millimetres takes forever
        raise ValueError(f"the arm is {length:.3g} m long; lengths are metres, and these may be millimetres")
    low, high = ranges.T
    drawn = np.random.default_rng(0).uniform(low, high, (NEAR_LOOKED_AT, len(names)))
    exclude = _excluded(parsed, urdf.never_touch)
    views = _compared(parsed, ranges, drawn, given["home"], exclude, notes)
    home = views[0].configuration
    origin = np.zeros(3) if given["origin"] is None else finite_array("origin", given["origin"], (3,))
    xml, excess = _fitted(parsed, ranges, origin, views, given["tolerance"])
    bodies = {known: body for body, known in parsed.names.items()}

    def touch(first: str, second: str, configuration: Float) -> bool:
        pair = bodies[first], bodies[second]
        return _distances(parsed, configuration, [pair])[pair] <= 0.0

    arm = arm_from_xml(
        name,
        xml,
        joints=names,
        tool="hand",
        home=home,
        velocity_limit=velocity,
        torque_limit=torque,
        exclude={parsed.named(pair): reason for pair, reason in exclude.items()},
        touch=touch,
    )
    _note_units(arm, notes)
    # Where masses are guesses, limits that do not hold them are no property of the arm, wherever it is.
    guessed = any(MASSES_GUESSED in note for note in notes)
    weighed = np.concatenate((home[None], drawn[: WEIGHED if guessed else 0]))
    weight = np.abs(torques(arm.chain, weighed, np.zeros(1), np.zeros(1))).max(axis=0)
    weak = weight > torque
    if weak.any() and given["torque_limit"] is None:  # a spring that the file lacks may bear it
        some = ", ".join(itertools.compress(names, weak))
        notes.append(
            f"{WARNING}torque limits of {some}: {WEIGHTS:g} times the weight{'' if guessed else ' at home'}, which "
            "those of the file do not hold; give torque_limit"
        )
        torque = np.where(weak, WEIGHTS * weight, torque)
    endless = itertools.compress(names, (whole.jnt_limited[numbers] == 0) & ~arm.chain.sliding)
    return replace(
        arm, excess=arm.excess + excess, notes=tuple(notes), continuous=tuple(endless), torque_limit=torque
    )


def _usual_joints(model: mujoco.MjModel, tool: Tool, base: str | None, notes: list[str]) -> Names:
    """Return the names of the joints from the base to the tool that belong to the arm."""
    chain = chain_joints(model, tool.body, 0 if base is None else model.body(base).id)
    if not chain:
        raise ValueError(f"no joint moves the tool {tool.name!r}; name another one with tool=")
    names = tuple(arm_joints(model, chain, notes))
    if len(names) < MIN_JOINTS:
        fixed = "".join(f"; {note}" for note in notes if note.startswith("fixed: "))
        raise ValueError(
            f"an arm has {MIN_JOINTS} or more joints, and {len(names)} are left of {', '.join(chain)}{fixed}; give "
            "joints=, or limits of sliding joints in the file"
        )
    notes.append(f"joints: {', '.join(names)}")
    return names


def read_model(file: str | Path) -> mujoco.MjModel:
    """Return the model of an MJCF or URDF file for drawings; visual meshes may be missing.

    In a URDF, geoms that collide are in a hidden group where their link has visual ones.
    """
    try:
        spec, _, urdf = _read(file, (), visual=True)
    except ValueError:  # a visual element that MuJoCo refuses, such as a colour
        spec, _, urdf = _read(file, ())
    model = _compiled(spec, [])
    if urdf.text:  # both are in groups that are drawn
        collides = (model.geom_contype | model.geom_conaffinity) > 0
        hidden = collides & np.isin(model.geom_bodyid, model.geom_bodyid[~collides])
        model.geom_group[hidden] = HIDDEN_GROUP
    return model


def _read(file: Any, packages: Packages, visual: bool = False) -> tuple[mujoco.MjSpec, str, Urdf]:
    """Return a specification that may be changed, its name, and what MuJoCo does not take from a URDF."""
    if isinstance(file, mujoco.MjSpec):
        return file.copy(), file.modelname, Urdf()
    if not isinstance(file, str | os.PathLike) or isinstance(os.fspath(file), bytes):
        raise TypeError(f"file must be the name or the text of an MJCF file, or an MjSpec, got {file!r:.60}")
    text = os.fspath(file)
    is_text = text.lstrip().startswith("<")
    path = Path(text).expanduser()
    urdf = Urdf(text if is_text else "")
    if not is_text and not path.is_file():
        raise ValueError(f"there is no file {text!r}")
    if is_text and _is_urdf(text):
        raise ValueError(
            "file must be the name of a URDF file, as its text does not tell where its meshes are"
        )
    if not is_text and (path.suffix.lower() == ".urdf" or _is_urdf(path.read_text(errors="replace"))):
        urdf = read_urdf(path, packages, visual)
    try:
        if urdf.text:
            spec = mujoco.MjSpec.from_string(urdf.text, assets=urdf.assets)
        else:
            spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        what = "the text" if is_text else path.name
        raise ValueError(f"MuJoCo cannot read {what} as MJCF or URDF: {error}") from None
    named_after_model = is_text or path.stem.lower() in GENERIC_NAMES
    return spec, urdf.name or (spec.modelname if named_after_model else path.stem), urdf


def _is_urdf(text: str) -> bool:
    """Return True for a text with the first element of URDF files outside of comments."""
    return bool(re.search(r"<robot[\s>]", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)))


def _compiled(spec: mujoco.MjSpec, notes: list[str]) -> mujoco.MjModel:
    """Return the model of a specification without its visual meshes and textures that cannot be read; notes tell.

    Joints without a name get one.
    """
    for number, joint in enumerate(spec.joints):
        joint.name = joint.name or f"unnamed_{number}"
    while True:
        try:
            model = spec.compile()
            break
        except ValueError as error:
            notes.append(_leave_out(spec, str(error)))
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        model.opt.gravity[:] = 0.0
    return model


def _leave_out(spec: mujoco.MjSpec, fault: str) -> str:
    """Delete the texture or the visual mesh that MuJoCo's message is about, and return a note of it.

    Raises:
        ValueError: The message is about something else, or about a mesh that collides.
    """
    quoted = [Path(each) for each in re.findall(r"'(.+?)'", fault)]

    def is_meant(*names: str) -> bool:
        return any(path.match(name) for path in quoted for name in names if name)

    for texture in spec.textures:
        if is_meant(texture.file, *texture.cubefiles):
            name = texture.name or Path(texture.file).stem
            for material in spec.materials:
                material.textures = ["" if each == name else each for each in material.textures]
            spec.delete(texture)
            return f"left out: texture {name}, which is missing or broken"
    for mesh in spec.meshes:
        name = mesh.name or Path(mesh.file).stem
        if not mesh.file or not is_meant(mesh.file, name):
            continue
        geoms = [geom for geom in spec.geoms if geom.meshname == name]
        bodies = [geom.parent.name for geom in geoms if geom.contype or geom.conaffinity]
        if bodies:
            raise ValueError(
                f"the mesh {mesh.file} of {', '.join(bodies)}, which collides, is missing or broken: {fault}"
            )
        bare = [geom.parent.name for geom in geoms if len(geom.parent.geoms) == 1]
        for part in (*geoms, mesh):
            spec.delete(part)
        told = f"{WARNING}nothing of {', '.join(bare)} can collide: " if bare else ""
        return f"{told}left out: visual mesh {Path(mesh.file).name}, which is missing or broken"
    raise ValueError(f"MuJoCo cannot read the file: {fault}")


def _joint_names(joints: Any) -> Names:
    """Return different names of joints."""
    names = tuple(joints) if isinstance(joints, Iterable) and not isinstance(joints, str) else ()
    are_strings = all(isinstance(each, str) for each in names)
    names = tuple(map(str, names))  # those of NumPy's arrays are of a class of their own
    if not are_strings or not MIN_JOINTS <= len(set(names)) == len(names):
        raise ValueError(
            f"joints must be {MIN_JOINTS} or more different names, in order from the base to the tool, got {joints!r}"
        )
    return names


def _note_units(arm: Arm, notes: list[str]) -> None:
    """Note ranges and lengths that were probably written in degrees and millimetres."""
    wide = ~arm.chain.sliding & (np.ptp(arm.joint_range, axis=1) > MOST_TURNS)
    if wide.any():
        some = ", ".join(itertools.compress(arm.joint_names, wide))
        notes.append(
            f"{WARNING}the range of {some} is over four turns; are they degrees in place of radians?"
        )
    spheres = np.linalg.norm(arm.spheres.centre, axis=1) + arm.spheres.radius
    length = float(max(np.linalg.norm(arm.chain.origin, axis=1).sum(), spheres.max()))
    if length > LONGEST:
        notes.append(f"{WARNING}the arm is {length:.3g} m long; are lengths millimetres in place of metres?")


def _per_joint(name: str, values: Any, joints: Names) -> Float:
    """Return one number for each joint, shape (J,); a single number applies to all."""
    numbers = finite_array(name, values, (len(joints),), (1,), ())
    return np.array(np.broadcast_to(numbers, (len(joints),)))


def _ranges(model: mujoco.MjModel, joints: Names, given: Any, notes: list[str]) -> Float:
    """Return the range of each joint, as MuJoCo read it from the file or as given, shape (J, 2)."""
    numbers = [model.joint(name).id for name in joints]
    kinds = model.jnt_type[numbers]
    if not np.isin(kinds, MOVES).all():
        some = ", ".join(itertools.compress(joints, ~np.isin(kinds, MOVES)))
        raise ValueError(f"neither a hinge nor a slide: {some}; leave it out to fix it")
    if given is not None:
        ranges = finite_array("joint_range", given, (len(joints), 2))
        if (ranges[:, 0] >= ranges[:, 1]).any():
            raise ValueError(f"joint_range must be pairs in increasing order, got {given!r}")
        if (np.ptp(ranges, axis=1) > ENDLESS).any():
            raise ValueError(f"joint_range must span at most {ENDLESS:g} rad or m, got {given!r}")
        return ranges
    endless = model.jnt_limited[numbers] == 0
    some = ", ".join(itertools.compress(joints, endless & (kinds == MOVES[1])))
    if some:
        raise ValueError(
            f"slides need limits of at most {ENDLESS:g} m, and {some} has none; give a range in the file, or "
            "joint_range, or joints= without it"
        )
    some = ", ".join(itertools.compress(joints, endless))
    if some:
        notes.append(f"range of {some}, continuous: +-pi")
    return np.where(endless[:, None], (-np.pi, np.pi), model.jnt_range[numbers])


def _given_limits(name: str, given: Any, own: Float, joints: Names, notes: list[str]) -> Float:
    """Return given limits of joints, shape (J,); a note tells those above the arm's own, which are 0 for none."""
    limits = _per_joint(name, given, joints)
    if not (limits > 0.0).all():
        raise ValueError(f"{name} must be positive, got {limits}")
    above = (own > 0.0) & (limits > (1.0 + ROUNDED) * own)
    if above.any():
        some = ", ".join(itertools.compress(joints, above))
        notes.append(f"{WARNING}{name} is greater than the arm's own, {own[above]}, of {some}")
    return limits


def _torques(
    model: mujoco.MjModel, joints: Names, ranges: Float, given: Any, arm: str, notes: list[str]
) -> Float:
    """Return the torque limit of each joint: the greatest of its actuators, or its own if that is less."""
    found = np.zeros(len(joints))
    for i, name in enumerate(joints):
        joint = model.joint(name).id
        drives = np.isin(model.actuator_trntype, JOINT_TRANSMISSIONS) & (model.actuator_trnid[:, 0] == joint)
        for index in np.flatnonzero(drives):
            found[i] = max(found[i], _actuator_torque(model, int(index)))
        if model.jnt_actfrclimited[joint]:
            own = _symmetric_limit(model.jnt_actfrcrange[joint])
            found[i] = min(found[i], own) if found[i] > 0.0 else own
    known = known_limits(KNOWN_TORQUES, arm, len(joints))
    if given is not None:
        return _given_limits("torque_limit", given, _or_known(found, known), joints, notes)
    needed: Any = 0.0
    if known is None and (found <= 0.0).any():
        inertia, weight = greatest_loads(mujoco.MjData(model), joints, ranges)
        needed = np.maximum(ACCELERATION * inertia, WEIGHTS * weight).clip(LEAST_TORQUE)
    how = f"{WEIGHTS:g} times what the arm's weight needs, at least enough for {ACCELERATION:g} rad/s^2 (slides m/s^2)"
    return _completed("torque", joints, found, known, needed, f"{how}; give torque_limit", notes)


def _or_known(limits: Float, known: Float | None) -> Float:
    """Return limits of which missing ones, which are 0, are those of a known arm, if it is one."""
    return limits if known is None else np.where(limits > 0.0, limits, known)


def _completed(
    what: str, joints: Names, limits: Float, known: Float | None, default: Any, how: str, notes: list[str]
) -> Float:
    """Return limits of which missing ones, which are 0, are those of a known arm or a default; a note tells it."""
    missing = limits <= 0.0
    some = ", ".join(itertools.compress(joints, missing))
    if some and known is not None:
        notes.append(f"{what} limits: those of the arm of this name")
    elif some:
        notes.append(f"{WARNING}the file has no {what} limits of {some}; they get {how}")
    return np.where(missing, default if known is None else known, limits)


def _actuator_torque(model: mujoco.MjModel, index: int) -> float:
    """Return an actuator's limit: of its force, and of its control where force is gain * control; 0 for none."""
    limits = []
    if model.actuator_forcelimited[index]:
        limits.append(_symmetric_limit(model.actuator_forcerange[index]))
    plain = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE
    if plain and model.actuator_ctrllimited[index]:
        gain = abs(float(model.actuator_gainprm[index, 0]))
        limits.append(gain * _symmetric_limit(model.actuator_ctrlrange[index]))
    return abs(float(model.actuator_gear[index, 0])) * min(limits, default=0.0)


def _symmetric_limit(limits: Float) -> float:
    """Return the limit that a range leaves in both directions; 0 if it is one-sided."""
    return max(min(-float(limits[0]), float(limits[1])), 0.0)


def _velocities(
    model: mujoco.MjModel, joints: Names, given: Any, in_urdf: Mapping[str, float], arm: str, notes: list[str]
) -> Float:
    """Return the velocity limit of each joint, shape (J,)."""
    found = np.array([in_urdf.get(name, 0.0) for name in joints])
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "velocity_limit") >= 0:
        own = model.numeric("velocity_limit").data
        if len(own) in (1, len(joints)):
            found = _per_joint("velocity_limit", own, joints)
        elif given is None:
            raise ValueError(
                f"the file's custom numbers velocity_limit are {len(own)}, and the arm has {len(joints)} joints; give "
                "velocity_limit="
            )
    known = known_limits(KNOWN_VELOCITIES, arm, len(joints))
    if given is not None:
        return _given_limits("velocity_limit", given, _or_known(found, known), joints, notes)
    how = f"{DEFAULT_VELOCITY_LIMIT:g} rad/s (slides m/s); give velocity_limit="
    return _completed("velocity", joints, found, known, DEFAULT_VELOCITY_LIMIT, how, notes)


def _home(parsed: Parsed, ranges: Float, given: Any, pairs: list[Pair], notes: list[str]) -> Float:
    """Return the home configuration, shape (J,), in which some pairs of bodies do not touch."""
    model, joints = parsed.model, parsed.joints
    low, high = ranges.T
    numbers = [model.joint(name).id for name in joints]
    endless = (model.jnt_limited[numbers] == 0) & (model.jnt_type[numbers] == MOVES[0])

    def within(configuration: Float) -> Float:
        """Return a configuration with continuous joints at the equivalent within their ranges."""
        outside = endless & ((configuration < low) | (configuration > high))
        return np.where(outside, low + np.mod(configuration - low, 2.0 * np.pi), configuration)

    if given is not None:
        home = within(_per_joint("home", given, joints))
        outside = ", ".join(itertools.compress(joints, (home < low) | (home > high)))
        if outside:
            raise ValueError(f"home is outside the range of {outside}")
        return home

    def apart(configuration: Float) -> float:
        return min(_distances(parsed, configuration, pairs).values(), default=1.0)

    candidates = {"zeros": np.zeros(len(joints)), "the middle of the ranges": 0.5 * (low + high)}
    if model.nkey:
        address = [int(model.joint(name).qposadr[0]) for name in joints]
        candidates = {"the file's keyframe": within(model.key_qpos[0, address]), **candidates}
    refused = ""
    for origin, configuration in candidates.items():
        if not ((configuration >= low) & (configuration <= high)).all():
            refused += f"; {origin}: outside the ranges"
        elif apart(configuration) < LEAST_GAP:
            refused += f"; {origin}: it nearly touches itself"
        else:
            notes.append(f"home: {origin}{refused and f' (not{refused[1:]})'}")
            return np.asarray(configuration)
    notes.append(f"home: the one that is farthest from touching itself, of random ones (not{refused[1:]})")
    inset = INSET * (high - low)
    drawn = np.random.default_rng(0).uniform(low + inset, high - inset, (HOMES, len(low)))
    return max(drawn, key=apart)


def _parse(model: mujoco.MjModel, joints: Names, tool: Tool, notes: list[str]) -> Parsed:
    """Return the arm of a model: the bodies that its joints move, and what they stand on."""
    carriers = [int(model.joint(name).bodyid[0]) for name in joints]
    numbers = [model.joint(name).id for name in joints]
    for i in range(1, len(joints)):
        # Joints of one body move it one after another, in the order of the file.
        in_order = carriers[i - 1] == carriers[i] and numbers[i - 1] < numbers[i]
        if not in_order and carriers[i - 1] not in ancestors(model, carriers[i]):
            raise ValueError(
                f"joints must be in order from the base, but {joints[i - 1]!r} does not carry {joints[i]!r}"
            )
    last_link = {body: link for link, body in enumerate(carriers, start=1)}
    moves_with = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        moves_with[body] = last_link.get(body, moves_with[model.body_parentid[body]])
    if moves_with[tool.body] != len(joints):
        raise ValueError(f"the tool does not move with the last joint, {joints[-1]!r}")
    rest = mujoco.MjData(model)
    rest.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
    move(rest, joints, np.zeros(len(joints)))
    root = model.body_rootid[carriers[0]]
    links: dict[int, int] = {}
    names: dict[int, str] = {}
    taken = {model.body(body).name for body in range(model.nbody)}
    for body in np.flatnonzero(
        moves_with | (model.body_rootid == root) | (np.arange(model.nbody) == 0)
    ).tolist():
        links[body] = int(moves_with[body])
        name = str(model.body(body).name)
        if name in RESERVED or name.startswith("obstacle_"):
            name = f"body_{body}" if links[body] else f"base_{body}"
            while name in taken:
                name += "_"
        names[body] = name
    geoms = collision_geoms(model, links)
    if not any(links[body] for body in geoms):
        raise ValueError(
            f"no geom moves with any of {', '.join(joints)}, so nothing of the arm can collide: give its links geoms "
            f"that do, in a URDF elements `collision`; {'; '.join(notes)}"
        )
    pairs = [(one, other) for one, other in itertools.combinations(geoms, 2) if links[one] != links[other]]
    _note_rest(model, joints, tool, list(links), notes)
    return Parsed(model, rest, copy.copy(rest), joints, carriers, tool, links, names, geoms, pairs)


def _note_rest(model: mujoco.MjModel, joints: Names, tool: Tool, bodies: list[int], notes: list[str]) -> None:
    """Note what the arm does not take from its file: other bodies and joints, planes, and forces such as of springs."""
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    ground = np.isin(model.geom_type, GROUNDS)
    others = np.setdiff1d(model.geom_bodyid[collides & ~ground], bodies)
    still = model.body_weldid[others] == 0
    for some, what in (
        (others[still], f"{WARNING}left out, though the arm may hit them: {{}}; give them as obstacles"),
        (others[~still], "left out, not part of the arm: {}"),
    ):
        if some.size:
            notes.append(what.format(", ".join(sorted(model.body(body).name or str(body) for body in some))))
    carrying = (tool.body, *ancestors(model, tool.body))
    fixed = np.flatnonzero(np.isin(model.jnt_bodyid, carrying) & ~np.isin(model.jnt_type, MOVES))
    if fixed.size:
        named = ", ".join(model.joint(index).name for index in fixed)
        notes.append(f"fixed: {named}, neither a hinge nor a slide")
    if (collides & ground).any():
        notes.append(f"{WARNING}left out: planes and height fields; give a floor as an obstacle, HalfSpace")
    numbers = [model.joint(name).id for name in joints]
    forces = {
        "springs": model.jnt_stiffness[numbers],
        "dry friction": model.dof_frictionloss[model.jnt_dofadr[numbers]],
        "gravity compensation": model.body_gravcomp[bodies],
    }
    some_forces = ", ".join(what for what, values in forces.items() if values.any())
    if some_forces:
        notes.append(f"left out of torques: {some_forces}")
    coupled = model.eq_obj1id[(model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_active0 > 0)]
    followers = ", ".join(itertools.compress(joints, np.isin(numbers, coupled)))
    if followers:
        notes.append(
            f"{WARNING}{followers} follows another joint in the file, not in plans; leave it out of joints="
        )


def _excluded(parsed: Parsed, never_touch: Iterable[tuple[str, str]]) -> dict[Pair, str]:
    """Return the pairs of bodies that the file, or an SRDF file, does not let collide, and those of consecutive links.

    Of each link, the bodies that carry the next one count. MuJoCo decides by contact bits, excluded bodies, and
    explicit pairs of geoms.
    """
    model = parsed.model
    silent = set(map(frozenset, never_touch))
    explicit = set(map(frozenset, zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)))
    types, affinities = model.geom_contype, model.geom_conaffinity
    # Geoms that collide with nothing stand for a link that has no others.
    spare = (types | affinities) == 0
    found = {}
    for first, second in parsed.pairs:
        collide = False
        for a, b in itertools.product(parsed.geoms[first], parsed.geoms[second]):
            bits = (types[a] & affinities[b]) | (types[b] & affinities[a])
            collide = collide or bool(bits or spare[a] or spare[b] or frozenset((a, b)) in explicit)
        excluded = (min(first, second) << 16) + max(first, second) in model.exclude_signature
        carries = first > 0 and first in ancestors(model, second)
        if carries and parsed.links[first] == parsed.link_below(second):
            found[first, second] = "consecutive links"
        elif (
            excluded or not collide or frozenset((model.body(first).name, model.body(second).name)) in silent
        ):
            found[first, second] = "excluded in the file"
    return found


def _compared(
    parsed: Parsed, ranges: Float, drawn: Float, given: Any, exclude: dict[Pair, str], notes: list[str]
) -> list[View]:
    """Return home and other configurations with the distances of the pairs that are compared.

    Pairs that cannot touch are excluded with the reason: those that are near and apart in all `drawn` configurations,
    shape (N, J), and those in contact at home.
    """
    never = f"in contact in none of {len(drawn):,} configurations, though always near"
    pairs = [pair for pair in parsed.pairs if pair not in exclude]
    looked_at = [View(each, _distances(parsed, each, pairs)) for each in drawn[:VIEWS]]
    away = {pair: [view.distances[pair] for view in looked_at] for pair in pairs}
    near = [pair for pair in pairs if np.median(away[pair]) < NEAR]
    exclude |= dict.fromkeys(_apart(parsed, near, drawn), never)
    movable = {pair for pair in pairs if max(away[pair]) > 0.0}
    compared = [pair for pair in pairs if pair in movable and pair not in exclude]
    home = _home(parsed, ranges, given, compared, notes)
    at_home = _distances(parsed, home, pairs)
    close = [pair for pair in pairs if pair not in exclude and 0.0 < at_home[pair] < LEAST_GAP]
    exclude |= dict.fromkeys(_apart(parsed, close, drawn), never)
    touching = [pair for pair in pairs if pair not in exclude and at_home[pair] <= 0.0]
    exclude |= dict.fromkeys(touching, "in contact at home")
    avoidable = [pair for pair in touching if pair in movable]  # they are apart elsewhere
    if given is not None and avoidable:
        some = "; ".join(" and ".join(sorted(parsed.named(pair))) for pair in avoidable)
        notes.append(f"{WARNING}in contact at the given home, and not compared in any plan: {some}")
    compared = [pair for pair in pairs if pair not in exclude]
    views = [View(home, {pair: at_home[pair] for pair in compared})]
    for joints, there in looked_at:
        views.append(View(joints, {pair: there[pair] for pair in compared if there[pair] >= PASSING}))
    return views


def _fitted(
    parsed: Parsed, ranges: Float, origin: Float, views: Sequence[View], tolerance: float
) -> tuple[str, float]:
    """Return the text of the arm's model, and the greatest excess of its capsules, [m].

    Capsules of bodies that are apart at home must be apart there, too: those that are not are split. So are those of
    bodies with room between them in other configurations, while there are such in more than WRONG of these.

    Raises:
        ValueError: Bodies are too close at home for that.
    """
    fits: dict[int, list[FittedCapsule]] = {}
    for body, geoms in parsed.geoms.items():
        fits[body] = []
        for geom in geoms:
            fits[body] += cover_geom(parsed.model, geom, tolerance)
    # Numbers of capsules of each body, the first ones, that were compared before
    compared = dict.fromkeys(fits, 0)
    while True:
        xml = _write(parsed, ranges, origin, fits)
        capsules = mujoco.MjModel.from_xml_string(xml)
        at_home, *passing = (list(_close_capsules(parsed, capsules, fits, view, compared)) for view in views)
        coarse = {part for _, part, excess in at_home if excess >= LEAST_EXCESS}
        for pair, _, excess in at_home:
            if excess < LEAST_EXCESS:
                raise ValueError(
                    f"the bodies {' and '.join(parsed.names[each] for each in pair)} are "
                    f"{1e3 * views[0].distances[pair]:.2g} mm apart at home, too close for the capsules around them: "
                    "give another home, or exclude their contact in the file"
                )
        wrong = [{part for _, part, excess in some if excess >= WORTH} for some in passing]
        if sum(map(bool, wrong)) > WRONG * len(wrong):
            coarse = coarse.union(*wrong)
            compared = {body: len(some) for body, some in fits.items()}
        if not coarse:
            return xml, max(capsule.excess for some in fits.values() for capsule in some)
        for body, index in sorted(coarse, reverse=True):
            fits[body] += split(parsed.model, fits[body].pop(index))
            compared[body] -= index < compared[body]


def _close_capsules(
    parsed: Parsed,
    model: mujoco.MjModel,
    fits: dict[int, list[FittedCapsule]],
    view: View,
    compared: dict[int, int],
) -> Iterator[tuple[Pair, tuple[int, int], float]]:
    """Yield pairs of bodies that are apart though their capsules are not: pair, and the coarser capsule of the two.

    It is told by body and index, and by its excess, [m]. One of the two was not among those that were compared before.
    """
    data = mujoco.MjData(model)
    move(data, parsed.joints, view.configuration)
    begin = {body: int(model.body(parsed.names[body]).geomadr[0]) for body in fits}
    for pair, distance in view.distances.items():
        first, second = pair
        least = min(LEFT_SHARE * distance, LEFT_MOST)
        some = slice(begin[first], begin[first] + len(fits[first]))
        others = slice(begin[second], begin[second] + len(fits[second]))
        apart = norm(data.geom_xpos[some, None] - data.geom_xpos[others])
        apart -= model.geom_rbound[some, None] + model.geom_rbound[others]  # of spheres around the capsules
        near = apart < least
        near[: compared[first], : compared[second]] = False
        for i, j in np.argwhere(near).tolist():
            geoms = begin[first] + i, begin[second] + j
            if mujoco.mj_geomDistance(model, data, *geoms, 0.01, None) < least:
                parts = (first, i), (second, j)
                part = max(parts, key=lambda part: fits[part[0]][part[1]].excess)
                yield pair, part, fits[part[0]][part[1]].excess


def _apart(parsed: Parsed, pairs: list[Pair], configurations: Float) -> list[Pair]:
    """Return the pairs of bodies that are in contact in none of some configurations, shape (N, J)."""
    for joints in configurations:
        there = _distances(parsed, joints, pairs)
        pairs = [pair for pair in pairs if there[pair] > 0.0]
    return pairs


def _distances(parsed: Parsed, joints: Float, pairs: Sequence[Pair]) -> dict[Pair, float]:
    """Return the distances of pairs of bodies in a configuration, [m], at most 0.1."""
    move(parsed.moved, parsed.joints, joints)
    found = dict.fromkeys(pairs, 0.1)
    for pair in pairs:
        first, second = pair
        for one, other in itertools.product(parsed.geoms[first], parsed.geoms[second]):
            away = mujoco.mj_geomDistance(parsed.model, parsed.moved, one, other, 0.1, None)
            found[pair] = min(found[pair], 0.0 if abs(away) < FLUSH else away)
    return found


def _write(parsed: Parsed, ranges: Float, origin: Float, fits: dict[int, list[FittedCapsule]]) -> str:
    """Return the text of the arm's model: its bodies on the stage, with capsules as geoms."""
    model, rest = parsed.model, parsed.rest
    root = ET.fromstring(asset("stage.xml"))
    _set(next(root.iter("option")), gravity=model.opt.gravity)
    written: dict[int, ET.Element] = {}
    for body, link in parsed.links.items():
        parent, axes, start = next(root.iter("worldbody")), np.eye(3), origin
        # A body hangs on the body with the joint that moves it, which comes before it in the file.
        above = parsed.link_below(body) if body in parsed.carriers else link
        if above:
            before = parsed.carriers[above - 1]
            parent = written[before]
            axes = rest.xmat[before].reshape(3, 3)
            start = rest.xpos[before]
        turn = rest.xmat[body].reshape(3, 3)
        element = ET.SubElement(parent, "body", name=parsed.names[body])
        _set(element, pos=axes.T @ (rest.xpos[body] - start), quat=quaternions_of(axes.T @ turn))
        for index in range(above, link):
            name = parsed.joints[index]
            joint = int(model.joint(name).id)
            dof = model.jnt_dofadr[joint]
            kind = "hinge" if model.jnt_type[joint] == MOVES[0] else "slide"
            added = ET.SubElement(element, "joint", name=name, type=kind)
            # Point and axis at 0 in the frame of the body, whatever the reference of the joint is.
            _set(added, pos=turn.T @ (rest.xanchor[joint] - rest.xpos[body]), axis=turn.T @ rest.xaxis[joint])
            _set(added, range=ranges[index], armature=model.dof_armature[dof])
            _set(added, damping=model.dof_damping[dof].flat[0])
            # Of several joints of one body, all but the last get a body of their own, which weighs nothing.
            if index < link - 1:
                element.set("name", f"{parsed.names[body]} after {name}")
                inertial = ET.SubElement(element, "inertial")
                _set(inertial, pos=np.zeros(3), mass=MIN_INERTIA, diaginertia=np.full(3, MIN_INERTIA))
                element = ET.SubElement(element, "body", name=parsed.names[body])
        if link and model.body_mass[body] > 0.0:
            inertial = ET.SubElement(element, "inertial")
            _set(inertial, mass=model.body_mass[body], diaginertia=_moments(model.body_inertia[body]))
            _set(inertial, pos=model.body_ipos[body], quat=model.body_iquat[body])
        written[body] = element
        for capsule in fits.get(body, []):
            _add_capsule(written[body], model, capsule)
    site = ET.SubElement(written[parsed.tool.body], "site", name="hand")
    _set(site, pos=parsed.tool.position, quat=parsed.tool.quaternion, size=0.004, rgba=np.zeros(4))
    return ET.tostring(root, encoding="unicode") + "\n"


def _set(element: ET.Element, **values: Any) -> None:
    """Set attributes to numbers with all digits."""
    for name, numbers in values.items():
        element.set(name, " ".join(repr(float(number)) for number in np.atleast_1d(numbers)))


def _moments(given: Float) -> Float:
    """Return principal moments of inertia of which none exceeds the sum of the others, as some of flat bodies do."""
    # Thin rods have one that is nearly 0, and the others are equal.
    moments = np.maximum(given, max(MIN_INERTIA, INERTIA_MARGIN * given.max()))
    largest = int(moments.argmax())
    moments[largest] = min(moments[largest], (1.0 - INERTIA_MARGIN) * (moments.sum() - moments[largest]))
    return moments


def _add_capsule(written: ET.Element, model: mujoco.MjModel, capsule: FittedCapsule) -> None:
    """Add a capsule that covers a geom, or a part of it, to the body."""
    turn = frame_matrices(model.geom_quat[capsule.geom])
    first, second = model.geom_pos[capsule.geom] + capsule.ends @ turn.T
    length = float(np.linalg.norm(second - first))
    if length < SHORT:
        added = ET.SubElement(written, "geom", type="sphere")
        _set(added, pos=0.5 * (first + second), size=capsule.radius + 0.5 * length)
    else:
        added = ET.SubElement(written, "geom", type="capsule")
        _set(added, fromto=(*first, *second), size=capsule.radius)
