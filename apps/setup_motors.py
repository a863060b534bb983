"""Give the motors of an arm on a servo bus their ids, one at a time; ``hal calibrate arm`` is here, too.

hal setup-motors --real --config my_rig.yaml
hal calibrate arm --real --config my_rig.yaml --out my_arm.json
hal calibrate arm --real --config my_rig.yaml --restore my_arm.json
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from hal import registry
from hal.apps._common import add_config_options, check_one_robot, config_options, program, robot_names
from hal.errors import CommandError, DeviceNotFound, NotSupported
from hal.specs import PadSpec, RobotSpec

_PERIOD = 0.02
"""Time between two looks at the motors while joints are moved by hand, s."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``setup-motors``."""
    made = argparse.ArgumentParser(
        prog="hal setup-motors",
        description="Give each motor of an arm or a leader on a servo bus (Feetech, Dynamixel), and of a gripper, the "
        "id and the rate that the rig has for it. The motors are connected alone, one after the other.",
    )
    add_config_options(made)
    made.add_argument("--robot", metavar="NAME", help="the arm, or the leader (default: the first arm)")
    return made


def arm_parser() -> argparse.ArgumentParser:
    """Return the parser of ``calibrate arm``."""
    made = argparse.ArgumentParser(
        prog="hal calibrate arm",
        description="Calibrate an arm on a servo bus (Feetech, Dynamixel) as LeRobot does: the middle pose, then every "
        "joint through its range, by hand. The result is stored in the motors, and in LeRobot's file. The torque is "
        "switched off, and the arm falls: support it.",
    )
    add_config_options(made)
    made.add_argument("--robot", metavar="NAME", help="the arm (default: the first)")
    made.add_argument("--out", metavar="FILE", help="file to write (default: ROBOT_calibration.json)")
    made.add_argument("--restore", metavar="FILE", help="only write such a file, or LeRobot's, into the motors")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run ``hal setup-motors``; return the exit status."""
    with _open_service(args, leaders=True) as service:
        for motor in service.motors:
            _ask(f"connect only the motor of {motor.name} (id {motor.id}), then press Enter")
            print(f"  {motor.name}: has the id {motor.id} now, {service.set_up(motor)}", flush=True)
    print("connect them all; then: hal calibrate arm")
    return 0


def calibrate_arm(args: argparse.Namespace) -> int:
    """Run ``hal calibrate arm``; return the exit status."""
    with _open_service(args) as service:
        _ask("the torque goes off: support the arm, then press Enter")
        if args.restore is not None:
            try:
                service.restore(json.loads(Path(args.restore).read_text(encoding="utf-8")))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise CommandError(f"--restore {args.restore} is no calibration of this arm: {error}") from None
            print(f"{args.restore} is stored in the motors")
            return 0
        service.relax()
        _ask(f"move every joint {service.pose}, then press Enter")
        service.take_middle()
        seen = service.watch()
        ended = threading.Event()
        threading.Thread(target=_wait_for_enter, args=(ended,), daemon=True).start()
        while not ended.wait(_PERIOD):
            seen = service.watch()
        print("\n".join(f"  {name:24s}{low:6d} to {high:5d}" for name, (low, high) in seen.items()))
        found = service.store()
    out = Path(args.out or f"{service.name}_calibration.json")
    out.write_text(json.dumps(found, indent=4) + "\n", encoding="utf-8")
    print(f"stored in the motors, and in {out}")
    return 0


def _open_service(args: argparse.Namespace, leaders: bool = False) -> Any:
    """Return the motors of the arm, or the leader, that the options name, as its driver opens them. Raises HalError."""
    from hal.config import load

    check_one_robot(args)
    plan = load(**config_options(args)).resolve()
    arms: dict[str, RobotSpec | PadSpec] = {robot.name: robot for robot in plan.robots}
    arms |= {pad.name: pad for pad in plan.pads if leaders and pad.leader is not None}
    name = next(iter(robot_names(args)), next(iter(arms)))
    if name not in arms:
        raise DeviceNotFound(f"--robot: this rig has no robot {name!r}")
    service = registry.function(arms[name].driver, registry.driver(arms[name].driver).motors)
    if service is None:
        raise NotSupported(f"{name} is simulated, or has no motors on a servo bus; add --real", code="no_servo_bus")
    return service(arms[name])


def _ask(text: str) -> None:
    print(f"  {text}", flush=True)
    try:
        input()
    except EOFError:
        raise CommandError("this program asks for Enter: run it in a terminal", code="no_terminal") from None


def _wait_for_enter(ended: threading.Event) -> None:
    with suppress(CommandError):  # the ranges are then those of joints that did not move
        _ask("move every joint through its whole range, then press Enter")
    ended.set()


if __name__ == "__main__":
    sys.exit(main())
