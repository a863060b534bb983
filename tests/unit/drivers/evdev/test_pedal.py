"""A foot switch, which is a keyboard: used only by a rig that names it, and a dead-man as a pad's button is."""

from __future__ import annotations

import time

from evdev_kit import MODELS, FakeInput, FakeNode, MakePad, poll

from hal.gamepad import Gamepad
from hal.pads.codes import BUS_USB, EV_KEY, KEY
from hal.pads.model import Identity

KEYS = [KEY["KEY_A"], KEY["KEY_B"], KEY["KEY_C"]]
(PEDAL,) = (model for model in MODELS if model["name"] == "pedal")


def plug(system: FakeInput) -> FakeNode:
    identity = Identity("PCsensor FootSwitch Keyboard", 0x1A86, 0xE026, BUS_USB, "hid-generic")
    return system.put(FakeNode("/dev/input/event5", {}, KEYS), identity, pad=False, keyboard=True)


def test_a_keyboard_is_no_pad_unless_the_rig_names_its_model(system: FakeInput, make_pad: MakePad) -> None:
    node = plug(system)
    assert not poll(make_pad()).connected
    assert not node.grabbed, "and it still types"
    other = Identity("A keyboard", 0x046D, 0xC31C, BUS_USB, "hid-generic")
    system.put(FakeNode("/dev/input/event6", {}, KEYS), other, pad=False, keyboard=True)
    pad = make_pad(PEDAL)
    assert pad.describe() == "foot switch (USB, /dev/input/event5)"
    assert node.grabbed
    node.send((EV_KEY, KEY["KEY_B"], 1), (EV_KEY, KEY["KEY_A"], 1))
    assert poll(pad).buttons == {"l2", "south"}
    assert pad.proves_liveness
    assert pad.mapping == "leader"


def test_a_pedal_that_was_held_when_it_was_found_counts_once_it_was_released(
    system: FakeInput, make_pad: MakePad
) -> None:
    node = plug(system)
    node.down = [KEY["KEY_B"]]
    pad = Gamepad(make_pad(PEDAL))
    deadman = pad.hold("l2")
    pad.open(time.monotonic())
    for value in (2, 2, 0, 1):  # the kernel repeats a key that is held
        node.send((EV_KEY, KEY["KEY_B"], value))
        assert not deadman.held
        pad.poll_once(time.monotonic())
    assert deadman.held
    system.unplug(node)
    pad.poll_once(time.monotonic())
    assert not deadman.held
