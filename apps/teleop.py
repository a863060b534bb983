"""Drive an arm from a browser or with a gamepad: in simulation and on the real arm, the same program.

python apps/teleop.py --sim
python apps/teleop.py --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Literal

from hal.apps.cli import ACTION_NEEDED, add_rig_options, rig_options, run_app

if TYPE_CHECKING:
    from hal.commands import Twist
    from hal.control import Control
    from hal.deadman import Deadman
    from hal.gamepad import Gamepad
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.teleop import Teleop

RATE_HZ = 50.0
STALE = 2.0
LET_GO = 0.2
"""s without the dead-man after which somebody does not want to go home any more."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="teleop",
        description="Drive an arm from a browser or with a gamepad, in simulation or for real.",
        epilog="Ctrl-C stops the arm.",
    )
    add_rig_options(made)
    drive = made.add_argument_group("driving")
    drive.add_argument("--robot", metavar="NAME", help="which arm, where the rig has several (the first)")
    drive.add_argument("--mapping", metavar="FILE", help="what the pad's controls do (what the pad is meant for)")
    drive.add_argument("--speed", type=float, metavar="SHARE", help="share of the mapping's speeds, above 0, at most 1")
    drive.add_argument("--duration", type=float, metavar="S", help="end after so many seconds")
    drive.add_argument("--report", metavar="FILE", help="write how the run went, as JSON")
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return run_app(_main, parser().parse_args(argv))


def _main(args: argparse.Namespace) -> int:
    import hal
    from hal.apps.banner import banner, listing
    from hal.apps.check import may_open
    from hal.errors import CommandError

    if args.speed is not None and not 0.0 < args.speed <= 1.0:
        raise CommandError(f"--speed must be above 0 and at most 1, not {args.speed:g}")
    if args.duration is not None and not args.duration > 0.0:
        raise CommandError(f"--duration must be positive, not {args.duration:g}")
    if args.report:
        from hal.apps.report import check_writable

        check_writable(args.report)
    from hal.config import load
    from hal.config.mapping import load_mapping
    from hal.pads.choice import check_wanted

    load_mapping(args.mapping or "default")
    check_wanted(args.pad)
    plan = load(args.config, sim=args.sim, overrides=args.overrides).resolve()
    if args.dry_run:
        if args.robot and args.robot not in {robot.name for robot in plan.robots}:
            raise CommandError(f"--robot {args.robot}: the rig has {', '.join(r.name for r in plan.robots) or 'none'}")
        print(f"{plan.source} is in order; it would open:")
        print("\n".join(f"  {line}" for line in [*listing(plan), *plan.warnings]))
        return 0
    if not may_open(plan):
        return ACTION_NEEDED
    with hal.open(**rig_options(args)) as rig:
        print(banner(rig), flush=True)
        name = args.robot or next(iter(rig.robots), None)
        if name is None:
            raise CommandError(f"{rig.plan.source} has no robot to drive")
        if args.pad == "none":
            raise CommandError("--pad none: this program needs something that drives")
        if not rig.gamepads:
            raise CommandError(f"{rig.plan.source} has no gamepad; add 'gamepads: {{pad: {{model: auto}}}}'")
        robot, pad = rig.robots[name], next(iter(rig.gamepads.values()))
        return Session(rig, robot, pad, args).run()


class Session:
    """One run of the app."""

    def __init__(self, rig: Rig, robot: Robot, pad: Gamepad, args: argparse.Namespace) -> None:
        from hal.apps.report import RunReport
        from hal.apps.status import StatusLine
        from hal.apps.steering import Steering

        self.rig, self.robot, self.pad, self.args = rig, robot, pad, args
        self.report = RunReport(rig, robot)
        self.line = StatusLine()
        self.end = rig.clock.now() + args.duration if args.duration else None
        self.stopped: str | None = None
        self.hand = ""
        """What is wrong with the gripper."""
        self.distrusted = ""
        """Why the pad that was plugged in may not drive."""
        self.steering = Steering(rig, robot, pad, args.mapping, args.speed or 1.0)

    @property
    def teleop(self) -> Teleop:
        """What the pad asks for."""
        return self.steering.teleop

    @property
    def deadman(self) -> Deadman:
        """What must be held."""
        return self.steering.deadman

    def run(self) -> int:
        """Drive until the time is over, the recording ends or Ctrl-C; then stop, report, close."""
        from hal.apps.banner import invitation

        clean = False
        try:
            print(self.steering.help())
            print(invitation(self.rig), flush=True)
            while self._turn():
                pass
            clean = True
        except KeyboardInterrupt:
            clean = True  # the session's end brought the arm to rest
        finally:
            self.line.clear()
            if self.args.report:
                self._write_report(clean)
        self.line.event(f"{self._ending()} after {self.rig.clock.now() - self.report.start:.1f} s; the arm is at rest")
        return 0

    def _event(self, text: str) -> None:
        """Tell it here and on the console's pages."""
        self.line.event(text)
        self.rig.say(text)

    def _write_report(self, clean: bool) -> None:
        """A rig that is gone cannot be asked; what ended the run must be told all the same."""
        from hal.errors import HalError

        try:
            self.report.write(self.args.report, self.report.collect(clean))
        except (HalError, OSError) as error:
            self.line.event(f"no report: {error}")

    def _turn(self) -> bool:
        """Drive, and go home when that was asked for. False when the run is over."""
        from hal.errors import ConnectionLost, MotionStopped, RobotFault, StaleStateError

        try:
            after = self._drive()
            if after == "home":
                self._go_home()
            elif after == "other pad":
                self.steering.take()
                self._event(f"{self.pad.describe()} drives")
                self.line.event(self.steering.help())
        except MotionStopped as stop:  # a new session wants the stop to be acknowledged first
            self._tripped(stop)
        except RobotFault as fault:
            self._faulted(fault)
        except (ConnectionLost, StaleStateError) as lost:
            self._lost(lost)
        else:
            return after != "over"
        self.rig.clock.sleep(0.1)
        return not self._over()

    def _drive(self) -> Literal["home", "other pad", "over"]:
        """Follow the pad, until something else is due."""
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
                    control.send(motion, gripper=grip, t_event=state.stamp.t if fresh else 0.0)
                    self._resumed()
                except MotionStopped as stop:
                    self._tripped(stop)
                except RobotFault as fault:
                    self._faulted(fault)
                self._show(control)
                if self._over():
                    return "over"
                if self.teleop.home_pressed(state) and self.deadman.held:
                    return "home"
                if self._other_pad():
                    return "other pad"
        return "over"

    def _other_pad(self) -> bool:
        """Was a pad plugged in whose controls are others, and which may drive this arm?"""
        if not self.steering.is_due:
            return False
        why = self.steering.distrust()
        if why and why != self.distrusted:
            self._event(why)
        self.distrusted = why
        return not why

    def _towards_goal(self, motion: Twist) -> Twist:
        """Sticks at rest and the handle of the 3D view dragged: there. It moves only while the dead-man is held."""
        from hal.following import towards

        view, name = self.rig.viewer3d, self.robot.name
        goal = view.goal(name) if view is not None else None
        if view is None or goal is None:
            return motion
        if motion.linear.any() or motion.angular.any():
            view.clear_goal(name)  # the sticks come first
            return motion
        mapping = self.teleop.mapping
        linear, angular = mapping.speeds()
        speed = self.teleop.speed
        return towards(goal, self.robot.state(max_age=STALE).tcp_set, speed * linear, speed * angular)

    def _go_home(self) -> None:
        from hal.errors import MotionStopped

        self._event("home: hold the dead-man until the arm is there")
        try:
            self.robot.move_to(self.robot.home, deadman=self.deadman, patience=LET_GO)
        except MotionStopped:
            if self.deadman.held or not self.deadman.connected:
                raise
            self._event("home: given up, the dead-man was let go of")
        else:
            self._event("home: there; let go of the dead-man and hold it again to drive")

    def _ending(self) -> str:
        if self.pad.finished:
            return f"{self.pad.describe()} was played to its end"
        return "stopped, as --duration says," if self.end and self.rig.clock.now() >= self.end else "stopped"

    def _over(self) -> bool:
        return self.pad.finished or (self.end is not None and self.rig.clock.now() >= self.end)

    def _lost(self, lost: Exception) -> None:
        """The arm does not answer: it may come back, but not if its process is gone."""
        self.robot.check()
        if self.stopped is None:  # its text counts the seconds: it is told once
            self._tripped(lost)

    def _tripped(self, stop: Exception) -> None:
        if self.stopped != str(stop):
            self.stopped = str(stop)
            self.report.tripped(getattr(stop, "reason", str(stop)))
            self._event(f"STOPPED: {stop}")

    def _faulted(self, fault: Exception) -> None:
        if self.stopped != str(fault):
            self.stopped = str(fault)
            self.report.faulted(getattr(fault, "cause", str(fault)))
            self._event(f"FAULT: {fault}")

    def _resumed(self) -> None:
        if self.stopped is not None:
            self.stopped = None
            self._event("going on")

    def _look_at_the_hand(self) -> None:
        """Say once what is wrong with the gripper; the arm goes on without it."""
        trouble = self.robot.gripper.trouble if self.robot.gripper is not None else ""
        if bool(trouble) != bool(self.hand):
            self._event(f"GRIPPER: {trouble}" if trouble else "the gripper is there again")
        self.hand = trouble

    def _show(self, control: Control) -> None:
        from hal.errors import ConnectionLost, StaleStateError

        try:
            state = self.robot.state(max_age=STALE)  # what is only shown may be older than what is acted on
        except (ConnectionLost, StaleStateError) as lost:
            self.robot.check()
            reason = str(lost)
            self.line.update(lambda: f"  {reason}")
            return
        self.report.saw(state)
        self._look_at_the_hand()

        def text() -> str:
            x, y, z = state.tcp.position
            held = "held" if self.deadman.held else "released"
            if self.pad.waiting_for and self.pad.state().connected:
                held = f"waits: let go of, or move once: {', '.join(self.pad.waiting_for)}"
            status = state.status.name.lower()
            hand = self.robot.gripper.newest() if self.robot.gripper is not None else None
            width = f"gripper {1e3 * hand.width:4.0f} mm  " if hand is not None and not self.hand else ""
            trips = f"  trips {len(self.report.trips)}" if self.report.trips else ""
            limited = f"  held back: {state.limited}" if state.limited else ""
            frames = "  ".join(
                f"{name} {counts.fps:.0f}/s"
                for name, camera in self.rig.cameras.items()
                if (counts := camera.counts()).fps is not None
            )
            return (
                f"  dead-man {held:8s}  {status:9s}{trips}  tcp {x:6.3f} {y:6.3f} {z:6.3f} m  {width}"
                f"{limited}  {frames}"
            )

        self.line.update(text)


if __name__ == "__main__":
    sys.exit(main())
