"""Panels of the live page in one tab: what is decided on the left, what can be changed on the right."""

from __future__ import annotations

import functools
import html
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.training.live.obstacle_editing import BOX_SIZES, KINDS

if TYPE_CHECKING:
    import viser

    from viapoint.training.live.comparison import MethodResult
    from viapoint.training.live.decisions import Proposal
    from viapoint.training.live.movements import Profile
    from viapoint.training.live.setting import Setting

WIDTH = 330
"""Width of a panel, [pixels]."""
PLOT_HEIGHT = 126
"""Height of a plot, [pixels]."""
SHOWN_CLEARANCE = 0.25
"""Greatest clearance in the plot, [m]."""
SPEEDS = {"1 x": 1.0, "1/2 x": 0.5, "1/4 x": 0.25}
"""Speeds of the playback."""
JOINT_DURATIONS = 0.3, 12.0
"""Least and greatest duration of the slider in joint space, [s]."""
MOST_VIAS = 4
"""Greatest number of via-points of the slider."""
RESET = "Reset"
"""Name of the button that undoes all changes of a scene."""
CHECKS = {"none": 0, "16": 16, "64": 64}
"""Numbers of proposals that the agent checks with computed geometry."""
GOOD, BAD, PLAIN = "#1b7f4b", "#c4202b", "#4a4f58"
"""Colours of messages."""


class Panels:
    """Panels of one tab.

    Args:
        client: Tab.
        setting: Setting of the agent.
        env_id: Id of the environment.
        scene_kinds: Names of the buttons that draw scenes.
        act: Function that is called with the name of a control and its values.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        setting: Setting,
        env_id: str,
        scene_kinds: Sequence[str],
        act: Callable[..., None],
    ) -> None:
        self._gui, self._setting, self._act = client.gui, setting, act
        self._task = setting.task
        self._quiet = False
        self._build_decision()
        self._build_controls(env_id, scene_kinds)

    def tell(self, text: str, colour: str = PLAIN, remark: str = "") -> None:
        """Show one sentence, and a remark on the scene below it."""
        self._message.content = (
            f'<div style="min-height:4.2em"><div id="viapoint-message" style="padding:0.2em 0.9em;color:{colour};'
            f'font-size:0.9em;line-height:1.35">{html.escape(text)}</div>{_note(remark) if remark else ""}</div>'
        )

    def show_proposals(self, proposals: Sequence[Proposal], picked: int, maker: str, seconds: float) -> None:
        """Show the table of proposals, the picked one in bold."""
        rows = [
            (
                "you" if not each.rank else str(each.rank),
                ("fails" if not each.clear else "-") if each.reward is None else f"{each.reward:.2f}",
                "-" if each.predicted is None else f"{each.predicted:.2f}",
                _millimetres(each.clearance) if each.reachable else "out of reach",
                f"{each.duration:.2f}",
            )
            for each in proposals
        ]
        self._pick.visible = len(proposals) > 1
        if not proposals:
            self._table.content = _note("There is no plan in this scene.")
            return
        names = ("rank", "reward", "agent's value", "clearance", "time")
        units = ("", "", "", "mm", "s")
        self._table.content = _table(names, units, rows, bold=picked) + _note(
            f"{maker}, decided in {1e3 * seconds:.0f} ms"
        )
        options = tuple("you" if not each.rank else f"#{each.rank}" for each in proposals)
        if tuple(self._pick.options) != options:
            self._pick.options = options

    def show_plots(self, plan: Profile | None, executed: Profile | None) -> None:
        """Show speed, jerk and clearance of a plan and of its execution."""
        for name, handle in self._plots.items():
            lines = [] if plan is None else [(plan.time, getattr(plan, name), "plan", PALETTE.plan)]
            if executed is not None and name != "jerk":
                lines.append((executed.time, getattr(executed, name), "executed", PALETTE.executed))
            data, series = _lines(lines)
            if name == "clearance" and lines:
                data = (data[0], *(np.minimum(1e3 * y, 1e3 * SHOWN_CLEARANCE) for y in data[1:]))
            if len(handle.series) != len(series):
                handle.data, handle.series = data, series
            else:
                handle.data = data

    def show_comparison(self, results: Sequence[MethodResult], *, running: str = "") -> None:
        """Show the table of methods; `running` names the one whose result is to come."""
        rows = [
            (
                each.name, "yes" if each.success else "no", f"{each.reward:.2f}", _millimetres(each.clearance),
                f"{each.jerk_ratio:.2f}", f"{1e3 * each.seconds:.0f}",
            )
            for each in results
        ]  # fmt: skip
        names = ("method", "success", "reward", "clearance", "jerk", "decided in")
        note = (
            f"{running} ..."
            if running
            else "Each row is simulated. Jerk is relative to the straight movement."
        )
        if not rows and not running:
            note = "Press the button to let other methods decide in this scene."
        head = _table(names, ("", "", "", "mm", "", "ms"), rows) if rows else ""
        self._methods.content = head + _note(note)

    def show_decided(self, duration: float | None, n_via: int) -> None:
        """Set the sliders to a decision; None leaves the duration as the user has set it."""
        self._quiet = True
        try:
            slider = self._duration
            if duration is not None:
                slider.value = float(np.clip(round(duration, 2), slider.min, slider.max))
            self._vias.value = n_via
        finally:
            self._quiet = False

    def show_selected(self, name: str, values: dict[str, float] | None) -> None:
        """Show the size of the selected obstacle; None if none is selected."""
        self._quiet = True
        try:
            for key, slider in self._sizes.items():
                slider.visible = values is not None and key in values
                if values is not None and key in values:
                    slider.value = float(np.clip(values[key], slider.min, slider.max))
            self._remove.disabled = values is None
            self._selected.content = _note(
                f"Selected: {name}" if values is not None else "Click an obstacle."
            )
        finally:
            self._quiet = False

    def show_running(self, *, running: bool) -> None:
        """Change the button of the execution."""
        self._execute.label = "Stop" if running else "Execute"

    def show_code(self, code: str) -> None:
        """Show Python code with a button that copies it."""
        with self._gui.add_modal("This scene in Python") as modal:
            escaped = html.escape(code)
            self._gui.add_html(
                f'<pre id="viapoint-code" style="background:#f5f5f2;padding:1em;border-radius:6px;overflow:auto;'
                f'font-size:0.82em;max-height:26em">{escaped}</pre>'
                "<button onclick=\"const code=document.getElementById('viapoint-code').textContent;"
                "const done=()=>{this.textContent='Copied'};"
                "navigator.clipboard?navigator.clipboard.writeText(code).then(done):done()"
                '" style="padding:0.5em 1.2em;margin-bottom:0.8em;border:0;border-radius:6px;background:#2f6fb3;'
                'color:white;cursor:pointer">Copy</button>'
            )
            self._gui.add_button("Close").on_click(lambda _: modal.close())

    @property
    def speed(self) -> float:
        """Speed of the playback."""
        return SPEEDS[self._speed.value]

    def _build_decision(self) -> None:
        gui, act = self._gui, self._act
        panel = gui.add_panel()
        with panel.add_tab("Decision"):
            self._table = gui.add_html("")
            self._pick = gui.add_button_group("Show", ("#1",), visible=False)
            self._pick.on_click(lambda event: act("pick", list(self._pick.options).index(event.target.value)))
            self._plots = {
                name: gui.add_uplot(
                    *_lines(()), title=title,
                    height=PLOT_HEIGHT, scales={"x": {"time": False}}, legend={"show": False},
                    cursor={"show": True}, axes=({"size": 30}, {"size": 46}), padding=(10, 10, 0, 0),
                )
                for name, title in (
                    ("speed", "speed of the hand [m/s]"),
                    ("jerk", f"jerk of the plan [{'m' if self._task.space.of_hand else 'rad'}/s³]"),
                    ("clearance", "clearance [mm]"),
                )
            }  # fmt: skip
            blue, dark = (_css(each) for each in (PALETTE.plan, PALETTE.executed))
            gui.add_html(
                f'<div style="padding:0 0.9em;font-size:0.8em;color:#4a4f58">time [s] &nbsp; <b style="color:{blue}">'
                f'plan</b> &nbsp; <b style="color:{dark}">executed</b></div>'
            )
        with panel.add_tab("Methods"):
            self._methods = gui.add_html("")
            gui.add_button("Compare in this scene").on_click(lambda _: act("compare"))
        panel.dock_left()
        panel.set_width(WIDTH)
        self.show_comparison(())

    def _build_controls(self, env_id: str, scene_kinds: Sequence[str]) -> None:
        gui, setting, act = self._gui, self._setting, self._act
        title = env_id.removeprefix("viapoint/")
        if setting.task.arm.file:
            title += f", {setting.task.arm.name}"
        subtitle = "no agent"
        if setting.agent is not None:
            subtitle = f"agent: {type(setting.agent).__name__}"
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH - 20)
        gui.add_html(
            f'<div style="padding:0 0.9em"><div style="font-weight:600">{html.escape(title)}</div>'
            f'<div style="font-size:0.82em;color:#6b7078">{html.escape(subtitle)}</div></div>'
        )
        self._message = gui.add_html("")
        self.tell("Getting ready.")
        self._execute = gui.add_button("Execute", color="green", icon="player-play")
        self._execute.on_click(lambda _: act("execute"))
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1/2 x")
        with gui.add_folder("Scene"):
            kinds = gui.add_button_group("", (*scene_kinds, RESET))
            kinds.on_click(lambda event: act("scene", event.target.value))
        with gui.add_folder("Decision"):
            self._build_decision_controls()
        if not setting.planar:
            turn = gui.add_checkbox("Turn the goal", False, hint="Rings turn the tool at the goal")
            turn.on_update(lambda event: act("rings", event.target.value))
        with gui.add_folder("Obstacles"):
            self._build_obstacle_controls()
        with gui.add_folder("Files", expand_by_default=False):
            gui.add_button("Save scene (JSON)").on_click(lambda _: act("save"))
            upload = gui.add_upload_button("Load scene (JSON)", mime_type="application/json")
            upload.on_upload(lambda event: act("load", event.target.value.content))
            gui.add_button("Copy as Python").on_click(lambda _: act("code"))
            gui.add_button("Save picture (PNG)").on_click(lambda _: act("picture"))
        gui.add_button("Reset the view").on_click(lambda _: act("view"))
        drag = "Drag start, goal, via-point and obstacles with the mouse."
        drag += "" if setting.planar else " Hold Shift to move them up and down."
        gui.add_html(_note(drag))

    def _build_decision_controls(self) -> None:
        gui, act, setting, action = self._gui, self._act, self._setting, self._task.action
        low, high = action.duration_range if self._task.space.of_hand else JOINT_DURATIONS
        self._duration = gui.add_slider("Duration [s]", low, high, 0.01, (low * high) ** 0.5)
        self._duration.on_update(self._unless_quiet(lambda event: act("duration", event.target.value)))
        method = gui.add_dropdown("Method", setting.methods, hint="Decides after each change of the scene")
        method.on_update(lambda event: act("method", event.target.value))
        most = action.n_via if self._task.replanning else max(MOST_VIAS, action.n_via)
        self._vias = gui.add_slider("Via-points", 0, most, 1, action.n_via)
        self._vias.disabled = most == action.n_via
        self._vias.on_update(self._unless_quiet(lambda event: act("vias", int(event.target.value))))
        if self._setting.decisions.checks:
            checks = gui.add_dropdown(
                "Exact checks", tuple(CHECKS), hint="Proposals whose clearance is computed"
            )
            checks.on_update(lambda event: act("checks", CHECKS[event.target.value]))
        gui.add_button("Decide anew").on_click(lambda _: act("decide"))

    def _build_obstacle_controls(self) -> None:
        gui, act, setting = self._gui, self._act, self._setting
        self._selected = gui.add_html("")
        bounds = {"radius": (0.01, 0.1, 0.001), "half-length": (0.0, 0.3, 0.005)}
        bounds |= dict.fromkeys(BOX_SIZES, (0.005, 0.5, 0.005))
        bounds |= {"heading": (-90.0, 90.0, 1.0), "elevation": (-90.0, 90.0, 1.0)}
        units = {**dict.fromkeys(bounds, "m"), "heading": "deg", "elevation": "deg"}
        self._sizes = {
            name: gui.add_slider(f"{name.capitalize()} [{units[name]}]", *limits, limits[0], visible=False)
            for name, limits in bounds.items()
        }
        for name, slider in self._sizes.items():
            resize = functools.partial(act, "resize", name)
            slider.on_update(self._unless_quiet(lambda event, resize=resize: resize(event.target.value)))  # type: ignore[misc]
        add = gui.add_button_group("Add", tuple(KINDS[setting.planar]))
        add.on_click(lambda event: act("add", event.target.value))
        self._remove = gui.add_button("Remove the selected one", disabled=True)
        self._remove.on_click(lambda _: act("remove"))
        self.show_selected("", None)

    def _unless_quiet(self, function: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that ignores changes made by the page itself."""

        def callback(event: Any) -> None:
            if event.client is not None and not self._quiet:
                function(event)

        return callback


def _lines(lines: Sequence[tuple[Any, Any, str, Colour]]) -> tuple[Any, Any]:
    """Return data and series of a plot with lines on one common time axis."""
    if not lines:
        return (np.zeros(2), np.zeros(2)), ({"label": "time"}, _series("nothing", PALETTE.plan))
    time = max((line[0] for line in lines), key=lambda each: float(each[-1]))
    columns = [np.interp(time, x, y) for x, y, *_ in lines]
    series = [_series(label, colour) for *_, label, colour in lines]
    return (time, *columns), ({"label": "time"}, *series)


def _series(label: str, colour: Colour) -> dict[str, Any]:
    line: dict[str, Any] = {"label": label, "stroke": _css(colour), "width": 2, "points": {"show": False}}
    return line | ({"dash": (6, 5)} if label == "executed" else {})


def _table(
    names: Sequence[str], units: Sequence[str], rows: Sequence[Sequence[str]], bold: int | None = None
) -> str:
    """Return a table as HTML."""
    cell = "padding:0.28em 0.35em;text-align:right;vertical-align:bottom"
    head = "".join(
        f'<th style="{cell};font-weight:500;color:#6b7078">{name}{f" [{unit}]" if unit else ""}</th>'
        for name, unit in zip(names, units, strict=True)
    )
    body = "".join(
        f'<tr style="border-top:1px solid #e6e6e3;{"font-weight:700" if i == bold else ""}">'
        + "".join(f'<td style="{cell}">{html.escape(value)}</td>' for value in row)
        + "</tr>"
        for i, row in enumerate(rows)
    )
    return (
        "<style>.viapoint-table tbody tr:hover{background:#fbf8b4}</style>"
        '<div style="padding:0.2em 0.7em"><table class="viapoint-table" '
        'style="width:100%;border-collapse:collapse;font-size:0.8em;'
        f'line-height:1.25"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def _note(text: str) -> str:
    return f'<div style="padding:0.2em 0.9em;font-size:0.8em;color:#6b7078">{html.escape(text)}</div>'


def _millimetres(length: float) -> str:
    return "far" if length >= 0.999 else f"{1e3 * length:.0f}"


def _css(colour: Colour) -> str:
    return "#" + "".join(f"{round(255 * each):02x}" for each in colour)
