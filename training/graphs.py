"""Decisions as graphs of tensors, which a compiler can translate: what stands in for what a graph cannot hold.

A graph knows shapes, not numbers: nothing in it is refused, left out or searched for depending on them. So within a
graph looking is done with tensors, passage times are asked for from outside, and movements are made by the primitives'
own formulas without their checks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import cast

import array_api_compat.torch as xp
import torch
from torch import Tensor

from viapoint import primitives
from viapoint.envs._arrays import clamp, last
from viapoint.envs.action import ActionLayout, Plan
from viapoint.primitives._banded import States
from viapoint.primitives._connecting import _coefficients
from viapoint.primitives._passage_rest import _Functions, _invariants, _root
from viapoint.primitives._sampling import evaluate

SHORTEST = 1e-5
"""Least part of a movement's duration that a segment takes, so that one of no length divides nothing by zero."""
_DRAWN: ContextVar[bool] = ContextVar("graph", default=False)


@contextmanager
def drawn() -> Iterator[None]:
    """What is computed meanwhile fits a graph."""
    before = _DRAWN.set(True)
    try:
        yield
    finally:
        _DRAWN.reset(before)


def is_drawn() -> bool:
    """Whether what is computed must fit a graph."""
    return _DRAWN.get()


def decoded(layout: ActionLayout, actions: Tensor, start: Tensor, goal: Tensor) -> Plan:
    """As :meth:`viapoint.envs.action.ActionLayout.decode` does."""
    if layout.timing == "learned":
        return layout.decode(actions, start, goal)
    even = torch.zeros((*actions.shape[:-1], layout.n_via))
    timed = dataclasses.replace(layout, timing="learned")
    waypoints, durations = timed.decode(torch.cat((actions, even), dim=-1), start, goal)
    return Plan(waypoints, passage_durations(waypoints, durations.sum(-1)))


def passage_durations(
    points: Tensor,
    duration: Tensor,
    start_velocity: Tensor | None = None,
    start_acceleration: Tensor | None = None,
) -> Tensor:
    """As :func:`viapoint.primitives.passage_durations` does, shape (..., K + 1), [s]."""
    if points.shape[-2] == 3 and start_velocity is None and start_acceleration is None:
        found = _fractions_at_rest(points.double()).to(points.dtype) * duration[..., None]
    else:
        found = _passage_durations(points, duration, start_velocity, start_acceleration)
    return torch.maximum(found, SHORTEST * duration[..., None])


def _fractions_at_rest(points: Tensor) -> Tensor:
    """Of the duration before and after one via-point, shape (..., 2)."""
    start, via, goal = (list(place.unbind(-1)) for place in points.unbind(-2))
    a, b, c, is_late, _ = _invariants(start, via, goal, _TENSORS)
    smaller = _root(a, b, c, _TENSORS)
    both = torch.stack((smaller, 1.0 - smaller), dim=-1)
    return torch.where(is_late[..., None], both.flip(-1), both)


_TENSORS = _Functions(torch.where, torch.sqrt, lambda x: x ** (1.0 / 3.0), clamp)


@torch.library.custom_op("viapoint::passage_durations", mutates_args=())
def _passage_durations(
    points: Tensor, duration: Tensor, start_velocity: Tensor | None, start_acceleration: Tensor | None
) -> Tensor:
    began = {"start_velocity": start_velocity, "start_acceleration": start_acceleration}
    numbers = {name: None if part is None else part.numpy() for name, part in began.items()}
    return torch.from_numpy(primitives.passage_durations(points.numpy(), duration.numpy(), **numbers))


@_passage_durations.register_fake
def _shape_of_durations(
    points: Tensor, duration: Tensor, start_velocity: Tensor | None, start_acceleration: Tensor | None
) -> Tensor:
    return points.new_empty((*points.shape[:-2], points.shape[-2] - 1))


def through(
    points: Tensor,
    durations: Tensor,
    start_velocity: Tensor | None = None,
    start_acceleration: Tensor | None = None,
) -> primitives.Trajectory:
    """As :func:`viapoint.primitives.through` does, for points apart."""
    vias: States = [[primitives.FREE, primitives.FREE] for _ in range(points.shape[-2] - 2)]
    states: States = [[start_velocity, start_acceleration], *vias, [None, None]]
    coefficients = _coefficients(xp, 3, points, durations, states)
    return primitives.Trajectory.from_segments(coefficients, durations, xp)


def places(trajectory: primitives.Trajectory, times: Tensor) -> Tensor:
    """As a trajectory gives them, for times within it; each component by itself in memory."""
    coefficients, starts, rates = trajectory.coefficients, trajectory.starts, trajectory.rates
    found: Tensor = evaluate(coefficients, starts, rates, times, (0,), None, xp)[0]
    return cast(Tensor, last(torch.stack(found.unbind(-1))))
