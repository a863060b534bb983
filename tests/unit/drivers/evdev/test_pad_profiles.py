"""Every pad model: the codes of its kernel driver, their controls, and whether it may be the dead-man of a real arm.

The tables are stated independently from the sources, and not read from ``sensors/gamepads``.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import pytest

if sys.platform != "linux":
    pytest.skip("evdev is Linux only", allow_module_level=True)

from evdev_kit import ROOT, FakeInput, FakeNode, MakePad, poll

from hal.config.mapping import load_mapping
from hal.errors import NotSupported
from hal.gamepad import Gamepad
from hal.pads.codes import ABS, BUS_BLUETOOTH, BUS_USB, EV_ABS, EV_KEY, KEY, REL
from hal.pads.mapper import AxisRange
from hal.pads.model import Identity

U, B = BUS_USB, BUS_BLUETOOTH


class Sent(NamedTuple):
    """The event codes that a family of pads sends for each control."""

    sticks: str
    """Across and up of the left and of the right one."""
    triggers: str
    """Codes of their axes, left and right; empty where they have none."""
    buttons: dict[str, str]
    """Control -> code."""


def names(text: str) -> dict[str, str]:
    return dict(pair.split(":") for pair in text.split())


SONY = Sent(
    "X Y RX RY",
    "Z RZ",
    names(
        "south:BTN_SOUTH east:BTN_EAST west:BTN_WEST north:BTN_NORTH l1:BTN_TL r1:BTN_TR l2:BTN_TL2 r2:BTN_TR2 "
        "select:BTN_SELECT start:BTN_START l3:BTN_THUMBL r3:BTN_THUMBR home:BTN_MODE"
    ),
)
XPAD_BUTTONS = names(
    "south:BTN_SOUTH east:BTN_EAST west:BTN_NORTH north:BTN_WEST l1:BTN_TL r1:BTN_TR select:BTN_SELECT "
    "start:BTN_START l3:BTN_THUMBL r3:BTN_THUMBR home:BTN_MODE"
)
XPAD = Sent("X Y RX RY", "Z RZ", XPAD_BUTTONS)
XBOX_BLE = Sent("X Y Z RZ", "BRAKE GAS", XPAD_BUTTONS)
XBOX_BT = Sent("X Y Z RZ", "BRAKE GAS", XPAD_BUTTONS | names("select:KEY_BACK home:KEY_HOMEPAGE"))
XBOX_2016 = Sent(
    "X Y RX RY",
    "Z RZ",
    names(
        "south:BTN_SOUTH east:BTN_EAST west:BTN_C north:BTN_NORTH l1:BTN_WEST r1:BTN_Z select:BTN_TL start:BTN_TR "
        "l3:BTN_TL2 r3:BTN_TR2 home:KEY_MENU"
    ),
)
NINTENDO = names(
    "south:BTN_EAST east:BTN_SOUTH west:BTN_WEST north:BTN_NORTH l1:BTN_TL r1:BTN_TR select:BTN_SELECT "
    "start:BTN_START l3:BTN_THUMBL r3:BTN_THUMBR home:BTN_MODE"
)
BITDO_PRO = Sent("X Y Z RZ", "BRAKE GAS", NINTENDO)
BITDO_SN30 = Sent("X Y Z RZ", "", NINTENDO | names("l2:BTN_TL2 r2:BTN_TR2"))
BITDO_ULTIMATE = Sent("X Y Z RZ", "BRAKE GAS", XPAD_BUTTONS)
F310_D = Sent(
    "X Y Z RZ",
    "",
    names(
        "west:BTN_TRIGGER south:BTN_THUMB east:BTN_THUMB2 north:BTN_TOP l1:BTN_TOP2 r1:BTN_PINKIE l2:BTN_BASE "
        "r2:BTN_BASE2 select:BTN_BASE3 start:BTN_BASE4 l3:BTN_BASE5 r3:BTN_BASE6"
    ),
)
F710_D = Sent(
    "X Y Z RZ",
    "",
    names(
        "west:BTN_SOUTH south:BTN_EAST east:BTN_C north:BTN_NORTH l1:BTN_WEST r1:BTN_Z l2:BTN_TL r2:BTN_TR "
        "select:BTN_TL2 start:BTN_TR2 l3:BTN_SELECT r3:BTN_START"
    ),
)

# (vendor, product, bus, kernel driver, codes, model, whether it may be the dead-man without a motion sensor)
PADS = [
    (0x054C, 0x05C4, U, "sony", SONY, "dualshock4", True),
    (0x054C, 0x09CC, U, "playstation", SONY, "dualshock4", True),
    (0x054C, 0x09CC, B, "playstation", SONY, "dualshock4", False),
    (0x054C, 0x0BA0, U, "sony", SONY, "dualshock4", False),
    (0x054C, 0x0CE6, U, "playstation", SONY, "dualsense", True),
    (0x054C, 0x0CE6, B, "playstation", SONY, "dualsense", False),
    (0x054C, 0x0DF2, U, "playstation", SONY, "dualsense", True),
    (0x045E, 0x028E, U, "xpad", XPAD, "xbox360", True),
    (0x045E, 0x028F, U, "xpad", XPAD, "xbox360", True),
    (0x045E, 0x0291, U, "xpad", XPAD, "xbox360", False),
    (0x045E, 0x02A9, U, "xpad", XPAD, "xbox360", False),
    (0x045E, 0x0719, U, "xpad", XPAD, "xbox360", False),
    (0x1234, 0x5678, U, "xpad", XPAD, "xbox360", False),
    (0x045E, 0x02D1, U, "xpad", XPAD, "xbox_one", True),
    (0x045E, 0x02EA, U, "xpad", XPAD, "xbox_one", True),
    (0x045E, 0x0B12, U, "xpad", XPAD, "xbox_one", True),
    (0x045E, 0x02FD, B, "microsoft", XBOX_BT, "xbox_bluetooth", False),
    (0x045E, 0x0B05, B, "microsoft", XBOX_BT, "xbox_bluetooth", False),
    (0x045E, 0x0B13, B, "hid-generic", XBOX_BLE, "xbox_bluetooth", False),
    (0x045E, 0x0B20, B, "microsoft", XBOX_BLE, "xbox_bluetooth", False),
    (0x045E, 0x0B22, B, "microsoft", XBOX_BLE, "xbox_bluetooth", False),
    (0x045E, 0x02E0, B, "microsoft", XBOX_2016, "xbox_bluetooth_2016", False),
    (0x045E, 0x028E, B, "xpadneo", XPAD, "xbox_xpadneo", False),
    (0x045E, 0x02E0, B, "xpadneo", XPAD, "xbox_xpadneo", False),
    (0x2DC8, 0x6003, U, "hid-generic", BITDO_PRO, "8bitdo_pro", True),
    (0x2DC8, 0x6006, B, "hid-generic", BITDO_PRO, "8bitdo_pro", False),
    (0x2DC8, 0x6006, U, "hid-generic", BITDO_PRO, "8bitdo_pro", False),
    (0x2DC8, 0x6001, U, "hid-generic", BITDO_SN30, "8bitdo_sn30", True),
    (0x2DC8, 0x6101, B, "hid-generic", BITDO_SN30, "8bitdo_sn30", False),
    (0x2DC8, 0x3011, U, "hid-generic", BITDO_ULTIMATE, "8bitdo_ultimate", True),
    (0x2DC8, 0x3012, U, "hid-generic", BITDO_ULTIMATE, "8bitdo_ultimate", False),
    (0x2DC8, 0x3013, U, "hid-generic", BITDO_ULTIMATE, "8bitdo_ultimate", False),
    (0x2DC8, 0x6012, U, "hid-generic", BITDO_ULTIMATE, "8bitdo_ultimate", False),
    (0x2DC8, 0x2000, U, "xpad", XPAD, "xbox360", True),
    (0x2DC8, 0x3106, U, "xpad", XPAD, "xbox360", False),
    (0x2DC8, 0x310A, U, "xpad", XPAD, "xbox360", False),
    (0x2DC8, 0xFFFF, U, "xpad", XPAD, "xbox360", False),
    (0x046D, 0xC21D, U, "xpad", XPAD, "xbox360", True),
    (0x046D, 0xC21E, U, "xpad", XPAD, "xbox360", True),
    (0x046D, 0xC21F, U, "xpad", XPAD, "xbox360", False),
    (0x046D, 0xC216, U, "logitech", F310_D, "logitech_d", True),
    (0x046D, 0xC219, U, "logitech", F710_D, "logitech_f710_d", False),
]
IDS = [
    f"{vendor:04x}:{product:04x} {'usb' if bus == U else 'bt'} {driver}" for vendor, product, bus, driver, *_ in PADS
]


def gamepad(sent: Sent) -> FakeNode:
    """Return a device with the controls of that family only, its sticks at rest."""
    axes = {ABS[f"ABS_{name}"]: AxisRange(-1000, 1000) for name in sent.sticks.split()}
    axes |= {ABS[f"ABS_{name}"]: AxisRange(0, 1023) for name in sent.triggers.split()}
    axes |= {ABS[name]: AxisRange(-1, 1) for name in ("ABS_HAT0X", "ABS_HAT0Y")}
    return FakeNode("/dev/input/event3", axes, [KEY[name] for name in sent.buttons.values()])


@pytest.mark.parametrize(("vendor", "product", "bus", "driver", "sent", "model", "guards"), PADS, ids=IDS)
def test_controls_and_trust_of_every_pad(
    vendor: int, product: int, bus: int, driver: str, sent: Sent, model: str, guards: bool,
    system: FakeInput, make_pad: MakePad,
) -> None:  # fmt: skip
    identity = Identity("A pad", vendor, product, bus, driver)
    node = system.put(gamepad(sent), identity, pad="BTN_SOUTH" in sent.buttons.values(), joystick=True)
    pad = make_pad()
    assert pad.notes == (), "no guess is needed"
    assert pad.details()["model"] == model
    rest = poll(pad)
    assert (rest.connected, rest.unknown, rest.buttons) == (True, frozenset(), frozenset())

    left_x, left_y, right_x, right_y = (ABS[f"ABS_{name}"] for name in sent.sticks.split())
    hat_x, hat_y = ABS["ABS_HAT0X"], ABS["ABS_HAT0Y"]
    moves = [(left_x, 1000, "left_x"), (left_y, -1000, "left_y"), (right_x, 1000, "right_x")]
    moves += [(right_y, -1000, "right_y"), (hat_x, 1, "dpad_x"), (hat_y, -1, "dpad_y")]
    for code, right_or_up, control in moves:
        node.send((EV_ABS, code, right_or_up))
        assert {name: value for name, value in poll(pad).axes.items() if value} == {control: 1.0}
        node.send((EV_ABS, code, -right_or_up))
        assert poll(pad).axes[control] == -1.0
        node.send((EV_ABS, code, 0))
        assert not any(poll(pad).axes.values())
    for code_name, control in zip(sent.triggers.split(), ("l2", "r2"), strict=bool(sent.triggers)):
        code = ABS[f"ABS_{code_name}"]
        node.send((EV_ABS, code, 1023))
        reading = poll(pad)
        assert {name: value for name, value in reading.axes.items() if value} == {control: 1.0}
        assert reading.buttons == (set() if control in sent.buttons else {control}), (
            "the axis is also the button, unless it has one"
        )
        node.send((EV_ABS, code, 0))
        poll(pad)
    for control, code_name in sent.buttons.items():
        node.send((EV_KEY, KEY[code_name], 1))
        assert poll(pad).buttons == {control}
        node.send((EV_KEY, KEY[code_name], 0))
        assert poll(pad).buttons == frozenset()

    public = Gamepad(pad)
    public.open(0.0)
    assert (pad.proves_liveness, public.distrust() is None) == (guards, guards), "only a wired pad proves its life"
    if not guards:
        with pytest.raises(NotSupported):
            public.hold("l1").check_trust()
        accepted = Gamepad(make_pad(accept_silent_pad=True))
        accepted.open(0.0)
        accepted.hold("l1").check_trust()


# SpaceMice.


SPACEMICE = [
    (0x046D, 0xC621, U, True),
    (0x046D, 0xC626, U, True),
    (0x046D, 0xC62B, U, True),
    (0x256F, 0xC62E, U, True),
    (0x256F, 0xC62F, U, False),
    (0x256F, 0xC631, U, True),
    (0x256F, 0xC632, U, False),
    (0x256F, 0xC633, U, True),
    (0x256F, 0xC635, U, True),
    (0x256F, 0xC63A, B, False),
    (0x256F, 0xC652, U, False),
    (0x256F, 0xFFFF, U, False),
]


@pytest.mark.parametrize(("vendor", "product", "bus", "guards"), SPACEMICE)
@pytest.mark.parametrize("mode", ["REL", "ABS"])
def test_spacemouse_is_known_in_both_modes(vendor, product, bus, guards, mode, system, make_pad):
    axes = {code: AxisRange(-350, 350) for code in range(6)} if mode == "ABS" else {}
    rels = REL.values() if mode == "REL" else ()
    node = FakeNode("/dev/input/event3", axes, [KEY["BTN_0"], KEY["BTN_1"]], rels)
    system.put(node, Identity("3Dconnexion", vendor, product, bus, "hid-generic"))
    pad = make_pad()
    assert (poll(pad).connected, pad.notes, pad.details()["model"]) == (True, (), "spacemouse")
    assert (pad.mapping, pad.proves_liveness) == ("spacemouse", guards)


# All of them.


def test_every_model_names_its_source_what_was_measured_and_a_mapping_that_exists() -> None:
    for path in sorted((ROOT / "sensors" / "gamepads").glob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        about = text.split("name:")[0].replace("\n# ", " ").lower()
        assert "read in" in about, f"{path.name} names no source"
        measured = "measured with the real" in about or "not measured" in about
        assert measured, f"{path.name} does not state what was measured"
        for line in text.splitlines():
            if line.startswith("mapping:"):
                load_mapping(line.split()[1])
