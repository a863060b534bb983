"""Import Ark's configuration files as a rig's file, with a report of every key.

hal import-ark global_config.yaml -o config/mine.yaml
hal import-ark global_config.yaml --check
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hal.apps._common import run_app

if TYPE_CHECKING:
    from hal.ark import ArkOptions, Imported

__all__ = ["main", "parser"]


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``import-ark``."""
    made = argparse.ArgumentParser(
        prog="import-ark",
        description="Convert Ark's configuration files to a rig file, with a report of every key.",
        epilog="Ark's files are only read. On an error nothing is written and the exit status is 2.",
    )
    made.add_argument("source", type=Path, metavar="GLOBAL_FILE", help="Ark's global_config.yaml")
    what = made.add_mutually_exclusive_group(required=True)
    what.add_argument("-o", "--out", type=Path, metavar="FILE", help="rig file to write")
    what.add_argument("--check", action="store_true", help="only report; write nothing")
    made.add_argument("--force", action="store_true", help="overwrite an existing file")
    made.add_argument(
        "--start",
        type=Path,
        metavar="FOLDER",
        help="folder that Ark is started in and its paths are relative to (default: search)",
    )
    made.add_argument(
        "--arm",
        action="append",
        default=[],
        metavar="NAME=MODEL",
        help="model of a robot (default: by its joints); may be repeated, like the next two",
    )
    made.add_argument("--urdf", action="append", default=[], metavar="NAME=FILE", help="URDF of a robot or an object")
    made.add_argument(
        "--without", action="append", default=[], metavar="NAME", help="leave out a robot, sensor or object"
    )
    made.add_argument(
        "--camera-model",
        default="pinhole",
        metavar="MODEL",
        help="model of every camera: %(default)s has the field of view of Ark's file, realsense_d435 the real one's",
    )
    return made


def main(argv: list[str] | None = None) -> int:
    """Run the program; return its exit status."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    from hal.ark import import_ark
    from hal.errors import CommandError

    if args.out is not None:
        if args.out.suffix not in (".yaml", ".yml"):
            raise CommandError(f"-o {args.out}: a rig's file ends in .yaml")
        if not args.out.expanduser().resolve().parent.is_dir():
            raise CommandError(f"-o {args.out}: there is no folder {args.out.parent}")
    imported = import_ark(args.source, _options(args))
    path = args.out.expanduser().resolve() if args.out is not None else None
    texts = imported.texts(path) if path is not None else {}
    there = [str(file) for file in texts if file.exists()]
    if there and not args.force:
        raise CommandError(f"{', '.join(there)} exists; --force overwrites it")
    print("\n".join(_report(imported)))
    if path is None:
        print("\nvalid; nothing is written (--check)")
        return 0
    _write(texts, path)
    program = "hal teleop" if sys.argv[0].endswith(".py") else "hal teleop"
    print(f"\nstart: {program} --sim --config {args.out}")
    return 0


def _options(args: argparse.Namespace) -> ArkOptions:
    from hal.ark import ArkOptions

    return ArkOptions(
        start=args.start,
        arms=_pairs("--arm", args.arm),
        urdfs={name: Path(file).expanduser() for name, file in _pairs("--urdf", args.urdf).items()},
        without=frozenset(args.without),
        camera_model=args.camera_model,
    )


def _pairs(option: str, given: Sequence[str]) -> dict[str, str]:
    from hal.errors import CommandError

    pairs = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise CommandError(f"{option} {text}: must be NAME=..., with a robot's or object's name in Ark's files")
        pairs[name] = value
    return pairs


def _report(imported: Imported) -> list[str]:
    from hal.ark.output import summary, table

    width = max(100, min(160, shutil.get_terminal_size((120, 24)).columns))
    lines = [*table(imported.rows, imported.source.parent, width), "", summary(imported.rows)]
    if imported.left_out:
        lines.append(f"left out (--without): {', '.join(imported.left_out)}")
    for name, model in imported.models.items():
        lines += ["", f"{name}: Ark's files do not describe this arm completely. Check in its model:"]
        lines += [f"  - {text}" for text in model.to_fill_in]
    return lines


def _write(texts: dict[Path, str], path: Path) -> None:
    """Write the rig's file ``path`` and the others, and list the rig's devices."""
    from hal.apps._display import list_devices
    from hal.config import load

    for file, text in texts.items():
        _put(file, text)
    plan = load(path).resolve()
    lines = [*list_devices(plan), *(f"note     {warning}" for warning in plan.warnings)]
    print("\n".join(["", *(f"written: {file}" for file in texts), *(f"  {line}" for line in lines)]))


def _put(path: Path, text: str) -> None:
    """Write a file completely or not at all."""
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main())
