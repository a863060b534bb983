"""A model for a pad that no model knows, from what it can send."""

from __future__ import annotations

import re
from collections.abc import Collection

from .codes import ABS, KEY, REL
from .model import Identity, MatchRule, PadModel

__all__ = ["guess_model", "guess_warning"]

# The kernel's rules for gamepads (Documentation/input/gamepad.rst) give these; many pads keep them only in part.
_BUTTONS = {
    "BTN_SOUTH": "south",
    "BTN_EAST": "east",
    "BTN_NORTH": "north",
    "BTN_WEST": "west",
    "BTN_TL": "l1",
    "BTN_TR": "r1",
    "BTN_TL2": "l2",
    "BTN_TR2": "r2",
    "BTN_SELECT": "select",
    "BTN_START": "start",
    "BTN_MODE": "home",
    "BTN_THUMBL": "l3",
    "BTN_THUMBR": "r3",
    "BTN_DPAD_UP": "+dpad_y",
    "BTN_DPAD_DOWN": "-dpad_y",
    "BTN_DPAD_LEFT": "-dpad_x",
    "BTN_DPAD_RIGHT": "+dpad_x",
}
_LEFT = {"ABS_X": "left_x", "ABS_Y": "-left_y"}
_RIGHT = ({"ABS_RX": "right_x", "ABS_RY": "-right_y"}, {"ABS_Z": "right_x", "ABS_RZ": "-right_y"})
_TRIGGERS = ({"ABS_Z": "l2", "ABS_RZ": "r2"}, {"ABS_BRAKE": "l2", "ABS_GAS": "r2"})
_HAT = {"ABS_HAT0X": "dpad_x", "ABS_HAT0Y": "-dpad_y"}
# As sensors/gamepads/spacemouse.yaml has them.
_CAP = {"X": "-push_y", "Y": "-push_x", "Z": "-push_z", "RX": "-turn_y", "RY": "-turn_x", "RZ": "-turn_z"}
_CAP_BUTTONS = {"BTN_0": "l1", "BTN_1": "r1"}
_CAP_REACH = (-350, 350)


def guess_model(pad: Identity, axes: Collection[int], keys: Collection[int], rels: Collection[int] = ()) -> PadModel:
    """A model from the event codes that the pad can send.

    Where there are RX and RY they are the right stick and Z and RZ the triggers; otherwise Z and RZ are the right
    stick, and BRAKE and GAS the triggers (Xbox pads over Bluetooth, 8BitDo). Six axes and no gamepad's buttons are a
    SpaceMouse.
    """
    bus = pad.bus_name if pad.bus_name != "other" else None
    # What hangs on USB may be a receiver; whoever keeps the model knows whether the pad has a cable.
    rule = MatchRule(vendor=pad.vendor, product=pad.product, bus=bus, wireless=True)
    file = re.sub(r"[^a-z0-9]+", "_", pad.name.lower()).strip("_") or "gamepad"
    title = pad.name or "unknown pad"
    if KEY["BTN_SOUTH"] not in keys and KEY["BTN_0"] in keys:
        kind = "REL_" if set(REL.values()) <= set(rels) else "ABS_"
        return PadModel(
            name=file,
            title=title,
            match=(rule,),
            axes={kind + code: control for code, control in _CAP.items()},
            ranges={kind + code: _CAP_REACH for code in _CAP} if kind == "REL_" else {},
            buttons={code: control for code, control in _CAP_BUTTONS.items() if KEY[code] in keys},
            mapping="spacemouse",
        )
    found: dict[str, str] = {}
    for wanted in (_LEFT, *_RIGHT, *_TRIGGERS, _HAT):
        free = all(ABS[code] in axes and code not in found for code in wanted)
        taken = set(found.values()) & set(wanted.values())
        if free and not taken:
            found.update(wanted)
    buttons = {code: control for code, control in _BUTTONS.items() if KEY[code] in keys}
    if "ABS_HAT0X" in found:
        buttons = {code: control for code, control in buttons.items() if "dpad" not in control}
    return PadModel(name=file, title=title, match=(rule,), axes=found, buttons=buttons)


def guess_warning(model: PadModel) -> str:
    """What a person should know about a guessed model, with the file to start from."""
    return (
        f"{model.title!r} is an unknown gamepad: its controls are guessed. Upper and left face button may be swapped, "
        "and a trigger may be a stick. Check each control with hal-check --pads, say 'wireless: false' if it has a "
        f"cable, and keep this as a model file, {model.name}.yaml, which the rig names (model: {model.name}.yaml):\n"
        f"{model.to_yaml()}"
    )
