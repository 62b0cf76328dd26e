"""A decision as machine code: the same formulas and weights, translated once by a C++ compiler.

A decision is about two thousand small operations, and Python needs longer to ask for one than the processor to do it.
So the whole decision is drawn as a graph for one scene, and torch's compiler makes one function of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from viapoint.training import sight
from viapoint.training.machine_code import digest, machine_code
from viapoint.training.sight import Observation

if TYPE_CHECKING:
    from viapoint.training.policies import ViaPolicy


class CannotCompileError(RuntimeError):
    """Decisions of an agent cannot be translated into machine code, here or at all."""


class CompiledDecision:
    """The decision of a policy in one scene, as its weights are now.

    Args:
        policy: Whose.
        candidates: How many movements its critic ranks; 0 takes the actor's own choice.
        keep: Folder where machine code is looked for, and kept.

    Raises:
        CannotCompileError: There is no compiler, or the decision searches depending on what it finds.
        ValueError: What is kept cannot be loaded.
    """

    def __init__(self, policy: ViaPolicy, candidates: int, keep: Path | None = None) -> None:
        space: Any = policy.observation_space
        if "obstacles" in space.spaces and sight.among_links(policy.task):
            raise CannotCompileError(
                "decisions cannot be compiled where all links of an arm in space must clear: which pairs of link and "
                "obstacle are looked at depends on the scene"
            )
        if policy.device.type != "cpu":
            raise CannotCompileError(
                f"decisions are compiled for the cpu only, the agent is on {policy.device}"
            )
        decision = _Decision(policy, candidates)
        kept = None if keep is None else keep / f"{decision.digest()}.pt2"
        if kept is None or not kept.is_file():
            require_compiler()
        self._shapes = {name: box.shape for name, box in decision.boxes.items()}
        self._weights = [*policy.parameters()]
        self._versions = self._now()
        self._run = machine_code(decision, decision.example(), kept)

    def __call__(self, observation: Observation) -> NDArray[np.float32] | None:
        """The action as `predict` returns it, or None where it must be decided otherwise.

        It is made for one scene, with or without an axis of scenes, and for the weights it was made of.
        """
        shapes = {name: np.shape(part) for name, part in observation.items()}
        lead = () if shapes == self._shapes else (1,)
        fits = not lead or shapes == {name: (1, *shape) for name, shape in self._shapes.items()}
        if not fits or self._now() != self._versions:
            return None
        parts = (np.array(observation[name], dtype=np.float32).reshape(1, -1) for name in self._shapes)
        (action,) = self._run([torch.from_numpy(part) for part in parts])
        found: NDArray[np.float32] = action.numpy().reshape(*lead, -1)
        return found

    def _now(self) -> list[int]:
        """What changes whenever a weight does."""
        return [weight._version for weight in self._weights]


class _Decision(nn.Module):
    """A policy's decision as a function of the parts of an observation."""

    def __init__(self, policy: ViaPolicy, candidates: int) -> None:
        super().__init__()
        self.policy, self.candidates = policy, candidates
        space: Any = policy.observation_space
        actions: Any = policy.action_space
        self.boxes = space.spaces
        self.low, self.high = torch.as_tensor(actions.low), torch.as_tensor(actions.high)

    def forward(self, *parts: Tensor) -> Tensor:
        action = self.policy.decide(dict(zip(self.boxes, parts, strict=True)), self.candidates)
        return self.low + 0.5 * (action + 1.0) * (self.high - self.low)

    def digest(self) -> str:
        """What it depends on as one word."""
        task, settings = self.policy.task.as_dict(), self.policy.settings
        return digest(
            repr((task, settings, self.boxes, self.low, self.high, self.candidates)), self.policy.state_dict()
        )

    def example(self) -> tuple[Tensor, ...]:
        """Some observation of one scene."""
        generator = np.random.default_rng(0)
        drawn = (generator.uniform(box.low, box.high) for box in self.boxes.values())
        return tuple(torch.tensor(part[None], dtype=torch.float32) for part in drawn)


def require_compiler() -> None:
    """Refuse where torch finds no C++ compiler.

    Raises:
        CannotCompileError: There is none.
    """
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except RuntimeError as error:
        raise CannotCompileError(
            "compiled decisions need a C++ compiler, and torch found none: install g++, or name one in the environment "
            "variable CXX; decisions that are not compiled need none"
        ) from error
