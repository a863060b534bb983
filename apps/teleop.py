"""Drive an arm from a browser or with a gamepad: in simulation and on the real arm, the same program.

hal teleop --sim
hal teleop --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

import hal
from hal.apps._common import (
    add_driving_options,
    add_rig_options,
    check_driving_options,
    check_report,
    program,
    resolve_plan,
    rig_options,
    select_robots,
    write_report,
)
from hal.apps._display import TeleopDisplay, banner, list_links
from hal.errors import CommandError, HalError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hal.rig import Rig
    from hal.robot import Robot
    from hal.types import PadState


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``teleop``."""
    made = argparse.ArgumentParser(
        prog="hal teleop",
        description="Drive an arm from a browser or with a gamepad, simulated or real.",
        epilog="Ctrl-C stops the arm and ends the program.",
    )
    add_rig_options(made)
    drive = add_driving_options(made)
    drive.add_argument("--duration", type=float, metavar="S", help="end after S seconds")
    drive.add_argument("--report", metavar="FILE", help="write measurements of the run to a JSON file")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run ``teleop``; return the exit status."""
    check_driving_options(args)
    if args.duration is not None and not args.duration > 0.0:
        raise CommandError(f"--duration must be positive, not {args.duration:g}")
    check_report(args.report)
    resolve_plan(args)
    with hal.open(**rig_options(args)) as rig:
        print(banner(rig), flush=True)
        return TeleopRun(rig, select_robots(rig, args), args).run()


class TeleopRun:
    """One run of the program on an open rig."""

    def __init__(self, rig: Rig, robots: Sequence[Robot], args: argparse.Namespace) -> None:
        self.rig, self.args = rig, args
        self.display = TeleopDisplay(
            rig,
            robots,
            independent=args.independent,
            mapping=args.mapping,
            speed=args.speed or 1.0,
            adjustable=True,
        )
        self.session = self.display.session
        self.end_time = rig.clock.now() + args.duration if args.duration else None

    def run(self) -> int:
        """Drive until the time is over, a recorded pad ends or Ctrl-C; then report. Return the exit status."""
        display, clean = self.display, False
        reason = "stopped"
        try:
            print(self.session.help())
            print(list_links(self.rig), flush=True)
            reason = self.session.run(self._end_reason)
            clean = True
        except KeyboardInterrupt:
            clean = True  # the arm is at rest
        finally:
            display.line.clear()
            if self.args.report:
                self._write_report(clean)
        seconds = self.rig.clock.now() - display.report.start
        at_rest = "the arm is at rest" if len(self.session.arms) == 1 else "the arms are at rest"
        display.line.event(f"{reason} after {seconds:.1f} s; {at_rest}")
        return 0

    def _end_reason(self, state: PadState) -> str:
        """Return why the run has to end, or nothing."""
        if self.session.finished:
            return "the recorded pad has ended"
        if self.end_time is not None and self.rig.clock.now() >= self.end_time:
            return f"finished (--duration {self.args.duration:g})"
        return ""

    def _write_report(self, clean: bool) -> None:
        """Write the report; if the rig cannot answer any more, print why there is none."""
        report = self.display.report
        try:
            write_report(self.args.report, report.collect(clean))
        except (HalError, OSError) as error:
            self.display.line.event(f"no report: {error}")


if __name__ == "__main__":
    sys.exit(main())
