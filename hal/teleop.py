"""Teleoperation: turns the states of a gamepad into commands for an arm and its gripper."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from . import registry
from .arguments import number
from .commands import JointVelocity, Twist
from .config.mapping import AxisMapping, TeleopMapping, load_mapping
from .errors import CommandError, ConnectionLost, MotionStopped, NotSupported, RobotFault, StaleStateError
from .geometry import Pose, difference
from .types import JOINT_AXES, PadState

if TYPE_CHECKING:
    from .commands import Command
    from .gamepad import Gamepad
    from .gripper import Gripper
    from .robot import Robot
    from .types import GripperState, RobotState
    from .views import Viewer3D

_CROSSED = 0.05
"""Distance between trigger and grip at which the trigger counts as having reached it, as a share of the travel."""
_PRESSED = 0.05
"""Share of a trigger's travel from which it counts as touched."""
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
        self._was_home = self._was_other = True
        self._was_acting = frozenset(self.mapping.actions)

    def reset(self) -> None:
        """Start a new session: a gripper's trigger must cross the present grip again, its button be released."""
        self._has_grip = False
        self._side = 0.0
        self._was_toggle = True
        self._toggled = None

    def prepare_takeover(self) -> None:
        """Prepare for driving an arm only while :meth:`is_touched`, the dead-man being held all the time.

        Raises:
            CommandError: The mapping has no control for it.
        """

    def is_touched(self, pad: PadState) -> bool:
        """Return whether a control is held that moves the arm or its gripper."""
        if any(self.mapping.twist(pad)) or any(self._jog(pad)):
            return True
        gripper = self.mapping.gripper
        if gripper is None:
            return False
        if gripper.axis is not None:
            return pad.axis(gripper.axis) > _PRESSED
        return any(pad.pressed(button) for button in (gripper.open, gripper.close, gripper.toggle) if button)

    def watch(self) -> None:
        """Note that a policy drives the arm in this turn."""

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

    def command(self, pad: PadState, dt: float) -> tuple[Command, float | None]:
        """Return the command and the grip for a state of the pad, or of a leader.

        As :meth:`step`, but while an axis of ``hal.types.JOINT_AXES`` is pushed, the command moves that joint alone, as
        fast as the mapping turns the tool.
        """
        motion, grip = self.step(pad, dt)
        jog = self._jog(pad)
        return JointVelocity(jog) if any(jog) else motion, grip

    def _jog(self, pad: PadState) -> list[float]:
        """Return the speed at which each joint (n,) is to be jogged, rad/s."""
        speed = self.speed * self.mapping.speeds()[1]
        return [speed * pad.axes.get(f"joint_{k}", 0.0) for k in range(1, self.robot.n + 1)]

    def home_pressed(self, pad: PadState) -> bool:
        """Return whether the button that moves the arm home was pressed since the last call."""
        _check_state(pad)
        button = self.mapping.go_home
        pressed = button is not None and pad.pressed(button)
        fresh, self._was_home = pressed and not self._was_home, pressed
        return fresh

    def other_arm_pressed(self, pad: PadState) -> bool:
        """Return whether the button that hands the pad on to the next arm was pressed since the last call."""
        _check_state(pad)
        button = self.mapping.other_arm
        pressed = button is not None and pad.pressed(button)
        fresh, self._was_other = pressed and not self._was_other, pressed
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
            state = _find_state(gripper)
            if state is None:
                return None  # the width is unknown
            difference = wanted - gripper.grip_at(state.width)
            crossed = self._side * difference < 0.0
            self._has_grip = crossed or abs(difference) < _CROSSED
            self._side = difference
        return wanted if self._has_grip else None

    def _toggle(self, pressed: bool, gripper: Gripper) -> float | None:
        """Return the grip of a press, for as long as it lasts, so that no single command matters."""
        if pressed and not self._was_toggle:
            state = _find_state(gripper)
            if state is not None:
                closed = state.grasped is True or gripper.grip_at(state.width_target) > _HALF
                self._toggled = 0.0 if closed else 1.0
        elif not pressed:
            self._toggled = None
        self._was_toggle = pressed
        return self._toggled

    def labels(self, actions: Collection[str] = ()) -> dict[str, Any]:
        """Return what the controls do, for a page that displays them.

        Args:
            actions: Actions of the mapping that the program handles, ``home`` if it uses :meth:`home_pressed`,
                ``other_arm`` if it uses :meth:`other_arm_pressed`, and ``jog`` if it uses :meth:`command`.

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
        if mapping.other_arm is not None and "other_arm" in actions:
            controls[mapping.other_arm] = ["next arm"]
        if "jog" in actions and mapping.speeds()[1] > 0.0:
            joints = zip(JOINT_AXES, self.robot.joints, strict=False)
            controls |= {axis: [f"jog {joint} -", f"jog {joint} +"] for axis, joint in joints}
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
            lines = ["each key press is one small step"]
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
    return Twist(_cap(left[:3], linear), _cap(left[3:], angular))


def _cap(left: Sequence[float], most: float) -> list[float]:
    distance = hypot(*left)
    return [min(_GAIN, most / distance) * part for part in left] if distance > 0.0 else [0.0, 0.0, 0.0]


SessionEventKind = Literal[
    "stopped",
    "fault",
    "resumed",
    "held",
    "homing",
    "homing_cancelled",
    "home_reached",
    "pad_changed",
    "pad_refused",
    "robot_changed",
    "setting_refused",
    "scene_reset",
    "gripper_fault",
    "gripper_recovered",
    "message",
]
"""What happened:

* ``stopped``, ``fault``: the arm does not follow the pad any more; :attr:`SessionEvent.reason` has the cause.
* ``resumed``: it follows the pad again.
* ``held``: it was brought to rest because another arm of the session stopped; it needs a new press of its dead-man.
* ``homing``, ``homing_cancelled``, ``home_reached``: the move home started, was cancelled by releasing the dead-man, or
  is complete.
* ``pad_changed``: a pad with another mapping was plugged in and is used from now on.
* ``pad_refused``: it was plugged in, but may not be the dead-man of this arm.
* ``robot_changed``: the pad drives another arm, chosen with the mapping's button or on a page of the console.
* ``scene_reset``, ``setting_refused``: a page of the console reset the simulated scene; the arm or the frame was to be
  changed while the dead-man was held, which has no effect.
* ``gripper_fault``, ``gripper_recovered``: the gripper does not answer or refuses, or no longer so; the arm continues.
* ``message``: text of the program, see :meth:`TeleopSession.announce`.
"""

Announce = Callable[[str, str, "SessionEventKind", str], None]
"""Called with an arm's name, a line for the user, its kind and the reason."""
STATE_AGE = 2.0
"""Greatest age of a state that is only shown, s."""
HOMING_PATIENCE = 0.2
"""Time without the dead-man after which a move home is cancelled, s."""
STILL = Twist((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""The command to stay."""


def _find_state(gripper: Gripper) -> GripperState | None:
    """Return the gripper's state, also after a command failed; None while it does not answer."""
    try:
        return gripper.state()
    except (ConnectionLost, StaleStateError):
        return None


def _kind_of(trouble: str) -> str:
    """Return a trouble of a gripper without what changes while it lasts: the age of its last state, and the reason."""
    return trouble if " failed: " in trouble else trouble.partition(" for ")[0]


class ArmTeleop:
    """One of the arms that a :class:`hal.TeleopSession` drives at once: its pad, mapping, dead-man, state and stops.

    Args:
        robots: Arms that the pad drives, one at a time; the first one at first.
        pad: The pad.
        mapping: Name or file of the mapping; None for the one that the plugged-in pad is meant for.
        speed: Share of the mapping's speeds, above 0, at most 1.
        announce: Gets every event.
        make: Returns what turns the pad's states into commands, for an arm, a pad, a mapping and a speed.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        pad: Gamepad,
        mapping: str | None,
        speed: float,
        announce: Announce,
        make: Callable[[Robot, Gamepad, str, float], Teleop],
    ) -> None:
        self.robots = tuple(robots)
        self.robot = self.robots[0]
        """The arm that is driven now."""
        self.pad = pad
        self.state: RobotState | None = None
        """Newest state of the arm; None while it does not answer."""
        self.stopped = ""
        """Why the arm does not follow the pad; empty while it does."""
        self._stop_reason = ""
        self.held_for = ""
        """Name of the arm whose stop holds this one; empty while none does."""
        self.gripper_trouble = ""
        """Why the gripper does not answer; empty while it does."""
        self.refused_pad = ""
        """Why a pad that was plugged in may not drive this arm; empty if it may."""
        self.seen = -1
        """Number of the pad's newest event that was turned into a command."""
        self.mapping = ""
        """Name or file of the mapping that is used."""
        self._mapping_wanted, self._speed, self._announce, self._make = mapping, speed, announce, make
        self.load_mapping()

    def announce(self, text: str, kind: SessionEventKind, reason: str = "") -> None:
        """Report an event of this arm."""
        self._announce(self.robot.name, text, kind, reason)

    @property
    def deadman_name(self) -> str:
        """Name of the dead-man's control as printed on the pad, for example ``L2``."""
        return self.pad.control_name(self.teleop.mapping.deadman)

    @property
    def next_robot(self) -> Robot:
        """The arm to which the mapping's button ``other_arm`` hands the pad on."""
        return self.robots[(self.robots.index(self.robot) + 1) % len(self.robots)]

    def choose_mapping(self) -> str:
        """Return the mapping to use: the wanted one, else that of the plugged-in pad, else the present one."""
        if self._mapping_wanted or (self.mapping and not self.pad.state().connected):
            return self._mapping_wanted or self.mapping
        return self.pad.mapping or "default"

    def load_mapping(self) -> None:
        """Use the mapping that is due. Its dead-man must be released and pressed before it counts."""
        self.mapping = self.choose_mapping()
        self.teleop = self._make(self.robot, self.pad, self.mapping, self._speed)
        self.deadman = self.pad.hold(self.teleop.mapping.deadman)

    def other_pad_ready(self) -> bool:
        """Return whether a pad with another mapping is plugged in and may drive this arm."""
        if self.choose_mapping() == self.mapping:
            return False
        spec = self.robot.spec
        why = (self.pad.distrust() or "") if spec.attended and not spec.emulated else ""
        if why and why != self.refused_pad:
            self.announce(why, "pad_refused", why)
        self.refused_pad = why
        return not why

    def set_speed(self, speed: float) -> None:
        """Change the share of the mapping's speeds, also for mappings that are loaded later."""
        self._speed = self.teleop.speed = speed

    def use_robot(self, robot: Robot) -> None:
        """Drive another arm. One that is not among :attr:`robots` is the only one from then on."""
        self.robot = robot
        self.robots = self.robots if robot in self.robots else (robot,)
        self.state = None
        self.stopped = self.held_for = self.gripper_trouble = ""
        self.load_mapping()

    def follow_gizmo(self, motion: Command, view: Viewer3D | None) -> Command:
        """Return the velocity towards the gizmo of the 3D view if it was dragged; a control or a release resets it."""
        name = self.robot.name
        goal = view.goal(name) if view is not None else None
        if view is None or goal is None:
            return motion
        moved = not isinstance(motion, Twist) or motion.linear.any() or motion.angular.any()
        if moved or self.held_for or not self.deadman.held:
            view.clear_goal(name)
            return motion
        linear, angular = self.teleop.mapping.speeds()
        speed = self.teleop.speed
        return twist_towards(goal, self.robot.state(max_age=STATE_AGE).tcp_set, speed * linear, speed * angular)

    def go_home(self) -> None:
        """Drive the arm home while the dead-man is held. Raises what stops it, except a released dead-man."""
        name = self.deadman_name
        self.announce(f"homing: hold {name} until the arm is there", "homing")
        try:
            self.robot.move_to(self.robot.home, deadman=self.deadman, patience=HOMING_PATIENCE)
        except MotionStopped:
            if self.deadman.held or not self.deadman.connected:
                raise
            self.announce(f"homing cancelled: {name} released", "homing_cancelled")
        else:
            self.announce(f"home reached: release {name}, then hold it again to drive", "home_reached")

    # State, stops and faults: one event for each.

    def update_state(self) -> None:
        """Read the newest state of the arm and of its gripper. Raises ConnectionLost if the process is gone."""
        try:
            self.state = self.robot.state(max_age=STATE_AGE)
        except (ConnectionLost, StaleStateError):
            self.robot.check()
            self.state = None
            return
        trouble = self.robot.gripper.trouble if self.robot.gripper is not None else ""
        if trouble and _kind_of(trouble) != _kind_of(self.gripper_trouble):
            self.announce(f"GRIPPER: {trouble}", "gripper_fault", trouble)
        elif self.gripper_trouble and not trouble:
            does = "takes commands" if " failed: " in self.gripper_trouble else "answers"
            self.announce(f"the gripper {does} again", "gripper_recovered")
        self.gripper_trouble = trouble

    def note_trouble(self, error: Exception) -> None:
        """Report what stopped the arm; raise it if another attempt is pointless."""
        if isinstance(error, RobotFault):
            self._note_stop(error, "fault", f"FAULT: {error}", error.cause)
        elif isinstance(error, (ConnectionLost, StaleStateError)):
            self.robot.check()  # raises if its process is gone
            self.state = None
            if not self.stopped:  # the message counts the seconds, so it would be a new event each time
                self._note_stop(error, "stopped", f"STOPPED: {error}", str(error))
        elif isinstance(error, NotSupported) and self.pad.state().connected:
            raise error  # else: an unplugged pad cannot be trusted as a dead-man
        else:
            self._note_stop(error, "stopped", f"STOPPED: {error}", getattr(error, "reason", str(error)))

    def _note_stop(self, error: Exception, kind: SessionEventKind, text: str, reason: str) -> None:
        if self.stopped != str(error):
            known = bool(self.stopped) and self._stop_reason.startswith(reason)  # the same stop, without its detail
            self.stopped = str(error)
            if not known:
                self._stop_reason = reason
                self.announce(text, kind, reason)

    def note_resumed(self) -> None:
        """Note that the arm follows the pad."""
        if self.stopped:
            self.stopped = ""
            self.announce("resumed", "resumed")

    def help(self) -> list[str]:
        """Return what the controls of the pad do, in lines of text."""
        mapping = self.teleop.mapping
        about = mapping.description
        lines = [f"mapping {self.mapping}{': ' if about else ''}{about}", *self.teleop.help(self.pad)]
        if len(self.robots) > 1:
            names = ", ".join(robot.name for robot in self.robots)
            if mapping.other_arm is None:
                lines.append(f"one pad for {names}: the mapping has no button other_arm")
            else:
                button = self.pad.control_name(mapping.other_arm)
                lines.append(f"next arm of {names}: {button}, with {self.deadman_name} released")
        return lines


def share_pads(robots: Sequence[Robot], pads: Sequence[Gamepad]) -> list[tuple[Gamepad, list[Robot]]]:
    """Return which pad drives which arms.

    A pad drives the arm that its entry in the rig names (``drives``); the others get the arms that are left, in order.
    Arms without a pad of their own are driven by the first pad, one at a time.

    Args:
        robots: The arms to drive, at least one.
        pads: The pads, at least one; those that are not needed, or are the dead-man of a leader, are left out.
    """
    guards = [pad.guard for pad in pads]
    pads = _drop_shared([pad for pad in pads if pad not in guards])
    left = {robot.name: robot for robot in robots}
    shared: list[tuple[Gamepad, list[Robot]]] = []
    for pad in pads:
        name = pad.driver.spec.drives
        if name in left:
            shared.append((pad, [left.pop(name)]))
    for pad in pads:
        if left and pad.driver.spec.drives is None and pad not in [used for used, _ in shared]:
            shared.append((pad, [left.pop(next(iter(left)))]))
    if not shared:  # every pad is meant for another arm
        shared.append((pads[0], []))
    shared[0][1].extend(left.values())
    order = list(robots)
    return sorted(shared, key=lambda entry: order.index(entry[1][0]))


def _drop_shared(pads: Sequence[Gamepad]) -> list[Gamepad]:
    """Leave out further pads whose input is that of one before: the page, a hand, or the keys."""
    found: dict[object, Gamepad] = {}
    for pad in pads:
        spec = pad.driver.spec
        source = registry.driver(spec.driver).pad_input
        found.setdefault((source, spec.hand) if source in ("console", "keys") else spec.name, pad)
    return list(found.values())
