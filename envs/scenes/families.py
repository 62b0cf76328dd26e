"""Registry of scene families: kinds of obstacles that are built beside a feasible path."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array, whole_number
from viapoint.envs.geometry.rows import CAPSULES
from viapoint.envs.scenes.draws import FeasiblePath, Site, Uniforms, unit
from viapoint.envs.scenes.planar_families import FAMILY_ROWS, PLANAR_BUILDERS
from viapoint.envs.scenes.spatial_families import (
    SpatialSite,
    Structures,
    bin_,
    cage,
    clutter,
    cupboard,
    desk,
    gate,
    notch,
    pillar,
    shelf,
    slot,
    table,
    tunnel,
    wall_window,
    window,
)

MOST_OBSTACLES = 256
"""Greatest number of obstacles in a scene that is given."""
MOST_DRAWN = 8
"""Greatest number of obstacles in a scene that is drawn."""

SiteBuilder = Callable[[Uniforms, Site], Float]
"""Function of uniform numbers and a site that returns obstacles, see :func:`register_scene_family`."""


@dataclass(frozen=True, kw_only=True)
class SceneFamily:
    """Kind of obstacles that scenes of one name have."""

    build: Callable[..., Any]
    """Builder of planar or spatial obstacles: :data:`~viapoint.envs.scenes.planar_families.Builder` or
    :data:`~viapoint.envs.scenes.spatial_families.Builder`."""
    n_obstacles: int
    """Obstacles that a scene must have room for."""
    passes_above: bool = False
    """Flag: the feasible path passes above the straight line."""
    rigid: int = 0
    """Count of obstacles, from the first, that make room together."""
    hard: bool = False
    """Flag: the family is part of the frozen `hard` scenes."""
    shapes: tuple[str, ...] = CAPSULES
    """Shapes of the obstacles."""
    trained: bool = False
    """Flag: the family is one of those of training by default if scenes may have its shapes."""


_TRAINED_BOXES: dict[str, Any] = {"shapes": ("box",), "trained": True}
_FAMILIES: dict[int, dict[str, SceneFamily]] = {
    2: {
        name: SceneFamily(build=build, n_obstacles=FAMILY_ROWS, hard=True)
        for name, build in PLANAR_BUILDERS.items()
    },
    3: {
        "clutter": SceneFamily(build=clutter, n_obstacles=1),
        "pillar": SceneFamily(build=pillar, n_obstacles=1),
        "shelf": SceneFamily(build=shelf, n_obstacles=3, passes_above=True, rigid=3, hard=True),
        "gate": SceneFamily(build=gate, n_obstacles=3, hard=True),
        "slot": SceneFamily(build=slot, n_obstacles=4, passes_above=True, rigid=3, hard=True),
        "window": SceneFamily(build=window, n_obstacles=4, hard=True),
        "tunnel": SceneFamily(build=tunnel, n_obstacles=6, hard=True),
        "table": SceneFamily(build=table, n_obstacles=4, passes_above=True, rigid=4, **_TRAINED_BOXES),
        "bin": SceneFamily(build=bin_, n_obstacles=5, passes_above=True, **_TRAINED_BOXES),
        "notch": SceneFamily(build=notch, n_obstacles=3, **_TRAINED_BOXES),
        "cupboard": SceneFamily(build=cupboard, n_obstacles=3, passes_above=True, rigid=2, **_TRAINED_BOXES),
        "desk": SceneFamily(build=desk, n_obstacles=5, passes_above=True, rigid=5, shapes=("box",)),
        "wall_window": SceneFamily(build=wall_window, n_obstacles=4, hard=True, shapes=("box",)),
        "cage": SceneFamily(build=cage, n_obstacles=8, passes_above=True, hard=True, shapes=("box",)),
    },
}


def scene_families(dimension: int) -> Mapping[str, SceneFamily]:
    """Return the families of scenes in the plane (2) or in space (3), by name."""
    return MappingProxyType(_FAMILIES[dimension])


def register_scene_family(
    name: str, build: SiteBuilder, *, dimension: int = 2, n_obstacles: int = FAMILY_ROWS
) -> None:
    """Register a family of scenes under a name.

    Afterwards :func:`~viapoint.envs.mdp.task.family_sampler` samples its scenes and, in space,
    :class:`~viapoint.envs.scenes.config.SpaceDistribution` accepts its name. A scene is rejected and drawn again if an
    obstacle comes too close to the feasible path, or if the straight movement hits nothing. In space, obstacles that
    are too close to the arm are first moved away from the path, and further obstacles are added. A process that
    unpickles a distribution with the name must register the family, too.

    Args:
        name: Name that is not taken among families of the same dimension.
        build: Function `build(uniforms, site)` that places obstacles in N scenes at once.
            `uniforms.take(k)` returns k random numbers of each scene in [0, 1), shape (N, k): 14 numbers altogether in
            the plane, 6 in space. `site.start` and `site.goal`, shape (N, D), and `site.path`, shape (N, T, D), [m],
            are the path of the hand that must stay free; `site.room` is the radius of the part that must pass, [m];
            `site.whole_arm` tells whether every link must clear the obstacles. The function must depend on nothing
            else, and row i of the result on row i of the arguments alone.
            It returns obstacles, shape (N, n, 2 D + 1) with n of `n_obstacles` at most: centre D, half-axis vector D
            and radius of each capsule, [m]; absent obstacles are rows of zeros.
        dimension: 2 for arms in the plane, 3 for arms in space.
        n_obstacles: Greatest number of obstacles that `build` returns, at most 5 in the plane and 8 in space. Tasks
            with fewer obstacles refuse the family.

    Raises:
        TypeError: The name is not a string, or `build` is not a function of two arguments.
        ValueError: The name is taken or empty, or a number is not allowed. Sampling raises it if `build` returns an
            array of another shape, or one that is not finite.

    Example:
        >>> import gymnasium as gym, numpy as np
        >>> from viapoint.envs import family_sampler, register_scene_family
        >>> def post(uniforms, site):
        ...     '''Return a post in the middle between start and goal.'''
        ...     centre = 0.5 * (site.start + site.goal)
        ...     radius = 0.01 + 0.02 * uniforms.take(1)
        ...     return np.concatenate((centre, np.zeros_like(centre), radius), axis=-1)[:, None]
        >>> register_scene_family("post", post, n_obstacles=1)
        >>> env = gym.make("viapoint.envs:viapoint/PlanarObstacles-v0")
        >>> scenes = family_sampler(env.unwrapped.task, "post")([np.random.default_rng(seed) for seed in range(4)])
        >>> scenes.obstacles.shape
        (4, 5, 5)
        >>> observation, _ = env.reset(options=scenes.take([0]).as_options())
    """
    if not isinstance(name, str):
        raise TypeError(f"name must be a string, got {name!r}")
    if dimension not in _FAMILIES:
        raise ValueError(f"dimension must be one of {', '.join(map(str, _FAMILIES))}, got {dimension!r}")
    most = FAMILY_ROWS if dimension == 2 else MOST_DRAWN
    whole_number("n_obstacles", n_obstacles, 1, most)
    families = _FAMILIES[dimension]
    if not name or name in families:
        raise ValueError(f"name must not be empty or one of {', '.join(families)}, got {name!r}")
    try:
        inspect.signature(build).bind(None, None)
    except (TypeError, ValueError) as error:
        raise TypeError(f"build must be a function build(uniforms, site), got {build!r}: {error}") from None
    checked = _checked(name, build, n_obstacles)
    families[name] = SceneFamily(
        build=checked if dimension == 2 else _at_places(checked), n_obstacles=n_obstacles
    )


def _checked(name: str, build: SiteBuilder, n_obstacles: int) -> SiteBuilder:
    """Return a builder that raises ValueError if `build` returns no obstacles of N scenes."""

    def checked(uniforms: Uniforms, site: Site) -> Float:
        number, dimension = site.start.shape
        size = 2 * dimension + 1
        rows = finite_array(f"obstacles of the family {name!r}", build(uniforms, site))
        if rows.ndim != 3 or rows.shape[::2] != (number, size) or rows.shape[1] > n_obstacles:
            raise ValueError(
                f"obstacles of the family {name!r} must have shape ({number}, n, {size}) with n at most {n_obstacles}, "
                f"got {rows.shape}"
            )
        return rows.copy()

    return checked


def _at_places(build: SiteBuilder) -> Callable[[Uniforms, SpatialSite], Structures]:
    """Return a builder of structures that calls `build` with one row for each place of each scene."""

    def built(uniforms: Uniforms, site: SpatialSite) -> Structures:
        number, places = site.top.shape
        feasible = FeasiblePath(*(np.repeat(part, places, axis=0) for part in site.feasible))
        flat = Site(feasible=feasible, room=site.room, whole_arm=site.whole_arm)
        rows = build(uniforms.flat(), flat)
        rows = rows.reshape(number, places, -1, rows.shape[-1])
        return Structures(rows, unit(rows[..., :3] - site.place[:, :, None]))

    return built
