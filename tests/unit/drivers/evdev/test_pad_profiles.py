"""Every pad model: the codes of its kernel driver, their controls, and whether it may be the dead-man of a real arm.

The tables are stated independently from the sources, and not read from ``sensors/gamepads``.
"""

from __future__ import annotations

from typing import NamedTuple

import pytest
from evdev_kit import ROOT, FakeNode, poll

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

FAMILIES = [
    (U, "sony", SONY, "dualshock4", "054c:05c4", "054c:0ba0"),
    (U, "playstation", SONY, "dualshock4", "054c:09cc", ""),
    (B, "playstation", SONY, "dualshock4", "", "054c:09cc"),
    (U, "playstation", SONY, "dualsense", "054c:0ce6 054c:0df2", ""),
    (B, "playstation", SONY, "dualsense", "", "054c:0ce6"),
    (U, "xpad", XPAD, "xbox360", "045e:028e 045e:028f", "045e:0291 045e:02a9 045e:0719 1234:5678"),
    (U, "xpad", XPAD, "xbox360", "2dc8:2000 046d:c21d 046d:c21e", "2dc8:3106 2dc8:310a 2dc8:ffff 046d:c21f"),
    (U, "xpad", XPAD, "xbox_one", "045e:02d1 045e:02ea 045e:0b12", ""),
    (B, "microsoft", XBOX_BT, "xbox_bluetooth", "", "045e:02fd 045e:0b05"),
    (B, "microsoft", XBOX_BLE, "xbox_bluetooth", "", "045e:0b20 045e:0b22"),
    (B, "hid-generic", XBOX_BLE, "xbox_bluetooth", "", "045e:0b13"),
    (B, "microsoft", XBOX_2016, "xbox_bluetooth_2016", "", "045e:02e0"),
    (B, "xpadneo", XPAD, "xbox_xpadneo", "", "045e:028e 045e:02e0"),
    (U, "hid-generic", BITDO_PRO, "8bitdo_pro", "2dc8:6003", "2dc8:6006"),
    (B, "hid-generic", BITDO_PRO, "8bitdo_pro", "", "2dc8:6006"),
    (U, "hid-generic", BITDO_SN30, "8bitdo_sn30", "2dc8:6001", ""),
    (B, "hid-generic", BITDO_SN30, "8bitdo_sn30", "", "2dc8:6101"),
    (U, "hid-generic", BITDO_ULTIMATE, "8bitdo_ultimate", "2dc8:3011", "2dc8:3012 2dc8:3013 2dc8:6012"),
    (U, "logitech", F310_D, "logitech_d", "046d:c216", ""),
    (U, "logitech", F710_D, "logitech_f710_d", "", "046d:c219"),
]
"""Bus, kernel driver, codes, model, vendor and product of the pads that may be the dead-man of a real arm without a
motion sensor, and of those that may not."""
PADS = [
    (*(int(number, 16) for number in ids.split(":")), bus, driver, sent, model, guards)
    for bus, driver, sent, model, trusted, others in FAMILIES
    for guards, pads in ((True, trusted), (False, others))
    for ids in pads.split()
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
def test_controls_and_trust_of_every_pad(vendor, product, bus, driver, sent, model, guards, system, make_pad):
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


SPACEMICE = [(0x046D, product, U, True) for product in (0xC621, 0xC626, 0xC62B)]
SPACEMICE += [(0x256F, product, U, True) for product in (0xC62E, 0xC631, 0xC633, 0xC635)]
SPACEMICE += [(0x256F, product, U, False) for product in (0xC62F, 0xC632, 0xC652, 0xFFFF)]
SPACEMICE += [(0x256F, 0xC63A, B, False)]


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
