"""Trained agents: those of run folders and those that are shipped."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from viapoint.training.planners.baselines import Method, agent_method
from viapoint.training.runs.model_io import untrained
from viapoint.training.runs.run_dir import find_model, load_model


class Agent(NamedTuple):
    """A trained agent and the environment that it was trained on."""

    model: Any
    env_id: str
    env_kwargs: dict[str, Any]
    folder: Path

    def method(self, checks: int = 0) -> Method:
        """Return the agent as a method that checks so many of its proposals by exact geometry."""
        return agent_method(self._named("agent", checks), self.model, checks)

    def untrained(self, checks: int = 0) -> Method:
        """Return the same network before training, as a method."""
        return agent_method(self._named("untrained", checks), untrained(self.model), checks)

    def _named(self, name: str, checks: int) -> str:
        if checks and not hasattr(self.model.policy, "checks"):
            kind = type(self.model).__name__
            raise ValueError(f"proposals are checked by ViaQ only; this agent is a {kind}")
        return f"{name}, {checks} checks" if checks else name


def load_agent(run: Path | None, pretrained: str | None) -> Agent:
    """The agent of a run folder, or the one shipped for an environment.

    Raises:
        ValueError: There is none.
    """
    folder = find_model(run) if run is not None else pretrained_folder(pretrained or "")
    model = load_model(folder)
    env: Any = model.get_env()
    return Agent(model, env.env_id, env.env_kwargs, folder)


def pretrained_folder(env_id: str) -> Path:
    """Where the agent shipped for an environment lies.

    Raises:
        ValueError: There is none.
    """
    shipped = Path(str(files("viapoint.training") / "pretrained"))
    names = sorted(path.parent.name for path in shipped.glob("*/model.json"))
    name = env_id.removeprefix("viapoint/")
    if name not in names:
        known = ", ".join(f"viapoint/{each}" for each in names) or "none yet"
        raise ValueError(f"there is no pretrained agent for {env_id!r}; there are: {known}")
    return shipped / name
