"""Drive an arm from a browser or with a gamepad: in simulation and on the real arm, the same program.

python apps/teleop.py --sim
python apps/teleop.py --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from hal.apps._common import ACTION_NEEDED, add_driving_options, add_rig_options, rig_options, run_app

if TYPE_CHECKING:
    from hal.gamepad import Gamepad
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.types import PadState


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="teleop",
        description="Drive an arm from a browser or with a gamepad, in simulation or for real.",
        epilog="Ctrl-C stops the arm.",
    )
    add_rig_options(made)
    drive = add_driving_options(made)
    drive.add_argument("--duration", type=float, metavar="S", help="end after so many seconds")
    drive.add_argument("--report", metavar="FILE", help="write how the run went, as JSON")
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    import hal
    from hal.apps._common import banner, planned
    from hal.apps.check import may_open
    from hal.apps.driving import check_driving, chosen_devices
    from hal.errors import CommandError

    check_driving(args)
    if args.duration is not None and not args.duration > 0.0:
        raise CommandError(f"--duration must be positive, not {args.duration:g}")
    if args.report:
        from hal.apps._common import check_writable

        check_writable(args.report)
    plan = planned(args)
    if plan is None:
        return 0
    if not may_open(plan):
        return ACTION_NEEDED
    with hal.open(**rig_options(args)) as rig:
        print(banner(rig), flush=True)
        return Session(rig, *chosen_devices(rig, args), args).run()


class Session:
    """One run of the app."""

    def __init__(self, rig: Rig, robot: Robot, pad: Gamepad, args: argparse.Namespace) -> None:
        from hal.apps.driving import Driving

        self.rig, self.pad, self.args = rig, pad, args
        self.driving = Driving(rig, robot, pad, mapping=args.mapping, speed=args.speed or 1.0, adjustable=True)
        self.end = rig.clock.now() + args.duration if args.duration else None

    def run(self) -> int:
        """Drive until the time is over, the recording ends or Ctrl-C; then stop, report, close."""
        from hal.apps._common import invitation

        driving, clean = self.driving, False
        try:
            print(driving.help())
            print(invitation(self.rig), flush=True)
            driving.drive(self._over)
            clean = True
        except KeyboardInterrupt:
            clean = True  # the session's end brought the arm to rest
        finally:
            driving.line.clear()
            if self.args.report:
                self._write_report(clean)
        driving.line.event(
            f"{self._ending()} after {self.rig.clock.now() - driving.report.start:.1f} s; the arm is at rest"
        )
        return 0

    def _over(self, state: PadState) -> str:
        """Why this should end."""
        if self.pad.finished:
            return f"{self.pad.describe()} was played to its end"
        if self.end is not None and self.rig.clock.now() >= self.end:
            return f"finished (--duration {self.args.duration})"
        return ""

    def _write_report(self, clean: bool) -> None:
        """A rig that is gone cannot be asked; what ended the run must be told all the same."""
        from hal.errors import HalError

        report = self.driving.report
        try:
            report.write(self.args.report, report.collect(clean))
        except (HalError, OSError) as error:
            self.driving.line.event(f"no report: {error}")

    def _ending(self) -> str:
        return self._over(self.pad.state()) or "stopped"


if __name__ == "__main__":
    sys.exit(main())
