"""What the controls of a gamepad do in teleoperation: a YAML file that anybody may edit.

Controls have names that are the same for every pad (:data:`hal.types.AXES`, :data:`hal.types.BUTTONS`): up and right
are positive, buttons are named by their place (``south`` is Cross on a Sony pad, A on an Xbox pad).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ..types import AXES, BUTTONS, PadState
from .data_files import data_folder, is_path, list_data, user_path
from .files import Problems, nearest, read_yaml, validate
from .schema import Flag, Quantity, Strict

__all__ = ["AxisMapping", "DirectionsMapping", "GripperMapping", "TeleopMapping", "TurnsMapping", "load_mapping"]


class AxisMapping(Strict):
    """One direction of motion: an axis, or a pair of buttons, and the speed at its end."""

    axis: str | None = None
    """Name of an axis: -1..1 for sticks and d-pad, 0..1 for triggers."""
    buttons: tuple[str, str] | None = None
    """Two buttons: the first moves backwards, the second forwards."""
    scale: Annotated[float, Quantity("m/s or rad/s", 0.0, 10.0, above=True)]
    """Speed at the end of the axis, or while the button is held: m/s or rad/s."""
    invert: Flag = False

    @model_validator(mode="after")
    def _one_control(self) -> AxisMapping:
        if (self.axis is None) == (self.buttons is None):
            raise ValueError("needs an axis, or two buttons [backwards, forwards]")
        if self.axis is not None:
            _known(self.axis, AXES, "axis")
        for button in self.buttons or ():
            _known(button, BUTTONS, "button")
        return self

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls that it uses."""
        return (self.axis,) if self.axis is not None else self.buttons or ()

    def value(self, pad: PadState) -> float:
        """The commanded speed, m/s or rad/s."""
        if self.axis is not None:
            share = pad.axis(self.axis)
        else:
            assert self.buttons is not None
            back, forth = self.buttons
            share = float(pad.pressed(forth)) - float(pad.pressed(back))
        return -self.scale * share if self.invert else self.scale * share


class DirectionsMapping(Strict):
    """Motion along x, y and z, m/s; what is left out does not move."""

    x: AxisMapping | None = None
    y: AxisMapping | None = None
    z: AxisMapping | None = None


class TurnsMapping(Strict):
    """Turning about x (roll), y (pitch) and z (yaw), rad/s; what is left out does not turn."""

    roll: AxisMapping | None = None
    pitch: AxisMapping | None = None
    yaw: AxisMapping | None = None


class GripperMapping(Strict):
    """An axis whose place is how far the gripper is closed (0 open, 1 closed), two buttons, or one for both."""

    axis: str | None = None
    open: str | None = None
    """Button that opens."""
    close: str | None = None
    """Button that closes."""
    toggle: str | None = None
    """Button that closes an open gripper and opens a closed one."""

    @model_validator(mode="after")
    def _one_control(self) -> GripperMapping:
        ways = (self.axis is not None, self.open is not None or self.close is not None, self.toggle is not None)
        if sum(ways) != 1:
            raise ValueError("needs an axis, or the buttons open and close, or one button: toggle")
        if self.axis is not None:
            _known(self.axis, AXES, "axis")
        elif self.toggle is not None:
            _known(self.toggle, BUTTONS, "button")
        elif self.open is None or self.close is None:
            raise ValueError("needs both buttons, open and close")
        else:
            _known(self.open, BUTTONS, "button")
            _known(self.close, BUTTONS, "button")
        return self

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls that it uses."""
        return tuple(c for c in (self.axis, self.open, self.close, self.toggle) if c is not None)


class TeleopMapping(Strict):
    """The whole pad."""

    description: str = ""
    frame: Literal["base", "tcp"] = "base"
    """Whose axes the motion is along: the arm's base's, or the tool's own."""
    deadman: str
    """Trigger or button: the arm moves only while it is held."""
    linear: DirectionsMapping = DirectionsMapping()
    angular: TurnsMapping = TurnsMapping()
    gripper: GripperMapping | None = None
    go_home: str | None = None
    """Button that drives the arm to its home position while the dead-man is held."""
    actions: dict[str, str] = Field(default_factory=dict)
    """What an app does when a button is pressed, for example ``record: south``; the app says which it knows."""

    @field_validator("deadman", "go_home")
    @classmethod
    def _is_button(cls, name: str | None) -> str | None:
        if name is not None:
            _known(name, BUTTONS, "button")
        return name

    @field_validator("actions")
    @classmethod
    def _are_buttons(cls, actions: dict[str, str]) -> dict[str, str]:
        for name in actions.values():
            _known(name, BUTTONS, "button")
        return actions

    @model_validator(mode="after")
    def _controls(self) -> TeleopMapping:
        moving = {control for mapping in self.axes() if mapping is not None for control in mapping.controls}
        moving |= set(self.gripper.controls) if self.gripper else set()
        alone = [self.deadman, *self.actions.values()] + ([self.go_home] if self.go_home else [])
        for control in alone:
            if control in moving or alone.count(control) > 1:
                raise ValueError(f"{control!r} has two meanings; the dead-man and every button need one of their own")
        return self

    def axes(self) -> tuple[AxisMapping | None, ...]:
        """The six directions: x, y, z, roll, pitch, yaw."""
        linear, angular = self.linear, self.angular
        return (linear.x, linear.y, linear.z, angular.roll, angular.pitch, angular.yaw)

    def speeds(self) -> tuple[float, float]:
        """The greatest speed along an axis, m/s, and about one, rad/s; 0 where nothing moves."""
        scales = [0.0 if axis is None else axis.scale for axis in self.axes()]
        return max(scales[:3]), max(scales[3:])

    def twist(self, pad: PadState) -> tuple[float, ...]:
        """The commanded twist (6,): m/s, then rad/s."""
        return tuple(0.0 if mapping is None else mapping.value(pad) for mapping in self.axes())


def load_mapping(mapping: str | Path | Mapping[str, Any] | TeleopMapping = "default") -> TeleopMapping:
    """A mapping from a file, the name of a built-in one, or a dict of the same shape.

    Raises ConfigError with every problem.
    """
    if isinstance(mapping, TeleopMapping):
        return mapping
    problems = Problems()
    data: dict[str, Any] | None = None
    if isinstance(mapping, Mapping):
        source, data = "<dict>", dict(mapping)
    elif isinstance(mapping, Path) or is_path(str(mapping)):
        path = user_path(mapping, Path.cwd())
        source, data = str(path), read_yaml(path, problems)
    else:
        source = str(data_folder("config") / "teleop" / f"{mapping}.yaml")
        there = list_data("config", "teleop")
        if mapping in there:
            data = read_yaml(Path(source), problems)
        else:
            text = f"there is no mapping {mapping!r}{nearest(str(mapping), there)}, or a path to your own"
            problems.add("<arguments>", "mapping", text)
    result = validate(TeleopMapping, data, source, problems) if data is not None else None
    problems.raise_any()
    assert result is not None
    return result


def _known(name: str, choices: tuple[str, ...], kind: str) -> None:
    if name not in choices:
        raise ValueError(f"there is no {kind} {name!r}{nearest(name, choices)}")
