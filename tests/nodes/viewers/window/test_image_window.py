"""The keyboard's window, on a real X server: keys, focus, images, closing and doing without."""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from events import Image
from nodes.viewers.window import ImageWindow
from runtime.testing import run_node
from tests.nodes.viewers.window.display import (
    KEYBOARD,
    Display,
    Message,
    Run,
    eventually,
    start,
    without_display,
)
from tests.nodes.viewers.window.window_run import BLUE, GREEN, RED, WHITE

PAINTER = {"name": "painter", "type": "tests.nodes.viewers.window.window_run:Painter"}
STUBBORN = {"name": "stubborn", "type": "tests.nodes.viewers.window.window_run:Stubborn"}

Begin = Callable[..., Run]


@pytest.fixture
def begin(display: Display, request: pytest.FixtureRequest) -> Iterator[Begin]:
    """Return what starts a run, whose window has the test's name and the keyboard."""
    with contextlib.ExitStack() as runs:

        def make(*nodes: Message, **keyboard: str) -> Run:
            run = runs.enter_context(Run(display, request.node.name, *nodes, keyboard=keyboard))
            run.wait_for("begun")
            run.focus()
            return run

        yield make


@pytest.fixture(scope="module")
def shared(display: Display) -> Iterator[Run]:
    """A run that several tests use one after the other."""
    with Run(display, "shared", PAINTER) as run:
        run.wait_for("begun")
        run.focus()
        yield run


@pytest.mark.slow
def test_keys_held_together_are_both_down_until_each_comes_up(shared: Run) -> None:
    """Two keys at once are two presses, and one coming up leaves the other held."""
    shared.heard.clear()
    shared.keys("keydown", "w", "keydown", "Shift_L")
    shared.wait_for("KeyPressed", key="left_shift")
    shared.keys("keyup", "w")
    shared.wait_for("KeyReleased", key="w")
    assert [(m["event"], m["key"]) for m in shared.heard] == [
        ("KeyPressed", "w"),
        ("KeyPressed", "left_shift"),
        ("KeyReleased", "w"),
    ]
    shared.keys("keyup", "Shift_L")
    shared.wait_for("KeyReleased", key="left_shift")


@pytest.mark.slow
def test_a_held_key_is_not_repeated(shared: Run) -> None:
    """What the X server repeats while a key is held is told once."""
    shared.heard.clear()
    shared.keys("keydown", "a")
    # The server repeats keys in real time: after 50 ms, and then every 10 ms.
    time.sleep(0.3)
    shared.keys("keyup", "a")
    shared.wait_for("KeyReleased", key="a")
    assert [m["event"] for m in shared.heard] == ["KeyPressed", "KeyReleased"]


@pytest.mark.parametrize(
    ("keysym", "name"),
    [
        *[("7", "7"), ("space", "space"), ("Left", "left"), ("Prior", "page_up"), ("F5", "f5")],
        *[("Escape", "escape"), ("KP_Add", "kp_add"), ("comma", "comma"), ("Alt_L", "left_alt")],
        ("105", "right_control"),  # by its code: xdotool would press the left one
    ],
)
def test_keys_have_the_names_that_events_promise(shared: Run, keysym: str, name: str) -> None:
    """Keys of every group come with their documented names."""
    shared.heard.clear()
    shared.keys("key", keysym)
    shared.wait_for("KeyReleased")
    assert [m["key"] for m in shared.heard] == [name, name]


def test_losing_the_focus_releases_what_is_held(shared: Run, display: Display) -> None:
    """A key that comes up elsewhere is not left stuck, and is not told a second time later."""
    shared.heard.clear()
    shared.keys("keydown", "d", "keydown", "123")  # louder: a key that GLFW has no name for
    shared.wait_for("KeyPressed", key="scancode_123")
    display.take_focus_away()
    shared.wait_for("KeyReleased")
    shared.wait_for("KeyReleased")
    assert {m["key"] for m in shared.heard[-2:]} == {"d", "scancode_123"}
    shared.keys("keyup", "d", "keyup", "123")
    shared.focus()
    shared.heard.clear()
    shared.keys("key", "x")
    shared.wait_for("KeyReleased")
    assert [m["key"] for m in shared.heard] == ["x", "x"]


def test_images_are_shown_right_side_up_and_in_their_colours(shared: Run, display: Display) -> None:
    """Each quadrant of the image is where it belongs, with black above and below it."""
    shared.keys("windowsize", str(shared.window), "400", "300")
    resized = shared.wait_for("WindowResized")
    assert (resized["width"], resized["height"]) == (400, 300)
    # 160 x 80 into 400 x 300: 400 x 200, from row 50 to row 249
    expected = {(25, 200): (0, 0, 0), (275, 200): (0, 0, 0)}
    expected |= {(53, 3): RED, (53, 396): GREEN, (246, 3): BLUE, (246, 396): WHITE}

    def shown() -> bool:
        screen = display.pixels()
        return all(tuple(screen[place]) == colour for place, colour in expected.items())

    assert eventually(shown), {place: display.pixels()[place] for place in expected}


@pytest.mark.slow
def test_grey_images_of_odd_width_are_shown(begin: Begin, display: Display) -> None:
    """A grey image whose rows are no multiple of four bytes is grey and not sheared."""
    begin(PAINTER | {"encoding": "mono8", "width": 161, "height": 121})

    def shown() -> bool:
        screen = display.pixels()
        places = [(3, 3), (3, 636), (476, 3), (476, 636), (200, 300), (200, 340)]
        values = [tuple(screen[place]) for place in places]
        return values == [RED[:1] * 3, (0,) * 3, (0,) * 3, WHITE, RED[:1] * 3, (0,) * 3]

    assert eventually(shown), np.unique(display.pixels()[:480, :640].reshape(-1, 3), axis=0)


@pytest.mark.slow
def test_an_image_that_cannot_be_shown_is_an_error(display: Display) -> None:
    """Four channels end the run with what was expected and found."""
    with Run(display, "four channels", PAINTER | {"encoding": "rgba8"}) as run:
        error = run.wait_for("failed")["error"]
    assert "expected a uint8 image of shape (height, width, 3) or (height, width)" in error
    assert "found uint8 of shape (80, 160, 4)" in error


@pytest.mark.slow
def test_letters_are_those_of_the_layout(begin: Begin, display: Display) -> None:
    """On a German keyboard z is the key marked z, and ü goes by its place."""
    display.call("setxkbmap", "de")
    try:
        run = begin()
        for keysym, name in [("z", "z"), ("y", "y"), ("udiaeresis", "left_bracket"), ("w", "w")]:
            run.keys("key", keysym)
            assert run.wait_for("KeyPressed")["key"] == name
    finally:
        display.call("setxkbmap", "us")


@pytest.mark.slow
def test_closing_the_window_ends_the_run(begin: Begin, display: Display) -> None:
    """The cross of the window ends the run in order, held keys released."""
    run = begin()
    run.keys("keydown", "w")
    run.wait_for("KeyPressed", key="w")
    display.ask_to_close(run.window)
    run.wait_for("WindowClosed", source="keyboard")
    run.wait_for("KeyReleased", key="w")
    assert run.wait_for("ended")["reason"] == "keyboard: WindowClosed"
    display.call("xdotool", "keyup", "w")


@pytest.mark.slow
def test_a_node_may_keep_the_window_open(begin: Begin, display: Display) -> None:
    """Where WindowClosed is handled, window and run go on, and each click is told."""
    run = begin(STUBBORN)
    for _ in range(2):
        display.ask_to_close(run.window)
        run.wait_for("WindowClosed")
    run.keys("key", "w")
    run.wait_for("KeyReleased", key="w")


@pytest.mark.slow
def test_keys_are_released_when_the_window_dies(begin: Begin, display: Display) -> None:
    """A window whose process is killed leaves no key held, and the others run on."""
    run = begin(on_error="drop")
    run.keys("keydown", "w")
    run.wait_for("KeyPressed", key="w")
    run.kill_window()
    run.wait_for("KeyReleased", key="w")
    display.call("xdotool", "keyup", "w")
    run.end()
    assert run.wait_for("ended")["reason"] == "SIGTERM"


@pytest.mark.slow
def test_images_of_two_cameras_are_warned_of_once(
    display: Display, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """On simulated time, too: who sees two cameras take turns is told how to narrow them."""
    monkeypatch.setenv("DISPLAY", display.name)
    grey = np.zeros((4, 4), np.uint8)
    images = [
        Image(stamp=n * 100_000_000, source=source, frame_id="camera", encoding="mono8", data=grey)
        for n, source in enumerate(["left", "right", "left", "right"])
    ]
    run_node(ImageWindow, inputs=images, name="keyboard")
    warnings = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert warnings == [
        "images of left and right alternate; select one camera in the file: "
        'inputs = { images = "right" }'
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "message"),
    [({}, "DISPLAY is not set"), ({"DISPLAY": ":4711"}, "DISPLAY=:4711, X11: Failed to open")],
)
def test_without_a_display_one_line_says_what_to_do(settings: dict[str, str], message: str) -> None:
    """No display is an error in one line, which says what was found and how to do without."""
    run = start(without_display() | settings, KEYBOARD)
    output, _ = run.communicate(timeout=30)
    error = json.loads(output.splitlines()[-1])["error"]
    assert run.returncode == 2
    assert "expected a display (X11 or Wayland), found none" in error
    assert message in error
    assert "xvfb-run" in error
    assert "\n" not in error
