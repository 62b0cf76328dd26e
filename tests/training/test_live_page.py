"""The live page in a real browser: decisions follow what a user does, and errors are said on the page."""

import dataclasses
import gc
import time

import numpy as np
import pytest

pytest.importorskip("mjviser", reason="the extra `live` is not installed")

from browser import wait_for
from helpers import JUMPS, PANDA, PLANE
from viser import transforms

from viapoint.envs import Cylinder
from viapoint.training import LivePage
from viapoint.training.live.arena import SEARCH

MESSAGE = "#viapoint-message"
SHIFT, UP = np.array([0.06, 0.08]), np.array([0.0, 0.05])
"""Displacements, [m]."""
UPSTREAM = "Unable to preventDefault inside passive event listener invocation."
"""Message of the library's client at every press on something that can be dragged; it changes nothing."""


@pytest.fixture(scope="module")
def page():
    """Function that opens the page of an environment once, as closing one takes seconds."""
    pages = {}

    def opened(env, seed=1):
        if env not in pages:
            pages[env] = LivePage(env=env, port=0, seed=seed)
        return pages[env]

    yield opened
    for each in pages.values():
        each.close()


@pytest.fixture
def open_tab(browser):
    """Open a tab of a page; all are closed in the end."""
    tabs = []

    def opened(page):
        before = set(page.tabs)
        tabs.append(browser.tab(page.url))
        (session,) = wait_for(lambda: set(page.tabs) - before)
        wait_for(lambda: session.idle and session.state.plan is not None)
        wait_for(lambda: tabs[-1].text(MESSAGE) not in ("", "Getting ready."))
        # The library's notice on software rendering would hide a part of the scene.
        tabs[-1].run("document.querySelector('.mantine-Notification-closeButton')?.click()")
        wait_for(lambda: steady(tabs[-1]))
        return tabs[-1], session

    yield opened
    for each in tabs:
        assert [error for error in each.errors if error != UPSTREAM] == []
        each.close()


def steady(tab):
    """Return True when the panels have found their places."""
    before = tab.canvas()
    time.sleep(0.3)
    return before == tab.canvas()


def settled(session):
    """Wait until the session has seen what the browser sent, and has done it."""
    time.sleep(0.25)
    wait_for(lambda: session.idle)


def on_screen(tab, session, point):
    """Return the pixel at which a point of the world is seen."""
    camera = session.client.camera
    x, y, depth = transforms.SO3(camera.wxyz).as_matrix().T @ (np.resize([*point, 0.0], 3) - camera.position)
    left, top, width, height = tab.canvas()
    scale = 0.5 * height / np.tan(0.5 * camera.fov) / depth
    return float(left + 0.5 * width + scale * x), float(top + 0.5 * height + scale * y)


def drag(tab, session, first, last):
    tab.drag(on_screen(tab, session, first), on_screen(tab, session, last))


def type_into(tab, session, number, text):
    """Type a number into one of the fields beside the sliders, and leave the field."""
    fields = "[...document.querySelectorAll('input[inputmode=decimal], input[inputmode=numeric]')]"
    tab.run(f"(() => {{const e = {fields}[{number}]; e.focus(); e.select()}})()")
    tab.call("Input.insertText", text=text)
    tab.run("document.activeElement.blur()")
    settled(session)
    return float(tab.run(f"{fields}[{number}].value"))


def test_what_a_user_does_changes_the_plan(page, open_tab):
    tab, session = open_tab(page(PLANE))
    hosts = {each.split("/")[2] for each in tab.requests if each.startswith("http")}
    assert hosts == {page(PLANE).url.split("/")[2]}

    before = session.state.plan.duration
    tab.run("document.querySelector('[role=slider]').focus()")
    for _ in range(4):
        tab.press_right()
    settled(session)
    assert session.state.plan.duration == pytest.approx(before + 0.04, abs=0.02)
    tab.press("button", "Decide anew")
    settled(session)
    assert session.state.duration is None

    goal, number = session.state.scene.goal, len(session.latencies)
    drag(tab, session, goal, goal + SHIFT)
    settled(session)
    assert np.linalg.norm(session.state.scene.goal - goal - SHIFT) < 0.01
    assert len(session.latencies) > number
    np.testing.assert_allclose(session.state.plan.waypoints[-1], session.state.scene.goal, atol=1e-6)

    tab.press("button", "Execute")
    wait_for(lambda: "Success" in tab.text(MESSAGE) or "Failure" in tab.text(MESSAGE))
    times, jerk, _ = session._panels._plots["jerk"].data
    rests = times > session.state.plan.duration
    assert rests.any()
    assert not jerk[rests].any()

    tab.press("[role=tab]", "Methods")
    tab.press("button", "Compare in this scene")
    wait_for(lambda: "motion planner" in tab.text("body") and "Each row is simulated" in tab.text("body"))
    settled(session)

    via = np.array(session.state.plan.waypoints[1])
    drag(tab, session, via, via + UP)
    settled(session)
    np.testing.assert_allclose(session.state.plan.waypoints[1], via + UP, atol=0.01)

    start = session.state.scene.start
    obstacle = session.state.scene.obstacles[0].position
    drag(tab, session, obstacle, start)
    settled(session)
    wait_for(lambda: "the start is in contact" in tab.text(MESSAGE))
    assert not session.state.plan.success
    tab.press("button", "wall")
    wait_for(lambda: "half_space" in [each.kind for each in session.state.scene.obstacles])
    tab.press("button", "Reset")
    wait_for(lambda: "in contact" not in tab.text(MESSAGE))
    np.testing.assert_array_equal(session.state.scene.goal, goal)
    np.testing.assert_array_equal(session.state.scene.obstacles[0].position, obstacle)


@pytest.mark.parametrize("text", ["-1", "40"])
def test_numbers_beyond_a_slider_are_its_ends(text, page, open_tab):
    tab, session = open_tab(page(PLANE))
    low, high = session.arena.task.action.duration_range
    duration = type_into(tab, session, 0, text)
    assert duration == pytest.approx(session.state.duration)
    assert session.state.duration in (low, high)
    number = type_into(tab, session, 1, text)
    assert number == session.state.n_via == (1 if text == "-1" else 3)
    assert "must be" not in tab.text(MESSAGE)
    vias = session._panels._vias
    assert (vias.visible, vias.min) == (True, 1)
    session.act("change", method=SEARCH, n_via=None)
    settled(session)
    assert (vias.visible, vias.min, vias.value) == (True, 0, session.arena.task.n_via)


def test_a_scene_without_a_decision_is_not_shown(page, open_tab):
    """A post stands where the target jumps to, which no method can plan for."""
    tab, session = open_tab(page(JUMPS))
    before = session.state
    post = Cylinder(0.02, 0.04, position=(*before.scene.jumps[0][1:], 0.0))
    session.act("change", scene=before.scene.with_obstacle(0, post))
    wait_for(lambda: "jump" in tab.text(MESSAGE))
    assert session.state is before
    tab.press("button", "Random")
    wait_for(lambda: "The plan takes" in tab.text(MESSAGE))
    assert session.state.scene is not before.scene
    session._panels._method.value = SEARCH
    session.state.scene = before.scene.with_obstacle(0, post)
    session.act("compare")
    settled(session)
    assert session._panels._method.value == session.state.method != SEARCH
    assert {movement for *_, movement in session.state.results} == {None}


def test_an_arm_in_space_follows_what_is_dragged_and_turned(page, open_tab):
    tab, session = open_tab(page(PANDA, seed=10))  # a scene in which nothing hides the goal
    arm, goal = session.arena.task.arm, session.state.scene.goal
    place = arm.hand(goal)
    aside = np.array([0.0, 0.03, 0.0])
    drag(tab, session, place, place + aside)
    settled(session)
    moved = arm.hand(session.state.scene.goal) - place
    assert np.abs(moved - aside).max() < 0.01
    assert np.abs(session.state.scene.goal - goal).max() < 0.5  # the nearest posture

    tab.press("label", "Turn")
    settled(session)
    place = arm.hand(session.state.scene.goal)
    turn = transforms.SO3.from_z_radians(0.1) @ transforms.SO3(
        session.arena.orientation(session.state.scene.goal)
    )
    session.act("turn", turn.wxyz)
    settled(session)
    np.testing.assert_allclose(arm.hand(session.state.scene.goal), place, atol=1e-3)
    assert abs(session.arena.orientation(session.state.scene.goal) @ turn.wxyz) == pytest.approx(
        1.0, abs=1e-4
    )


def test_tabs_are_independent_and_leave_nothing_behind(page, open_tab):
    shared = page(PLANE)
    wait_for(lambda: not shared.tabs)
    first, one = open_tab(shared)
    second, two = open_tab(shared)
    goal = two.state.scene.goal
    second.press("button", "Random")
    settled(two)
    assert not np.array_equal(two.state.scene.goal, goal)
    assert np.array_equal(one.state.scene.goal, goal)

    first.call("Page.bringToFront")  # a page in the background is not drawn
    first.press("button", "Random")
    settled(one)
    first.call("Page.reload")
    wait_for(lambda: one not in shared.tabs)
    wait_for(lambda: len(shared.tabs) == 2 and all(each.idle and each.state.plan for each in shared.tabs))
    second.close()
    wait_for(lambda: two not in shared.tabs)
    gc.collect()
    assert len(shared.tabs) == 1


def test_files_are_saved_and_impossible_ones_are_refused(page, open_tab):
    tab, session = open_tab(page(PLANE))
    tab.press("div", "Files")
    time.sleep(0.6)  # it unfolds
    tab.press("button", "Save scene (JSON)")
    wait_for(lambda: list(tab.downloads.glob("*.json")))
    tab.press("button", "Save picture (PNG)")
    (picture,) = wait_for(lambda: list(tab.downloads.glob("*.png")))
    assert picture.read_bytes().startswith(b"\x89PNG")
    tab.press("button", "Copy as Python")
    assert "gym.make(" in wait_for(lambda: tab.text("#viapoint-code"))

    scene = session.state.scene
    first, *others = scene.obstacles
    there = dataclasses.replace(first, position=(*scene.goal, first.position[2]))
    session.act("load", scene._replace(obstacles=(there, *others)).to_json(PLANE).encode())
    wait_for(lambda: "impossible" in tab.text(MESSAGE))
    assert session.state.scene is scene
    session.act("load", scene._replace(goal=scene.goal + 0.01).to_json(PLANE).encode())
    wait_for(lambda: "plan" in tab.text(MESSAGE))
    np.testing.assert_allclose(session.state.scene.goal, scene.goal + 0.01, atol=1e-6)
