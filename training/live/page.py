"""Server of the live page, and its tabs."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import io
import logging
import math
import socket
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser
from PIL import Image

from viapoint.envs import Arm
from viapoint.envs.common.arrays import Float
from viapoint.training.agents.agent import Agent, load_agent
from viapoint.training.agents.model_io import check_same_task
from viapoint.training.checks import DEFAULT_ENV, SHIPPED_IDS
from viapoint.training.configs import env_of_arm, task_with
from viapoint.training.live import arena as live
from viapoint.training.live.drawing import PLANE, RESET, SPACE, ArmDrawing, Panels, View
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.search import registered_task

LOOPBACK = "127.0.0.1"  # Address that only this machine reaches
PAUSE = 0.12  # Time without other changes after which proposals are computed, [s]
TICK = 0.03  # Time between two pictures of a movement, [s]


class Tab:
    """One tab: its state, and the thread in which all that a user does changes it."""

    def __init__(self, client: viser.ClientHandle, make: Callable[[], tuple[live.Arena, ArmDrawing]]) -> None:
        self.client, self._make = client, make
        self.latencies: list[float] = []  # from changes to messages with plans, [s]
        self._loop = asyncio.new_event_loop()  # its time is in seconds
        self._jobs: dict[Any, tuple[float, Callable[[], None]]] = {}  # when they are due, and functions
        self._busy = self._closed = False
        self.act("change")
        self._thread = threading.Thread(target=self._run, name=f"viapoint-{client.client_id}", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        """True if nothing waits to be done and nothing moves."""
        return not (self._busy or self._jobs)

    def act(self, name: str, *values: Any, delay: float = 0.0, **changes: Any) -> None:
        """Call a method by its name, such as `drag`, in the thread of the tab, after a delay, [s].

        A waiting call of the same kind is replaced, so that a fast drag skips positions instead of lagging behind.
        """
        if not self._closed:
            kind = name, *(value for value in values if isinstance(value, str)), *changes
            due = self._loop.time() + delay
            self._jobs[kind] = due, functools.partial(getattr(self, name), *values, **changes)
            self._loop.call_soon_threadsafe(self._loop.call_at, due, self._do, kind, due)

    def close(self, timeout: float = 0.0) -> None:
        """End the thread after what is being done, and wait for it, [s]."""
        if not self._closed:
            self._closed = True
            self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout)

    # The thread

    def _run(self) -> None:
        self.arena, drawing = self._make()
        self._scenes = self.arena.scenes()
        self.client.gui.set_panel_label("Viapoint")
        self._panels = Panels(self.client, self.arena, self._scenes, self.act)
        self._view = View(self.client, self.arena, drawing, self.act)
        scene = next(self._scenes["Random"])
        self.state = live.State(scene=scene, drawn=scene, method=self.arena.methods[0])
        self._loop.run_forever()
        self._loop.close()
        self.arena.close()

    def _do(self, kind: Any, due: float) -> None:
        """Do a job, unless it has been replaced or cancelled; an error is told in one sentence."""
        if self._closed or self._jobs.get(kind, (None,))[0] != due:
            return
        self._busy, self._due = True, due
        _, job = self._jobs.pop(kind)
        try:
            job()
        except Exception as error:
            sentence = " ".join(str(error).split())
            if not isinstance(error, ValueError | OSError):
                traceback.print_exc()
                sentence = f"{type(error).__name__}: {sentence}"
            self.state.playing = False
            self._say(f"{sentence[:1].upper()}{sentence[1:].rstrip('.')}.", good=False)
        self._busy = False

    def _say(self, message: str, good: bool) -> None:
        self.state.message, self.state.good = message, good
        self._draw()

    def _draw(self) -> None:
        with self.client.atomic():  # one message
            self._view.draw(self.state)
            self._panels.draw(self.state)

    # Decisions

    def change(self, **changes: Any) -> None:
        """Decide anew after changes, and show the plan, the rest in a pause; without a decision nothing changes."""
        state = dataclasses.replace(self.state, movement=None, playing=False, **changes)
        state.before = state.plan
        if "scene" in changes:
            state.results = ()
        state.proposals = (live.decide(self.arena, state),)
        self.state = state
        self.pick(0, before=state.before)
        self.client.flush()
        self.latencies.append(self._loop.time() - self._due)
        self.act("propose", delay=PAUSE)

    def propose(self) -> None:
        """Show what the plan is compared with, unless something moves."""
        if self.state.playing:
            self.act("propose", delay=PAUSE)
            return
        self.state.proposals = live.propose(self.arena, self.state)
        self.pick(0)

    def pick(self, index: int, before: MotionPlan | None = None) -> None:
        """Show one of the proposals as the plan, and the plan before the last change, if there is one."""
        state = self.state
        if index < len(state.proposals):
            state.picked, state.before = index, before
            state.movement = None
            state.playing = False
            proposal = state.proposals[index]
            wanted = None if index else state.duration  # the others have durations of their own
            self._say(live.describe_plan(proposal, wanted), proposal.motion.success)

    # Scenes

    def go_to(self, kind: str) -> None:
        """Go to another scene of a kind, or undo all changes."""
        scene = self.state.drawn if kind == RESET else next(self._scenes[kind])
        self.change(scene=scene, drawn=scene, by_hand=None, duration=None, selected=None)

    def load(self, content: bytes) -> None:
        """Go to the scene of a JSON file; an impossible one is refused."""
        scene = self.arena.read(content)
        self.change(scene=scene, drawn=scene, by_hand=None, duration=None, selected=None)

    def drag(self, kind: str, number: int, place: Float) -> None:
        """Move start, goal, an obstacle or a via-point to another place, shape (3,), [m]."""
        state, scene, arena = self.state, self.state.scene, self.arena
        if kind == "start":
            start = arena.moved(scene.start, place, scene.obstacles)
            self.change(scene=scene._replace(start=start), by_hand=None)
        elif kind == "goal":
            goal = arena.moved(scene.goal, place, scene.obstacles)
            if not (state.playing and arena.task.replanning):
                self.change(scene=scene._replace(goal=goal, jumps=()), by_hand=None)
            elif arena.task.space.inside(goal):  # the running movement follows it
                state.scene = scene._replace(goal=goal, jumps=())
            else:
                raise ValueError("the goal would be out of the arm's reach")
        elif kind == "obstacle" and number < len(scene.obstacles):
            shape = dataclasses.replace(scene.obstacles[number], position=place)
            self.change(scene=scene.with_obstacle(number, shape), selected=number)
        elif kind == "via" and state.plan is not None and number < len(state.plan.durations) - 1:
            vias = state.plan.waypoints[1:-1].copy()
            vias[number] = arena.moved(vias[number], place)
            self.change(by_hand=vias)

    def turn(self, quaternion: Float) -> None:
        """Turn the selected obstacle, or the tool at the goal."""
        scene, arena, row = self.state.scene, self.arena, self.state.selected
        if row is None:
            goal = arena.moved(scene.goal, arena.tool(scene.goal), scene.obstacles, quaternion)
            self.change(scene=scene._replace(goal=goal, jumps=()), by_hand=None)
        else:
            shape = dataclasses.replace(scene.obstacles[row], quaternion=quaternion)
            self.change(scene=scene.with_obstacle(row, shape))

    def show(self, name: str, value: Any) -> None:
        """Select an obstacle, unless it has been removed meanwhile, or show the rings that turn it or the goal."""
        if name != "selected" or value < len(self.state.scene.obstacles):
            setattr(self.state, name, value)
            self._draw()

    def resize(self, name: str, value: float) -> None:
        """Change a size of the selected obstacle."""
        row, scene = self.state.selected, self.state.scene
        if row is not None:
            self.change(scene=scene.with_obstacle(row, self.arena.resized(scene.obstacles[row], name, value)))

    def add(self, kind: str) -> None:
        """Add an obstacle."""
        scene = self.state.scene
        row = len(scene.obstacles)
        if row >= live.MOST_OBSTACLES:
            raise ValueError(f"a scene has at most {live.MOST_OBSTACLES} obstacles")
        self.change(scene=scene.with_obstacle(row, self.arena.new_obstacle(scene, kind)), selected=row)

    def remove(self) -> None:
        """Remove the selected obstacle."""
        if self.state.selected is not None:
            self.change(scene=self.state.scene.without(self.state.selected), selected=None)

    # Movements

    def execute(self) -> None:
        """Begin to play the simulated movement, or stop it."""
        self.state.playing = not self.state.playing
        self._instants = self._play()
        self._draw()
        self.advance()

    def advance(self) -> None:
        """Show the present instant of a movement, and then the next one."""
        if self.state.playing:
            next(self._instants, None)
            self.act("advance", delay=TICK)

    def _play(self) -> Iterator[None]:
        """Show instants of a movement; its next part is simulated when this one has been shown."""
        state = self.state
        state.movement = None
        speed = 0.5 if self.arena.planar else 1.0  # movements in the plane are short
        for movement in live.execute(self.arena, state):
            times = movement.rollout.time
            if state.movement is None or len(times) < len(state.movement.rollout.time):  # a new episode
                state.instant, began = 0, time.monotonic()
            state.movement = movement
            while state.instant < len(times) - 1:
                now = int(np.searchsorted(times, (time.monotonic() - began) * speed))
                state.instant = min(max(now, state.instant + 1), len(times) - 1)
                self._draw()
                yield
        state.playing = False
        text = live.describe_outcome(movement.info, in_joints=not self.arena.task.space.of_hand)
        self._say(text, text.startswith("Success"))

    def compare(self) -> None:
        """Compare the methods in the present scene, until the user does something else."""
        state = self.state
        state.playing, state.results = False, ()
        for method in self.arena.methods:
            trial = live.State(scene=state.scene, drawn=state.drawn, method=method, checks=state.checks)
            movement, seconds = None, math.nan
            with contextlib.suppress(ValueError):  # the method refuses the scene
                trial.proposals = (live.decide(self.arena, trial, time_limit=1.0),)
                *_, movement = live.execute(self.arena, trial)
                seconds = trial.proposals[0].seconds
            state.results = (*state.results, (method, seconds, movement))
            self._draw()
            if self._jobs.keys() - {("advance",), ("propose",)}:
                break

    # Files

    def save(self) -> None:
        """Save the scene as JSON."""
        content = self.state.scene.to_json(self.arena.env_id).encode()
        self.client.send_file_download("scene.json", content, save_immediately=True)

    def show_code(self) -> None:
        """Show Python code that sets the scene up."""
        arguments = self.arena.arguments["any" if self.arena.limit(self.state.scene) else "own"]
        self._panels.show_code(self.state.scene.to_python(self.arena.env_id, arguments))

    def save_picture(self) -> None:
        """Save a picture of the present view, rendered by the browser, as a PNG file on white."""
        file = io.BytesIO()
        Image.fromarray(self.client.get_render(800, 1280, timeout=20.0)).save(file, "PNG")
        self.client.send_file_download("viapoint.png", file.getvalue(), save_immediately=True)


class LivePage(contextlib.AbstractContextManager["LivePage", None]):
    """Page in the browser on which scenes are changed by hand and the movement is planned anew.

    Args:
        agent: Agent, run folder, model folder, or id of a shipped agent; it decides at first. None for the agent that
            is shipped for `env`, if there is one; then the motion planner decides at first.
        env: Id of the environment; by default that of the agent.
        port: Port to listen on; 0 for a free one.
        arm: Name, file or record of the arm of the environment; without `env`, it moves among obstacles.
        model_file: File whose visible geoms, such as meshes, are drawn; by default the one that `arm` names.
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
        loaded = load_agent(agent) if isinstance(agent, str | Path) else agent
        known = None if loaded is None else loaded.env_id
        found, argument = env_of_arm(str(arm) if isinstance(arm, Path) else arm, env or known)
        env = found or DEFAULT_ENV
        if known not in (None, env):
            raise ValueError(f"the agent decides in {known}, not in {env}")
        if loaded is None and env in SHIPPED_IDS and not env_kwargs and not argument:
            loaded = load_agent(env)
        own = {} if loaded is None else loaded.env_kwargs
        arguments = {**(env_kwargs or own), **argument}
        task = task_with(env, arguments)  # says what is wrong with an argument
        if loaded is not None:
            check_same_task(registered_task(env, **own), task)
        self._made = env, loaded, seed, arguments, agent is not None
        self._model_file = model_file
        arena, _ = self._make()
        drawn = next(arena.scenes()["Random"])
        for method in arena.methods[:2]:  # a first decision takes longer than others
            live.decide(arena, live.State(scene=drawn, drawn=drawn, method=method))
        arena.close()
        self._tabs: dict[int, Tab] = {}
        # A tab may be closed while its thread still draws.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        self._server = _serve(port)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        camera = self._server.initial_camera  # also the view to which the library's button resets
        *places, camera.up, camera.fov = PLANE if arena.planar else SPACE
        camera.position, camera.look_at = arena.foot + arena.scale * np.array(places)
        scene = self._server.scene  # lights in which pale colours are not white
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_ambient("/ambient", intensity=2.5)
        scene.add_light_directional("/lamp", intensity=1.2, position=(-0.6, -0.5, 2.0))
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self._server.get_port()}"

    @property
    def tabs(self) -> tuple[Tab, ...]:
        """Open tabs."""
        return tuple(self._tabs.values())

    def wait(self) -> None:
        """Wait until the page is closed or Ctrl-C is pressed."""
        self._server.sleep_forever()

    def close(self) -> None:
        """Close all tabs and the server."""
        for tab in self.tabs:
            tab.close(timeout=5.0)
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _make(self) -> tuple[live.Arena, ArmDrawing]:
        arena = live.Arena(*self._made)
        file = self._model_file or arena.task.arm.file or None
        return arena, ArmDrawing(arena.task.arm, file)

    def _connect(self, client: viser.ClientHandle) -> None:
        self._tabs[client.client_id] = Tab(client, self._make)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        tab = self._tabs.pop(client.client_id, None)
        if tab is not None:
            tab.close()


def run(config: Any) -> None:
    """Serve the live page until Ctrl-C; see :class:`LivePage`."""
    torch.set_num_threads(1)  # decisions are small, and the page has threads of its own
    given = {"arm": config.arm, **config.env_kwargs, "env": config.env}
    with LivePage(config.agent, port=config.port, seed=config.seed, **given) as page:
        print(f"live page: {page.url} (Ctrl-C ends it)", flush=True)
        page.wait()


def _serve(port: int) -> viser.ViserServer:
    """Start the server on exactly this port of the loopback address, which only this machine reaches."""
    try:
        with socket.create_server((LOOPBACK, port)) as probe:
            port = probe.getsockname()[1]
    except OSError as error:
        sentence = f"the page cannot listen on port {port} ({error.strerror}); --port chooses another one"
        raise OSError(sentence) from None
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):  # the library prints a box with the address
        server = viser.ViserServer(host=LOOPBACK, port=port, verbose=False)
    # The page never asks for a public address, and a message that does gets none: no request leaves the machine.
    server.request_share_url = lambda *_, **__: None
    return server
