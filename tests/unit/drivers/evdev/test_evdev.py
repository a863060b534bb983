"""The evdev driver, with recordings of real kernel drivers under umockdev and with a fake input system."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from evdev_kit import AXES, DS4, MODELS, REST, ROOT, FakeInput, FakeNode, MakePad, poll, poll_until

from hal.drivers.evdev.pad import EvdevPad
from hal.errors import ConfigError, DriverMissing, NotSupported
from hal.gamepad import Gamepad
from hal.pads.codes import ABS, BUS_BLUETOOTH, BUS_USB, EV_ABS, EV_KEY, EV_MSC, EV_SYN, KEY, SYN_DROPPED
from hal.pads.mapper import AxisRange
from hal.pads.model import Identity
from hal.specs import PadSpec

PADS = ROOT / "tests" / "data" / "pads"
XBOX = Identity("Microsoft X-Box 360 pad", 0x045E, 0x028E, BUS_USB, "xpad")


# Recordings of the real kernel drivers.


def replay(name: str, node: str, events: int, folder: Path) -> list[dict[str, Any]]:
    """Return what the driver reports while umockdev plays a recording."""
    if shutil.which("umockdev-run") is None:
        pytest.skip("needs umockdev: sudo apt install umockdev")
    pytest.importorskip("evdev", reason="needs python-evdev: pip install evdev-binary")
    for ending in ("umockdev", "ioctl", "events"):  # umockdev looks for its files beside each other
        shutil.copy(PADS / f"{name}.{ending}", folder)
    command = ["umockdev-run", "-d", f"{name}.umockdev", "-i", f"{node}={name}.ioctl", "-e", f"{node}={name}.events"]
    command += ["--", sys.executable, str(PADS / "read_pad.py"), str(events)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


# The meaning of each code in the recordings, stated independently: (control, value at the least, at the greatest).
STICK_OF = {0: ("left_x", -1, 1), 1: ("left_y", 1, -1), 3: ("right_x", -1, 1), 4: ("right_y", 1, -1)}
BUTTON_OF = {0x134: "west", 0x130: "south", 0x131: "east", 0x133: "north", 0x136: "l1", 0x137: "r1"}
BUTTON_OF |= {0x138: "l2", 0x139: "r2", 0x13A: "select", 0x13B: "start", 0x13D: "l3", 0x13E: "r3"}


def expected_readings(path: Path) -> tuple[int, list[tuple[dict[str, float], list[str]]]]:
    """Return the number of events, and after each report the axes that are not 0 and the buttons."""
    axes: dict[str, float] = {}
    buttons: set[str] = set()
    readings: list[tuple[dict[str, float], list[str]]] = []
    lines = [line.split()[2:] for line in path.read_text().splitlines() if line.startswith("E:")]
    for kind, code, text in lines:
        where, value = (int(kind, 16), int(code, 16)), int(text)
        if where[0] == 3 and where[1] in STICK_OF:
            control, low, high = STICK_OF[where[1]]
            axes[control] = low + (high - low) * value / 255
        elif where == (3, 0x10):
            axes["dpad_x"] = value
        elif where[0] == 1:
            (buttons.add if value else buttons.discard)(BUTTON_OF[where[1]])
        elif where[0] == 0:
            readings.append((dict(axes), sorted(buttons)))
        else:
            assert where == (4, 4), f"unexpected event in the recording: {where}"
    return len(lines), readings


@pytest.mark.parametrize(
    ("name", "node", "events", "title", "flat"),
    [
        ("ds4", "/dev/input/event3", 93, "DualShock 4", 15 / 127.5),
        pytest.param("dualsense", "/dev/input/event4", 64, "DualSense", 0.0, marks=pytest.mark.slow),
    ],
)
def test_recorded_pad_is_read_completely(name, node, events, title, flat, tmp_path):
    found, *readings, end = replay(name, node, events, tmp_path)
    assert (found["describe"], len(found["plugged"])) == (f"{title} (USB, {node})", 1)
    assert (found["notes"], found["trusted"]) == ([], True)
    assert len(found["unknown"]) == 8, "unknown before its first report"
    assert found["flat"]["left_x"] == pytest.approx(flat)
    assert end == {"events": events, "connected": True, "unknown": []}

    recorded, expected = expected_readings(PADS / f"{name}.events")
    assert recorded == events
    assert len(readings) == len(expected), "every report is a reading of its own"
    for reading, (axes, buttons) in zip(readings, expected, strict=True):
        assert reading["buttons"] == buttons
        assert reading["axes"] == pytest.approx(dict.fromkeys(reading["axes"], 0.0) | axes, abs=0.005)
    assert {button for _, buttons in expected for button in buttons} == set(BUTTON_OF.values())
    assert max(axes.get("left_x", 0.0) for axes, _ in expected) == 1.0, "to the right"
    assert max(axes.get("right_y", 0.0) for axes, _ in expected) == 1.0, "up"
    assert max(axes.get("dpad_x", 0.0) for axes, _ in expected) == 1.0


# A fake input system.


def test_events_become_readings(system: FakeInput, make_pad: MakePad) -> None:
    node = system.plug(DS4)
    pad = make_pad()
    assert pad.describe() == "DualShock 4 (USB, /dev/input/event3)"
    node.send(*REST, (EV_ABS, ABS["ABS_Y"], 0), (EV_KEY, KEY["BTN_WEST"], 1))
    reading = poll(pad)
    assert reading.connected
    assert (reading.axes["left_y"], reading.buttons) == (1.0, {"west"})
    assert reading.seq == 9, "with the report that it made when it was opened"
    assert not reading.unknown


def test_axes_are_unknown_before_the_first_event(system: FakeInput, make_pad: MakePad) -> None:
    node = system.plug(DS4)
    node.speaks = False
    node.shown = dict.fromkeys(node.shown, 0)  # as hid-sony shows it: full left and up
    reading = poll(make_pad())
    assert set(reading.unknown) == {"left_x", "left_y", "right_x", "right_y", "l2", "r2", "dpad_x", "dpad_y"}
    assert not any(reading.axes.values())


@pytest.mark.parametrize("identity", [DS4, XBOX], ids=["hid-playstation", "xpad"])
def test_deadman_held_while_plugging_in_must_be_released_first(system, make_pad, identity):
    """Both drivers show a pad at rest until its first report, whatever is held: seen with the real ones."""
    node = system.plug(identity)
    node.speaks = False
    pad = Gamepad(make_pad())
    pad.open(time.monotonic())
    deadman = pad.hold("l2")
    for _ in range(3):
        pad.poll_once(time.monotonic())
        assert pad.waiting_for
    full = (EV_ABS, ABS["ABS_Z"], 255)
    for _ in range(3):  # the first report: held already
        node.shown[ABS["ABS_Z"]] = 255
        node.send(full)
        pad.poll_once(time.monotonic())
        assert "l2" in pad.waiting_for
        assert not deadman.held
    node.send((EV_ABS, ABS["ABS_Z"], 0))
    pad.poll_once(time.monotonic())
    assert not deadman.held
    node.send(full)
    pad.poll_once(time.monotonic())
    assert deadman.held, "released and pressed again"


def test_report_of_the_xbox_button_alone_makes_nothing_known(system: FakeInput, make_pad: MakePad) -> None:
    """xpad reports it in a packet of its own; the kernel shows every other control at rest then, whatever is held."""
    node = system.plug(XBOX)
    node.keys |= {KEY["BTN_MODE"]}
    node.speaks = False
    pad = Gamepad(make_pad())
    pad.open(time.monotonic())
    deadman = pad.hold("l2")
    for value in (1, 0):
        node.send((EV_KEY, KEY["BTN_MODE"], value))
        pad.poll_once(time.monotonic())
        assert pad.waiting_for
    node.shown[ABS["ABS_Z"]] = 255
    node.send((EV_ABS, ABS["ABS_Z"], 255))
    pad.poll_once(time.monotonic())
    assert not deadman.held, "it was held from the beginning"


def test_two_gamepads_of_a_program_use_two_pads(make_pad: MakePad, system: FakeInput) -> None:
    """An unplugged pad is not replaced by the one of the other gamepad."""
    first = system.plug(DS4, number=3)
    system.plug(XBOX, number=6, uniq="cc:dd")
    one, two = make_pad(), make_pad()
    assert [poll(pad).connected for pad in (one, two)] == [True, True]
    assert one.describe().endswith("event3)")
    assert two.describe().endswith("event6)")
    system.unplug(first)
    end = time.monotonic() + 10.0
    while not one.notes:
        assert time.monotonic() < end
        assert not poll(one).connected
        assert poll(two).connected
        time.sleep(0.01)


def test_sony_pad_is_known_after_two_reports_of_its_motion_sensor(system: FakeInput, make_pad: MakePad) -> None:
    """A resting pad sends only motion; the first report may be older than the opening."""
    node = system.plug(DS4)
    node.speaks = False
    motion = system.plug(MOTION, number=4, pad=False)
    pad = make_pad()
    motion.send(BEAT)
    assert poll(pad).unknown
    node.shown[ABS["ABS_Z"]] = 255
    motion.send(BEAT)
    reading = poll(pad)
    assert not reading.unknown
    assert reading.axes["l2"] == 1.0, "it is held, and that was no event"


def test_times_are_on_the_clock_of_the_rig(system: FakeInput, make_pad: MakePad) -> None:
    node = system.plug(DS4)
    node.speaks = False
    pad = make_pad()
    node.send(*REST, t=time.monotonic() - 0.05)
    reading = pad.poll(1000.0, 0.0)  # a simulated time
    assert 999.0 < reading.t <= 999.951
    assert 999.9 < reading.t_alive <= 1000.1


def test_state_is_read_again_after_dropped_events(system: FakeInput, make_pad: MakePad) -> None:
    node = system.plug(DS4)
    pad = make_pad()
    node.send(*REST, (EV_KEY, KEY["BTN_SOUTH"], 1))
    assert poll(pad).buttons == {"south"}
    node.shown = {**dict.fromkeys(AXES, 128), ABS["ABS_Y"]: 0, ABS["ABS_HAT0X"]: 1, ABS["ABS_HAT0Y"]: 0}
    node.down = [KEY["BTN_EAST"]]
    # Events between the mark and the next report are void.
    node.send((EV_SYN, SYN_DROPPED, 0), (EV_ABS, ABS["ABS_X"], 255), (EV_KEY, KEY["BTN_NORTH"], 1), whole=False)
    assert poll(pad).buttons == {"south"}
    node.send()
    reading = poll(pad)
    assert reading.buttons == {"east"}
    assert abs(reading.axes["left_x"]) < 0.01
    assert (reading.axes["left_y"], reading.axes["dpad_x"]) == (1.0, 1.0)
    node.send((EV_ABS, ABS["ABS_X"], 255))
    assert poll(pad).axes["left_x"] == 1.0


def test_unreadable_pad_is_noted_and_used_once_it_is_readable(system: FakeInput, make_pad: MakePad) -> None:
    system.plug(DS4)
    system.forbidden.add("/dev/input/event3")
    pad = make_pad()
    assert not poll(pad).connected
    assert len(pad.notes) == 1
    system.allow("/dev/input/event3")  # udev, a moment later
    poll_until(pad, lambda reading: reading.connected)
    assert pad.notes == ()


def test_devices_are_listed_only_after_a_change(system, make_pad, monkeypatch):
    system.plug(DS4)
    system.forbidden.add("/dev/input/event3")
    nodes = Mock(side_effect=system.nodes)
    monkeypatch.setattr(system, "nodes", nodes)
    pad = make_pad()
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        pad.poll(time.monotonic(), 0.01)
    assert nodes.call_count == 1


# Proof of life.


MOTION = DS4._replace(name="Wireless Controller Motion Sensors")
TOUCH = DS4._replace(name="Wireless Controller Touchpad")
BEAT = (EV_MSC, 5, 1)


@pytest.mark.parametrize("bus", [BUS_USB, BUS_BLUETOOTH])
def test_silence_of_the_motion_sensor_ages_the_proof_of_life(system: FakeInput, make_pad: MakePad, bus: int) -> None:
    node = system.plug(DS4._replace(bus=bus))
    motion = system.plug(MOTION._replace(bus=bus), number=4, pad=False)
    system.plug(TOUCH._replace(bus=bus), number=5, pad=False)
    pad = make_pad()
    node.send(*REST)
    poll(pad)
    assert pad.proves_liveness is (bus == BUS_USB)
    assert system.opened == ["/dev/input/event3", "/dev/input/event4", "/dev/input/event5"]
    alive = [pad.poll(now, 0.0).t_alive for now in (100.0, 101.0)]
    assert alive == pytest.approx([100.0, 101.0], abs=0.05)  # no event yet: every poll counts
    motion.send(BEAT)
    assert pad.poll(102.0, 0.0).t_alive == pytest.approx(102.0, abs=0.05)
    assert pad.proves_liveness
    silent = [pad.poll(now, 0.0) for now in (103.0, 104.0)]
    assert all(reading.connected for reading in silent)
    assert [reading.t_alive for reading in silent] == pytest.approx([102.0, 102.0], abs=0.05)
    motion.send(BEAT)
    assert pad.poll(105.0, 0.0).t_alive == pytest.approx(105.0, abs=0.05)


def test_motion_sensor_of_the_same_pad_may_appear_later(system: FakeInput, make_pad: MakePad) -> None:
    system.plug(MOTION._replace(bus=BUS_BLUETOOTH), number=2, uniq="cc:dd", pad=False)
    system.plug(DS4._replace(bus=BUS_BLUETOOTH), number=3)
    pad = make_pad()
    poll(pad)
    assert system.opened == ["/dev/input/event3"]
    motion = system.plug(MOTION._replace(bus=BUS_BLUETOOTH), number=4, pad=False)
    motion.send(BEAT)
    poll_until(pad, lambda _: pad.proves_liveness)
    assert system.opened == ["/dev/input/event3", "/dev/input/event4"]


def test_click_of_the_touchpad_is_a_button(system: FakeInput, make_pad: MakePad) -> None:
    node = system.plug(DS4)
    touch = system.plug(TOUCH, number=5, pad=False)
    touch.down = [KEY["BTN_LEFT"]]
    pad = make_pad()
    node.send(*REST)
    assert poll(pad).buttons == {"touchpad"}, "pressed before it was opened"
    touch.send((EV_KEY, KEY["BTN_LEFT"], 0))
    before = poll(pad)
    touch.send((EV_KEY, KEY["BTN_LEFT"], 1), (EV_ABS, ABS["ABS_X"], 900))
    node.send((EV_KEY, KEY["BTN_SOUTH"], 1))
    reading = poll(pad)
    assert (before.buttons, reading.buttons) == (frozenset(), {"touchpad", "south"})
    assert abs(reading.axes["left_x"]) < 0.01, "the finger's position is not a stick"
    assert reading.seq > before.seq
    touch.down = []
    touch.send((EV_SYN, SYN_DROPPED, 0))
    assert poll(pad).buttons == {"south"}, "read again after a drop"
    system.unplug(touch)
    assert not poll(pad).connected


@pytest.mark.parametrize("hang_up", [True, False])
def test_loss_of_the_motion_sensor_is_loss_of_the_pad(system: FakeInput, make_pad: MakePad, hang_up: bool) -> None:
    node = system.plug(DS4)
    motion = system.plug(MOTION, number=4, pad=False)
    pad = make_pad()
    motion.send(BEAT)
    assert poll(pad).connected
    system.unplug(motion, hang_up=hang_up)
    assert not poll(pad).connected
    assert (node.open_ends, motion.open_ends) == (0, 0)


@pytest.mark.parametrize(
    "identity",
    [
        Identity("Xbox Wireless Controller", 0x045E, 0x02EA, BUS_BLUETOOTH, "microsoft"),
        Identity("Xbox 360 Wireless Receiver", 0x045E, 0x0719, BUS_USB, "xpad"),
        Identity("Unknown pad", 0x1234, 0x5678, BUS_USB, "hid-generic"),
    ],
)
def test_pad_whose_silence_goes_unnoticed_is_no_deadman_of_a_real_arm(system, make_pad, identity):
    system.plug(identity)
    pad = make_pad()
    assert poll(pad).connected
    assert not pad.proves_liveness
    public = Gamepad(pad)
    with pytest.raises(NotSupported):
        public.hold("l2").check_trust()


# Which pad.


def test_other_devices_are_not_opened(system: FakeInput, make_pad: MakePad) -> None:
    system.plug(Identity("Keyboard", 1, 2, BUS_USB, "usbhid"), pad=False)
    pad = make_pad()
    assert (poll(pad).connected, pad.proves_liveness, system.opened) == (False, False, [])


def test_options_choose_the_pad(system: FakeInput, make_pad: MakePad) -> None:
    system.plug(DS4, number=3)
    system.plug(DS4._replace(name="The other one"), number=7, uniq="cc:dd")
    assert make_pad().describe().endswith("event3)")
    other = make_pad(name="OTHER")
    assert other.describe().endswith("event7)")
    other.close()
    assert make_pad(device="/dev/input/event7").describe().endswith("event7)")
    missing = make_pad(device="/dev/input/event9")
    assert not poll(missing).connected


def test_fixed_model_uses_only_pads_that_it_matches(system: FakeInput, make_pad: MakePad) -> None:
    system.plug(DS4)
    (xbox,) = (model for model in MODELS if model["name"] == "xbox_one")
    assert not poll(make_pad(model=xbox)).connected
    system.plug(Identity("Microsoft X-Box One S pad", 0x045E, 0x02EA, BUS_USB, "xpad"), number=8, uniq="")
    assert make_pad(model=xbox).describe() == "Xbox One pad (USB, /dev/input/event8)"


def test_unknown_pad_is_guessed_with_a_note(system: FakeInput, make_pad: MakePad) -> None:
    node = system.plug(Identity("ACME Pad", 0x1234, 0x5678, BUS_USB, "hid-generic"))
    pad = make_pad()
    assert "ABS_X: left_x" in pad.notes[0]
    node.send(*REST, (EV_ABS, ABS["ABS_RX"], 255), (EV_KEY, KEY["BTN_SOUTH"], 1))
    reading = poll(pad)
    assert (reading.axes["right_x"], reading.buttons) == (1.0, {"south"})


F310_D = Identity("Logitech Dual Action", 0x046D, 0xC216, BUS_USB, "logitech")


def test_joystick_is_a_pad_where_a_model_matches_it(system: FakeInput, make_pad: MakePad) -> None:
    axes = {ABS[name]: AxisRange(0, 255, 15) for name in ("ABS_X", "ABS_Y", "ABS_Z", "ABS_RZ")}
    keys = range(KEY["BTN_TRIGGER"], KEY["BTN_BASE6"] + 1)
    wheel = FakeNode("/dev/input/event4", axes, keys)
    system.put(wheel, Identity("A wheel", 0x046D, 0xC29B, BUS_USB, "logitech"), pad=False, joystick=True)
    pad = make_pad()
    assert (poll(pad).connected, pad.notes) == (False, ())
    node = FakeNode("/dev/input/event5", axes, keys)
    system.put(node, F310_D, uniq="", pad=False, joystick=True)
    poll_until(pad, lambda reading: reading.connected)
    assert pad.describe() == "Logitech F310 (D mode) (USB, /dev/input/event5)"
    node.send((EV_ABS, ABS["ABS_RZ"], 0), (EV_KEY, KEY["BTN_THUMB"], 1), (EV_KEY, KEY["BTN_BASE2"], 1))
    reading = poll(pad)
    assert (reading.axes["right_y"], reading.axes["r2"], reading.buttons) == (1.0, 1.0, {"south", "r2"})


def test_unknown_options_are_refused(make_pad: MakePad) -> None:
    with pytest.raises(ConfigError) as caught:
        make_pad(devise="/dev/input/event3")
    assert [(problem.file, problem.key) for problem in caught.value.problems] == [("gamepads.pad", "devise")]


def test_missing_library_is_an_error(monkeypatch: pytest.MonkeyPatch, pad_spec: PadSpec) -> None:
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(DriverMissing):
        EvdevPad(pad_spec).open()
