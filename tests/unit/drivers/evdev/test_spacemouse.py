"""A SpaceMouse: its directions, and the meaning of silence in its two modes."""

from __future__ import annotations

import time

import pytest
from evdev_kit import FakeInput, FakeNode, MakePad, poll, poll_until

import hal
from hal.config.mapping import load_mapping
from hal.drivers.evdev.pad import EvdevPad
from hal.gamepad import Gamepad
from hal.pads.codes import ABS, BUS_USB, EV_ABS, EV_KEY, EV_REL, EV_SYN, KEY, REL, SYN_DROPPED
from hal.pads.mapper import REL_SILENCE, AxisRange
from hal.pads.model import Identity, guess_model
from hal.servo.watchdog import SILENCE
from hal.types import CAP_AXES

COMPACT = Identity("3Dconnexion SpaceMouse Compact", 0x256F, 0xC635, BUS_USB, "hid-generic")
BUTTONS = [KEY["BTN_0"], KEY["BTN_1"]]
LEFT = KEY["BTN_0"]


def rel_node(number: int = 3) -> FakeNode:
    return FakeNode(f"/dev/input/event{number}", {}, BUTTONS, REL.values())


def abs_node() -> FakeNode:
    return FakeNode("/dev/input/event3", {code: AxisRange(-350, 350) for code in range(6)}, BUTTONS)


def moved(pad: EvdevPad) -> dict[str, float]:
    return {name: value for name, value in poll(pad).axes.items() if value}


@pytest.mark.parametrize("mode", ["REL", "ABS"])
@pytest.mark.parametrize(
    ("code", "value", "control", "expected"),
    [
        ("Y", -350, "push_x", 1.0),  # the device's Y points to the user: away is forwards
        ("X", -350, "push_y", 1.0),  # its X points right: to the left
        ("Z", -350, "push_z", 1.0),  # its Z points down: pulled up
        ("RY", -350, "turn_x", 1.0),  # tilted to the right
        ("RX", -350, "turn_y", 1.0),  # tilted forwards
        ("RZ", -350, "turn_z", 1.0),  # turned to the left, seen from above
        ("X", 175, "push_y", -0.5),
        ("RZ", 500, "turn_z", -1.0),  # out of range
    ],
)
def test_pushes_and_turns_are_along_the_axes_of_the_base(mode, code, value, control, expected, system, make_pad):
    node = system.put(rel_node() if mode == "REL" else abs_node(), COMPACT)
    pad = make_pad()
    assert pad.describe() == "SpaceMouse Compact (USB, /dev/input/event3)"
    node.send((EV_REL, REL[f"REL_{code}"], value) if mode == "REL" else (EV_ABS, ABS[f"ABS_{code}"], value))
    assert moved(pad) == {control: pytest.approx(expected)}


def test_silent_axis_counts_as_released_in_rel_mode(system: FakeInput, make_pad: MakePad) -> None:
    """Nothing is sent on release: the arm would move on forever."""
    node = system.put(rel_node(), COMPACT)
    pad = make_pad()
    pressed = time.monotonic()
    node.send((EV_REL, REL["REL_X"], -350), (EV_KEY, LEFT, 1), t=pressed)
    held = poll(pad)
    assert held.axes["push_y"] == 1.0
    released = poll_until(pad, lambda reading: reading.axes["push_y"] == 0.0)
    assert time.monotonic() - pressed >= REL_SILENCE
    assert released.seq > held.seq
    assert released.t > held.t, "the release is an event"
    assert released.buttons == {"l1"}, "buttons report their release"
    assert REL_SILENCE < SILENCE, "shorter than the silence that trips the arm"


def test_each_axis_expires_by_itself(system: FakeInput, make_pad: MakePad) -> None:
    node = system.put(rel_node(), COMPACT)
    pad = make_pad()
    old = time.monotonic() - REL_SILENCE - 0.01
    node.send((EV_REL, REL["REL_X"], -350), t=old)
    node.send((EV_REL, REL["REL_RZ"], -350))
    assert moved(pad) == {"turn_z": 1.0}, "counted from the event, not from its reading"


def test_silence_is_a_steady_hold_in_abs_mode(system: FakeInput, make_pad: MakePad) -> None:
    node = system.put(abs_node(), COMPACT)
    pad = make_pad()
    node.send((EV_ABS, ABS["ABS_X"], -350), t=time.monotonic() - 60.0)
    assert moved(pad) == {"push_y": 1.0}
    end = time.monotonic() + 2.0 * REL_SILENCE
    while time.monotonic() < end:
        assert moved(pad) == {"push_y": 1.0}
        time.sleep(0.01)
    node.send((EV_ABS, ABS["ABS_X"], 0))
    assert moved(pad) == {}


def test_dropped_events_release_the_cap_and_buttons_are_read_again(system: FakeInput, make_pad: MakePad) -> None:
    node = system.put(rel_node(), COMPACT)
    pad = make_pad()
    node.send((EV_REL, REL["REL_X"], -350), (EV_KEY, LEFT, 1))
    assert moved(pad) == {"push_y": 1.0}
    node.send((EV_SYN, SYN_DROPPED, 0), (EV_REL, REL["REL_Y"], -350))
    reading = poll(pad)
    assert (moved(pad), reading.buttons) == ({}, frozenset())


# Behind the public pad.


def drive(pad: Gamepad, node: FakeNode, *events: tuple[int, int, int]) -> None:
    node.send(*events)
    pad.poll_once(time.monotonic())


def settle(pad: Gamepad, limit: float = 10.0) -> None:
    """Poll until the pad's controls count."""
    end = time.monotonic() + limit
    while pad.waiting_for:
        assert time.monotonic() < end, pad.waiting_for
        pad.poll_once(time.monotonic())
        time.sleep(0.005)


def test_cap_pushed_while_plugging_in_must_be_released_first(system: FakeInput, make_pad: MakePad) -> None:
    node = system.put(rel_node(), COMPACT)
    node.speaks = False
    pad = Gamepad(make_pad())
    pad.open(time.monotonic())
    deadman = pad.hold("l1")
    assert pad.waiting_for, "it may be pushed"
    push = (EV_REL, REL["REL_X"], -350)
    end = time.monotonic() + 2.0 * REL_SILENCE
    while time.monotonic() < end:  # held all the time, and the button too
        drive(pad, node, push, (EV_KEY, LEFT, 1))
        assert not any(pad.state().axes.values())
        assert not deadman.held
        time.sleep(0.01)
    settle_from = pad.waiting_for
    assert "push_y" in settle_from
    drive(pad, node, (EV_KEY, LEFT, 0))
    settle(pad)
    drive(pad, node, push, (EV_KEY, LEFT, 1))
    assert (pad.state().axis("push_y"), deadman.held) == (1.0, True)


def test_mapping_moves_the_tool_in_the_direction_of_the_cap() -> None:
    mapping = load_mapping("spacemouse")
    stamp = hal.Stamp(0.0, 0.0, 1)
    twists = [mapping.twist(hal.PadState(stamp, {axis: 1.0}, frozenset(), connected=True)) for axis in CAP_AXES]
    for k, twist in enumerate(twists):
        assert twist[k] > 0.0
        assert sum(map(abs, twist)) == twist[k], "and nowhere else"
    assert mapping.frame == "base"


def test_unknown_cap_is_guessed_like_the_model(system: FakeInput, make_pad: MakePad) -> None:
    stranger = COMPACT._replace(vendor=0x1234, name="ACME Cap")
    node = system.put(rel_node(), stranger)
    pad = make_pad()
    assert pad.notes
    assert (pad.mapping, pad.proves_liveness) == ("spacemouse", False)
    node.send((EV_REL, REL["REL_Z"], -350), (EV_KEY, LEFT, 1))
    assert moved(pad) == {"push_z": 1.0}
    guessed = guess_model(stranger, {}, BUTTONS, REL.values())
    known = next(model for model in pad._models if model.name == "spacemouse")
    assert guessed.axes == {code: axis for code, axis in known.axes.items() if code.startswith("REL")}
    assert guessed.buttons == known.buttons
