"""The command ``hal``: all programs, and lists of the built-in models and rigs.

hal teleop --sim
hal list robots
hal schema > rig.schema.json
"""

from __future__ import annotations

import argparse
import json
import sys
from importlib import import_module
from pathlib import Path

from hal.apps._common import run_app, typed_command

__all__ = ["PROGRAMS", "main", "parser"]

PROGRAMS = {
    "teleop": "drive an arm: page in a browser, gamepad, terminal, recorded tour",
    "check": "check this computer, arms and cameras; list gamepads and CAN adapters",
    "collect": "record demonstrations",
    "review": "view, check and repair a dataset",
    "dataset": "list, mark, delete, trim, merge, split and check recorded episodes",
    "replay": "replay a recorded episode",
    "rollout": "run a policy and count its successes",
    "serve-lerobot": "serve a policy that was trained with LeRobot, for rollout",
    "generate": "generate a dataset in simulation, on several workers",
    "grasp": "find an object and grasp it",
    "push": "find an object and push it to a goal",
    "export": "convert a dataset for training",
    "calibrate": "measure where a camera is, or where a gripper is closed",
    "import-ark": "convert a configuration of Ark",
}
LISTS = {
    "robots": ("robots",),
    "cameras": ("sensors", "cameras"),
    "rigs": ("config",),
    "pads": ("sensors", "gamepads"),
}
"""Kind of built-in file -> its folder."""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    programs = "\n".join(f"  {name:13s} {what}" for name, what in PROGRAMS.items())
    made = argparse.ArgumentParser(
        prog="hal",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description=f"programs:\n{programs}\n\n"
        f"  {'list':13s} list built-in files: {', '.join(LISTS)}\n"
        f"  {'schema':13s} print the JSON schema of a rig's file, for editors",
        epilog="hal PROGRAM --help shows a program's own options.",
    )
    made.add_argument("--version", action="store_true", help="print the version")
    made.add_argument("command", nargs="?", choices=[*PROGRAMS, "list", "schema"], metavar="PROGRAM")
    made.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="the program's options")
    return made


def main(argv: list[str] | None = None) -> int:
    """Run the program; return the exit status."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    import hal

    if args.command in PROGRAMS:
        return int(import_module(f"hal.apps.{args.command.replace('-', '_')}").main(args.arguments))
    if args.version:
        print(f"robot-hal {hal.__version__}")
    elif args.command == "list":
        return _list(args.arguments)
    elif args.command == "schema":
        from hal.config.rigfile import rig_schema

        print(json.dumps(rig_schema(), indent=2))
    else:
        parser().print_help()
    return 0


def _list(arguments: list[str]) -> int:
    made = argparse.ArgumentParser(prog=typed_command("hal list"), description="List built-in models and rigs by name.")
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
