"""Time scaling of movements to limits of velocity, acceleration and jerk."""

from __future__ import annotations

from .array_api import Array, broadcast_batch, require
from .trajectory import Trajectory, require_trajectory


def minimum_duration(
    trajectory: Trajectory,
    *,
    velocity: Array | None = None,
    acceleration: Array | None = None,
    jerk: Array | None = None,
) -> Array:
    """Return the shortest duration to which the movement can be scaled within the limits.

    Scaling time by a factor s divides the nu-th derivative by s^nu and keeps the path, so
    s = max_nu (peak_nu / limit_nu)^(1 / nu), with the exact extrema of the trajectory.
    `trajectory.stretched(minimum_duration(trajectory, ...))` is the performance-limited movement. Boundary
    velocities and accelerations scale as well.

    Args:
        trajectory: the movement, of any duration.
        velocity: limit [m/s]: a number or an array (..., 1) limits the Euclidean norm, an array (..., D) each
            axis.
        acceleration: limit [m/s^2], likewise.
        jerk: limit [m/s^3], likewise.

    Returns:
        (...,) [s]; 0 where nothing moves.

    Raises:
        ValueError: no limit is given, or a limit is not finite, not positive, or of a wrong shape.

    Example:
        >>> from viapoint.primitives import minimum_duration, point_to_point
        >>> reach = point_to_point([0.0], [0.4], 1.0)
        >>> fastest = reach.stretched(minimum_duration(reach, velocity=1.5))
        >>> round(float(fastest.duration), 9), round(float(fastest.peak(1)), 9)
        (0.5, 1.5)
    """
    require_trajectory(trajectory)
    named = {"velocity": velocity, "acceleration": acceleration, "jerk": jerk}
    if all(limit is None for limit in named.values()):
        raise ValueError("give at least one limit: velocity, acceleration or jerk")
    xp, limits = trajectory.namespace, trajectory.floats(named, widest=True)
    factor = 0.0 * trajectory.duration
    for nu, (name, limit) in enumerate(zip(named, limits, strict=True), start=1):
        if limit is None:
            continue
        require(limit > 0, name, limit, "must be positive")
        if limit.ndim and limit.shape[-1] not in (1, trajectory.dimension):
            allowed = f"a number, (..., 1) or (..., {trajectory.dimension})"
            raise ValueError(f"{name} must be {allowed}, got shape {tuple(limit.shape)}")
        broadcast_batch(trajectory=trajectory.batch_shape, **{name: tuple(limit.shape[:-1])})
        excess = _excess(trajectory, nu, limit)
        # The slope of a root is infinite at 0, and torch would multiply it by 0: take the root of positive ratios only.
        moves = excess > 0
        root = xp.where(moves, excess, 1.0) ** (1.0 / nu)
        factor = xp.maximum(factor, xp.where(moves, root, 0.0))
    return factor * trajectory.duration


def _excess(trajectory: Trajectory, nu: int, limit: Array) -> Array:
    """Return (...,) the greatest ratio of the nu-th derivative to its limit."""
    xp = trajectory.namespace
    if limit.ndim == 0:
        return trajectory.peak(nu) / limit
    if limit.shape[-1] == 1 and trajectory.dimension > 1:
        return trajectory.peak(nu) / limit[..., 0]
    extrema = trajectory.extrema(nu)
    return xp.max(xp.maximum(-extrema.minimum, extrema.maximum) / limit, axis=-1)
