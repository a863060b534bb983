"""A teleoperation session: an arm driven with a gamepad, across stops, faults and changes of the pad."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np

from .errors import (
    CommandError,
    ConnectionLost,
    HalError,
    MotionStopped,
    NotSupported,
    RobotFault,
    StaleStateError,
)
from .learning.episode import reset_scene, stands_in_world
from .teleop import Teleop, twist_towards
from .views import DrivingView

if TYPE_CHECKING:
    from .commands import Twist
    from .deadman import Deadman
    from .gamepad import Gamepad
    from .rig import Rig
    from .robot import Robot
    from .types import PadState, RobotState

__all__ = ["SessionEvent", "SessionEventKind", "TeleopSession"]

RATE_HZ = 50.0
"""Rate at which the pad is read and commands are sent, Hz."""
STATE_AGE = 2.0
"""Greatest age of a state that is only shown, s."""
HOMING_PATIENCE = 0.2
"""Time without the dead-man after which a move home is cancelled, s."""
RETRY_DELAY = 0.1
"""Pause after a stop, before the next control session is opened, s."""

T = TypeVar("T")
Until = Callable[["PadState"], str]

SessionEventKind = Literal[
    "stopped",
    "fault",
    "resumed",
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
* ``homing``, ``homing_cancelled``, ``home_reached``: the move home started, was cancelled by releasing the dead-man, or
  is complete.
* ``pad_changed``: a pad with another mapping was plugged in and is used from now on.
* ``pad_refused``: it was plugged in, but may not be the dead-man of this arm.
* ``robot_changed``, ``scene_reset``, ``setting_refused``: a page of the console chose another arm, reset the simulated
  scene, or changed a setting while the dead-man was held, which has no effect.
* ``gripper_fault``, ``gripper_recovered``: the gripper does not answer, or answers again; the arm continues without it.
* ``message``: text of the program, see :meth:`TeleopSession.announce`.
"""


@dataclass(frozen=True, slots=True)
class SessionEvent:
    """An event of a teleoperation session."""

    kind: SessionEventKind
    text: str
    """One line for the user."""
    reason: str = ""
    """Cause of a stop or a fault, without the remedy; else empty."""


class _Due(Enum):
    """An action for which the control session has to end first."""

    HOME = "home"
    OTHER_PAD = "other pad"
    OTHER_ROBOT = "other robot"
    RESET_SCENE = "reset scene"


class TeleopSession:
    """Drive an arm with a gamepad until the program has a reason to end.

    A session opens one control session (:meth:`hal.Robot.control`) after another: when a stop or a fault ends one, the
    next follows as soon as the arm permits, and the arm moves again after a new press of the dead-man. The arm is at
    rest between them. The session also

    * drives the arm home when the mapping's button is pressed with the dead-man held;
    * changes the mapping when another kind of pad is plugged in;
    * follows the gizmo of the 3D view while the sticks are at rest;
    * applies the settings that a page of the console changes, if ``adjustable``.

    Everything runs in the thread that calls :meth:`run`, callbacks included. Nothing is printed: events go to
    ``on_event`` and, as text, to the pages of the console.

    Example:
        Drive the first arm of a rig with its first pad until Ctrl-C::

            with hal.open("panda_table", sim=True) as rig:
                session = hal.TeleopSession(rig, on_event=lambda event: print(event.text))
                print(session.help())
                session.run()
    """

    def __init__(
        self,
        rig: Rig,
        robot: Robot | None = None,
        pad: Gamepad | None = None,
        *,
        mapping: str | None = None,
        speed: float = 1.0,
        actions: tuple[str, ...] = (),
        adjustable: bool = False,
        on_event: Callable[[SessionEvent], None] | None = None,
        on_tick: Callable[[], None] | None = None,
    ) -> None:
        """Prepare a session; nothing moves before :meth:`run`.

        Args:
            rig: Open rig.
            robot: Arm to drive; None for the rig's first one.
            pad: Gamepad that drives it; None for the rig's first one.
            mapping: Name or file of the teleoperation mapping; None for the one that the plugged-in pad is meant for.
            speed: Share of the mapping's speeds, above 0, at most 1. The console cannot exceed it.
            actions: Actions of the mapping (``record``, ``finish``, ...) that the program handles, for the labels on
                the console.
            adjustable: Whether a page of the console may choose the arm, the speed and the frame, and reset a
                simulated scene.
            on_event: Called with every :class:`SessionEvent`.
            on_tick: Called after every command, with :attr:`state` updated.

        Raises:
            CommandError: The rig has no robot or no gamepad.
            ConfigError: The mapping is wrong.
        """
        self.rig = rig
        self.robot = _first(robot, rig.robots.values(), f"{rig.plan.source} has no robot", "no_robot")
        missing = f"{rig.plan.source} has no gamepad; add 'gamepads: {{pad: {{model: auto}}}}'"
        self.pad = _first(pad, rig.gamepads.values(), missing, "no_gamepad")
        self.state: RobotState | None = None
        """Newest state of the arm; None while it does not answer."""
        self.stopped = ""
        """Why the arm does not follow the pad; empty while it does."""
        self.gripper_trouble = ""
        """Why the gripper does not answer; empty while it does."""
        self.mapping = ""
        """Name or file of the mapping that is used."""
        self._mapping_wanted = mapping
        self._speed = self._speed_max = speed
        self._actions = actions
        self._on_event = on_event
        self._on_tick = on_tick
        self._refused_pad = ""
        self._changes: dict[str, str | float] = {}
        """Settings that the page in control changed and that are not applied yet, the newest value of each."""
        self._next_robot = ""
        self._settings = self._available_settings() if adjustable else ()
        self._load_mapping()
        if self._settings and rig.console is not None:
            rig.console.on_setting(self._changes.__setitem__)

    @property
    def teleop(self) -> Teleop:
        """The present conversion of pad states into commands."""
        return self._teleop

    @property
    def deadman(self) -> Deadman:
        """The present dead-man."""
        return self._deadman

    @property
    def deadman_name(self) -> str:
        """Name of the dead-man's control as printed on the pad, for example ``L2``."""
        return self.pad.control_name(self.teleop.mapping.deadman)

    @property
    def drives_home(self) -> bool:
        """Whether :meth:`reset_scene` has to drive the arm home; a simulated arm is placed there."""
        return not stands_in_world(self.rig, self.robot)

    def help(self) -> str:
        """Return what the controls of the pad do, in a few lines."""
        about = self.teleop.mapping.description
        lines = [f"drives {self.robot.name}"] if len(self.rig.robots) > 1 else []
        lines += [f"mapping {self.mapping}{': ' if about else ''}{about}", *self.teleop.help(self.pad)]
        return "\n".join(f"  {line}" for line in lines)

    def run(self, until: Until | None = None) -> str:
        """Follow the pad.

        Args:
            until: Called with the pad's state after every command, and while there is no control session; a non-empty
                result ends the run. None runs until a recorded pad has ended.

        Returns:
            The result of ``until``. The arm is at rest.

        Raises:
            ConnectionLost: The arm's process is gone.
            KeyboardInterrupt: Ctrl-C. The arm is at rest.
        """
        check = until or self._pad_finished
        while True:
            due = self.guard(lambda: self._follow_pad(check)) or self._apply_settings()
            if due is _Due.HOME:
                self.guard(self._go_home)
            elif due is _Due.OTHER_PAD:
                self.use_plugged_pad()
            elif due is _Due.OTHER_ROBOT:
                self._use_other_robot()
            elif due is _Due.RESET_SCENE:
                self._reset_world()
            elif reason := due or check(self.pad.state()):
                return str(reason)

    def reset_scene(self, seed: int, keep_waiting: Callable[[], bool] = lambda: True) -> bool:
        """Reset the scene for an episode: simulated objects and arms are placed, any other arm drives home.

        An arm drives home only for a press of the dead-man that is made for this: a press that began before this call,
        or before a stop, does not count. At home its gripper opens.

        Args:
            seed: Seed of the poses of objects with random ranges.
            keep_waiting: Called ten times a second while the dead-man is released; False cancels.

        Returns:
            Whether the scene was reset; False if ``keep_waiting`` cancelled it.

        Raises:
            ConnectionLost: The arm's process is gone.
        """
        deadman, presses = self.deadman, self.deadman.record.presses
        while keep_waiting():
            if deadman is not self.deadman:  # of another pad, which counts its own presses
                deadman, presses = self.deadman, self.deadman.record.presses
            record = deadman.record
            if not self.drives_home or (record.held and record.presses > presses):
                if self.guard(partial(self._try_reset, seed, presses)):
                    self._open_gripper()
                    return True
                presses = deadman.record.presses  # stopped on the way: a new press is needed
            else:
                self.use_plugged_pad()
                self.rig.clock.sleep(RETRY_DELAY)
        return False

    def guard(self, motion: Callable[[], T]) -> T | None:
        """Call a function that moves the arm, and turn what stops the arm into an event.

        Args:
            motion: Function without arguments.

        Returns:
            Its result; None, after a short pause, if a stop, a fault or a lost connection ended it.

        Raises:
            ConnectionLost: The arm's process is gone, so that another attempt is pointless.
        """
        try:
            return motion()
        except MotionStopped as stop:  # a new control session needs the stop to be acknowledged first
            self._note_stop(stop)
        except RobotFault as fault:
            self._note_fault(fault)
        except (ConnectionLost, StaleStateError) as lost:
            self._note_lost(lost)
        except NotSupported as refusal:
            if self.pad.state().connected:
                raise
            self._note_stop(refusal)  # an unplugged pad cannot be trusted as a dead-man
        self.rig.clock.sleep(RETRY_DELAY)
        return None

    def announce(self, text: str, kind: SessionEventKind = "message", reason: str = "") -> None:
        """Pass a line of text to ``on_event`` and to the pages of the console."""
        if self._on_event is not None:
            self._on_event(SessionEvent(kind, text, reason))
        self.rig.say(text)

    def use_plugged_pad(self) -> None:
        """Use the mapping of the pad that is plugged in, if it is another one and the pad may drive this arm.

        :meth:`run` does this by itself. The new dead-man counts once it was released.
        """
        if self._other_pad_ready():
            self._load_mapping()
            self.announce(f"driving with {self.pad.describe()}", "pad_changed")

    # One control session.

    def _follow_pad(self, until: Until) -> str | _Due:
        """Follow the pad in one control session; return why it ended."""
        seen = -1
        with self.robot.control(deadman=self.deadman, rate_hz=RATE_HZ) as control:
            self.teleop.reset()
            if self.rig.viewer3d is not None:
                self.rig.viewer3d.clear_goal(self.robot.name)
            for tick in self.rig.clock.rate(RATE_HZ):
                state = self.pad.state()
                fresh, seen = state.stamp.seq != seen, state.stamp.seq
                motion, grip = self.teleop.step(state, tick.dt)
                motion = self._follow_gizmo(motion)
                try:
                    control.send(motion, grip=grip, t_event=state.stamp.t if fresh else 0.0)
                    self._note_resumed()
                except MotionStopped as stop:
                    self._note_stop(stop)
                except RobotFault as fault:
                    self._note_fault(fault)
                self._update_state()
                if self._on_tick is not None:
                    self._on_tick()
                if due := until(state) or self._due(state):
                    return due
        raise AssertionError("a paced loop does not end")

    def _follow_gizmo(self, motion: Twist) -> Twist:
        """Return the velocity towards the gizmo of the 3D view if it was dragged; moving a stick resets the gizmo."""
        view, name = self.rig.viewer3d, self.robot.name
        goal = view.goal(name) if view is not None else None
        if view is None or goal is None:
            return motion
        if motion.linear.any() or motion.angular.any():
            view.clear_goal(name)
            return motion
        linear, angular = self.teleop.mapping.speeds()
        speed = self.teleop.speed
        return twist_towards(goal, self.robot.state(max_age=STATE_AGE).tcp_set, speed * linear, speed * angular)

    def _update_state(self) -> None:
        try:
            self.state = self.robot.state(max_age=STATE_AGE)
        except (ConnectionLost, StaleStateError):
            self.robot.check()
            self.state = None
            return
        trouble = self.robot.gripper.trouble if self.robot.gripper is not None else ""
        if trouble and not self.gripper_trouble:
            self.announce(f"GRIPPER: {trouble}", "gripper_fault", trouble)
        elif self.gripper_trouble and not trouble:
            self.announce("the gripper answers again", "gripper_recovered")
        self.gripper_trouble = trouble

    def _due(self, state: PadState) -> str | _Due:
        """Return what has to be done outside of a control session, if anything."""
        if self.teleop.home_pressed(state) and self.deadman.held:
            return _Due.HOME
        return _Due.OTHER_PAD if self._other_pad_ready() else self._apply_settings()

    def _pad_finished(self, state: PadState) -> str:
        return "the recorded pad has ended" if self.pad.finished else ""

    # The way home.

    def _go_home(self) -> None:
        self.announce(f"homing: hold {self.deadman_name} until the arm is there", "homing")
        try:
            self.robot.move_to(self.robot.home, deadman=self.deadman, patience=HOMING_PATIENCE)
        except MotionStopped:
            if self.deadman.held or not self.deadman.connected:
                raise
            self.announce(f"homing cancelled: {self.deadman_name} released", "homing_cancelled")
        else:
            name = self.deadman_name
            self.announce(f"home reached: release {name}, then hold it again to drive", "home_reached")

    def _try_reset(self, seed: int, since: int) -> bool:
        """Reset the scene; return False if the dead-man was released on the way home.

        Args:
            seed: See :meth:`reset_scene`.
            since: Number of presses of the dead-man that do not count.
        """
        deadman = self.deadman
        try:
            reset_scene(
                self.rig,
                self.robot,
                random=np.random.default_rng(seed),
                deadman=deadman,
                since=since,
                patience=HOMING_PATIENCE,
                open_gripper=False,
            )
        except MotionStopped:
            if deadman.held or not deadman.connected or not self.drives_home:
                raise
            return False
        return True

    def _open_gripper(self) -> None:
        """Open the gripper of an arm that drove home; the arm continues without a gripper that cannot."""
        if self.drives_home and self.robot.gripper is not None:
            try:
                self.robot.gripper.open()
            except (HalError, OSError) as trouble:
                self.announce(f"GRIPPER: {trouble}", "gripper_fault", str(trouble))

    # The mapping, which depends on the pad that is plugged in.

    def _due_mapping(self) -> str:
        """Return the mapping to use: the wanted one, else that of the plugged-in pad, else the present one."""
        if self._mapping_wanted or (self.mapping and not self.pad.state().connected):
            return self._mapping_wanted or self.mapping
        return self.pad.mapping or "default"

    def _load_mapping(self) -> None:
        """Use the mapping that is due. Its dead-man must be released and pressed before it counts."""
        self.mapping = self._due_mapping()
        self._teleop = Teleop(self.robot, mapping=self.mapping, speed=self._speed)
        self._deadman = self.pad.hold(self._teleop.mapping.deadman)
        self._show_driving()

    def _other_pad_ready(self) -> bool:
        """Whether a pad with another mapping is plugged in and may drive this arm."""
        if self._due_mapping() == self.mapping:
            return False
        spec = self.robot.spec
        why = (self.pad.distrust() or "") if spec.attended and not spec.emulated else ""
        if why and why != self._refused_pad:
            self.announce(why, "pad_refused", why)
        self._refused_pad = why
        return not why

    # Settings that a page of the console changes.

    def _available_settings(self) -> tuple[str, ...]:
        """Return what a page may set: the arm if there are several, and the scene if nothing real moves."""
        arms = ("robot",) if len(self.rig.robots) > 1 else ()
        scene = ("scene",) if self.rig.plan.world is not None and not self.rig.attended else ()
        return ("speed", "frame", *arms, *scene)

    def _show_driving(self) -> None:
        """Show on the console which arm is driven, how fast, and what the controls do."""
        console, teleop = self.rig.console, self.teleop
        if console is not None:
            console.explain(teleop.labels(actions=("home", *self._actions)))
            view = DrivingView(self.robot.name, teleop.speed, self._speed_max, teleop.frame, self._settings)
            console.show_driving(view)

    def _apply_settings(self) -> Literal[""] | _Due:
        """Apply what the page in control has set; return what has to be done outside of a control session, if anything.

        The arm and the frame change only while the dead-man is released, so that no control that is held moves another
        arm, or in another direction.
        """
        while self._changes:
            name, value = self._changes.popitem()
            if name == "speed":
                self._speed = self.teleop.speed = min(float(value), self._speed_max)
                self._show_driving()
            elif name == "scene":
                return _Due.RESET_SCENE
            elif self.deadman.held:
                what = "arm" if name == "robot" else name
                self.announce(f"the {what} was not changed: release {self.deadman_name} first", "setting_refused")
            elif name == "frame":
                self.teleop.frame = "tcp" if value == "tcp" else "base"
                self._show_driving()
            elif value != self.robot.name:
                self._next_robot = str(value)
                return _Due.OTHER_ROBOT
        return ""

    def _use_other_robot(self) -> None:
        """Drive the arm that was chosen on the page; its dead-man must be pressed again."""
        self.robot = self.rig.robots[self._next_robot]
        self.stopped = self.gripper_trouble = ""
        self.state = None
        self._load_mapping()
        self.announce(f"driving {self.robot.name}", "robot_changed")

    def _reset_world(self) -> None:
        """Reset the simulated scene. The control session has ended, so the arm is at rest."""
        self.rig.world.reset()
        self.announce(f"scene reset: hold {self.deadman_name} again to drive", "scene_reset")

    # Stops and faults: one event for each.

    def _note_stop(self, stop: Exception) -> None:
        if self.stopped != str(stop):
            self.stopped = str(stop)
            self.announce(f"STOPPED: {stop}", "stopped", getattr(stop, "reason", str(stop)))

    def _note_fault(self, fault: Exception) -> None:
        if self.stopped != str(fault):
            self.stopped = str(fault)
            self.announce(f"FAULT: {fault}", "fault", getattr(fault, "cause", str(fault)))

    def _note_lost(self, lost: Exception) -> None:
        """Note that the arm does not answer. Raises ConnectionLost if its process is gone."""
        self.robot.check()
        self.state = None
        if not self.stopped:  # the message counts the seconds, so it would be a new event each time
            self._note_stop(lost)

    def _note_resumed(self) -> None:
        if self.stopped:
            self.stopped = ""
            self.announce("resumed", "resumed")


def _first(given: T | None, devices: Iterable[T], missing: str, code: str) -> T:
    """Return ``given``, else the first of ``devices``."""
    found = given if given is not None else next(iter(devices), None)
    if found is None:
        raise CommandError(missing, code=code)
    return found
