"""Choices for an arm of a file: tool, joints and limits, where the user names none."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs.arms.capsule_fit import hull_of
from viapoint.envs.arms.urdf import WARNING
from viapoint.envs.common.arrays import Float
from viapoint.envs.common.validation import finite_array

MOVES = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))  # Joints that an arm may have
GROUNDS = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))  # Geoms that are left out
# Usual names of tools, the most telling first; prefixes that end in `_`, `/` or `:` may precede them
TOOL_NAMES = (
    r"attachment(_site)?", r"tcp", r"tool\d*(_?center)?(_?(point|frame|link))?", r"ee(f|_?site|_?link|_?frame)?",
    r"end_?effector.*", r"grip(per)?(_?(site|link|base|center))?", r"pinch(_?site)?", r"grasp(_?(site|target|frame))?",
    r"(right_|left_)?hand(_?(site|link))?", r"flange.*", r"link_(tcp|eef)",
)  # fmt: skip
GRIPPERS = re.compile(r"grip|jaw|finger|fngr|claw|knuckle", re.IGNORECASE)
"""Words in the names of bodies and joints of a gripper, which is not part of a chain whose tool has no usual name."""
SAME_PLACE = 1e-3  # Greatest distance of two frames that are the same tool, [m]
LEAST_CHAIN = 3  # Least number of joints of a branch that is an arm and not a finger
KNOWN_VELOCITIES: dict[str, tuple[float, ...]] = {
    "panda": (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    "fr3": (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    "ur3e": (3.14, 3.14, 3.14, 6.28, 6.28, 6.28),
    "ur5e": (3.14,) * 6,
    "ur10e": (2.09, 2.09, 3.14, 3.14, 3.14, 3.14),
    "iiwa14": (1.48, 1.48, 1.75, 1.31, 2.27, 2.36, 2.36),
    "gen3": (1.39, 1.39, 1.39, 1.39, 1.22, 1.22, 1.22),
    "xarm7": (3.14,) * 7,
    "lite6": (3.14,) * 6,
    "sawyer": (1.74, 1.33, 1.96, 1.96, 3.49, 3.49, 4.55),
    "rizon4": (2.09, 2.09, 2.44, 2.44, 4.89, 4.89, 4.89),
    "piper": (3.14, 3.4, 3.14, 3.93, 3.93, 3.93),
    "z1": (3.14,) * 6,
    "tiago": (0.07, 2.7, 3.66, 4.58, 4.58, 1.95, 1.76, 1.76),
    "j2s7s300": (0.628, 0.628, 0.628, 0.628, 0.838, 0.838, 0.838),
}
"""Velocity limits of well-known arms by a word of their name, [rad/s] or [m/s]: data sheets of Franka Robotics (Panda,
FR3), Universal Robots (e-Series), KUKA (LBR iiwa 14 R820), Kinova (Gen3), UFACTORY (xArm 7, Lite 6), Rethink Robotics
(Sawyer), Flexiv (Rizon 4) and AgileX (PiPER); URDF files of Unitree (Z1), PAL Robotics (TIAGo) and Kinova (Jaco)."""
# Torque limits of well-known arms that MuJoCo models often lack, [N m]: data sheet of KUKA (LBR iiwa 14 R820)
KNOWN_TORQUES: dict[str, tuple[float, ...]] = {"iiwa14": (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0)}


class Tool(NamedTuple):
    """Frame of the tool."""

    body: int  # Body that carries it
    position: Float  # Place in the frame of the body, shape (3,), [m]
    quaternion: Float  # Orientation in this frame, shape (4,)
    name: str  # Name of the site or the body, for the report


def choose_tool(model: mujoco.MjModel, given: Any, base: str | None, notes: list[str]) -> Tool:
    """Return the tool: the given site, body, or body and point; else one with a usual name; else the tip of the arm.

    Raises:
        ValueError: There is no such part, or there are several arms and neither `tool` nor `base` tells which.
    """
    sites, bodies = list[Tool](), list[Tool]()
    for index in range(model.nsite):
        frame = model.site_pos[index].copy(), model.site_quat[index].copy()
        sites.append(Tool(int(model.site_bodyid[index]), *frame, model.site(index).name))
    for index in range(1, model.nbody):
        bodies.append(Tool(index, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), model.body(index).name))
    root = 0 if base is None else _named(base, bodies).body
    if isinstance(given, str):
        tool = _named(given, (*sites, *bodies))
    elif given is not None:
        try:
            name, point = given
        except (TypeError, ValueError):
            raise ValueError(f"tool must be a site, a body, or (body, point), got {given!r:.60}") from None
        tool = _named(name, bodies)
        tool = tool._replace(position=finite_array("tool", point, (3,)), name=f"a point of {name!r}")
    else:
        tool = _usual_tool(model, sites, bodies, root, notes) or _tip(model, sites, bodies, root)
    if root not in (tool.body, *ancestors(model, tool.body)):
        raise ValueError(f"the tool {tool.name!r} is not carried by the base {base!r}; name one of both")
    return tool


def _named(name: Any, parts: Sequence[Tool]) -> Tool:
    """Return the part of a name."""
    for part in parts:
        if part.name == name:
            return part
    named = ", ".join(part.name for part in parts if part.name) or "none"
    raise ValueError(f"there is no site or body {name!r} in the file; there are: {named}")


def _usual_tool(
    model: mujoco.MjModel, sites: list[Tool], bodies: list[Tool], root: int, notes: list[str]
) -> Tool | None:
    """Return the site or body with the most telling of the usual names on a chain from a body, None for none.

    Raises:
        ValueError: There are several arms with such names, or equally telling ones side by side on one wrist.
    """
    chains = {}
    for body in range(model.nbody):
        chain = set(chain_joints(model, body, root))
        if root in (body, *ancestors(model, body)) and len(chain) >= LEAST_CHAIN:
            chains[body] = chain
    matches: list[list[Tool]] = []
    for pattern, parts in itertools.product(TOOL_NAMES, (sites, bodies)):
        found = []
        for part in parts:
            # The name of the robot may be its prefix.
            fits = re.fullmatch(rf"(.*[_/:])?{pattern}", part.name, re.IGNORECASE)
            if fits and part.body in chains:
                found.append(part)
        if found:
            matches.append(found)
    if not matches:
        return None
    # Of several on one chain, the first one on the last body counts.
    last = max(reversed(matches[0]), key=lambda part: len(chains[part.body])).body
    tool = next(part for part in matches[0] if part.body == last)
    rivals = [part.name for part in matches[0] if not chains[part.body] <= chains[last]]
    for others in matches[1:]:  # less telling names matter on other arms alone
        rivals += [part.name for part in others if chains[part.body].isdisjoint(chains[last])]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    apart = []
    for part in matches[0]:
        way = data.xpos[part.body] - data.xpos[tool.body] + data.xmat[part.body].reshape(3, 3) @ part.position
        way -= data.xmat[tool.body].reshape(3, 3) @ tool.position
        if chains[part.body] == chains[last] and np.linalg.norm(way) > SAME_PLACE:
            apart.append(part)
    # One that carries the other is a flange, as in one of the 61 files of benchmarks/arms.py, a TIAGo. None of them has
    # tools side by side.
    inner = [part.name for part in apart if part.body in ancestors(model, tool.body)]
    rivals += [part.name for part in apart if part.name not in inner]
    if rivals:
        listed = ", ".join(dict.fromkeys([tool.name, *rivals]))
        raise ValueError(f"there are several tools: {listed}; name one with tool=")
    if inner:
        notes.append(
            f"{WARNING}the tool is {tool.name!r}, but could be {', '.join(inner)}; name it with tool="
        )
    return tool


def _own_joints(model: mujoco.MjModel, body: int) -> list[str]:
    """Return the names of the hinges and slides of a body."""
    first = int(model.body_jntadr[body])
    joints = range(first, first + int(model.body_jntnum[body]))
    return [model.joint(joint).name for joint in joints if model.jnt_type[joint] in MOVES]


def chain_joints(model: mujoco.MjModel, body: int, root: int) -> list[str]:
    """Return the names of the hinges and slides that carry a body, from the root, whose own count, too, to it."""
    names: list[str] = []
    for each in (body, *ancestors(model, body)):
        names = _own_joints(model, each) + names
        if each == root:
            break
    return names


def arm_joints(model: mujoco.MjModel, chain: list[str], notes: list[str]) -> list[str]:
    """Return the joints of a chain without those of a mobile base, and without those of fingers.

    A body with a slide that has no end is a mobile base, unless a hinge carries it. Fingers are what hangs on a body
    from which several short branches move, unless one of them is longer than the others.
    """
    carriers = {name: int(model.joint(name).bodyid[0]) for name in chain}
    endless = (model.jnt_type == MOVES[1]) & (model.jnt_limited == 0)
    mobile = set()
    for name in chain:
        if endless[model.jnt_bodyid == carriers[name]].any():
            mobile.add(name)
        elif model.joint(name).type[0] == MOVES[0]:
            break
    fingers = set()
    for name in chain:
        way = [carriers[name], *ancestors(model, carriers[name])]
        for body in way[1:-1]:
            moving, arms = _branches(model, body)
            if len(moving) > 1 and not arms and _rest_of_arm(model, moving) not in way:
                fingers.add(name)
    for some, what in ((mobile, "a mobile base"), (fingers, "fingers")):
        if some:
            notes.append(f"fixed: {', '.join(sorted(some))}, taken for {what}")
    return [name for name in chain if name not in mobile | fingers]


def _children(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the bodies that hang on a body."""
    return [each for each in range(1, model.nbody) if model.body_parentid[each] == body]


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the bodies that carry a body, the nearest first."""
    found = []
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found


def _tip(model: mujoco.MjModel, sites: list[Tool], bodies: list[Tool], root: int) -> Tool:
    """Return the tip of the last link of the longest chain of joints, before it branches into fingers.

    It is the only site on the link, or else the only frame without geoms, its flange. Elsewhere it is on an axis of the
    link's frame, as far away as geoms of the link reach: on the axis, and to the side, where their bounding box has its
    centre farthest off. Where this box is centred, it is the frame itself.

    Raises:
        ValueError: There are several arms, or no chain.
    """
    body = root
    while True:
        moving, arms = _branches(model, body)
        lengths = [_joints_below(model, each) for each in arms]
        if len(arms) > 1 and max(lengths) - min(lengths) < LEAST_CHAIN:
            names = ", ".join(model.body(each).name or str(each) for each in arms)
            raise ValueError(f"the chain branches into {names}; name one with base=, or a tool with tool=")
        if arms:
            body = arms[int(np.argmax(lengths))]
        elif (rest := _rest_of_arm(model, moving)) is not None:
            body = rest
        else:  # nothing more that moves, or fingers
            break
    if len(chain_joints(model, body, root)) < 2:
        raise ValueError("no chain of two or more hinges and slides leads to a tool; name one with tool=")
    own = [site for site in sites if model.body_weldid[site.body] == model.body_weldid[body]]
    if len(own) == 1:
        return own[0]._replace(name=f"the site {own[0].name!r} of {bodies[body - 1].name!r}")
    flange = body
    while True:
        still = [each for each in _children(model, flange) if not _joints_below(model, each)]
        frames = [each for each in still if not model.body_geomnum[each]]
        if len(frames) != 1:
            break
        flange = frames[0]
    tip = bodies[flange - 1]
    low, high = _bounds(model, body)
    middle = np.round(low + high, 6)
    axis = int(np.abs(middle).argmax())
    if flange != body or abs(middle[axis]) <= SAME_PLACE:
        return tip._replace(name=f"the frame of {tip.name!r}")
    sign, end = ("", high) if middle[axis] > 0.0 else ("-", low)
    away = f"{abs(end[axis]):.3g} m along {sign}{'xyz'[axis]} of its frame"
    tip.position[axis] = end[axis]
    return tip._replace(name=f"the tip of {tip.name!r}, {away}")


def _bounds(model: mujoco.MjModel, body: int) -> tuple[Float, Float]:
    """Return lowest and highest coordinates of a body's origin and the geoms of its link, in its frame, [m]."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    axes = data.xmat[body].reshape(3, 3)
    link = np.flatnonzero(model.body_weldid == model.body_weldid[body]).tolist()
    bounds = [np.zeros((1, 3))]
    for geom in itertools.chain(*collision_geoms(model, dict.fromkeys(link, 1)).values()):
        corners, radius, _ = hull_of(model, geom)
        places = data.geom_xpos[geom] + corners @ data.geom_xmat[geom].reshape(3, 3).T
        places = (places - data.xpos[body]) @ axes
        bounds += [places - radius, places + radius]
    everything = np.concatenate(bounds)
    return everything.min(axis=0), everything.max(axis=0)


def collision_geoms(model: mujoco.MjModel, links: dict[int, int]) -> dict[int, list[int]]:
    """Return the geoms of each body: those that collide, or all of a link of which none does; grounds are left out."""
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    solid = ~np.isin(model.geom_type, GROUNDS)
    link = np.array([links.get(int(body), -1) for body in model.geom_bodyid])
    found = {}
    for body in sorted(links, key=lambda body: links[body]):
        used = solid & (link == links[body])
        if (used & collides).any():
            used &= collides
        geoms = np.flatnonzero(used & (model.geom_bodyid == body)).tolist()
        if geoms:
            found[body] = geoms
    return found


def _branches(model: mujoco.MjModel, body: int) -> tuple[list[int], list[int]]:
    """Return the bodies that hang on a body and move, and those of them that begin an arm, and not a finger."""
    moving = [each for each in _children(model, body) if _joints_below(model, each)]
    arms = []
    for each in moving:
        if _joints_below(model, each) >= LEAST_CHAIN and not _is_gripper(model, each):
            arms.append(each)
    return moving, arms


def _rest_of_arm(model: mujoco.MjModel, moving: list[int]) -> int | None:
    """Return the one of some moving bodies that goes on with the arm: the longest, and no gripper; None for fingers."""
    lengths = [_joints_below(model, each) for each in moving]
    if not moving or lengths.count(max(lengths)) > 1:
        return None
    longest = moving[int(np.argmax(lengths))]
    return None if _is_gripper(model, longest) else longest


def _is_gripper(model: mujoco.MjModel, body: int) -> bool:
    """Return True if a joint of a body is named after a part of a gripper; or the body, where nothing moves on it."""
    names = _own_joints(model, body)
    if names and _joints_below(model, body) == len(names):
        names.append(model.body(body).name)
    return any(GRIPPERS.search(name) for name in names)


def _joints_below(model: mujoco.MjModel, body: int) -> int:
    """Return the greatest number of hinges and slides on a way from a body to a leaf, its own included."""
    deepest = max((_joints_below(model, each) for each in _children(model, body)), default=0)
    return len(_own_joints(model, body)) + deepest


def known_limits(table: dict[str, tuple[float, ...]], name: str, number: int) -> Float | None:
    """Return the limits of a well-known arm by whole words of its name, shape (J,); None for others."""
    for known, limits in table.items():
        # Between letters and digits there may be something else, as in `iiwa_14`.
        word = r"[\W_]*".join(re.findall(r"[a-z]+|[0-9]+", known))
        # A version may follow, as in `fr3v2`, `rizon4s` and `panda1`.
        version = r"([a-z]\d*)?" if known[-1].isdigit() else r"\d*"
        whole = re.search(rf"(?<![a-z0-9]){word}{version}(?![a-z0-9])", name.lower())
        if whole and len(limits) == number:
            return np.array(limits)
    return None
