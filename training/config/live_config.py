"""Configuration of the command `live`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import tyro

from viapoint.training.config.base import Config
from viapoint.training.config.checks import check_env
from viapoint.training.config.configs import AGENT, ENV, PRETRAINED, take_pretrained


@dataclass(frozen=True, kw_only=True)
class LiveConfig(Config):
    """Serve a page in the browser on which scenes are changed by hand and the agent decides anew.

    Example: viapoint live --pretrained viapoint/PandaObstacles-v0
    """

    agent: Annotated[tyro.conf.Positional[str | None], AGENT] = None
    """Run folder, model folder, or id of an environment with a shipped agent."""
    pretrained: Annotated[str | None, PRETRAINED] = None
    """Id of an environment: its shipped agent, as if the id were given as AGENT."""
    env: Annotated[str | None, ENV] = None
    """Id of the environment; where no agent is shipped for it, the geometry search decides."""
    host: str = "127.0.0.1"
    """Address to listen on; other machines reach any but 127.0.0.1."""
    port: int = 8080
    """Port to listen on; 0 for a free one."""
    seed: int | None = None
    """Seed of the random scenes."""

    least: ClassVar = {"port": 0, "seed": 0}

    def _check(self) -> None:
        take_pretrained(self)
        if self.env is not None:
            check_env(self.env)
