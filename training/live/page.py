"""Server of the live page."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import time
import warnings
from pathlib import Path
from typing import Any, Self

import torch
import viser

from viapoint.envs import Arm
from viapoint.envs.registration import check_registered
from viapoint.training.agents.agent import Agent, load_agent
from viapoint.training.config.checks import DEFAULT_ENV, SHIPPED_IDS
from viapoint.training.config.configs import env_of_arm
from viapoint.training.live.session import Session
from viapoint.training.live.setting import Shared

LOOPBACK = "127.0.0.1"
"""Address that only this machine reaches."""
JOIN = 5.0
"""Time limit for the end of a session, [s]."""


class LivePage:
    """Page in the browser on which scenes are changed by hand and the agent decides anew.

    Args:
        agent: Agent, run folder, model folder, or id of an environment with a shipped agent. None for the agent that is
            shipped for `env` or, if there is none, the geometry search.
        env: Id of the environment; by default that of the agent.
        port: Port to listen on; 0 for a free one.
        arm: Arm of the environment: the name of one, an MJCF or URDF file, or an arm. Without `env`, it moves among
            obstacles.
        model_file: MJCF file whose visible geoms, such as meshes, are drawn; by default the one that `arm` names.
        seed: Seed of the random scenes.
        **env_kwargs: Arguments of the environment; by default those of the agent.

    Raises:
        ValueError: The agent cannot be loaded, or an argument is not allowed.
        OSError: The port is occupied.

    Example:
        >>> from viapoint.training import LivePage
        >>> with LivePage(env="viapoint/PlanarObstacles-v0", port=0) as page:
        ...     page.url.rpartition(":")[0]  # page.wait() would serve it until Ctrl-C
        'http://127.0.0.1'
    """

    def __init__(
        self,
        agent: Agent | str | Path | None = None,
        *,
        env: str | None = None,
        arm: Arm | str | Path | None = None,
        port: int = 8080,
        model_file: str | Path | None = None,
        seed: int | None = None,
        **env_kwargs: Any,
    ) -> None:
        if arm is not None:
            agent = load_agent(agent) if isinstance(agent, str | Path) else agent
            named = env if agent is None else agent.env_id
            env, argument = env_of_arm(str(arm) if isinstance(arm, Path) else arm, named)
            env_kwargs = {**(env_kwargs or ({} if agent is None else agent.env_kwargs)), **argument}
        if agent is None and (env or DEFAULT_ENV) in SHIPPED_IDS and not env_kwargs:
            agent = env or DEFAULT_ENV
        loaded = load_agent(agent) if isinstance(agent, str | Path) else agent
        if loaded is not None:
            if env not in (None, loaded.env_id):
                raise ValueError(f"the agent decides in {loaded.env_id}, not in {env}")
            env, env_kwargs = loaded.env_id, env_kwargs or loaded.env_kwargs
        env = env or DEFAULT_ENV
        check_registered(env)
        self._shared = Shared(env, loaded, model_file=model_file, seed=seed, env_kwargs=env_kwargs)
        self._sessions: dict[int, Session] = {}
        # A tab may be closed while its session still draws.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        self._server = _serve(port)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        _light(self._server.scene)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self._server.get_port()}"

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Sessions of the open tabs."""
        return tuple(self._sessions.values())

    def wait(self) -> None:
        """Wait until the page is closed or Ctrl-C is pressed."""
        while True:
            time.sleep(3600.0)

    def close(self) -> None:
        """Close all sessions and the server."""
        for session in self.sessions:
            session.close()
        for session in self.sessions:
            session.join(JOIN)
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _connect(self, client: viser.ClientHandle) -> None:
        number = client.client_id
        self._sessions[number] = Session(client, self._shared, lambda: self._sessions.pop(number, None))

    def _disconnect(self, client: viser.ClientHandle) -> None:
        session = self._sessions.get(client.client_id)
        if session is not None:
            session.close()


def run(config: Any) -> None:
    """Serve the live page until Ctrl-C; see :class:`LivePage`."""
    torch.set_num_threads(1)  # decisions are small, and the page has threads of its own
    given = {"env": config.env, "arm": config.arm, "port": config.port, "seed": config.seed}
    with LivePage(config.agent, **given) as page:
        print(f"live page: {page.url} (Ctrl-C ends it)", flush=True)
        page.wait()


def _serve(port: int) -> viser.ViserServer:
    """Start the server on exactly this port of the loopback address, which only this machine reaches."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise OSError(
                f"the page cannot listen on port {port} ({error.strerror}); --port chooses another one"
            ) from None
        port = probe.getsockname()[1]
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):  # the library prints a box with the address
        server = viser.ViserServer(host=LOOPBACK, port=port, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise OSError(f"the page cannot listen on port {port}; --port chooses another one")
    # The page never asks for a public address, and a message that does gets none: no request leaves the machine.
    server.request_share_url = lambda *_, **__: None
    return server


def _light(scene: Any) -> None:
    """Replace the default lights, in which pale colours are white."""
    scene.configure_environment_map(None)
    scene.configure_default_lights(enabled=False)
    scene.add_light_ambient("/ambient", intensity=2.5)
    scene.add_light_directional("/lamp", intensity=1.2, position=(-0.6, -0.5, 2.0))
