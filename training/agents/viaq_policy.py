"""Policy of viaq: candidate plans, a critic that ranks them, and exact geometric checks of the best ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import is_vectorized_observation
from torch import Tensor

from viapoint.envs.actions.via_points import frame
from viapoint.envs.arms import ARMS
from viapoint.envs.geometry.rows import has_shapes
from viapoint.envs.mdp.observation import is_replanning
from viapoint.envs.mdp.task import Task
from viapoint.envs.sim.outcome import SETTLING
from viapoint.training.agents.obstacle_parts import Poses, cut_obstacles, whole_obstacles
from viapoint.training.agents.viaq_critic import PlanInputs, SceneInputs, ViaQCritic
from viapoint.training.config.checks import check_arguments
from viapoint.training.planning.candidates import candidate_actions, normal_steps
from viapoint.training.planning.search import best_actions, score_plans
from viapoint.training.planning.plan_checks import (
    CLEARANCE_MARGIN,
    INFEASIBLE,
    REACH_MARGIN,
    reward_bounds,
)
from viapoint.training.planning.planned_movements import (
    Observation,
    direction,
    plan_movements,
    take_rows,
)

Numbers = NDArray[np.floating[Any]]

KEEP = 0.1
"""Minimum gain of Q for which a running plan is revised."""
N_ELITES = 8
"""Number of candidates around which each round of refinement samples."""
SPREAD = 0.15
"""Standard deviation of the first round of refinement, in the action space; each round halves it."""
PROPOSALS = 32
"""Greatest number of proposals that are checked; all further checks are of plans around the best of them."""
LOCAL_ROUNDS = 4
"""Rounds of checks around the best checked plans."""
CHECKED_INSTANTS = 16
"""Number of instants, for each via-point, at which plans are evaluated if the best of them are checked exactly."""
SHORTEST_AXIS = 1e-9
"""Length below which the axis of a capsule is that of a sphere, [m]."""
POSITIONS = 1 << 16
"""Planned positions that are computed together, so that temporary arrays stay in the cache."""


class ViaQPolicy(BasePolicy):
    """Policy that ranks candidates with a critic and can check the best ones with exact geometry.

    Args:
        observation_space: Observation space of the environment.
        action_space: Action space of the environment.
        lr_schedule: Learning rate as a function of the remaining progress.
        task: Task of the environment as plain values, see :meth:`viapoint.envs.mdp.task.Task.as_dict`.
        width: Width of the hidden layers of the pair networks. The default is 32 if every link must clear obstacles,
            and 16 if only the hand must.
        instants: Instants of a plan at which the pair networks are evaluated. The default is 16 if every link must
            clear obstacles, and 32 if only the hand must.
        candidates: Number of Sobol points in the action space.
        refinements: Rounds of candidates around the best ones. If plans are checked, one round may have the candidates
            of all, see :meth:`propose`.
        per_refinement: Candidates of each round.
        checks: Greatest number of plans that exact geometry checks, the best candidates first; 0 for none.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Any,
        *,
        task: Mapping[str, Any],
        width: int | None = None,
        instants: int | None = None,
        candidates: int = 256,
        refinements: int = 2,
        per_refinement: int = 64,
        checks: int = 0,
        optimizer_class: type[torch.optim.Optimizer] = torch.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        check_arguments(
            ViaQPolicy,
            {
                "width": width,
                "instants": instants,
                "candidates": candidates,
                "refinements": refinements,
                "per_refinement": per_refinement,
                "checks": checks,
            },
        )
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )
        self.task = Task.from_dict(task, ARMS)
        self.replanning = is_replanning(observation_space.spaces)
        self.candidates, self.refinements, self.per_refinement = candidates, refinements, per_refinement
        self.checks = checks
        self.instants = instants or (16 if self.task.whole_arm else 32)
        self.shares = instants_of(self.instants)
        self.width = width or (32 if self.task.whole_arm else 16)
        self.critic = self.make_critic()
        self.critic_target = self.make_critic() if self.replanning else None
        if self.critic_target is not None:
            self.critic_target.load_state_dict(self.critic.state_dict())
            self.critic_target.requires_grad_(False)
        self.optimizer = self.optimizer_class(
            self.critic.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def make_critic(self) -> ViaQCritic:
        """Return a new critic for the task."""
        return ViaQCritic(self.task, replanning=self.replanning, width=self.width)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "width": self.width,
            "task": self.task.as_dict(),
            "lr_schedule": self._dummy_schedule,
            "instants": self.instants,
            "candidates": self.candidates,
            "refinements": self.refinements,
            "per_refinement": self.per_refinement,
            "checks": self.checks,
        }

    def scene(self, observation: Observation) -> SceneInputs:
        """Return the inputs of the critic that depend on B scenes only."""
        ends = seen_ends(observation)
        if "obstacles" in observation:
            whole: Any = self.task.observation.scene_rows(observation["obstacles"])
            velocity = observation.get("obstacle_velocities")
            moving = None if velocity is None else velocity.reshape(*whole.shape[:2], -1)
            if has_shapes(whole):
                parts = whole_obstacles(whole, self.task.scenes.shapes, moving)
            else:
                parts = cut_obstacles(whole, whole[..., -1] > 0.0, moving)
        else:
            none = np.zeros((len(ends), 1, 2 * self.task.arm.dimension + 1))
            parts = cut_obstacles(none, np.zeros((len(ends), 1), dtype=bool))
        return SceneInputs(_tensor(ends), parts)

    def inputs(
        self,
        observation: Observation,
        actions: Numbers,
        scene: SceneInputs | None = None,
        shares: Numbers | None = None,
        *,
        coarse: bool = False,
    ) -> PlanInputs:
        """Return the critic's inputs for H actions in each of B scenes.

        Args:
            observation: Parts of B observations, shape (B, .) each.
            actions: Shape (B, H, m).
            scene: Inputs that belong to the scenes; computed if not given.
            shares: Fractions of the duration at which the pair networks are evaluated; those of training if not given.
            coarse: See :func:`plan_movements`.
        """
        shares = self.shares if shares is None else shares
        moves = plan_movements(observation, actions, self.task, shares, coarse=coarse)
        relative = moves.duration / self.task.action.centre_duration
        spare = np.zeros_like(relative)
        if self.replanning:
            spare = np.clip(observation["time_left"] - moves.duration - SETTLING, -0.2, 0.2)
        effort = np.stack((moves.effort, relative - 1.0, np.log(relative), spare), axis=-1)
        reach = np.asarray(self.task.arm.reach_margin(moves.path)).min(axis=-1)
        poses = planned_poses(self.task, moves.path, moves.duration[..., None] * shares)
        scene = scene or self.scene(observation)
        return PlanInputs(scene, _tensor(actions), _tensor(effort), _tensor(reach), poses)

    @torch.inference_mode()
    def values(
        self,
        observation: Observation,
        actions: Numbers,
        scene: SceneInputs | None = None,
        *,
        near: float | None = None,
        coarse: bool = False,
    ) -> Numbers:
        """Return the ranking criterion of H actions in each of B scenes, shape (B, H); see :meth:`ViaQCritic.merit`.

        In replanning tasks a first action of zero, which keeps the plan, gets a bonus of KEEP.

        Args:
            observation: Parts of B observations, shape (B, .) each.
            actions: Shape (B, H, m).
            scene: Inputs that belong to the scenes; computed if not given.
            near: See :meth:`ViaQCritic.forward`.
            coarse: Evaluate the pair networks at no more than CHECKED_INSTANTS instants a via-point.
        """
        fewer = max(self.instants // (CHECKED_INSTANTS * max(self.task.action.n_via, 1)), 1)
        shares = self.shares[::fewer] if coarse else self.shares
        inputs = self.inputs(observation, actions, scene, shares, coarse=coarse)
        values: Numbers = self.critic.merit(self.critic(inputs, near=near)).numpy()
        if self.replanning:
            values[:, 0] += np.where((actions[:, 0] == 0.0).all(axis=-1), KEEP, 0.0)
        return values

    def propose(self, observation: Observation) -> tuple[Numbers, Numbers]:
        """Return candidates, shape (B, N, m), and their ranking criterion, shape (B, N); the first is zero.

        Checks make up for a second round of refinement where this was measured: in single movements with one via-point
        of which only the hand must clear obstacles.
        """
        block = max(POSITIONS // (self.candidates * self.instants), 1)
        number = len(observation["hand"])
        if number > block:
            pieces = [
                self.propose(take_rows(observation, slice(i, i + block))) for i in range(0, number, block)
            ]
            actions, values = (np.concatenate(each) for each in zip(*pieces, strict=True))
            return actions, values
        spread = candidate_actions(self.task, self.candidates, replanning=self.replanning)
        actions, scene = np.broadcast_to(spread, (number, *spread.shape)), self.scene(observation)
        coarse, rounds, size = self.checks > 0, self.refinements, self.per_refinement
        if coarse and rounds and self.task.action.n_via <= 1 and not (self.task.whole_arm or self.replanning):
            rounds, size = 1, rounds * size
        geometry = self.critic.pairs.geometry
        near = geometry.near_coarse if coarse else geometry.near
        values = self.values(observation, actions, scene, near=near, coarse=coarse)
        for each in range(rounds):
            some = self._near(actions, values, each, size)
            actions = np.concatenate((actions, some), axis=1)
            others = self.values(observation, some, scene, near=near, coarse=coarse)
            values = np.concatenate((values, others), axis=1)
        return actions, values

    def _near(self, actions: Numbers, values: Numbers, each: int, size: int) -> Numbers:
        """Return `size` candidates around the best ones, shape (B, size, m)."""
        best = min(N_ELITES, actions.shape[1])
        top = np.argpartition(-values, best - 1, axis=1)[:, :best]
        return self._around(np.take_along_axis(actions, top[..., None], axis=1), each, size)

    def _around(self, centres: Numbers, each: int, size: int) -> Numbers:
        """Return `size` candidates of a round around some of shape (B, ., m), shape (B, size, m)."""
        steps = normal_steps(size, self.task.action.size, each) * (SPREAD * 0.5**each)
        around = centres[:, np.arange(size) % centres.shape[1]]
        return np.clip(around + steps, -1.0, 1.0).astype(np.float32)

    def decide(self, observation: Observation) -> Numbers:
        """Return the chosen actions, shape (B, m)."""
        actions, values = self.propose(observation)
        every = np.arange(len(actions))
        if not self.checks:
            return np.asarray(actions[every, values.argmax(axis=1)])
        count = min(self.checks, values.shape[1])
        local = max(count - PROPOSALS, 0)
        checked = np.take_along_axis(actions, self._promising(values, count - local)[..., None], axis=1)
        worth = self._score(observation, checked)
        best: Numbers = checked[every, worth.argmax(axis=1)]
        unsolved = np.flatnonzero(worth.max(axis=1) < 0.5 * INFEASIBLE)
        some = every if self.replanning else unsolved
        if local and len(some):
            best[some] = self._improved(take_rows(observation, some), checked[some], worth[some], local)
        return np.asarray(best)

    def _improved(self, observation: Observation, checked: Numbers, worth: Numbers, count: int) -> Numbers:
        """Return the best of checked actions and of `count` further ones around the best of them, shape (B, m).

        Around plans that are clear, those with the greatest reward without obstacles are checked, and around others an
        even selection.
        """
        for each in range(LOCAL_ROUNDS):
            share = (count + each) // LOCAL_ROUNDS
            if share:
                near = self._around(best_actions(checked, worth)[0], each, self.per_refinement)
                _, bound = reward_bounds(observation, near, self.task, REACH_MARGIN)
                clear = worth.max(axis=1, keepdims=True) > 0.5 * INFEASIBLE
                top = np.argsort(np.where(clear, -bound, 0.0), axis=1, kind="stable")[:, :share]
                near = np.take_along_axis(near, top[..., None], axis=1)
                checked = np.concatenate((checked, near), axis=1)
                worth = np.concatenate((worth, self._score(observation, near)), axis=1)
        return np.asarray(checked[np.arange(len(checked)), worth.argmax(axis=1)])

    def _score(self, observation: Observation, actions: Numbers) -> Numbers:
        """Return the merit of actions by computed geometry, shape (B, H)."""
        return score_plans(observation, actions, self.task, (CLEARANCE_MARGIN, REACH_MARGIN))

    def _promising(self, values: Numbers, count: int) -> NDArray[np.intp]:
        """Return indices of candidates to check, shape (B, count), for ranking criteria of shape (B, N).

        Refined candidates resemble each other, so at least half of the checks go to the best Sobol points.
        """
        if self.replanning:  # the action that keeps the plan is always checked
            values = np.concatenate((np.full_like(values[:, :1], np.inf), values[:, 1:]), axis=1)
        refined = min(count // 2, values.shape[1] - self.candidates)
        spread = min(count - refined, self.candidates)
        first = np.argsort(-values[:, : self.candidates], axis=1)[:, :spread]
        last = np.argsort(-values[:, self.candidates :], axis=1)[:, :refined]
        return np.concatenate((first, last + self.candidates), axis=1)

    def forward(self, observation: Any, deterministic: bool = True) -> Tensor:
        """Return the chosen actions, shape (B, m)."""
        return self._predict(observation, deterministic)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        arrays = {name: each.cpu().numpy() for name, each in observation.items()}
        return torch.from_numpy(np.ascontiguousarray(self.decide(arrays), dtype=np.float32))

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """Return actions for one observation or a batch, and no state, as policies of Stable-Baselines3 do.

        Raises:
            ValueError: The observation is not a dict with the parts of the observation space, is not finite, or the
                hand is at the goal already.
        """
        if isinstance(observation, tuple):
            return super().predict(cast(Any, observation), state, *args, **kwargs)  # it explains the mistake
        self._check_parts(observation)
        parts: Any = self.observation_space
        several = is_vectorized_observation(observation, parts)
        batch = {name: np.reshape(observation[name], (-1, *box.shape)) for name, box in parts.spaces.items()}
        actions = np.clip(np.asarray(self.decide(batch), np.float32), -1.0, 1.0)
        return (actions if several else actions[0]), state

    def _check_parts(self, observation: Any) -> None:
        space: Any = self.observation_space
        wanted = ", ".join(space.spaces)
        if not isinstance(observation, dict):
            raise ValueError(f"observation must be a dict of {wanted}; got {type(observation).__name__}")
        if observation.keys() != space.spaces.keys():
            raise ValueError(
                f"observation must have the parts {wanted}; got {', '.join(map(str, observation))}"
            )
        for name, each in observation.items():
            if not np.isfinite(np.asarray(each)).all():
                raise ValueError(f"observation must be finite; {name} is {np.asarray(each)}")
        apart = np.asarray(observation["goal"]) != np.asarray(observation["hand"])
        if not self.replanning and not apart.any(axis=-1).all():
            raise ValueError("hand and goal must differ: no movement leads from a point to itself")


def planned_poses(task: Task, path: Numbers, time: Numbers) -> Poses:
    """Return the planned poses of the arm for paths of the hand, shape (B, H, T, D), [m]."""
    if not task.whole_arm:
        return Poses(_tensor(np.moveaxis(path, -1, 0)[None]), None, _tensor(time))
    links = np.asarray(task.arm.links(task.arm.inverse_kinematics(path)))
    first, last = (np.moveaxis(links[..., end, :], (-2, -1), (0, 1)) for end in (0, 1))
    axis = last - first
    length = np.sqrt((axis * axis).sum(axis=1, keepdims=True))
    axis = axis / np.maximum(length, SHORTEST_AXIS)  # zero for spheres
    sizes = _tensor(0.5 * length[:, 0, 0, 0, 0]), _tensor(task.arm.link_radii)
    return Poses(_tensor(0.5 * (first + last)), _tensor(axis), _tensor(time), *sizes)


def seen_ends(observation: Observation) -> Numbers:
    """Return start, goal, distance and, in replanning tasks, the present motion, scaled to order one, shape (B, E).

    Velocity and acceleration of the hand are in the frame of the line from hand to goal.
    """
    line = direction(observation)
    distance = np.sqrt((line * line).sum(axis=-1, keepdims=True))
    ends = [2.0 * observation["hand"], 2.0 * observation["goal"], 2.0 * distance]
    if is_replanning(observation):
        axes = np.stack(frame(line), axis=-1)
        for name, scale in (("velocity", 1.0), ("acceleration", 0.1)):
            ends.append((observation[name][:, None] @ axes)[:, 0] * scale)
        ends += [observation["remaining"], observation["time_left"]]
    return np.concatenate(ends, axis=-1)


def instants_of(number: int) -> NDArray[np.float32]:
    """Return fractions of the duration of a movement, shape (number,), denser where the hand is fast."""
    share = np.linspace(0.0, 1.0, 2001)
    gone = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return np.interp((np.arange(number) + 0.5) / number, 0.7 * gone + 0.3 * share, share).astype(np.float32)


def _tensor(values: Any) -> Tensor:
    """Return a single-precision tensor; read-only arrays are copied."""
    return torch.from_numpy(np.require(values, dtype=np.float32, requirements=["C", "W"]))
