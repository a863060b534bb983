"""A person drives an arm with a pad: one session after another, with the stops, the faults and the way home between."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from hal.apps._common import StatusLine
from hal.errors import HalError, MotionStopped

if TYPE_CHECKING:
    from hal.commands import Twist
    from hal.control import Control
    from hal.deadman import Deadman
    from hal.gamepad import Gamepad
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.teleop import Teleop
    from hal.types import PadState

__all__ = [
    "Beginning",
    "Driving",
    "Steering",
    "check_driving",
    "chosen_devices",
]

# [steering.py] What the controls of a pad do in an app: the mapping that was asked for, or the one that the pad
# is meant for.


class Steering:
    """The mapping of a pad, which changes with the pad: a SpaceMouse may be plugged in where a gamepad was before."""

    teleop: Teleop
    deadman: Deadman
    mapping = ""

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        pad: Gamepad,
        asked: str | None,
        speed: float,
        actions: tuple[str, ...] = (),
        settings: tuple[str, ...] = (),
    ) -> None:
        """Use the mapping that is due now.

        Args:
            asked: The mapping that the user wants, whatever the pad is.
            speed: Share of the mapping's speeds; the console cannot exceed it.
            actions: Those of the mapping that the app knows.
            settings: Those of ``hal.views.SETTINGS`` that the console may change.

        Raises:
            ConfigError: For a bad mapping.
        """
        self._rig, self._robot, self._pad, self._asked = rig, robot, pad, asked
        self._speed = self._speed_max = speed
        self._actions, self._settings = actions, settings
        self.take()

    def _wanted(self) -> str:
        """While no pad is there, the one before."""
        if self._asked or (self.mapping and not self._pad.state().connected):
            return self._asked or self.mapping
        return self._pad.mapping or "default"

    @property
    def is_due(self) -> bool:
        """Was a pad plugged in that is meant for another mapping?"""
        return self._wanted() != self.mapping

    def distrust(self) -> str:
        """Why that pad may not drive this arm; nothing where it may."""
        spec = self._robot.spec
        return (self._pad.distrust() or "") if spec.attended and not spec.emulated else ""

    def take(self) -> None:
        """Use the mapping that is due. Its dead-man must be released and pressed before it counts."""
        import hal

        self.mapping = self._wanted()
        self.teleop = hal.Teleop(self._robot, mapping=self.mapping, speed=self._speed)
        self.deadman = self._pad.hold(self.teleop.mapping.deadman)
        self._show()

    def drive(self, robot: Robot) -> None:
        """Drive this arm from the next session on."""
        self._robot = robot
        self.take()

    def set_speed(self, speed: float) -> None:
        """Drive at this share of the mapping's speeds, or at the greatest one that is allowed."""
        self._speed = self.teleop.speed = min(speed, self._speed_max)
        self._show()

    def set_frame(self, frame: str) -> None:
        """Move along the axes of the arm's base, or of its tool."""
        self.teleop.frame = "tcp" if frame == "tcp" else "base"
        self._show()

    def _show(self) -> None:
        """Show on the console's pages which arm is driven, and what the controls do."""
        from hal.views import DrivingView

        console, teleop = self._rig.console, self.teleop
        if console is None:
            return
        console.explain(teleop.labels(actions=("home", *self._actions)))
        view = DrivingView(self._robot.name, teleop.speed, self._speed_max, teleop.frame, self._settings)
        console.show_driving(view)

    def help(self) -> str:
        """For people, some lines."""
        about = self.teleop.mapping.description
        drives = [f"drives {self._robot.name}"] if len(self._rig.robots) > 1 else []
        lines = [*drives, f"mapping {self.mapping}{': ' if about else ''}{about}", *self.teleop.help(self._pad)]
        return "\n".join(f"  {line}" for line in lines)


RATE_HZ = 50.0
STALE = 2.0
"""s; what is only shown may be older than what is acted on."""
LET_GO = 0.2
"""s without the dead-man after which somebody does not want to go home any more."""
AGAIN = 0.1
"""s between two tries where no session can be had."""

HOME, OTHER_PAD, OTHER_ARM, RESET = "home", "other pad", "other arm", "reset"
"""What may be due after a session."""

T = TypeVar("T")
Look = Callable[["PadState"], str]
"""Called in every turn with what the pad does; the reason to end, or nothing."""


def check_driving(args: argparse.Namespace) -> None:
    """Check the options of :func:`~hal.apps._common.add_driving_options` before anything is opened."""
    from hal.config.mapping import load_mapping
    from hal.errors import CommandError
    from hal.pads.choice import check_wanted

    if args.speed is not None and not 0.0 < args.speed <= 1.0:
        raise CommandError(f"--speed must be above 0 and at most 1, not {args.speed:g}")
    load_mapping(args.mapping or "default")
    check_wanted(args.pad)


def chosen_devices(rig: Rig, args: argparse.Namespace) -> tuple[Robot, Gamepad]:
    """The arm that is driven, and the pad that drives it. CommandError where there is none."""
    from hal.errors import CommandError

    name = args.robot or next(iter(rig.robots), None)
    if name is None:
        raise CommandError(f"{rig.plan.source} has no robot to drive")
    if args.pad == "none":
        raise CommandError("--pad none: this program needs something that drives")
    if not rig.gamepads:
        raise CommandError(f"{rig.plan.source} has no gamepad; add 'gamepads: {{pad: {{model: auto}}}}'")
    return rig.robots[name], next(iter(rig.gamepads.values()))


def _settings(rig: Rig) -> tuple[str, ...]:
    """What a page may set: the arm where there are several, and the scene where nothing real moves."""
    arms = ("robot",) if len(rig.robots) > 1 else ()
    scene = ("scene",) if rig.plan.world is not None and not rig.attended else ()
    return ("speed", "frame", *arms, *scene)


class Driving:
    """:meth:`drive` follows the pad, whatever stops the arm in between, until the caller has a reason to end."""

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        pad: Gamepad,
        *,
        mapping: str | None = None,
        speed: float = 1.0,
        actions: tuple[str, ...] = (),
        adjustable: bool = False,
    ) -> None:
        """``actions`` are those of the mapping that the app knows. ``adjustable``: a page of the console may choose the
        arm, the speed and the frame, and reset a simulated scene."""
        from hal.apps._common import RunReport
        # FOLD: import dropped

        self.rig, self.robot, self.pad = rig, robot, pad
        self.report = RunReport(rig, robot)
        self.line = StatusLine()
        self.note = ""
        """What stands first in the live line."""
        self.stopped: str | None = None
        """What stopped the arm, until it follows again."""
        self._hand = ""
        """What is wrong with the gripper."""
        self._distrusted = ""
        """Why the pad that was plugged in may not drive."""
        self._wishes: dict[str, str | float] = {}
        """Settings that the page in control changed: the newest of each."""
        self._next_arm = ""
        settings = _settings(rig) if adjustable else ()
        self._steering = Steering(rig, robot, pad, mapping, speed, actions, settings)
        if settings and rig.console is not None:
            rig.console.on_setting(self._wishes.__setitem__)

    @property
    def teleop(self) -> Teleop:
        """What the pad asks for."""
        return self._steering.teleop

    @property
    def mapping(self) -> str:
        """Name, or file, of what the pad's controls do."""
        return self._steering.mapping

    @property
    def deadman(self) -> Deadman:
        """What must be held."""
        return self._steering.deadman

    def help(self) -> str:
        """What the pad's controls do, for people, some lines."""
        return self._steering.help()

    def event(self, text: str) -> None:
        """Tell it here and on the console's pages."""
        self.line.event(text)
        self.rig.say(text)

    def drive(self, look: Look) -> str:
        """Follow the pad until ``look`` gives a reason to end; returns that. The arm is at rest then."""
        while True:
            after = self.guarded(lambda: self._session(look)) or self._apply_settings()
            if after == HOME:
                self.guarded(self._go_home)
            elif after == OTHER_PAD:
                self.take_other_pad()
            elif after == OTHER_ARM:
                self._take_other_arm()
            elif after == RESET:
                self._reset_scene()
            elif reason := after or look(self.pad.state()):
                return reason

    def guarded(self, motion: Callable[[], T]) -> T | None:
        """Do what moves the arm. None, a moment later, where something stopped that; a person was told what.

        Raises ConnectionLost where the arm's process is gone, so that trying again has no sense.
        """
        from hal.errors import ConnectionLost, MotionStopped, NotSupported, RobotFault, StaleStateError

        try:
            return motion()
        except MotionStopped as stop:  # a new session wants the stop to be acknowledged first
            self._tripped(stop)
        except RobotFault as fault:
            self._faulted(fault)
        except (ConnectionLost, StaleStateError) as lost:
            self._lost(lost)
        except NotSupported as why:
            if self.pad.state().connected:
                raise
            self._tripped(why)  # nobody can hold a pad that is not plugged in
        self.rig.clock.sleep(AGAIN)
        return None

    def _session(self, look: Look) -> str:
        """Follow the pad, until something else is due; returns that."""
        from hal.errors import MotionStopped, RobotFault

        seen = -1
        with self.robot.control(deadman=self.deadman, rate_hz=RATE_HZ) as control:
            self.teleop.reset()
            if self.rig.viewer3d is not None:
                self.rig.viewer3d.clear_goal(self.robot.name)
            for tick in self.rig.clock.rate(RATE_HZ):
                state = self.pad.state()
                fresh, seen = state.stamp.seq != seen, state.stamp.seq
                motion, grip = self.teleop.step(state, tick.dt)
                motion = self._towards_goal(motion)
                try:
                    control.send(motion, grip=grip, t_event=state.stamp.t if fresh else 0.0)
                    self._resumed()
                except MotionStopped as stop:
                    self._tripped(stop)
                except RobotFault as fault:
                    self._faulted(fault)
                self._show(control)
                if due := look(state) or self._due(state):
                    return due
        raise AssertionError("a rate never ends")

    def _due(self, state: PadState) -> str:
        """What must be done outside of a session."""
        if self.teleop.home_pressed(state) and self.deadman.held:
            return HOME
        return OTHER_PAD if self._other_pad() else self._apply_settings()

    def _apply_settings(self) -> str:
        """Apply what the page in control has set; return what must be done outside of a session, or nothing.

        What the controls mean changes only while the dead-man is released, so that nothing that is held moves
        another arm, or moves another way.
        """
        while self._wishes:
            name, value = self._wishes.popitem()
            if name == "speed":
                self._steering.set_speed(float(value))
            elif name == "scene":
                return RESET
            elif self.deadman.held:
                self.event(f"the {'arm' if name == 'robot' else name} was not changed: release the dead-man first")
            elif name == "frame":
                self._steering.set_frame(str(value))
            elif value != self.robot.name:
                self._next_arm = str(value)
                return OTHER_ARM
        return ""

    def _take_other_arm(self) -> None:
        """Drive the arm that was chosen on the page. It needs a new press of the dead-man."""
        self.robot = self.rig.robots[self._next_arm]
        self.stopped = None
        self.report.follow(self.robot)
        self._steering.drive(self.robot)
        self.event(f"driving {self.robot.name}")

    def _reset_scene(self) -> None:
        """Put the simulated objects and arms back to where they started. The session has ended, so the arm rests."""
        self.rig.world.reset()
        self.event("scene reset: hold the dead-man again to drive")

    def take_other_pad(self) -> None:
        """Was a pad plugged in whose controls are others, and which may drive? From now on it does."""
        if self._other_pad():
            self._steering.take()
            self.event(f"driving with {self.pad.describe()}")
            self.line.event(self.help())

    def _other_pad(self) -> bool:
        """Was a pad plugged in whose controls are others, and which may drive this arm?"""
        if not self._steering.is_due:
            return False
        why = self._steering.distrust()
        if why and why != self._distrusted:
            self.event(why)
        self._distrusted = why
        return not why

    def _towards_goal(self, motion: Twist) -> Twist:
        """Sticks at rest and the handle of the 3D view dragged: there. It moves only while the dead-man is held."""
        from hal.teleop import towards

        view, name = self.rig.viewer3d, self.robot.name
        goal = view.goal(name) if view is not None else None
        if view is None or goal is None:
            return motion
        if motion.linear.any() or motion.angular.any():
            view.clear_goal(name)  # the sticks come first
            return motion
        linear, angular = self.teleop.mapping.speeds()
        speed = self.teleop.speed
        return towards(goal, self.robot.state(max_age=STALE).tcp_set, speed * linear, speed * angular)

    def _go_home(self) -> None:
        from hal.errors import MotionStopped

        self.event("homing: hold the dead-man until the arm is there")
        try:
            self.robot.move_to(self.robot.home, deadman=self.deadman, patience=LET_GO)
        except MotionStopped:
            if self.deadman.held or not self.deadman.connected:
                raise
            self.event("homing cancelled: dead-man released")
        else:
            self.event("home reached: release the dead-man, then hold it again to drive")

    # What went wrong, told once.

    def _lost(self, lost: Exception) -> None:
        """The arm does not answer: it may come back, but not if its process is gone."""
        self.robot.check()
        if self.stopped is None:  # its text counts the seconds: it is told once
            self._tripped(lost)

    def _tripped(self, stop: Exception) -> None:
        if self.stopped != str(stop):
            self.stopped = str(stop)
            self.report.tripped(getattr(stop, "reason", str(stop)))
            self.event(f"STOPPED: {stop}")

    def _faulted(self, fault: Exception) -> None:
        if self.stopped != str(fault):
            self.stopped = str(fault)
            self.report.faulted(getattr(fault, "cause", str(fault)))
            self.event(f"FAULT: {fault}")

    def _resumed(self) -> None:
        if self.stopped is not None:
            self.stopped = None
            self.event("resumed")

    def _look_at_the_hand(self) -> None:
        """Say once what is wrong with the gripper; the arm goes on without it."""
        trouble = self.robot.gripper.trouble if self.robot.gripper is not None else ""
        if bool(trouble) != bool(self._hand):
            self.event(f"GRIPPER: {trouble}" if trouble else "the gripper answers again")
        self._hand = trouble

    def _show(self, control: Control) -> None:
        from hal.errors import ConnectionLost, StaleStateError

        try:
            state = self.robot.state(max_age=STALE)
        except (ConnectionLost, StaleStateError) as lost:
            self.robot.check()
            reason = str(lost)
            self.line.update(lambda: f"  {self.note}{reason}")
            return
        self.report.saw(state)
        self._look_at_the_hand()

        def text() -> str:
            x, y, z = state.tcp.position
            held = "held" if self.deadman.held else "released"
            if self.pad.waiting_for and self.pad.state().connected:
                held = f"waits: release, or move once: {', '.join(self.pad.waiting_for)}"
            status = state.status.name.lower()
            hand = self.robot.gripper.newest() if self.robot.gripper is not None else None
            width = f"gripper {1e3 * hand.width:4.0f} mm  " if hand is not None and not self._hand else ""
            trips = f"  trips {len(self.report.trips)}" if self.report.trips else ""
            limited = f"  limited: {state.limited}" if state.limited else ""
            frames = "  ".join(
                f"{name} {counts.fps:.0f}/s"
                for name, camera in self.rig.cameras.items()
                if (counts := camera.counts()).fps is not None
            )
            return (
                f"  {self.note}dead-man {held:8s}  {status:9s}{trips}  tcp {x:6.3f} {y:6.3f} {z:6.3f} m  {width}"
                f"{limited}  {frames}"
            )

        self.line.update(text)


# [beginning.py] How an episode begins where a person drives: everything goes back to where it starts, and a real
# arm drives home.


class Beginning:
    """The arm moves only for a press of the dead-man that was made for this.

    Neither the one that drove the episode before, nor one that is still held after a stop, drives it home.
    """

    def __init__(self, driving: Driving) -> None:
        from hal.learning.episode import stands_in_world

        self._driving = driving
        self._rig, self._robot = driving.rig, driving.robot
        self.drives_home = not stands_in_world(self._rig, self._robot)
        """Has the arm to drive? A simulated one is put there."""

    def put_back(self, seed: int, goes_on: Callable[[], bool]) -> bool:
        """Until it is done, or ``goes_on()``, asked again and again, says no. ``seed``: of where things go."""
        presses = self._driving.deadman.record.presses
        while goes_on():
            record = self._driving.deadman.record
            if not self.drives_home or (record.held and record.presses > presses):
                if self._driving.guarded(partial(self._reset, seed, presses)):
                    self._open_hand()
                    return True
                presses = self._driving.deadman.record.presses  # whatever stopped it: a new press, then
            else:
                self._driving.take_other_pad()
                self._rig.clock.sleep(AGAIN)
        return False

    def _reset(self, seed: int, since: int) -> bool:
        """Was everything put back? Not where the dead-man was let go of."""
        import numpy as np

        from hal.learning.episode import reset_scene

        deadman = self._driving.deadman
        options: dict[str, Any] = {"deadman": deadman, "since": since, "patience": LET_GO, "hand": False}
        try:
            reset_scene(self._rig, self._robot, random=np.random.default_rng(seed), **options)
        except MotionStopped:
            if deadman.held or not deadman.connected or not self.drives_home:
                raise
            return False
        return True

    def _open_hand(self) -> None:
        """At home. The arm goes on without one that cannot."""
        if self.drives_home and self._robot.gripper is not None:
            try:
                self._robot.gripper.open()
            except (HalError, OSError) as trouble:
                self._driving.event(f"GRIPPER: {trouble}")
