"""The page as a gamepad, on the app's side: no event is missed, none is invented, an interruption releases."""

from __future__ import annotations

import math
import threading

import pytest
from errors_kit import raises_code

from hal import registry
from hal.config import load
from hal.config.files import Problems
from hal.config.models import load_pad_models
from hal.driver import PadReading
from hal.drivers.web.pad import PadQueue, WebPad, lost_reading, pad_reading
from hal.errors import ConfigError, NotSupported
from hal.gamepad import Gamepad
from hal.pads.choice import Chosen
from hal.rig import check_opening
from hal.specs import PadSpec
from hal.types import BUTTONS, PAGE_AXES

L2 = 1 << BUTTONS.index("l2")
SOUTH = 1 << BUTTONS.index("south")


class Page:
    """The console as a pad sees it, with a page that does what a test says."""

    def __init__(self) -> None:
        self.queue = PadQueue()
        self.driver: str | None = "page 1"
        self.playing: list[bool] = []
        self.stop_count = 0

    def subscribe(self, hand: str) -> PadQueue:
        return self.queue

    def show_playing(self, on: bool) -> None:
        self.playing.append(on)

    def send(self, t: float, mask: int = 0, **axes: float) -> None:
        values = [axes.get(name, 1.0 if name == "l2" and mask & L2 else 0.0) for name in PAGE_AXES]
        message = {"connected": True, "t": t, "t_alive": t - 0.001, "axes": values, "buttons": mask, "hands": {}}
        self.queue.put(pad_reading(message))

    def leave(self, t: float) -> None:
        self.queue.put(pad_reading({"connected": False, "t": t, "why": "hidden"}))


@pytest.fixture
def page() -> Page:
    return Page()


@pytest.fixture
def pad(page: Page) -> WebPad:
    models = tuple(load_pad_models(Problems()).values())
    pad = WebPad(PadSpec("pad", "web", None, models), page)
    pad.open()
    return pad


def test_axes_and_buttons_have_their_names(page: Page, pad: WebPad) -> None:
    page.send(1.0, SOUTH, left_x=0.5, dpad_y=-1.0)
    found = pad.poll(1.0, 0.0)
    assert found.connected
    assert found.buttons == {"south"}
    assert {name: value for name, value in found.axes.items() if value} == {"left_x": 0.5, "dpad_y": -1.0}
    assert (found.t, found.t_alive) == (0.999, 0.999)


def test_each_hand_holds_a_dead_man_of_its_own() -> None:
    """And neither that of the page, whose controls move neither of them."""
    hand = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0, 0.7)
    message = {"connected": True, "t": 1.0, "t_alive": 1.0, "axes": [0.5] * 16, "buttons": SOUTH}
    message["hands"] = {"left": hand}
    left, right, page = (pad_reading(message, side, "l1") for side in ("left", "right", "any"))
    assert (left.buttons, left.pose, left.axes["r2"], left.axes["left_x"]) == ({"l1", "r2"}, hand[:7], 0.7, 0.0)
    assert (right.connected, right.buttons, right.pose, set(right.axes.values())) == (True, frozenset(), (), {0.0})
    assert (page.buttons, page.pose, page.axes["left_x"]) == ({"south"}, (), 0.5)
    page = pad_reading({**message, "hands": {"any": hand}})
    assert (page.buttons, page.pose, page.axes["r2"]) == ({"south", "r2"}, hand[:7], 0.7)


def test_a_repeated_state_proves_life_and_is_no_event(page: Page, pad: WebPad) -> None:
    page.send(1.0, left_x=0.5)
    first = pad.poll(1.0, 0.0)
    page.send(1.02, left_x=0.5)
    second = pad.poll(1.02, 0.0)
    assert (second.seq, second.t) == (first.seq, first.t)
    assert second.t_alive == pytest.approx(1.019)
    assert pad.poll(1.1, 0.0) == second, "silence proves nothing"
    silent = pad.poll(1.2, 0.0)
    assert (silent.connected, silent.axes["left_x"]) == (False, 0.0), "nor does it push a stick for ever"


def test_every_message_is_handed_out_in_order(page: Page, pad: WebPad) -> None:
    for t, mask in ((1.0, 0), (1.01, SOUTH), (1.02, 0), (1.03, SOUTH)):
        page.send(t, mask)
    pressed = [bool(pad.poll(1.04, 0.0).buttons) for _ in range(4)]
    assert pressed == [False, True, False, True]


def test_an_app_that_is_too_late_sees_an_interruption_and_the_newest(page: Page, pad: WebPad) -> None:
    for k in range(65):
        page.send(1.0 + 0.02 * k, L2)
    found = [pad.poll(2.3, 0.0) for _ in range(2)]
    assert [reading.connected for reading in found] == [False, True]
    assert found[1].t_alive == pytest.approx(1.0 + 0.02 * 64 - 0.001)


def test_a_poll_waits_for_news_and_no_longer(page: Page, pad: WebPad) -> None:
    answers: list[PadReading] = []
    poller = threading.Thread(target=lambda: answers.append(pad.poll(1.0, 30.0)))
    poller.start()
    page.send(1.0, SOUTH)
    poller.join(10.0)
    assert answers[0].buttons == {"south"}


def test_a_page_that_left_while_it_held_must_let_go_before_it_holds_again(page: Page, pad: WebPad) -> None:
    gamepad = Gamepad(pad)
    gamepad.open(0.0)
    deadman = gamepad.hold("l2")

    def after(t: float) -> bool:
        gamepad.poll_once(t)
        return deadman.held

    page.send(1.0)
    assert not after(1.0)
    page.send(1.02, L2)
    assert after(1.02)
    page.leave(1.04)
    page.send(1.05, L2)
    assert not after(1.04)
    assert not deadman.connected
    assert not after(1.05)
    assert not deadman.connected, "every servo must have the time to see that it was lost"
    page.send(1.10, L2)
    assert not after(1.10), "held all through the interruption"
    page.send(1.12)
    assert not after(1.12)
    page.send(1.14, L2)
    assert after(1.14)
    assert deadman.record.presses == 2


def test_it_may_guard_a_real_arm(pad: WebPad) -> None:
    Gamepad(pad).hold("l2").check_trust()


def test_the_tour_plays_and_gives_way(page: Page, pad: WebPad) -> None:
    page.send(1.0)
    assert pad.poll(1.0, 0.0).connected
    pad.play(True)
    assert not pad.poll(1.0, 0.0).connected, "what is held on the page does not hold on in the tour"
    held = []
    for k in range(60):
        page.send(1.0 + 0.05 * k)
        held.append(pad.poll(1.0 + 0.05 * k, 0.0).axes["l2"] > 0.5)
    assert any(held)
    page.send(4.1, SOUTH)
    assert not pad.poll(4.1, 0.0).connected
    assert (page.playing, pad.poll(4.2, 0.0).buttons) == ([True, False], {"south"})
    assert not pad.finished


@pytest.mark.parametrize("end", ["stop", "silence"])
def test_a_stop_and_a_silent_page_end_the_tour(page: Page, pad: WebPad, end: str) -> None:
    page.send(1.0)
    pad.poll(1.0, 0.0)
    pad.play(True)
    pad.poll(1.0, 0.0)
    page.send(1.1)
    assert pad.poll(1.1, 0.0).connected
    if end == "stop":
        page.stop_count += 1
        page.send(1.2)
    assert pad.poll(1.2 if end == "stop" else 1.3, 0.0).connected is False
    page.send(2.0)
    assert pad.poll(2.0, 0.0).buttons == frozenset(), "it does not go on by itself"
    assert page.playing == [True, False]


def test_the_tour_ends_when_its_page_goes_and_when_it_is_over(page: Page, pad: WebPad) -> None:
    for end in (lambda: page.leave(1.1), lambda: pad.play(False)):
        page.send(1.0)
        pad.poll(1.0, 0.0)
        pad.play(True)
        pad.poll(1.0, 0.0)
        pad.poll(1.05, 0.0)
        end()
        assert not pad.poll(1.1, 0.0).connected
        assert page.playing[-1] is False
    page.send(2.0)
    pad.poll(2.0, 0.0)
    pad.play(True)
    pad.poll(2.0, 0.0)
    for t in range(2, 600):
        page.send(float(t))
        pad.poll(float(t), 0.0)
        if not page.playing[-1]:
            break
    assert page.playing[-1] is False, "the recording has an end"


def test_a_rig_without_a_console_is_refused() -> None:
    with raises_code(NotSupported, "no_console"):
        WebPad(PadSpec("pad", "web", None)).open()


def test_a_hand_is_left_or_right() -> None:
    specs = [PadSpec("pad", "web", None, options=options) for options in ({}, {"hand": "left"}, {"hand": "middle"})]
    codes = [[code for *_, code in registry.check_record("web", "gamepad", spec)] for spec in specs]
    assert codes == [[], [], ["unknown_hand"]]


def open_pads(first: dict[str, str], second: dict[str, str]) -> list[Chosen]:
    """Check a rig of two arms that two pads of the page drive."""
    bases = {"left": [0, 0.5, 0], "right": [0, -0.5, 0]}
    arms = {name: {"model": "panda", "base": {"position": at}} for name, at in bases.items()}
    pads = [{"driver": "web", "drives": arm, "options": it} for arm, it in zip(arms, (first, second), strict=True)]
    rig = {"robots": arms, "gamepads": dict(zip(("first", "second"), pads, strict=True))}
    return check_opening(load(rig, sim=True).resolve(), None, "none", False)


def test_a_hand_drives_one_arm_and_the_page_one_at_a_time() -> None:
    right = {"hand": "right"}
    assert [pad.notes for pad in open_pads({}, right)] == [(), ()]
    assert [len(pad.notes) for pad in open_pads({}, {})] == [0, 1]
    with pytest.raises(ConfigError) as refused:
        open_pads(right, right)
    assert [(problem.key, problem.code) for problem in refused.value.problems] == [
        ("gamepads.second.options.hand", "same_hand")
    ]


def test_a_lost_pad_has_nothing_pressed() -> None:
    lost = lost_reading(3.0)
    assert (lost.connected, lost.buttons, set(lost.axes.values())) == (False, frozenset(), {0.0})
    assert lost.t_alive == -math.inf
