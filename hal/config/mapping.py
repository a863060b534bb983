"""Gamepad mappings: what each control does in teleoperation, as YAML files in ``config/teleop/`` or of your own.

Names of controls are the same for every pad (:data:`hal.types.AXES`, :data:`hal.types.BUTTONS`): up and right
are positive, buttons are named by their place (``south`` is Cross on a Sony pad, A on an Xbox pad).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ..types import AXES, BUTTONS, PadState
from .files import load_record, one_of
from .schema import Flag, Quantity, Strict, ValueProblem

AxisName = Annotated[str, one_of("axis", AXES)]
ButtonName = Annotated[str, one_of("button", BUTTONS)]


class AxisMapping(Strict):
    """One direction of motion: an axis, or a pair of buttons, and the greatest speed."""

    axis: AxisName | None = None
    """Name of an axis: -1..1 for sticks and d-pad, 0..1 for triggers."""
    buttons: tuple[ButtonName, ButtonName] | None = None
    """Two buttons: the first moves backwards, the second forwards."""
    scale: Annotated[float, Quantity("m/s or rad/s", 0.0, 10.0, above=True)]
    """Speed at the end of the axis, or while the button is held: m/s or rad/s."""
    invert: Flag = False

    @model_validator(mode="after")
    def _check_control(self) -> AxisMapping:
        if (self.axis is None) == (self.buttons is None):
            raise ValueProblem("needs an axis, or two buttons [backwards, forwards]", "missing_key")
        return self

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls that are used."""
        return (self.axis,) if self.axis is not None else self.buttons or ()

    def value(self, pad: PadState) -> float:
        """Return the commanded speed, m/s or rad/s."""
        if self.axis is not None:
            share = pad.axis(self.axis)
        else:
            assert self.buttons is not None
            back, forth = self.buttons
            share = float(pad.pressed(forth)) - float(pad.pressed(back))
        return -self.scale * share if self.invert else self.scale * share


class DirectionsMapping(Strict):
    """Motion along x, y and z, m/s; a direction that is left out does not move."""

    x: AxisMapping | None = None
    y: AxisMapping | None = None
    z: AxisMapping | None = None


class TurnsMapping(Strict):
    """Rotation about x (roll), y (pitch) and z (yaw), rad/s; an axis that is left out does not turn."""

    roll: AxisMapping | None = None
    pitch: AxisMapping | None = None
    yaw: AxisMapping | None = None


class GripperMapping(Strict):
    """Control of the gripper: an axis (0 open, 1 closed), two buttons, or one button for both."""

    axis: AxisName | None = None
    open: ButtonName | None = None
    """Button that opens."""
    close: ButtonName | None = None
    """Button that closes."""
    toggle: ButtonName | None = None
    """Button that closes an open gripper and opens a closed one."""

    @model_validator(mode="after")
    def _check_control(self) -> GripperMapping:
        ways = (self.axis is not None, self.open is not None or self.close is not None, self.toggle is not None)
        if sum(ways) != 1:
            raise ValueProblem("needs an axis, or the buttons open and close, or one button: toggle", "conflict")
        if (self.open is None) != (self.close is None):
            raise ValueProblem("needs both buttons, open and close", "missing_key")
        return self

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls that are used."""
        return tuple(c for c in (self.axis, self.open, self.close, self.toggle) if c is not None)


class TeleopMapping(Strict):
    """The mapping of a whole gamepad."""

    description: str = ""
    frame: Literal["base", "tcp"] = "base"
    """Frame of the motion: the arm's base, or the tool."""
    deadman: ButtonName
    """Trigger or button that must be held for the arm to move."""
    linear: DirectionsMapping = DirectionsMapping()
    angular: TurnsMapping = TurnsMapping()
    gripper: GripperMapping | None = None
    go_home: ButtonName | None = None
    """Button that moves the arm to its home position while the dead-man is held."""
    other_arm: ButtonName | None = None
    """Button that hands the pad on to the next arm of a session with several, while the dead-man is released."""
    take_over: ButtonName | None = None
    """Button with which a leader drives in place of a policy; it may be one of :attr:`actions`."""
    actions: dict[str, ButtonName] = Field(default_factory=dict)
    """Action of an app -> its button, for example ``record: south``; each app documents its actions."""

    @model_validator(mode="after")
    def _check_distinct(self) -> TeleopMapping:
        moving = {control for mapping in self.axes() if mapping is not None for control in mapping.controls}
        moving |= set(self.gripper.controls) if self.gripper else set()
        alone = [self.deadman, *self.actions.values(), *filter(None, (self.go_home, self.other_arm))]
        for control in alone:
            if control in moving or alone.count(control) > 1:
                message = f"{control!r} is used twice; the dead-man and every action need a control of their own"
                raise ValueProblem(message, "duplicate_name")
        return self

    def axes(self) -> tuple[AxisMapping | None, ...]:
        """Return the six directions: x, y, z, roll, pitch, yaw."""
        linear, angular = self.linear, self.angular
        return (linear.x, linear.y, linear.z, angular.roll, angular.pitch, angular.yaw)

    def speeds(self) -> tuple[float, float]:
        """Return the greatest speed along an axis, m/s, and about an axis, rad/s; 0 without any."""
        scales = [0.0 if axis is None else axis.scale for axis in self.axes()]
        return max(scales[:3]), max(scales[3:])

    def twist(self, pad: PadState) -> tuple[float, ...]:
        """Return the commanded twist (6,): m/s, then rad/s."""
        return tuple(0.0 if mapping is None else mapping.value(pad) for mapping in self.axes())


def load_mapping(mapping: str | Path | Mapping[str, Any] | TeleopMapping = "default") -> TeleopMapping:
    """Return a checked mapping, from a file, the name of a built-in one, a dict with the same keys, or a mapping.

    Raises:
        ConfigError: It has problems; all are listed.
    """
    return load_record(TeleopMapping, mapping, "teleop", "mapping")
