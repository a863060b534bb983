"""Teleoperation: turns the states of a gamepad into commands for an arm and its gripper."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .arguments import number
from .commands import Twist
from .config.mapping import AxisMapping, TeleopMapping, load_mapping
from .errors import CommandError
from .geometry import Pose, difference
from .types import PadState

if TYPE_CHECKING:
    from .gamepad import Gamepad
    from .gripper import Gripper
    from .robot import Robot

__all__ = [
    "Teleop",
    "twist_towards",
]

_CROSSED = 0.05
"""Distance between trigger and grip at which the trigger counts as having reached it, as a share of the travel."""
_HALF = 0.5
"""Share of its greatest width below which a gripper's target counts as closed."""
_DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
_WORDS = (
    ("back", "forward"),
    ("right", "left"),
    ("down", "up"),
    ("tilt left", "tilt right"),
    ("tip up", "tip down"),
    ("turn right", "turn left"),
)
"""The six directions of :data:`_DIRECTIONS` in the arm's base frame (x forward, y left, z up), the negative one first.
"""
_SIDEWAYS = ("left_x", "right_x", "dpad_x")
_MOVES = (("move", "m/s"), ("turn", "rad/s"))
_GAIN = 4.0
"""Share of the remaining distance that is covered per second near the goal, 1/s. Far slower than the servo brakes, so
the tcp arrives without overshoot."""


class Teleop:
    """Turns pad states into commands by a mapping (``config/teleop``).

    A trigger that closes the gripper takes over only once it has crossed the present grip: neither the start of a
    session, nor a new press of the dead-man, nor a reconnected pad ever drops what the fingers hold. A button that
    opens and closes acts when it is pressed with the dead-man held, on the last command that the gripper got from
    anywhere.

    Args:
        robot: The arm.
        mapping: Name or path of a mapping, or the mapping itself.
        speed: Share of the mapping's speeds, above 0, at most 1.

    Raises:
        ConfigError: The mapping is wrong.
        CommandError: The speed is out of range.
    """

    def __init__(
        self, robot: Robot, mapping: str | Path | Mapping[str, Any] | TeleopMapping = "default", speed: float = 1.0
    ) -> None:
        speed = number("speed", speed, least=0.0, above=True, most=1.0)
        self.robot = robot
        self.mapping = load_mapping(mapping)
        self.speed = speed
        """Share of the mapping's speeds, above 0, at most 1."""
        self.frame = self.mapping.frame
        """Axes that the controls move along, ``base`` or ``tcp``; the mapping's at first."""
        self._has_grip = False
        self._side = 0.0
        self._was_toggle = True
        self._toggled: float | None = None
        self._was_home = True
        self._was_acting = frozenset(self.mapping.actions)

    def reset(self) -> None:
        """Start a new session: a gripper's trigger must cross the present grip again, its button be released."""
        self._has_grip = False
        self._side = 0.0
        self._was_toggle = True
        self._toggled = None

    def step(self, pad: PadState, dt: float) -> tuple[Twist, float | None]:
        """Return the command for a pad's state.

        Args:
            pad: State of the pad.
            dt: Time since the last step, s; without effect, because the command is a velocity.

        Returns:
            The twist for the arm, and the grip from 0 (open) to 1 (closed), or None to leave the gripper alone.
        """
        _check_state(pad)
        twist = self.mapping.twist(pad)
        linear, angular = ([self.speed * value for value in part] for part in (twist[:3], twist[3:]))
        return Twist(linear, angular, frame=self.frame), self._grip(pad)

    def home_pressed(self, pad: PadState) -> bool:
        """Return whether the button that moves the arm home was pressed since the last call."""
        _check_state(pad)
        button = self.mapping.go_home
        pressed = button is not None and pad.pressed(button)
        fresh, self._was_home = pressed and not self._was_home, pressed
        return fresh

    def pressed(self, pad: PadState) -> frozenset[str]:
        """Return the mapping's actions whose button was pressed since the last call, dead-man or not."""
        acting = frozenset(action for action, button in self.mapping.actions.items() if pad.pressed(button))
        fresh, self._was_acting = acting - self._was_acting, acting
        return fresh

    def _grip(self, pad: PadState) -> float | None:
        mapping, gripper = self.mapping.gripper, self.robot.gripper
        if mapping is None or gripper is None:
            return None
        if not (pad.connected and pad.pressed(self.mapping.deadman)):
            self.reset()
            return None
        if mapping.toggle is not None:
            return self._toggle(pad.pressed(mapping.toggle), gripper)
        if mapping.axis is None:
            if pad.pressed(str(mapping.close)):
                return 1.0
            return 0.0 if pad.pressed(str(mapping.open)) else None
        wanted = min(1.0, max(0.0, pad.axis(mapping.axis)))
        if not self._has_grip:
            state = gripper.newest()
            if state is None or gripper.trouble:
                return None  # the width is unknown
            difference = wanted - (1.0 - state.width / gripper.width_max)
            crossed = self._side * difference < 0.0
            self._has_grip = crossed or abs(difference) < _CROSSED
            self._side = difference
        return wanted if self._has_grip else None

    def _toggle(self, pressed: bool, gripper: Gripper) -> float | None:
        """Return the grip of a press, for as long as it lasts, so that no single command matters."""
        if pressed and not self._was_toggle:
            state = gripper.newest()
            if state is not None and not gripper.trouble:
                closed = state.grasped is True or state.width_target < _HALF * gripper.width_max
                self._toggled = 0.0 if closed else 1.0
        elif not pressed:
            self._toggled = None
        self._was_toggle = pressed
        return self._toggled

    def labels(self, actions: Collection[str] = ()) -> dict[str, Any]:
        """Return what the controls do, for a page that displays them.

        Args:
            actions: Actions of the mapping that the program handles, and ``home`` if it uses :meth:`home_pressed`.

        Returns:
            A dict for JSON. Its ``controls`` map an axis to its meanings at both ends (-1 and 1, or released and
            pressed), and a button to its meaning.
        """
        mapping = self.mapping
        controls: dict[str, list[str]] = {}
        for axis, low, high, _ in self._directions():
            if axis.buttons is not None:
                controls.update(zip(axis.buttons, ([low], [high]), strict=True))
            else:
                controls[str(axis.axis)] = [low, high]
        grip = mapping.gripper if self.robot.gripper is not None else None
        if grip is not None and grip.axis is not None:
            controls[grip.axis] = ["gripper: open", "gripper: closed"]
        elif grip is not None and grip.toggle is not None:
            controls[grip.toggle] = ["open or close the gripper"]
        elif grip is not None:
            controls |= {str(grip.open): ["open the gripper"], str(grip.close): ["close the gripper"]}
        controls |= {button: [action] for action, button in mapping.actions.items() if action in actions}
        home = mapping.go_home if "home" in actions else None
        if home is not None:
            controls[home] = ["home"]
        return {
            "deadman": mapping.deadman,
            "home": home,
            "frame": self.frame,
            "robot": self.robot.name,
            "controls": controls,
        }

    def _directions(self) -> Iterator[tuple[AxisMapping, str, str, str]]:
        """Yield each mapped axis, what its low and its high end (or its two buttons) do, and the unit of its speed."""
        units = 3 * ["m/s"] + 3 * ["rad/s"]
        for name, words, axis, unit in zip(_DIRECTIONS, _WORDS, self.mapping.axes(), units, strict=True):
            if axis is not None:
                low, high = words if self.frame == "base" else (f"tool {name} -", f"tool {name} +")
                yield (axis, high, low, unit) if axis.invert else (axis, low, high, unit)

    def help(self, pad: Gamepad) -> list[str]:
        """Return what the controls of ``pad`` do, in lines of text."""
        mapping, name = self.mapping, pad.control_name
        deadman = name(mapping.deadman)
        if pad.can_hold:
            lines = [f"hold {deadman} to move; release it to stop"]
        else:
            lines = [f"each key is one small step, with {deadman} included"]
        moves: dict[str, list[str]] = {"m/s": [], "rad/s": []}
        for axis, low, high, unit in self._directions():
            # Two buttons and sideways axes ("left/right") are named with the low end first, others ("up/down") last.
            low_first = axis.buttons is not None or axis.axis in _SIDEWAYS
            ways = f"{low}/{high}" if low_first else f"{high}/{low}"
            moves[unit].append(f"{ways} by {'/'.join(map(name, axis.controls))} ({self.speed * axis.scale:g} {unit})")
        lines += [f"{word}: " + ", ".join(moves[unit]) for word, unit in _MOVES if moves[unit]]
        if mapping.gripper is not None and self.robot.gripper is not None:
            lines.append("gripper: " + ", ".join(map(name, mapping.gripper.controls)))
        if mapping.go_home is not None and pad.can_hold:
            lines.append(f"home: {name(mapping.go_home)}, with {deadman} held")
        return lines


def _check_state(pad: PadState) -> None:
    if not isinstance(pad, PadState):
        raise CommandError(f"pass the pad's state, teleop.step(pad.state(), tick.dt), not a {type(pad).__name__}")


def twist_towards(goal: Pose, tcp: Pose, linear: float, angular: float) -> Twist:
    """Return the velocity that moves the tcp to a goal: straight, about one axis of rotation, slowing down at the end.

    Args:
        goal: Pose to reach, base frame.
        tcp: Present pose, base frame.
        linear: Greatest linear speed, m/s.
        angular: Greatest angular speed, rad/s.
    """
    left = difference((*tcp.position, *tcp.orientation), (*goal.position, *goal.orientation))
    return Twist(_capped(left[:3], linear), _capped(left[3:], angular))


def _capped(left: Sequence[float], most: float) -> list[float]:
    distance = hypot(*left)
    return [min(_GAIN, most / distance) * part for part in left] if distance > 0.0 else [0.0, 0.0, 0.0]
