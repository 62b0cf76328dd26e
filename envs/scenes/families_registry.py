"""Registry of scene families: functions that draw the layout of a scene."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from viapoint.envs.common.validation import names_of, whole_number
from viapoint.envs.geometry.shapes import IN_TABLES, KINDS, PLAIN_KINDS, Shape, as_obstacles
from viapoint.envs.scenes import families_plane, families_space
from viapoint.envs.scenes.layout import MOST_PLACES, PLACE, ROW, Layout, Place, Room, most_rows

# Function of a random generator and a room that returns a layout, see :func:`register_scene_family`
Build = Callable[[np.random.Generator, Room], Any]


@dataclass(frozen=True)
class SceneFamily:
    """Kind of scenes that have a name."""

    build: Build  # Function that draws a layout
    n_obstacles: int = 1  # Least number of obstacles that a scene must have room for
    kinds: tuple[str, ...] = ("box",)  # Kinds of obstacles that the family needs
    # True if the family is one of those of training by default; those shipped without are hard
    trained: bool = False

    def lack(self, kinds: Iterable[str], most: int) -> str:
        """Return what scenes with some kinds, and at most so many obstacles, lack for the family; empty for nothing."""
        missing = set(self.kinds) - set(kinds)
        if missing:
            return f"needs obstacles of the kinds {', '.join(sorted(missing))}"
        enough = self.n_obstacles <= max(most, 1)
        return "" if enough else f"needs n_obstacles of {self.n_obstacles} or more, got {most}"


# Families by their place, True for the plane and False for space, and their name
FAMILIES: dict[tuple[bool, str], SceneFamily] = {
    (True, "clutter"): SceneFamily(families_plane.clutter, 1, (), trained=True),
    (True, "gate"): SceneFamily(families_plane.gate, 2),
    (True, "corridor"): SceneFamily(families_plane.corridor, 4),
    (True, "ring"): SceneFamily(families_plane.ring, 5),
    (True, "oblique bar"): SceneFamily(families_plane.oblique_bar, 3),
    (True, "cul-de-sac"): SceneFamily(families_plane.cul_de_sac, 5),
    (False, "shelf"): SceneFamily(families_space.shelf, 4, trained=True),
    (False, "table"): SceneFamily(families_space.table, 2, trained=True),
    (False, "bin"): SceneFamily(families_space.bin_, 5, trained=True),
    (False, "gate"): SceneFamily(families_space.gate, 3, trained=True),
    (False, "tunnel"): SceneFamily(families_space.tunnel, 4, trained=True),
    (False, "clutter"): SceneFamily(families_space.clutter, 1, (), trained=True),
    (False, "cage"): SceneFamily(families_space.cage, 6),
    (False, "wall_window"): SceneFamily(families_space.wall_window, 4),
}


def scene_families(plane: bool) -> Mapping[str, SceneFamily]:
    """Return the families of scenes in the plane or in space, by name."""
    return {name: each for (there, name), each in FAMILIES.items() if there == plane}


def default_families(plane: bool, kinds: Iterable[str], most: int) -> tuple[str, ...]:
    """Return the families of training that scenes with some kinds, and at most so many obstacles, have room for."""
    known = scene_families(plane)
    return tuple(name for name, each in known.items() if each.trained and not each.lack(kinds, most))


def check_families(families: Sequence[str], plane: bool, kinds: Iterable[str], most: int) -> tuple[str, ...]:
    """Return names of families after a check that scenes have room for them.

    Raises:
        ValueError: A name is unknown, or a family needs other kinds or more obstacles.
    """
    known = scene_families(plane)
    if not most and tuple(families) != default_families(plane, kinds, most):
        raise ValueError(
            f"families need n_obstacles of 1 or more, or (0, 1) for one without obstacles, got {', '.join(families)}; "
            "without, ends are free configurations"
        )
    for name in families:
        if name not in known:
            others = "others need register_scene_family in this process"
            raise ValueError(f"families must be some of {', '.join(known)}, got {name!r}; {others}")
        lack = known[name].lack(kinds, most)
        if lack:
            raise ValueError(f"the family {name!r} {lack}")
    return tuple(families)


def register_scene_family(
    name: str,
    build: Build,
    *,
    plane: bool = False,
    kinds: tuple[str, ...] = (),
    n_obstacles: int = 1,
) -> None:
    """Register a family of scenes under a name, which tasks then accept in `families`.

    Scenes in which an end cannot be reached or touches something, or whose straight movement is free, are drawn again.
    A process that loads a task with the name must register the family, too.

    Args:
        name: Name that is not taken among families of the same place.
        build: Function `build(rng, room)` of a random generator and a :class:`~viapoint.envs.scenes.layout.Room`. It
            returns a list of shapes and a list of :class:`~viapoint.envs.scenes.layout.Place`, [m], where goals are,
            and starts where both are exchanged; without places, goals are free configurations. In the plane it returns
            a third list of one place, the start. Or it returns the layout of a
            :class:`~viapoint.envs.scenes.layout.Furniture`. It must depend on nothing but its arguments.
        plane: True for arms in the plane, False for arms in space.
        kinds: Kinds of obstacles that the family needs; others appear only if `room.kinds` has them.
        n_obstacles: Least number of obstacles that a task must have room for; `room.most` says how many it has room
            for.

    Raises:
        TypeError: The name is not a string, `build` is not a function of two arguments, or `plane` is not a bool.
        ValueError: The name is taken or empty, or a kind or number is not allowed.

    Example:
        >>> from viapoint.envs.geometry.shapes import Sphere
        >>> from viapoint.envs.scenes.families_registry import register_scene_family, scene_families
        >>> from viapoint.envs.scenes.layout import Place
        >>> def ball(rng, room):
        ...     '''Return a ball in front of the arm, and a goal behind it.'''
        ...     x = rng.uniform(0.4, 0.5)
        ...     return [Sphere(0.08, position=(x, 0.0, 0.4))], [Place((x + 0.15, 0.0, 0.4), half=(0.05, 0.05, 0.05))]
        >>> register_scene_family("ball", ball, kinds=("sphere",))
        >>> "ball" in scene_families(plane=False)
        True
    """
    if not isinstance(name, str):
        raise TypeError(f"name must be a string, got {name!r}")
    if not isinstance(plane, bool):
        raise TypeError(f"plane must be True or False, got {plane!r}")
    taken = scene_families(plane)
    if not name:
        raise ValueError("name must not be empty")
    if name in taken:
        raise ValueError(f"name {name!r} is taken, as are {', '.join(taken)}")
    kinds = names_of("kinds", kinds) if kinds else ()
    unknown = [kind for kind in kinds if kind not in PLAIN_KINDS]
    if unknown:
        raise ValueError(f"kinds of families must be some of {', '.join(PLAIN_KINDS)}, got {unknown}")
    whole_number("n_obstacles", n_obstacles, 1)
    try:
        inspect.signature(build).bind(None, None)
    except (TypeError, ValueError) as error:
        raise TypeError(f"build must be a function build(rng, room), got {build!r}: {error}") from None
    FAMILIES[plane, name] = SceneFamily(_checked(name, build), n_obstacles, tuple(kinds))


def _checked(name: str, build: Build) -> Build:
    """Return a function that returns the layout of a user's function, or says what is wrong with it."""

    def checked(rng: np.random.Generator, room: Room) -> Layout:
        built = build(rng, room)  # errors of the function itself are its own
        try:
            if not isinstance(built, Layout | tuple | list):
                raise TypeError(f"build must return shapes and places, or a layout, got {built!r}")
            if not isinstance(built, Layout) and any(isinstance(part, Shape) for part in built):
                raise TypeError("build must return a list of shapes and a list of places, got shapes alone")
            layout = built if isinstance(built, Layout) else _as_layout(*built)
            numbers = np.array([*layout.rows, *layout.goals, *layout.starts])
            if len(layout.rows) % ROW or (len(layout.goals) + len(layout.starts)) % PLACE:
                raise ValueError("a layout must be made by Furniture")
            if not np.isfinite(numbers).all():
                raise ValueError("obstacles and places must be finite")
            found = {KINDS[int(kind)] for kind in layout.rows[::ROW]}
            if not found <= set(room.kinds):
                allowed = ", ".join(room.kinds)
                raise ValueError(
                    f"obstacles must be of the task's shapes, {allowed}, got {', '.join(sorted(found))}"
                )
            drawn = len(layout.rows) // ROW
            count = layout.keep or drawn
            if count > room.most or drawn > most_rows(room.most):
                raise ValueError(f"there must be at most {room.most} obstacles, got {count} of {drawn}")
            if max(len(layout.goals), len(layout.starts)) > MOST_PLACES * PLACE:
                raise ValueError(f"there must be at most {MOST_PLACES} places of starts, and of goals")
        except (TypeError, ValueError) as error:
            raise ValueError(f"scene family {name!r}: {error}") from None
        return layout

    return checked


def _as_layout(shapes: Iterable[Shape], goals: Iterable[Place] = (), starts: Iterable[Place] = ()) -> Layout:
    """Return the layout of shapes and places."""
    rows: list[float] = []
    for shape in as_obstacles(list(shapes)):
        if shape.number in IN_TABLES:
            raise ValueError(f"kinds must be some of {', '.join(PLAIN_KINDS)}")
        if shape.velocity.any():
            raise ValueError("shapes must be at rest; tasks with moving_obstacles draw their courses")
        rows += [shape.number, *shape.position, *shape.rotation.ravel(), *shape.packed_size]
    return Layout(rows, _numbers(goals), _numbers(starts))


def _numbers(places: Iterable[Place]) -> list[float]:
    """Return places as numbers."""
    numbers: list[float] = []
    for place in places:
        position, approach, half, cone = Place(*place)
        numbers += [*position, *approach, *half, 1.0, 0.0, cone]
    return numbers
