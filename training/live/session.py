"""Session of one tab of the live page: its scene, its decisions and its movements, in one thread of its own."""

from __future__ import annotations

import io
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from viapoint.envs.common.types import Float
from viapoint.training.live.decisions import Decision, Proposal, describe_plan, plan_by_hand
from viapoint.training.live.job_thread import TICK, Job, JobThread
from viapoint.training.live.movements import (
    Profile,
    Segment,
    describe_outcome,
    execute_replanning,
    execute_stepwise,
    execute_whole,
    executed_profile,
    plan_profile,
)
from viapoint.training.live.obstacle_editing import new_obstacle, resized, sizes_of
from viapoint.training.live.panels import BAD, GOOD, RESET, Panels
from viapoint.training.live.scene_file import LiveScene, to_json, to_python
from viapoint.training.live.scene_view import SceneView

if TYPE_CHECKING:
    import viser

    from viapoint.envs.mdp.task import Task
    from viapoint.training.live.setting import MethodResult, Setting, Shared

LATENCIES = 200
"""Changes whose latency is kept."""
FADE_EVERY = 0.08
"""Time between two steps of fading, [s]."""
PICTURE = 1280, 800
"""Width and height of saved pictures, [pixels]."""
RENDER_TIMEOUT = 20.0
"""Time limit of one picture from the browser, [s]."""


class Session:
    """Session of one tab; all its work is done in one :class:`JobThread`.

    Args:
        client: Tab.
        shared: Environments and agent, which all tabs share.
        on_end: Function that is called when the session has ended.
    """

    def __init__(self, client: viser.ClientHandle, shared: Shared, on_end: Callable[[], object]) -> None:
        self._on_end = on_end
        self._client, self._shared, self._setting = client, shared, shared.own
        self._checks, self._n_via = 0, shared.own.task.action.n_via
        self._by_hand: tuple[Float, float] | None = None
        self._duration: float | None = None
        self._selected: int | None = None
        self._decision: Decision | None = None
        self._proposals: tuple[Proposal, ...] = ()
        self._picked = 0
        self._playing: Iterator[float] | None = None
        self._movement: list[Segment] = []
        self._next_picture = self._next_fade = 0.0
        self.decisions = 0
        """Number of decisions so far."""
        self.latencies: deque[float] = deque(maxlen=LATENCIES)
        """Times from the last changes to the messages with their plans, [s]."""
        self._fading = False
        self._envs: dict[Setting, Any] = {}
        self._step_env: Any = None
        self._origin = ""
        self._jobs = JobThread(
            f"viapoint-tab-{client.client_id}", begin=self._open, animate=self._animate, end=self._end,
            tell=lambda sentence: self._panels.tell(sentence, BAD),
        )  # fmt: skip
        self._jobs.start()

    @property
    def scene(self) -> LiveScene:
        """Present scene."""
        return self._scene

    @property
    def proposal(self) -> Proposal | None:
        """Plan that is shown; None if there is none."""
        return self._proposals[self._picked] if self._proposals else None

    @property
    def camera(self) -> viser.CameraHandle:
        """Camera of the tab."""
        return self._client.camera

    @property
    def movement(self) -> tuple[Segment, ...]:
        """Last movement that was played."""
        return tuple(self._movement)

    @property
    def alive(self) -> bool:
        """True until the thread has ended."""
        return self._jobs.is_alive()

    @property
    def idle(self) -> bool:
        """True if nothing waits to be done and nothing moves."""
        return self._jobs.idle and self._playing is None

    def close(self) -> None:
        """Stop the thread, which closes the environments."""
        self._jobs.close()

    def join(self, timeout: float) -> None:
        """Wait for the end of the thread."""
        self._jobs.join(timeout)

    def post(self, key: str, job: Job) -> None:
        """Hand a job to the thread; a waiting one of the same key is replaced."""
        self._jobs.post(key, job)

    def load(self, content: bytes) -> None:
        """Go to the scene of a JSON file; an impossible one is refused on the page."""
        self._act("load", content)

    def _act(self, control: str, *values: Any) -> None:
        """Post the job of a control of the panels, with its values."""
        jobs: dict[str, Callable[..., None]] = {
            "scene": self._draw_scene,
            "duration": self._set_duration,
            "vias": lambda n: self._redecide(_n_via=n, _by_hand=None),
            "checks": lambda n: self._redecide(_checks=n),
            "pick": self._pick,
            "add": self._add,
            "remove": self._remove,
            "resize": self._resize,
            "decide": self._decide_anew,
            "execute": self._execute,
            "compare": self._compare,
            "save": self._save,
            "load": lambda content: self._take(self._shared.read(content), ""),
            "code": self._code,
            "picture": self._picture,
            "view": lambda: self._view.look_at_everything(),
        }
        self.post(control, lambda: jobs[control](*values))

    @property
    def _task(self) -> Task:
        return self._setting.task

    @property
    def _fitted(self) -> LiveScene:
        """Present scene with the rows of the present setting."""
        return self._scene.with_shapes(self._task.scenes.shapes)

    @property
    def _env(self) -> Any:
        """Environment of the present setting."""
        if self._setting not in self._envs:
            self._envs[self._setting] = self._setting.make_env()
        return self._envs[self._setting]

    # The thread

    def _open(self) -> None:
        shared = self._shared
        self._step_env = shared.own.make_step_env()
        self._kinds = shared.scene_kinds()
        floor = float(shared.own.model.geom("table").pos[2])
        self._client.gui.set_panel_label("Viapoint")
        self._panels = Panels(self._client, shared.own, tuple(self._kinds), self._act)
        with self._client.atomic():
            self._view = SceneView(
                self._client, self._task, shared.drawing(), floor,
                on_drag=lambda *event: self.post(f"drag {event[0]}", lambda: self._drag(*event)),
                on_pick=lambda index: self.post("pick", lambda: self._pick(index)),
                on_select=lambda row: self.post("select", lambda: self._select(row)),
            )  # fmt: skip
        self._jobs.guard(lambda: self._draw_scene(next(iter(self._kinds))))

    def _end(self) -> None:
        for env in (*self._envs.values(), self._step_env):
            if env is not None:
                env.close()
        self._on_end()

    def _animate(self) -> bool:
        """Fade old plans, show the next picture of a movement when it is due, and return True if there is more."""
        now = time.monotonic()
        if now >= self._next_fade:
            self._next_fade = now + FADE_EVERY
            with self._client.atomic():
                self._fading = self._view.fade()
        if self._playing is not None and now >= self._next_picture:
            self._jobs.guard(self._advance)
        return self._playing is not None or self._fading

    def _advance(self) -> None:
        assert self._playing is not None
        try:
            wait = next(self._playing)
        except BaseException as end:
            self._playing = None
            self._panels.show_running(running=False)
            if not isinstance(end, StopIteration):
                raise
            self._finish()
            return
        self._next_picture = time.monotonic() + wait

    # Scenes

    def _draw_scene(self, kind: str) -> None:
        self._take(*(self._drawn if kind == RESET else self._kinds[kind]()))

    def _take(self, scene: LiveScene, origin: str) -> None:
        """Go to another scene, of which a sentence says where it comes from."""
        self._by_hand = self._duration = self._selected = None
        self._drawn = scene, origin
        self._set_scene(scene, changed=True, origin=origin)
        self._panels.show_selected("", None)

    def _set_scene(self, scene: LiveScene, *, changed: bool, origin: str = "") -> None:
        """Show a scene and decide in it."""
        setting = self._shared.setting_of(scene)
        self._stop()
        self._view.show_executed(None)
        self._scene, self._setting = scene, setting
        if changed:
            self._origin = origin
        with self._client.atomic():
            self._view.show_scene(scene, self._selected)
            self._view.pose(np.asarray(self._task.arm.inverse_kinematics(scene.start)))
        if changed:
            self._panels.show_comparison(())
        self._decide()

    def _drag(self, name: str, point: Float) -> None:
        """Move what is dragged."""
        kind, _, number = name.partition(" ")
        if kind == "goal" and self._playing is not None and self._task.replanning:
            self._move_goal(point)
        elif kind == "via":
            self._move_via(int(number), point)
        elif kind == "obstacle":
            if int(number) >= len(self._scene.obstacles):
                return
            row = self._scene.obstacles[int(number)].copy()
            row[: len(point)] = point
            if self._selected != int(number):
                self._select(int(number))
            self._set_scene(self._scene.with_row(int(number), row), changed=True)
        else:
            self._by_hand = None
            scene = self._scene._replace(start=point)
            if kind == "goal":
                scene = self._scene._replace(goal=point, jumps=self._scene.jumps[:0])
            self._set_scene(scene, changed=True)

    def _move_goal(self, point: Float) -> None:
        """Move the goal while the arm moves; an impossible one is refused."""
        scene = self._scene._replace(goal=point, jumps=self._scene.jumps[:0])
        margin = float(self._task.arm.reach_margin(point))
        if margin < 0.0:
            self._view.move_handle("goal", self._scene.goal)
            raise ValueError(f"the goal would be {-margin:.3f} m out of the arm's reach")
        self._scene = scene
        self._view.move_handle("goal", point)

    def _move_via(self, number: int, point: Float) -> None:
        """Plan through a via-point that was dragged."""
        if self.proposal is None:
            return
        vias = np.array(self.proposal.plan.waypoints[1:-1])
        if number < len(vias):
            vias[number] = point
            self._by_hand = vias, self.proposal.duration
            self._set_scene(self._scene, changed=False)

    def _select(self, row: int) -> None:
        """Select an obstacle, unless it has been removed meanwhile."""
        if row < len(self._scene.obstacles):
            self._selected = row
            self._view.show_obstacles(self._scene.obstacles, row)
            self._panels.show_selected(f"obstacle {row}", sizes_of(self._scene.obstacles[row]))

    def _resize(self, name: str, value: float) -> None:
        if self._selected is not None:
            numbers = resized(self._scene.obstacles[self._selected], name, value)
            self._set_scene(self._scene.with_row(self._selected, numbers), changed=True)

    def _add(self, kind: str) -> None:
        scene = self._scene.with_obstacle(new_obstacle(self._scene, kind))
        self._shared.setting_of(scene)
        self._selected = len(scene.obstacles) - 1
        self._set_scene(scene, changed=True)
        self._panels.show_selected(f"obstacle {self._selected}", sizes_of(scene.obstacles[-1]))

    def _remove(self) -> None:
        row, self._selected = self._selected, None
        if row is not None:
            self._set_scene(self._scene.without(row), changed=True)
        self._panels.show_selected("", None)

    # Decisions

    def _decide(self) -> None:
        """Decide and show the plan; proposals and plots follow when nothing else is to be done."""
        self._decision, self._proposals, self._picked = None, (), 0
        try:
            observation = self._setting.observe(self._fitted, self._env)
        except ValueError:
            self._view.show_plan(None, np.zeros((0, self._task.arm.dimension)), clear=False)
            self._view.show_proposals([])
            self._panels.show_proposals((), 0, "", 0.0)
            self._panels.show_plots(None, None)
            raise
        self._decision = decision = self._setting.decisions.choose(
            observation, n_via=self._n_via, checks=self._checks
        )
        chosen = decision.chosen
        if self._by_hand is not None:
            chosen = self._setting.decisions.evaluate(observation, plan_by_hand(self._scene, *self._by_hand))
        elif self._duration is not None:
            vias = np.asarray(chosen.plan.waypoints[1:-1])
            chosen = self._setting.decisions.evaluate(
                observation, plan_by_hand(self._scene, vias, self._duration)
            )
        self._proposals = (chosen,)
        self._show_plan()
        self._client.flush()
        self.decisions += 1
        self.latencies.append(time.perf_counter() - self._jobs.posted)
        self.post("later proposals", lambda: self._add_proposals(observation, decision))

    def _show_plan(self) -> None:
        """Show the picked proposal, and say what it does."""
        plan = self.proposal
        assert plan is not None
        remarks, limit = [self._origin], self._shared.own.limit(self._scene)
        if limit and self._shared.own.agent is not None:
            remarks.append(f"The agent was trained {limit}, so the geometry search decides.")
        remark = " ".join(filter(None, remarks))
        with self._client.atomic():  # one message
            self._view.show_plan(plan.path(), np.asarray(plan.plan.waypoints[1:-1]), clear=plan.clear)
            if self._proposals[1:] == ():
                self._view.show_proposals([])
            self._panels.show_decided(plan.duration, len(plan.plan.durations) - 1)
            self._panels.tell(describe_plan(plan), GOOD if plan.clear else BAD, remark)

    def _add_proposals(self, observation: Any, decision: Decision) -> None:
        """Show the other proposals, and the profile of the plan."""
        if decision is not self._decision or self._playing is not None:
            return
        others = self._setting.decisions.proposals(observation, decision)
        own = self._proposals[0]
        self._proposals = others if own.rank else (own, *others)
        self._show_details()

    def _show_details(self, executed: Profile | None = None) -> None:
        plan, decision = self.proposal, self._decision
        if plan is None or decision is None:
            return
        others, profile = self._proposals, plan_profile(self._task, self._fitted, plan.plan)
        with self._client.atomic():
            self._view.show_proposals([each.path() for each in others], [each.clear for each in others])
            self._panels.show_proposals(others, self._picked, decision.maker, decision.seconds)
            self._panels.show_plots(profile, executed)

    def _pick(self, index: int) -> None:
        """Show another proposal as the plan."""
        if index < len(self._proposals):
            self._stop()
            self._view.show_executed(None)
            self._picked = index
            self._show_plan()
            self._show_details()

    def _redecide(self, **changes: Any) -> None:
        """Decide anew after a change of the settings of decisions."""
        for name, value in changes.items():
            setattr(self, name, value)
        self._set_scene(self._scene, changed=False)

    # Movements

    def _stop(self) -> None:
        if self._playing is not None:
            self._playing = None
            self._panels.show_running(running=False)

    def _execute(self) -> None:
        """Begin to play the simulated movement, or stop it."""
        if self._playing is not None:
            self._stop()
            return
        if self.proposal is None:
            raise ValueError("there is no plan to execute: move what stands in the way first")
        self._panels.show_running(running=True)
        self._playing = self._play(self._segments(), self._panels.speed)
        self._next_picture = 0.0

    def _segments(self) -> Iterator[Segment]:
        plan = self.proposal
        assert plan is not None
        if self._task.replanning:
            decisions = self._setting.decisions
            return execute_replanning(
                self._env, decisions, self._fitted, plan.plan, lambda: self._scene.goal, self._checks
            )
        if self._step_env is not None and plan.rank == 1 and self._setting is self._shared.own:
            return execute_stepwise(self._step_env, self._setting.agent, self._fitted)
        return execute_whole(self._env, self._fitted, plan.plan)

    def _play(self, segments: Iterator[Segment], speed: float) -> Iterator[float]:
        """Show a movement at a speed relative to real time, and yield the time until the next picture, [s].

        Each segment is computed when the one before it has been shown.
        """
        self._movement = []
        began, hand = None, list[Float]()
        for segment in segments:
            if began is None:
                began = time.monotonic() - float(segment.time[0]) / speed
            if segment.restarted:
                hand = []
            if segment.path is not None:
                self._view.show_plan(segment.path, np.zeros((0, segment.hand.shape[-1])), clear=True)
            self._movement.append(segment)
            shown = 0
            while shown < len(segment.time):
                elapsed = (time.monotonic() - began) * speed
                ahead = int(np.searchsorted(segment.time, elapsed))
                shown = min(max(ahead, shown + 1), len(segment.time))
                self._show(segment, shown - 1, hand)
                yield min(TICK, max((float(segment.time[shown - 1]) - elapsed) / speed, 0.0))
            hand.append(segment.hand)

    def _show(self, segment: Segment, row: int, hand: list[Float]) -> None:
        """Show one instant of a segment after the hand positions of those before it."""
        with self._client.atomic():
            self._view.pose(segment.joints[row])
            path = np.concatenate((*hand, segment.hand[: row + 1]))
            self._view.show_executed(path, contact=bool(segment.contact[: row + 1].any()))
            scene = self._scene.batch()
            if scene.courses.any():
                self._view.show_obstacles(scene.places(segment.time[None, row : row + 1])[0, 0])

    def _finish(self) -> None:
        """Say what came of the movement, and show its profile."""
        segments = self._movement
        info = segments[-1].info
        text = describe_outcome({name: np.asarray(value).reshape(-1)[0] for name, value in info.items()})
        self._panels.tell(text, GOOD if text.startswith("Success") else BAD)
        if not any(each.restarted for each in segments):
            self._show_details(executed_profile(segments))

    def _compare(self) -> None:
        """Compare methods, one job for each, so that changes of the scene come between."""
        scene, setting = self._scene, self._setting
        results: list[MethodResult] = []
        setting.observe(self._fitted, self._env)  # an impossible scene is refused
        rows = setting.compare(self._fitted, self._checks)

        def step() -> None:
            if scene is not self._scene:
                return
            following = next(rows, None)
            self._panels.show_comparison(results, running=following[0] if following else "")
            if following is not None:
                self._client.flush()
                with setting.comparing:
                    results.append(following[1]())
                self.post("later comparison", step)

        step()

    # Files

    def _save(self) -> None:
        text = to_json(self._scene, self._setting.env_id)
        self._download("scene.json", text.encode())

    def _code(self) -> None:
        setting, changing = self._setting, self._task.replanning
        self._panels.show_code(to_python(self._fitted, setting.env_id, setting.env_kwargs, changing=changing))

    def _picture(self) -> None:
        """Save a picture of the present view, rendered by the browser, as a PNG file on white."""
        self._client.flush()
        width, height = PICTURE
        picture = self._client.get_render(height, width, transport_format="png", timeout=RENDER_TIMEOUT)
        image = Image.fromarray(picture).convert("RGBA")
        ground = Image.new("RGBA", image.size, "white")
        ground.alpha_composite(image)
        file = io.BytesIO()
        ground.convert("RGB").save(file, "PNG", optimize=True)
        self._download("viapoint.png", file.getvalue())

    def _download(self, name: str, content: bytes) -> None:
        self._client.send_file_download(name, content, save_immediately=True)

    def _decide_anew(self) -> None:
        self._redecide(_by_hand=None, _duration=None, _n_via=self._shared.own.task.action.n_via)

    def _set_duration(self, duration: float) -> None:
        if self._by_hand is not None:
            self._redecide(_by_hand=(self._by_hand[0], duration))
        else:
            self._redecide(_duration=duration)
