"""The command ``hal``: all programs, and lists of the built-in models and rigs.

hal teleop --sim
hal list robots
hal schema > rig.schema.json

Another package adds a program by an entry point of the group ``hal.apps``, a function of the arguments that returns the
exit status. A :class:`~hal.HalError` that it raises is printed as a message::

    [project.entry-points."hal.apps"]
    import-ark = "hal_import_ark.program:main"
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import hal
from hal.apps._common import program
from hal.errors import CommandError, DriverMissing

PROGRAMS = {
    "teleop": "drive an arm: page in a browser, gamepad, terminal, recorded tour",
    "check": "check this computer, arms and cameras; list gamepads and CAN adapters",
    "collect": "record demonstrations",
    "review": "view, check and repair a dataset",
    "dataset": "list, mark, delete, trim, merge, split and check recorded episodes",
    "replay": "replay a recorded episode",
    "rollout": "run a policy and count its successes",
    "serve": "serve the arms of this computer to a program on another one",
    "keys": "make, list and revoke certificates for connections between computers",
    "serve-lerobot": "serve a policy that was trained with LeRobot, for rollout",
    "generate": "generate a dataset in simulation, on several workers",
    "grasp": "find an object and grasp it",
    "push": "find an object and push it to a goal",
    "export": "convert a dataset for training",
    "calibrate": "measure where a camera is, its lens, where a gripper is closed; home a gripper; calibrate servos",
    "setup-motors": "give the motors of an arm on a servo bus their ids",
}
GROUP = "hal.apps"
"""Group of the entry points of programs that other packages have."""
BESIDE = {
    "emulate": (
        "play what a rig names as real: Franka, UR, UFACTORY and CAN arms, servo buses, Robotiq grippers",
        "packages/emulators",
    ),
    "import-ark": ("convert a configuration of Ark", "packages/import-ark"),
}
"""Program of a package beside this one -> what it does, and the package's folder in the repository."""
LISTS = {
    "robots": ("robots",),
    "grippers": ("robots", "grippers"),
    "cameras": ("sensors", "cameras"),
    "rigs": ("config",),
    "pads": ("sensors", "gamepads"),
    "leaders": ("sensors", "leaders"),
}
"""Kind of built-in file -> its folder."""
COMMANDS = {
    "list": f"list built-in files: {', '.join(LISTS)}",
    "schema": "print the JSON schema of a rig's file, for editors",
}
"""Command of ``hal`` itself -> what it does."""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    programs, own = ("\n".join(f"  {name:13s} {what}" for name, what in each.items()) for each in (PROGRAMS, COMMANDS))
    beside = "\n".join(f"  {name:13s} {what} ({folder})" for name, (what, folder) in BESIDE.items())
    made = argparse.ArgumentParser(
        prog="hal",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description=f"programs:\n{programs}\n\n{own}\n\nprograms of other packages:\n{beside}",
        epilog="hal PROGRAM --help shows a program's own options.",
    )
    made.add_argument("--version", action="store_true", help="print the version")
    made.add_argument("command", nargs="?", metavar="PROGRAM")
    made.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="the program's options")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    if args.version:
        print(f"robot-hal {hal.__version__}")
    elif args.command == "list":
        return _list(args.arguments)
    elif args.command == "schema":
        from hal.config.rigfile import rig_schema

        print(json.dumps(rig_schema(), indent=2))
    elif args.command is None:
        parser().print_help()
    else:
        return int(_find_program(args.command)(args.arguments))
    return 0


def _find_program(name: str) -> Callable[[list[str]], int]:
    """Return the function of a program: one of :data:`PROGRAMS`, or of an installed package.

    Raises:
        DriverMissing: The program is in a package that is not installed.
        CommandError: There is no such program.
    """
    if name in PROGRAMS:
        main: Callable[[list[str]], int] = import_module(f"hal.apps.{name.replace('-', '_')}").main
        return main
    from importlib.metadata import entry_points  # slow to import, so only when it is needed

    from hal.errors import suggest

    for point in entry_points(group=GROUP, name=name):
        loaded: Callable[[list[str]], int] = point.load()
        return loaded
    if name in BESIDE:
        folder = BESIDE[name][1]
        message = f"hal {name} is a package of its own: pip install -e {folder}, in the repository of robot-hal"
        raise DriverMissing(message, code="missing_package")
    programs = [*PROGRAMS, *BESIDE, *(point.name for point in entry_points(group=GROUP)), *COMMANDS]
    raise CommandError(f"there is no program {name!r}{suggest(name, set(programs))}", code="unknown_program")


def _list(arguments: list[str]) -> int:
    made = argparse.ArgumentParser(prog="hal list", description="List built-in models and rigs by name.")
    made.add_argument("kinds", nargs="*", metavar="KIND", help=f"{', '.join(LISTS)} (all)")
    kinds = made.parse_args(arguments).kinds or list(LISTS)
    for kind in kinds:
        if kind not in LISTS:
            made.error(f"unknown kind {kind!r}; kinds: {', '.join(LISTS)}")
    from hal.config.data_files import find_data, list_data

    for kind in kinds:
        if len(kinds) > 1:
            print(f"{kind}:")
        folder = LISTS[kind]
        for name in list_data(*folder):
            print(f"  {name:24s} {_summary(find_data(*folder, f'{name}.yaml'))}")
    return 0


def _summary(file: Path) -> str:
    """Return the description of a file: its key of that name, or the first sentence of its first comment."""
    lines = file.read_text(encoding="utf-8").splitlines()
    described = next((line for line in lines if line.startswith("description:")), None)
    if described is not None:
        return described.partition(":")[2].strip()
    comment = []
    for line in lines:
        if line.startswith("# yaml-language-server"):
            continue
        if not line.startswith("#") or not line.strip("# "):
            break
        comment.append(line.lstrip("# "))
    return " ".join(comment).partition(". ")[0].rstrip(".")


if __name__ == "__main__":
    sys.exit(main())
