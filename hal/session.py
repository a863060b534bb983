"""A teleoperation session: arms driven with gamepads, across stops, faults and changes of the pad."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeVar

import numpy as np

from . import registry
from .errors import (
    CommandError,
    ConnectionLost,
    HalError,
    MotionStopped,
    NotSupported,
    RobotFault,
    StaleStateError,
)
from .leading import make_teleop
from .learning.episode import reset_scene, stands_in_world
from .teleop import HOMING_PATIENCE, STILL, ArmTeleop, SessionEventKind, Teleop, share_pads
from .views import DrivingView

if TYPE_CHECKING:
    from .control import Control
    from .deadman import Deadman
    from .gamepad import Gamepad
    from .rig import Rig
    from .robot import Robot
    from .types import PadState, RobotState

RATE_HZ = 50.0
"""Rate at which commands are sent, Hz, beside those for changes of the pad."""
RETRY_DELAY = 0.1
"""Pause after a stop, before the next control session is opened, s."""
REOPEN_PERIOD = 1.0
"""Time between two attempts to reach an independent arm that does not answer, s; made while no dead-man is held."""

T = TypeVar("T")
Until = Callable[["PadState"], str]


@dataclass(frozen=True, slots=True)
class SessionEvent:
    """An event of a teleoperation session."""

    kind: SessionEventKind
    text: str
    """One line for the user."""
    reason: str = ""
    """Cause of a stop or a fault, without the remedy; else empty."""
    robot: str = ""
    """Name of the arm; empty for what concerns all of them."""


class _Task(Enum):
    """An action for which the control sessions have to end first."""

    HOME = "home"
    OTHER_PAD = "other pad"
    OTHER_ROBOT = "other robot"
    RESET_SCENE = "reset scene"
    REOPEN = "reopen"


class _Due(NamedTuple):
    """A task, the arm that it concerns, and the arm to be driven instead."""

    task: _Task
    arm: ArmTeleop
    robot: Robot | None = None


class TeleopSession:
    """Drive arms with gamepads until the program has a reason to end.

    A session opens one control session (:meth:`hal.Robot.control`) after another: when a stop or a fault ends one, the
    next follows as soon as the arm permits, and the arm moves again after a new press of the dead-man. The arm is at
    rest between them. The session also

    * drives several arms at once, each with its own pad and dead-man; one that stops brings the others to rest, and
      each of them then needs a new press (unless ``independent``);
    * hands a pad that has several arms on to the next one with the mapping's button ``other_arm``, while the dead-man
      is released; an arm that is not driven holds;
    * drives the arm home when the mapping's button is pressed with the dead-man held;
    * changes the mapping when another kind of pad is plugged in;
    * follows the gizmo of the 3D view while the sticks are at rest;
    * applies the settings that a page of the console changes, if ``adjustable``.

    Nothing moves before :meth:`run`. Everything runs in the thread that calls it, callbacks included. Nothing is
    printed: events go to ``on_event`` and, as text, to the pages of the console.

    Example:
        Drive the first arm of a rig with its first pad until Ctrl-C::

            with hal.open("panda_table", sim=True) as rig:
                session = hal.TeleopSession(rig, on_event=lambda event: print(event.text))
                print(session.help())
                session.run()

    Args:
        rig: Open rig.
        robot: Arm to drive, or several; None for the rig's first one.
        pad: Gamepad that drives it, or several; None for as many of the rig's as there are arms. A pad drives the
            arm that its entry in the rig names (``drives``), else the next one; a single pad drives one after
            the other.
        independent: Whether an arm that stops leaves the others moving.
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

    def __init__(
        self,
        rig: Rig,
        robot: Robot | Sequence[Robot] | None = None,
        pad: Gamepad | Sequence[Gamepad] | None = None,
        *,
        independent: bool = False,
        mapping: str | None = None,
        speed: float = 1.0,
        actions: tuple[str, ...] = (),
        adjustable: bool = False,
        on_event: Callable[[SessionEvent], None] | None = None,
        on_tick: Callable[[], None] | None = None,
    ) -> None:
        self.rig = rig
        robots = _list_given(robot, list(rig.robots.values())[:1], f"{rig.plan.source} has no robot", "no_robot")
        missing = f"{rig.plan.source} has no gamepad; add 'gamepads: {{pad: {{model: auto}}}}'"
        pads = _list_given(pad, list(rig.gamepads.values()), missing, "no_gamepad")
        self._several = len(robots) > 1
        self.arms = tuple(
            ArmTeleop(arms, pad, mapping, speed, self._announce, make_teleop) for pad, arms in share_pads(robots, pads)
        )
        """The arms that are driven at once, each with its pad."""
        self._arm = self.arms[0]
        """The arm that the next error concerns."""
        self._independent = independent
        self._speed = self._speed_max = speed
        self._actions = actions
        self._on_event = on_event
        self._on_tick = on_tick
        self._moved = threading.Event()
        """Set by a pad that has changed."""
        for arm in self.arms:
            arm.pad.wake(self._moved)
        self._changes: dict[str, str | float] = {}
        """Settings that the page in control changed and that are not applied yet, the newest value of each."""
        self._reopen_at = 0.0
        """Time at which an arm that did not answer is tried again, s."""
        self._settings = self._available_settings() if adjustable else ()
        self._show_driving()
        if self._settings and rig.console is not None:
            rig.console.on_setting(self._changes.__setitem__)

    # The first arm, which is the only one in most sessions.

    @property
    def robot(self) -> Robot:
        """The first arm that is driven."""
        return self.arms[0].robot

    @property
    def pad(self) -> Gamepad:
        """The pad of the first arm."""
        return self.arms[0].pad

    @property
    def teleop(self) -> Teleop:
        """The present conversion of its pad's states into commands."""
        return self.arms[0].teleop

    @property
    def deadman(self) -> Deadman:
        """The present dead-man of the first arm."""
        return self.arms[0].deadman

    @property
    def deadman_name(self) -> str:
        """Name of the dead-man's control as printed on the pad, for example ``L2``."""
        return self.arms[0].deadman_name

    @property
    def mapping(self) -> str:
        """Name or file of the mapping that is used."""
        return self.arms[0].mapping

    @property
    def state(self) -> RobotState | None:
        """Newest state of the first arm; None while it does not answer."""
        return self.arms[0].state

    @property
    def stopped(self) -> str:
        """Why the first arm does not follow its pad; empty while it does."""
        return self.arms[0].stopped

    @property
    def gripper_trouble(self) -> str:
        """Why its gripper does not answer; empty while it does."""
        return self.arms[0].gripper_trouble

    @property
    def held(self) -> bool:
        """Whether the dead-man of any arm is held."""
        return any(arm.deadman.held for arm in self.arms)

    @property
    def finished(self) -> bool:
        """Whether every pad is a recording that has ended."""
        return all(arm.pad.finished for arm in self.arms)

    @property
    def drives_home(self) -> bool:
        """Whether :meth:`reset_scene` has to drive an arm home; a simulated arm is placed there."""
        return any(not stands_in_world(self.rig, robot) for arm in self.arms for robot in arm.robots)

    def help(self) -> str:
        """Return what the controls of the pads do, in a few lines."""
        lines = []
        for arm in self.arms:
            if len(self.rig.robots) > 1:
                lines.append(f"{arm.pad.name} drives {arm.robot.name}")
            lines += arm.help()
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
            due = self.guard(lambda: self._follow_pads(check)) or self._apply_settings()
            if isinstance(due, _Due):
                self._arm = due.arm
                self._carry_out(due)
            elif reason := due or check(self.pad.state()):
                return str(reason)

    def _carry_out(self, due: _Due) -> None:
        if due.task is _Task.HOME:
            self.guard(due.arm.go_home)
        elif due.task is _Task.OTHER_PAD:
            self.use_plugged_pad()
        elif due.task is _Task.OTHER_ROBOT and due.robot is not None:
            self._use_other_robot(due.arm, due.robot)
        elif due.task is _Task.RESET_SCENE:
            self._reset_world()

    def reset_scene(self, seed: int, keep_waiting: Callable[[], bool] = lambda: True) -> bool:
        """Reset the scene for an episode: simulated objects and arms are placed, any other arm drives home.

        An arm drives home only for a press of the dead-man that is made for this: a press that began before this call,
        or before a stop, does not count. At home its gripper opens.

        Args:
            seed: Seed of the poses of objects with random ranges, and of what ``simulation.randomize`` varies.
            keep_waiting: Called ten times a second while the dead-man is released; False cancels.

        Returns:
            Whether the scene was reset; False if ``keep_waiting`` cancelled it.

        Raises:
            ConnectionLost: The arm's process is gone.
        """
        for arm in self.arms:
            for robot in arm.robots:
                if not self._reset_arm(arm, robot, seed, keep_waiting):
                    return False
        return True

    def _reset_arm(self, arm: ArmTeleop, robot: Robot, seed: int, keep_waiting: Callable[[], bool]) -> bool:
        """Reset the scene, and bring one arm home in it; return False if ``keep_waiting`` cancelled it."""
        self._arm = arm
        drives = not stands_in_world(self.rig, robot)
        if drives and robot is not arm.robot:
            self._use_other_robot(arm, robot)
        deadman, presses = arm.deadman, arm.deadman.record.presses
        while keep_waiting():
            if deadman is not arm.deadman:  # of another pad, which counts its own presses
                deadman, presses = arm.deadman, arm.deadman.record.presses
            record = deadman.record
            if not drives or (record.held and record.presses > presses):
                if self.guard(partial(self._try_reset, arm, robot, seed, presses)):
                    self._open_gripper(robot)
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
        except (MotionStopped, RobotFault, ConnectionLost, StaleStateError, NotSupported) as error:
            self._arm.note_trouble(error)
        self.rig.clock.sleep(RETRY_DELAY)
        return None

    def announce(self, text: str, kind: SessionEventKind = "message", reason: str = "") -> None:
        """Pass a line of text to ``on_event`` and to the pages of the console."""
        self._announce("", text, kind, reason)

    def _announce(self, robot: str, text: str, kind: SessionEventKind, reason: str) -> None:
        """The same about an arm, whose name is put in front if there are several."""
        if robot and self._several:
            text = f"{robot}: {text}"
        if self._on_event is not None:
            self._on_event(SessionEvent(kind, text, reason, robot))
        self.rig.say(text)

    def use_plugged_pad(self) -> None:
        """Use the mapping of the pad that is plugged in, if it is another one and the pad may drive this arm.

        :meth:`run` does this by itself. The new dead-man counts once it was released.
        """
        for arm in self.arms:
            if arm.other_pad_ready():
                arm.load_mapping()
                self._show_driving()
                arm.announce(f"driving with {arm.pad.describe()}", "pad_changed")

    # One control session of each arm.

    def _follow_pads(self, until: Until) -> str | _Due:
        """Follow the pads in one control session of each arm; return why they ended."""
        with ExitStack() as sessions:
            controls = self._open_controls(sessions)
            sessions.callback(_brake, controls.values())  # all at once, before the first is waited for
            for tick in self.rig.clock.rate(RATE_HZ, self._moved):
                for arm in self.arms:
                    if arm in controls and not self._drive(arm, controls[arm], tick.dt):
                        del controls[arm]
                self._hold_others()
                if self._on_tick is not None:
                    self._on_tick()
                if due := until(self.pad.state()) or self._find_due(len(controls) < len(self.arms)):
                    return due
        raise AssertionError("a paced loop does not end")

    def _open_controls(self, sessions: ExitStack) -> dict[ArmTeleop, Control]:
        """Open a control session of each arm. Only independent arms can do without another that does not answer."""
        controls: dict[ArmTeleop, Control] = {}
        for arm in self.arms:
            self._arm = arm
            try:
                controls[arm] = sessions.enter_context(arm.robot.control(deadman=arm.deadman, rate_hz=RATE_HZ))
            except (MotionStopped, RobotFault, ConnectionLost, StaleStateError, NotSupported) as error:
                if not self._independent or (arm is self.arms[-1] and not controls):
                    raise
                self._give_up(arm, error)
            arm.teleop.reset()
            arm.seen = -1
            if self.rig.viewer3d is not None:
                self.rig.viewer3d.clear_goal(arm.robot.name)
        return controls

    def _drive(self, arm: ArmTeleop, control: Control, dt: float) -> bool:
        """Send an arm the command of its pad; return False if the arm is lost, and the others go on without it."""
        self._arm = arm
        state = arm.pad.state()
        fresh, arm.seen = state.stamp.seq != arm.seen, state.stamp.seq
        try:
            motion, grip = arm.teleop.command(state, dt)
            if arm.held_for:
                motion, grip = STILL, None
            motion = arm.follow_gizmo(motion, self.rig.viewer3d)
            control.send(motion, grip=grip, t_event=state.stamp.t if fresh else 0.0)
            arm.note_resumed()
        except (MotionStopped, RobotFault) as stop:
            arm.note_trouble(stop)
        except (ConnectionLost, StaleStateError) as lost:
            if not self._independent or len(self.arms) == 1:
                raise
            self._give_up(arm, lost)
            return False
        arm.update_state()
        return True

    def _give_up(self, arm: ArmTeleop, error: Exception) -> None:
        """Go on without an arm that does not answer, and try it again later."""
        arm.note_trouble(error)
        self._reopen_at = self.rig.clock.now() + REOPEN_PERIOD

    def _hold_others(self) -> None:
        """Bring an arm to rest while another one is stopped; it needs a new press of its own dead-man."""
        if self._independent:
            return
        for arm in self.arms:
            other = next((other for other in self.arms if other is not arm and other.stopped), None)
            if other is not None and not arm.stopped:
                if not arm.held_for:
                    arm.held_for = other.robot.name
                    text = f"holds, because {other.robot.name} stopped: release {arm.deadman_name} and hold it again"
                    arm.announce(text, "held")
                arm.deadman.disarm()
            elif arm.held_for:
                arm.held_for = ""

    def _find_due(self, lacking: bool) -> str | _Due:
        """Return what has to be done outside of the control sessions, if anything; ``lacking``: an arm has none."""
        for arm in self.arms:
            state = arm.pad.state()
            if arm.teleop.home_pressed(state) and arm.deadman.held:
                return _Due(_Task.HOME, arm)
            if arm.other_pad_ready():
                return _Due(_Task.OTHER_PAD, arm)
            if arm.teleop.other_arm_pressed(state) and len(arm.robots) > 1:
                if not arm.deadman.held:
                    return _Due(_Task.OTHER_ROBOT, arm, arm.next_robot)
                self._refuse_setting(arm, "arm")
        if lacking and not self.held and self.rig.clock.now() >= self._reopen_at:
            return _Due(_Task.REOPEN, self._arm)
        return self._apply_settings()

    def _pad_finished(self, state: PadState) -> str:
        return "the recorded pad has ended" if self.finished else ""

    # The way home.

    def _try_reset(self, arm: ArmTeleop, robot: Robot, seed: int, since: int) -> bool:
        """Reset the scene; return False if the dead-man was released on the way home.

        Args:
            arm: The pad, and the arm that it drives.
            robot: The arm to bring home.
            seed: See :meth:`reset_scene`.
            since: Number of presses of the dead-man that do not count.
        """
        deadman = arm.deadman
        try:
            reset_scene(
                self.rig,
                robot,
                random=np.random.default_rng(seed),
                seed=seed,
                deadman=deadman,
                since=since,
                patience=HOMING_PATIENCE,
                open_gripper=False,
            )
        except MotionStopped:
            if deadman.held or not deadman.connected or stands_in_world(self.rig, robot):
                raise
            return False
        return True

    def _open_gripper(self, robot: Robot) -> None:
        """Open the gripper of an arm that drove home; the arm continues without a gripper that cannot."""
        if robot.gripper is not None and not stands_in_world(self.rig, robot):
            try:
                robot.gripper.open()
            except (HalError, OSError) as trouble:
                self._arm.announce(f"GRIPPER: {trouble}", "gripper_fault", str(trouble))

    # Settings that a page of the console changes.

    def _available_settings(self) -> tuple[str, ...]:
        """Return what a page may set: the arm if one pad drives several, and the scene if nothing real moves."""
        arms = ("robot",) if len(self.rig.robots) > 1 and len(self.arms) == 1 else ()
        scene = ("scene",) if self.rig.plan.world is not None and not self.rig.attended else ()
        return ("speed", "frame", *arms, *scene)

    def _show_driving(self) -> None:
        """Show on the console which arm its pad drives, else the first, how fast, and what the controls do."""
        console = self.rig.console
        if console is not None:
            page = registry.pad_driver("console")
            specs = [(arm, arm.pad.driver.spec) for arm in self.arms]
            arm = next((arm for arm, spec in specs if spec.driver == page and not spec.hand), self.arms[0])
            teleop, several = arm.teleop, ("other_arm",) if len(arm.robots) > 1 else ()
            console.explain(teleop.labels(actions=("home", "jog", *several, *self._actions)))
            console.show_driving(
                DrivingView(arm.robot.name, teleop.speed, self._speed_max, teleop.frame, self._settings)
            )

    def _apply_settings(self) -> Literal[""] | _Due:
        """Apply what the page in control has set; return what has to be done outside of a control session, if anything.

        The arm and the frame change only while the dead-man is released, so that no control that is held moves another
        arm, or in another direction.
        """
        while self._changes:
            name, value = self._changes.popitem()
            if name == "speed":
                self._speed = min(float(value), self._speed_max)
                for arm in self.arms:
                    arm.set_speed(self._speed)
                self._show_driving()
            elif name == "scene":
                return _Due(_Task.RESET_SCENE, self.arms[0])
            elif self.held:
                self._refuse_setting(self.arms[0], "arm" if name == "robot" else name)
            elif name == "frame":
                for arm in self.arms:
                    arm.teleop.frame = "tcp" if value == "tcp" else "base"
                self._show_driving()
            elif value != self.robot.name:
                return _Due(_Task.OTHER_ROBOT, self.arms[0], self.rig.robots[str(value)])
        return ""

    def _refuse_setting(self, arm: ArmTeleop, name: str) -> None:
        arm.announce(f"the {name} was not changed: release {arm.deadman_name} first", "setting_refused")

    def _use_other_robot(self, arm: ArmTeleop, robot: Robot) -> None:
        """Drive another arm with this pad; the dead-man must be pressed again. The last one holds."""
        arm.use_robot(robot)
        self._show_driving()
        self.announce(f"driving {robot.name}", "robot_changed")

    def _reset_world(self) -> None:
        """Reset the simulated scene. The control sessions have ended, so the arms are at rest."""
        self.rig.world.reset()
        self.announce(f"scene reset: hold {self.deadman_name} again to drive", "scene_reset")


def _brake(controls: Iterable[Control]) -> None:
    for control in controls:
        control.brake()


def _list_given(given: T | Sequence[T] | None, default: Sequence[T], missing: str, code: str) -> list[T]:
    """Return what was given as a list, else ``default``. Raises CommandError if it is empty."""
    if given is None:
        found = list(default)
    else:
        found = list(given) if isinstance(given, (list, tuple)) else [given]  # type: ignore[list-item]
    if not found:
        raise CommandError(missing, code=code)
    return found
