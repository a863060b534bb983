"""Models of gamepads (``sensors/gamepads/*.yaml``): event code -> control, and how the model of a pad is chosen.

A model is data only; :class:`~hal.pads.mapper.PadMapper` applies it. :func:`guess_model` makes one for an unknown pad.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, Field, model_validator

from ..config.files import check_record, one_of
from ..config.schema import Strict, ValueProblem
from ..types import AXES, BUTTONS
from .codes import ABS, BUS_BLUETOOTH, BUS_USB, KEY, REL

PRINTED: Mapping[str, Mapping[str, str]] = {
    "playstation": {
        "south": "Cross",
        "east": "Circle",
        "west": "Square",
        "north": "Triangle",
        "start": "Options",
        "select": "Share",
        "home": "PS",
    },
    "xbox": {
        "south": "A",
        "east": "B",
        "west": "X",
        "north": "Y",
        "l1": "LB",
        "r1": "RB",
        "l2": "LT",
        "r2": "RT",
        "l3": "LS",
        "r3": "RS",
        "start": "Menu",
        "select": "View",
        "home": "Xbox",
    },
    "spacemouse": {
        "l1": "left button",
        "r1": "right button",
        "push_x": "push forward/back",
        "push_y": "push left/right",
        "push_z": "lift/press",
        "turn_x": "tilt left/right",
        "turn_y": "tilt forward/back",
        "turn_z": "twist",
    },
}
"""Family of pads -> control -> its name as printed on the pad, or how it is moved."""

_BUSES = {BUS_USB: "usb", BUS_BLUETOOTH: "bluetooth"}
_AXIS_CODES = (*ABS, *REL)


class Identity(NamedTuple):
    """What the kernel reports about a connected pad."""

    name: str
    vendor: int
    product: int
    bus: int
    """``BUS_USB``, ``BUS_BLUETOOTH`` or another of the kernel's bus numbers."""
    driver: str
    """The kernel's driver, for example ``xpad``; empty if it is unknown."""

    @property
    def bus_name(self) -> str:
        """``usb``, ``bluetooth`` or ``other``."""
        return _BUSES.get(self.bus, "other")


def _axis(text: str) -> str:
    name = text.removeprefix("-")
    if name not in AXES:
        message = f"{name!r} is not an axis; axes: {', '.join(AXES)}, with '-' in front for a reversed one"
        raise ValueProblem(message, "unknown_control")
    return text


def _button(text: str) -> str:
    if text in BUTTONS or text in ("+dpad_x", "-dpad_x", "+dpad_y", "-dpad_y"):
        return text
    message = f"{text!r} is not a button; buttons: {', '.join(BUTTONS)}, or a d-pad's +dpad_x, -dpad_x ..."
    raise ValueProblem(message, "unknown_control")


class MatchRule(Strict):
    """A rule that a pad matches if every property that the rule names is the pad's."""

    vendor: Annotated[int, Field(ge=0, le=0xFFFF)] | None = None
    product: Annotated[int, Field(ge=0, le=0xFFFF)] | None = None
    name: str | None = None
    """Part of the device's name; the case does not matter."""
    driver: str | None = None
    """The kernel's driver: the same pad has other event codes with another driver."""
    bus: Annotated[str, one_of("bus", ("usb", "bluetooth"))] | None = None
    wireless: bool = False
    """Whether the device is only the receiver of a wireless pad, so that it stays when the pad is gone."""
    title: str | None = None
    """Name to display, if it is not the model's title."""

    def fits(self, pad: Identity) -> int:
        """Return the number of properties that the rule names; 0 if the pad does not match."""
        wanted = (self.vendor, self.product, self.driver, self.bus)
        found = (pad.vendor, pad.product, pad.driver, pad.bus_name)
        if any(w is not None and w != f for w, f in zip(wanted, found, strict=True)):
            return 0
        if self.name is not None and self.name.lower() not in pad.name.lower():
            return 0
        return sum(w is not None for w in (*wanted, self.name))


class PadModel(Strict):
    """One kind of gamepad, as in ``sensors/gamepads/<name>.yaml``."""

    name: str
    """The file's name without ``.yaml``."""
    title: str
    """Name to display."""
    match: tuple[MatchRule, ...] = ()
    axes: dict[Annotated[str, one_of("event code of an axis", _AXIS_CODES)], Annotated[str, AfterValidator(_axis)]]
    """Event code -> axis, or ``-axis`` where the kernel's value grows the other way (on sticks, downwards). Codes that
    a pad does not send are allowed."""
    buttons: dict[Annotated[str, one_of("event code of a button", KEY)], Annotated[str, AfterValidator(_button)]]
    """Event code -> button; ``+dpad_y`` etc. where the directions of the d-pad are buttons."""
    ranges: dict[Annotated[str, one_of("event code of an axis", _AXIS_CODES)], tuple[int, int]] = Field(
        default_factory=dict
    )
    """Event code -> (minimum, maximum): required for ``REL_`` axes, which report none, and for axes whose reported
    range is wrong."""
    absolute: tuple[Annotated[str, one_of("axis", [name for name in AXES if name not in BUTTONS])], ...] = ()
    """Axes that stay where they are put, such as levers; none that is also a button, for a dead-man springs back."""
    motion_node: str | None = None
    """End of the name of the pad's motion sensor, which reports all the time and so shows that the pad is connected."""
    touch_node: str | None = None
    """End of the name of the pad's touchpad, a separate device; pressing it is the button ``touchpad``."""
    printed: Annotated[str, one_of("family of pads", PRINTED)] | None = None
    """Family of pads (of :data:`PRINTED`) whose names of the controls this pad has; None for plain names."""
    mapping: str | None = None
    """Teleoperation mapping for this pad (``config/teleop``); default: ``default``."""

    @property
    def control_names(self) -> Mapping[str, str]:
        """Control -> its name as printed on the pad, where that is known."""
        return PRINTED[self.printed] if self.printed is not None else {}

    @model_validator(mode="after")
    def _has_ranges(self) -> PadModel:
        missing = [code for code in self.axes if code in REL and code not in self.ranges]
        if missing:
            raise ValueProblem(f"needs ranges of {', '.join(missing)}, such as [-350, 350]", "missing_key")
        return self

    def find_rule(self, pad: Identity) -> MatchRule | None:
        """Return the rule with the most matching properties; None if the model does not match."""
        best = max(self.match, key=lambda rule: rule.fits(pad), default=None)
        return best if best is not None and best.fits(pad) else None

    def to_yaml(self) -> str:
        """Return the model as the text of a file in ``sensors/gamepads`` or beside a rig."""
        import yaml

        text: str = yaml.safe_dump(self.model_dump(exclude_defaults=True, mode="json"), sort_keys=False)
        return re.sub(r"(vendor|product): (\d+)$", lambda m: f"{m[1]}: 0x{int(m[2]):04x}", text, flags=re.MULTILINE)


def pad_model(data: Mapping[str, Any], file: str = "<gamepad model>") -> PadModel:
    """Return a checked model. Raises ConfigError, which lists every problem; ``file`` is its name in them."""
    return check_record(PadModel, data, file)


def choose_model(models: Iterable[PadModel], pad: Identity) -> tuple[PadModel, MatchRule] | None:
    """Return the model with the most specific rule for a pad, and that rule; None for an unknown pad."""
    best: tuple[PadModel, MatchRule] | None = None
    for model in models:
        rule = model.find_rule(pad)
        if rule is not None and (best is None or rule.fits(pad) > best[1].fits(pad)):
            best = model, rule
    return best


# Models of unknown pads

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
    """Return a model from the event codes that the pad can send.

    If there are RX and RY, they are the right stick and Z and RZ the triggers; otherwise Z and RZ are the right stick,
    and BRAKE and GAS the triggers (Xbox pads over Bluetooth, 8BitDo). Six axes without a gamepad's buttons are a
    SpaceMouse.
    """
    bus = pad.bus_name if pad.bus_name != "other" else None
    # A device on USB may be a receiver; the user corrects this if the pad has a cable.
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
    """Return the warning about a guessed model, with the file to start from."""
    return (
        f"{model.title!r} is an unknown gamepad: its controls are guessed. Upper and left face button may be swapped, "
        "and a trigger may be a stick. Check each control with hal check --pads, set 'wireless: false' if it has a "
        f"cable, and save this as a model file, {model.name}.yaml, which the rig names (model: {model.name}.yaml):\n"
        f"{model.to_yaml()}"
    )
