"""Panels of the live page: what was decided on the left, what can be changed on the right."""

from __future__ import annotations

import functools
import html
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import viser
from matplotlib.colors import to_hex

from viapoint.envs.common.arrays import Float, norm
from viapoint.envs.common.palette import PALETTE
from viapoint.training.live.arena import AGENT, MOTION, OMPL, SIZES, Arena
from viapoint.training.live.decide import profile
from viapoint.training.live.state import Movement, State

WIDTH = 330  # Width of a panel, [pixels]
RESET = "Reset"  # Name of the button that undoes all changes of a scene
CHECKS = {"none": 0, "16": 16, "64": 64}  # Proposals that are checked with computed geometry
NOTE = '<div style="padding:0.2em 0.9em;font-size:0.8em;color:#6b7078">{}</div>'
MESSAGE = '<div id="viapoint-message" style="padding:0.2em 0.9em;font-size:0.9em;color:{}">{}</div>'
CODE = (
    '<pre id="viapoint-code" style="background:#f5f5f2;padding:1em;overflow:auto;font-size:0.82em">{}</pre>'
    '<button onclick="navigator.clipboard.writeText(this.previousElementSibling.textContent)">Copy</button>'
)
LINE = {"width": 2, "points": {"show": False}}
# Lines of the plots
LINES: Any = (
    {"label": "time"},
    {**LINE, "label": "plan", "stroke": to_hex(PALETTE.plan)},
    {**LINE, "label": "executed", "stroke": to_hex(PALETTE.executed), "dash": (6, 5)},
)


class Panels:
    """Panels of one tab, drawn from its state; `act` is called with the name of what a user does and its values."""

    def __init__(
        self, client: viser.ClientHandle, arena: Arena, scene_kinds: Iterable[str], act: Callable[..., None]
    ) -> None:
        self._gui, self._arena, self._act = client.gui, arena, act
        self._selection: Any = ()
        self._plots: dict[str, Any] = {}
        self._build_results()
        self._build_controls(scene_kinds)

    def draw(self, state: State) -> None:
        """Show what was decided, and set the controls."""
        remark = state.scene.origin if state.scene is state.drawn else ""
        limit = self._arena.limit(state.scene)
        plan = state.plan
        if limit and state.method == AGENT:
            remark += f" The agent was trained {limit}, so the geometry search decides."
        message = MESSAGE.format("#1b7f4b" if state.good else "#c4202b", html.escape(state.message))
        self._message.content = message + NOTE.format(html.escape(remark))
        self._execute.label = "Stop" if state.playing else "Execute"
        self._vias.visible = state.method != OMPL  # which takes as many as its path needs
        self._vias.min = int(state.method == MOTION)
        self._vias.value = self._arena.n_via(state)
        if plan is not None and state.duration is None:
            low, high = self._duration.min, self._duration.max
            self._duration.value = float(np.clip(round(plan.duration, 2), low, high))
        self._draw_selection(state)
        self._draw_comparison(state)
        if plan is not None and state.before is None and not state.playing:
            self._draw_proposals(state)
            self._draw_plots(profile(self._arena, state.scene, plan.plan), state.movement)

    def show_code(self, code: str) -> None:
        """Show Python code with a button that copies it."""
        with self._gui.add_modal("This scene in Python") as modal:
            self._gui.add_html(CODE.format(html.escape(code)))
            self._gui.add_button("Close").on_click(lambda _: modal.close())

    def _draw_proposals(self, state: State) -> None:
        rows = []
        for number, each in enumerate(state.proposals, start=1):
            motion = each.motion
            reward = _number(each.reward) if motion.success else "fails"
            known = _number(each.value), _millimetres(motion.clearance), _number(motion.duration)
            rows.append((f"#{number}", reward, *known))
        names = "plan", "reward", "agent's value", "clearance [mm]", "time [s]"
        first = state.proposals[0]
        note = f"{first.maker}, decided in {1e3 * first.seconds:.0f} ms"
        self._table.content = _table(names, rows, state.picked) + NOTE.format(note)
        self._pick.visible = len(rows) > 1
        self._pick.options = tuple(name for name, *_ in rows)

    def _draw_plots(self, profile: Mapping[str, Float], movement: Movement | None) -> None:
        """Plot the plan, and the executed movement if there is one."""
        time, executed = profile["time"], {}
        if movement is not None:
            rollout = movement.rollout
            time = rollout.time
            executed["speed"] = norm(np.gradient(rollout.hand, time, axis=0))
            executed["clearance"] = rollout.clearance
        for name, plot in self._plots.items():
            beyond = 0.0 if name == "jerk" else None  # the arm rests after the plan
            planned = np.interp(time, profile["time"], profile[name], right=beyond)
            other = executed.get(
                name, np.where(time > 0.0, np.nan, planned)
            )  # one number: no line, but a plot
            lines = np.array([planned, other])
            if name == "clearance":  # in millimetres, where it is small
                lines = np.minimum(1e3 * lines, 250.0)
            plot.data = (time, *lines)

    def _draw_comparison(self, state: State) -> None:
        rows = []
        for name, seconds, movement in state.results:
            info = movement.info
            success = "yes" if info["is_success"] else "no"
            numbers = _millimetres(info["min_clearance"]), _number(info["jerk_ratio"]), f"{1e3 * seconds:.0f}"
            rows.append((name, success, _number(movement.reward), *numbers))
        names = "method", "success", "reward", "clearance [mm]", "jerk", "decided in [ms]"
        note = "Each row is simulated. Jerk is relative to the straight movement."
        if 0 < len(rows) < len(self._arena.methods):
            note = f"{self._arena.methods[len(rows)]} ..."
        self._methods.content = (_table(names, rows) if rows else "") + NOTE.format(note)

    def _draw_selection(self, state: State) -> None:
        """Show the sizes of the selected obstacle; sliders that the user moves are left alone."""
        row, shapes = state.selected, state.scene.obstacles
        if self._selection == (row, len(shapes), id(state.drawn)):
            return
        self._selection = row, len(shapes), id(state.drawn)
        values = {} if row is None else self._arena.sizes_of(shapes[row])
        for name, slider in self._sizes.items():
            slider.visible = name in values
            slider.value = float(np.clip(values.get(name, 0.0), slider.min, slider.max))
        self._remove.disabled = row is None
        name = "Click an obstacle." if row is None else f"Selected: {shapes[row].name or f'obstacle {row}'}"
        self._selected.content = NOTE.format(html.escape(name))

    def _build_results(self) -> None:
        gui = self._gui
        panel = gui.add_panel()
        with panel.add_tab("Decision"):
            self._table = gui.add_html("")
            self._pick = gui.add_button_group("Show", ("#1",), visible=False)
            self._pick.on_click(lambda event: self._act("pick", int(event.target.value[1:]) - 1))
            unit = "m/s³" if self._arena.task.space.of_hand else "rad/s³"
            titles = "speed of the hand [m/s]", f"jerk of the plan [{unit}]", "clearance [mm]"
            for name, title in zip(("speed", "jerk", "clearance"), titles, strict=True):
                self._plots[name] = gui.add_uplot(
                    (np.zeros(2), np.zeros(2), np.zeros(2)), LINES, title=title, height=126,
                    scales={"x": {"time": False}}, legend={"show": False}, cursor={"show": True},
                    axes=({"size": 30}, {"size": 46}), padding=(10, 10, 0, 0),
                )  # fmt: skip
            gui.add_html(NOTE.format("time [s]; solid: plan, dashed: executed"))
        with panel.add_tab("Methods"):
            self._methods = gui.add_html("")
            self._button("Compare in this scene", "compare")
        panel.dock_left()
        panel.set_width(WIDTH)

    def _build_controls(self, scene_kinds: Iterable[str]) -> None:
        gui, arena, act = self._gui, self._arena, self._act
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH - 20)
        arm, agent = arena.task.arm, arena.agent
        title = arena.env_id.removeprefix("viapoint/") + (f", {arm.name}" if arm.file else "")
        decides = "no agent" if agent is None else f"agent: {type(agent).__name__}"
        gui.add_html(NOTE.format(f"<b>{html.escape(title)}</b><br>{decides}"))
        self._message = gui.add_html("")
        self._execute = self._button("Execute", "execute", color="green", icon="player-play")
        with gui.add_folder("Scene"):
            kinds = gui.add_button_group("", (*scene_kinds, RESET))
            kinds.on_click(lambda event: act("go_to", event.target.value))
        with gui.add_folder("Decision"):
            self._build_decision()
        with gui.add_folder("Obstacles"):
            self._selected, self._sizes = gui.add_html(""), {}
            for name, (*_, least, most) in SIZES.items():
                label = f"{name.capitalize()} [m]"
                self._sizes[name] = gui.add_slider(label, least, most, 0.001, least, visible=False)
                _on_slide(self._sizes[name], functools.partial(act, "resize", name))
            shapes = gui.add_button_group("Add", tuple(arena.new_shapes()))
            shapes.on_click(lambda event: act("add", event.target.value))
            self._remove = self._button("Remove the selected one", "remove", disabled=True)
        hint = "Rings turn the selected obstacle, or the tool at the goal"
        turn = gui.add_checkbox("Turn", False, hint=hint)
        turn.on_update(lambda event: act("show", "turning", event.target.value))
        with gui.add_folder("Files", expand_by_default=False):
            self._button("Save scene (JSON)", "save")
            upload = gui.add_upload_button("Load scene (JSON)", mime_type="application/json")
            upload.on_upload(lambda event: act("load", event.target.value.content))
            self._button("Copy as Python", "show_code")
            self._button("Save picture (PNG)", "save_picture")
        drag = "Drag start, goal, via-point and obstacles with the mouse."
        gui.add_html(NOTE.format(drag + ("" if arena.planar else " Hold Shift to move them up and down.")))

    def _build_decision(self) -> None:
        gui, act, arena, action = self._gui, self._act, self._arena, self._arena.task.action
        anew: dict[str, Any] = {"by_hand": None, "duration": None, "n_via": None}
        low, high = action.duration_range if arena.task.space.of_hand else (0.3, 12.0)
        self._duration = gui.add_slider("Duration [s]", low, high, 0.01, (low * high) ** 0.5)
        _on_slide(self._duration, lambda value: act("change", duration=value))
        methods = gui.add_dropdown("Method", arena.methods, hint="Decides after each change of the scene")
        methods.on_update(lambda event: act("change", method=event.target.value, **anew))
        most = action.n_via if arena.task.replanning else max(3, action.n_via)
        self._vias = gui.add_slider("Via-points", 0, most, 1, action.n_via, disabled=most == action.n_via)
        _on_slide(self._vias, lambda value: act("change", n_via=value, by_hand=None))
        if hasattr(arena.policy, "checks"):
            hint = "Proposals whose clearance is computed"
            checks = gui.add_dropdown("Exact checks", tuple(CHECKS), hint=hint)
            checks.on_update(lambda event: act("change", checks=CHECKS[event.target.value]))
        gui.add_button("Decide anew").on_click(lambda _: act("change", **anew))

    def _button(self, label: str, name: str, **kwargs: Any) -> Any:
        """Add a button that calls what is done under a name."""
        button = self._gui.add_button(label, **kwargs)
        button.on_click(lambda _: self._act(name))
        return button


def _on_slide(slider: Any, function: Callable[[Any], None]) -> None:
    """Call a function with the values that a user gives a slider; a number that is typed may lie outside."""

    def call(event: Any) -> None:
        if event.client is not None:  # otherwise the page itself has set it
            function(min(max(slider.value, slider.min), slider.max))

    slider.on_update(call)


def _table(names: Iterable[str], rows: Iterable[Iterable[str]], bold: int = -1) -> str:
    """Return an HTML table, with one row in bold."""
    lines = ["".join(f'<th style="font-weight:500;color:#6b7078">{name}</th>' for name in names)]
    for i, row in enumerate(rows):
        cell = f'<td style="font-weight:{700 if i == bold else 400}">'
        lines.append("".join(f"{cell}{html.escape(each)}</td>" for each in row))
    body = "".join(f'<tr style="border-top:1px solid #e6e6e3;text-align:right">{line}</tr>' for line in lines)
    return f'<table style="width:100%;padding:0 0.7em;font-size:0.8em">{body}</table>'


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _millimetres(length: float) -> str:
    if length < -1.0:
        return "out of reach"
    return "far" if length >= 0.999 else f"{1e3 * length:.0f}"
