"""Session of one tab of the live page: its scene, its decisions and its movements, in one thread of its own."""

from __future__ import annotations

import dataclasses
import io
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from viapoint.envs import ReachVectorEnv, Scenes, Task
from viapoint.envs.common.types import Float, Observation
from viapoint.training.live.comparison import MethodResult, compare
from viapoint.training.live.decisions import (
    AGENT,
    MOTION,
    SECOND_LIMIT,
    TIME_LIMIT,
    Decision,
    Proposal,
    describe_plan,
    plan_by_hand,
)
from viapoint.training.live.job_thread import TICK, Job, JobThread
from viapoint.training.live.movements import (
    SAMPLES,
    Decide,
    Profile,
    Segment,
    describe_outcome,
    execute_replanning,
    execute_stepwise,
    execute_whole,
    executed_profile,
)
from viapoint.training.live.obstacle_editing import new_obstacle, resized, sizes_of
from viapoint.training.live.panels import BAD, GOOD, RESET, Panels
from viapoint.training.live.scene import LiveScene, to_python
from viapoint.training.live.scene_view import SceneView
from viapoint.training.live.setting import N_VIA

if TYPE_CHECKING:
    import viser

    from viapoint.envs import Plan
    from viapoint.training.live.setting import Setting, Shared
    from viapoint.training.planning.motion_plan import MotionPlan

MOST_VIAS = 3
"""Greatest number of via-points of the motion planner."""
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
        self._method, self._checks = shared.own.methods[0], 0
        self._n_via = self._usual_n_via
        self._last: MotionPlan | None = None
        self._by_hand: tuple[Float, float] | None = None
        self._duration: float | None = None
        self._selected: int | None = None
        self._scenes: Scenes | None = None
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
        self._turning = False
        self._envs: dict[Setting, ReachVectorEnv] = {}
        self._step_env: ReachVectorEnv | None = None
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
    def setting(self) -> Setting:
        """Setting of the present scene: its task and who decides."""
        return self._setting

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

    def choose(self, method: str) -> None:
        """Choose the method that decides, one of the setting's `methods`."""
        self._act("method", method)

    def turn(self, quaternion: Float) -> None:
        """Turn the tool at the goal to another orientation."""
        self.post("drag turn", lambda: self._turn(quaternion))

    def _act(self, control: str, *values: Any) -> None:
        """Post the job of a control of the panels, with its values."""
        jobs: dict[str, Callable[..., None]] = {
            "scene": self._draw_scene,
            "duration": self._set_duration,
            "method": self._set_method,
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
            "rings": self._show_rings,
            "view": lambda: self._view.look_at_everything(),
        }
        self.post(control, lambda: jobs[control](*values))

    @property
    def _usual_n_via(self) -> int:
        """Number of via-points that the method has by default."""
        return N_VIA if self._method == MOTION else self._shared.own.task.action.n_via

    @property
    def _task(self) -> Task:
        return self._setting.task

    @property
    def _env(self) -> ReachVectorEnv:
        """Environment of the present setting."""
        if self._setting not in self._envs:
            self._envs[self._setting] = self._setting.make_env()
        return self._envs[self._setting]

    # The thread

    def _open(self) -> None:
        shared = self._shared
        self._step_env = shared.own.make_step_env()
        self._kinds = shared.scene_kinds()
        floor = float(shared.model.geom("table").pos[2])
        self._client.gui.set_panel_label("Viapoint")
        self._panels = Panels(self._client, shared.own, shared.env_id, tuple(self._kinds), self._act)
        with self._client.atomic():
            self._view = SceneView(
                self._client, shared.own, shared.drawing(), floor,
                on_drag=lambda *event: self.post(f"drag {event[0]}", lambda: self._drag(*event)),
                on_pick=lambda index: self.post("pick", lambda: self._pick(index)),
                on_select=lambda row: self.post("select", lambda: self._select(row)),
                on_turn=self.turn,
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
            self._show_ends()
            self._view.show_obstacles(scene.obstacles, self._selected)
            self._view.pose(self._task.space.joints(scene.start))
        if changed:
            self._panels.show_comparison(())
        self._decide()

    def _show_ends(self) -> None:
        scene, setting = self._scene, self._setting
        joints = self._task.space.joints(scene.goal)
        self._view.show_ends(setting.tool(scene.start), setting.tool(scene.goal), joints)

    def _show_rings(self, shown: bool) -> None:
        """Show the rings that turn the tool at the goal, or hide them."""
        self._turning = shown
        self._view.show_rings(self._setting.orientation(self._scene.goal) if shown else None)

    def _turn(self, quaternion: Float) -> None:
        """Turn the tool at the goal."""
        scene, setting = self._scene, self._setting
        goal = setting.moved(scene.goal, setting.tool(scene.goal), scene.packed, quaternion)
        self._by_hand = None
        self._set_scene(scene.at_rest()._replace(goal=goal), changed=True)

    def _drag(self, name: str, place: Float) -> None:
        """Move what is dragged to another place, shape (3,), [m]."""
        kind, _, number = name.partition(" ")
        if kind == "goal" and self._playing is not None and self._task.replanning:
            self._move_goal(place)
        elif kind == "via":
            self._move_via(int(number), place)
        elif kind == "obstacle":
            self._move_obstacle(int(number), place)
        else:
            self._move_end(kind, place)

    def _move_end(self, name: str, place: Float) -> None:
        scene, setting = self._scene, self._setting
        moved = setting.moved(getattr(scene, name), place, scene.packed)
        self._by_hand = None
        scene = scene._replace(start=moved) if name == "start" else scene.at_rest()._replace(goal=moved)
        self._set_scene(scene, changed=True)
        if self._turning:
            self._show_rings(True)

    def _move_obstacle(self, row: int, place: Float) -> None:
        if row >= len(self._scene.obstacles):
            return
        shape = dataclasses.replace(self._scene.obstacles[row], position=place)
        if self._selected != row:
            self._select(row)
        self._set_scene(self._scene.with_obstacle(shape, row), changed=True)

    def _move_goal(self, place: Float) -> None:
        """Move the goal while the arm moves; an impossible one is refused."""
        goal = self._setting.moved(self._scene.goal, place, None)
        if not self._task.space.inside(goal):
            raise ValueError("the goal would be out of the arm's reach")
        self._scene = self._scene.at_rest()._replace(goal=goal)
        self._show_ends()

    def _move_via(self, number: int, place: Float) -> None:
        """Plan through a via-point that was dragged."""
        if self.proposal is None:
            return
        vias = np.array(self.proposal.plan.waypoints[1:-1])
        if number < len(vias):
            vias[number] = self._setting.moved(vias[number], place, None)
            self._by_hand = vias, self.proposal.duration
            self._set_scene(self._scene, changed=False)

    def _select(self, row: int) -> None:
        """Select an obstacle, unless it has been removed meanwhile."""
        if row < len(self._scene.obstacles):
            self._selected = row
            self._view.show_obstacles(self._scene.obstacles, row)
            self._show_selected()

    def _show_selected(self) -> None:
        if self._selected is None:
            self._panels.show_selected("", None)
            return
        shape = self._scene.obstacles[self._selected]
        name = shape.name or f"obstacle {self._selected}"
        self._panels.show_selected(name, sizes_of(shape, self._setting.planar))

    def _resize(self, name: str, value: float) -> None:
        if self._selected is not None:
            shape = resized(self._scene.obstacles[self._selected], name, value, self._setting.planar)
            self._set_scene(self._scene.with_obstacle(shape, self._selected), changed=True)

    def _add(self, kind: str) -> None:
        scene = self._scene.with_obstacle(new_obstacle(self._setting, self._scene, kind))
        self._shared.setting_of(scene)
        self._selected = len(scene.obstacles) - 1
        self._set_scene(scene, changed=True)
        self._show_selected()

    def _remove(self) -> None:
        row, self._selected = self._selected, None
        if row is not None:
            self._set_scene(self._scene.without(row), changed=True)
        self._show_selected()

    # Decisions

    def _decide(self) -> None:
        """Decide and show the plan; proposals and plots follow when nothing else is to be done."""
        self._decision, self._proposals, self._picked = None, (), 0
        self._scenes = None
        n_via = min(max(self._n_via, 1), MOST_VIAS)
        if self._method == MOTION and self._by_hand is None:
            self._plan(n_via, TIME_LIMIT)
            return
        try:
            observation, _ = self._env.reset(options=self._scene.options())
        except ValueError:
            if MOTION in self._setting.methods:  # it says what is wrong, and shows the best plan in red
                self._plan(n_via, TIME_LIMIT)
                if self._proposals and not self._proposals[0].clear:
                    return
                raise
            self._view.show_plan(None, np.zeros((0, 3)), clear=False)
            self._view.show_proposals([])
            self._panels.show_proposals((), 0, "", 0.0)
            self._panels.show_plots(None, None)
            raise
        scenes = self._env.scenes
        assert scenes is not None
        self._scenes, decisions = scenes, self._setting.decisions
        self._decision = decision = decisions.choose(
            observation,
            scenes,
            n_via=self._n_via,
            checks=self._checks,
            by_agent=self._method == AGENT,
        )
        chosen = decision.chosen
        if self._by_hand is not None:
            chosen = decisions.evaluate(scenes, plan_by_hand(self._scene, *self._by_hand))
        elif self._duration is not None:
            vias = np.asarray(chosen.plan.waypoints[1:-1])
            chosen = decisions.evaluate(scenes, plan_by_hand(self._scene, vias, self._duration))
        self._show_decision(chosen)
        self.post("later proposals", lambda: self._add_proposals(observation, scenes, decision))

    def _show_decision(self, chosen: Proposal, *, timed: bool = True) -> None:
        """Show a new plan at once, and note the time since the change."""
        self._proposals = (chosen,)
        self._show_plan()
        self._client.flush()
        self.decisions += 1
        if timed:
            self.latencies.append(time.perf_counter() - self._jobs.posted)

    def _plan(self, n_via: int, time_limit: float) -> None:
        """Show a plan of the motion planner; where it is not free, a second one follows in the next pause."""
        decisions = self._setting.decisions
        decision = decisions.plan(self._scene, n_via, self._duration, self._last, time_limit)
        self._last, self._decision = decision.motion, decision
        self._show_decision(decision.chosen, timed=time_limit == TIME_LIMIT)

        def follow() -> None:
            if decision is not self._decision or self._playing is not None:
                return
            if decision.chosen.reason and time_limit < SECOND_LIMIT:
                self._plan(n_via, SECOND_LIMIT)
            self._show_details()

        self.post("later proposals", follow)

    def _show_plan(self) -> None:
        """Show the picked proposal, and say what it does."""
        plan = self.proposal
        assert plan is not None
        remarks, limit = [self._origin], self._shared.own.limit(self._scene)
        if limit and self._method == AGENT:
            remarks.append(f"The agent was trained {limit}, so the geometry search decides.")
        remark = " ".join(filter(None, remarks))
        tool = self._setting.tool
        with self._client.atomic():  # one message
            vias = tool(np.asarray(plan.plan.waypoints[1:-1]))
            self._view.show_plan(tool(plan.profile.coordinates), vias, clear=plan.clear)
            if self._proposals[1:] == ():
                self._view.show_proposals([])
            chosen = plan.duration if self._duration is None else None
            self._panels.show_decided(chosen, len(plan.plan.durations) - 1)
            self._panels.tell(describe_plan(plan), GOOD if plan.clear else BAD, remark)

    def _add_proposals(self, observation: Observation, scenes: Scenes, decision: Decision) -> None:
        """Show the other proposals, and the profile of the plan."""
        if decision is not self._decision or self._playing is not None:
            return
        others = self._setting.decisions.proposals(observation, scenes, decision)
        own = self._proposals[0]
        self._proposals = others if own.rank else (own, *others)
        self._show_details()

    def _show_details(self, executed: Profile | None = None) -> None:
        plan, decision = self.proposal, self._decision
        if plan is None or decision is None:
            return
        others = self._proposals
        paths = [self._setting.tool(each.profile.coordinates) for each in others]
        with self._client.atomic():
            self._view.show_proposals(paths, [each.clear for each in others])
            self._panels.show_proposals(others, self._picked, decision.maker, decision.seconds)
            self._panels.show_plots(plan.profile, executed)

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
        plan, setting = self.proposal, self._setting
        assert plan is not None
        if self._task.replanning:
            checks, goal_of = self._checks, lambda: self._scene.goal
            decide: Decide = lambda seen: setting.decisions.action(seen, checks)  # noqa: E731
            return execute_replanning(self._env, decide, self._scene, plan.plan, goal_of)
        if (
            self._step_env is not None
            and self._method == AGENT
            and plan.rank == 1
            and setting is self._shared.own
        ):
            return execute_stepwise(self._step_env, setting.act, self._scene)
        return execute_whole(self._env, self._scene, plan.plan)

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
            if segment.plan is not None:
                self._view.show_plan(self._path(segment.plan), np.zeros((0, 3)), clear=True)
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
            self._view.move_obstacles(segment.places[row])

    def _path(self, plan: Plan) -> Float:
        """Return places of the tool along a plan, shape (SAMPLES, 3), [m]."""
        time = np.linspace(0.0, float(plan.duration), SAMPLES)
        return self._setting.tool(np.asarray(plan.trajectory()(time)))

    def _finish(self) -> None:
        """Tell the outcome of the movement, and show its profile."""
        segments = self._movement
        text = describe_outcome(segments[-1].info, in_joints=not self._task.space.of_hand)
        self._panels.tell(text, GOOD if text.startswith("Success") else BAD)
        if not any(each.restarted for each in segments):
            self._show_details(executed_profile(segments))

    def _compare(self) -> None:
        """Compare methods, one job for each, so that changes of the scene come between."""
        scene, results = self._scene, list[MethodResult]()
        self._env.reset(options=scene.options())  # raises where the scene is impossible
        methods = compare(self._setting, scene, self._shared.planners, self._checks)

        def step() -> None:
            if scene is not self._scene:
                methods.close()
                return
            following = next(methods, None)
            self._panels.show_comparison(results, running=following[0] if following else "")
            if following is not None:
                self._client.flush()
                results.append(following[1]())
                self.post("later comparison", step)

        step()

    # Files

    def _save(self) -> None:
        self._download("scene.json", self._scene.to_json(self._shared.env_id).encode())

    def _code(self) -> None:
        shared = self._shared
        code = to_python(self._scene, shared.env_id, shared.arguments(self._setting))
        self._panels.show_code(code)

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
        self._redecide(_by_hand=None, _duration=None, _n_via=self._usual_n_via)

    def _set_method(self, name: str) -> None:
        self._method, self._last = name, None
        self._decide_anew()

    def _set_duration(self, duration: float) -> None:
        if self._by_hand is not None:
            self._redecide(_by_hand=(self._by_hand[0], duration))
        else:
            self._redecide(_duration=duration)
