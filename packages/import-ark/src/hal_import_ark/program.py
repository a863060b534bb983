"""The program ``hal import-ark``: converts Ark's configuration files to a rig's file, with a report of every key.

hal import-ark global_config.yaml -o config/mine.yaml
hal import-ark global_config.yaml --check
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from hal.config import load
from hal.errors import CommandError

from .entries import ArkOptions
from .importing import Imported, import_ark
from .output import summary, table


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    made = argparse.ArgumentParser(
        prog="hal import-ark",
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


def main(argv: list[str]) -> int:
    """Run the program; return its exit status.

    Raises:
        HalError: An option or a file is wrong; ``hal`` prints it as a message.
    """
    args = parser().parse_args(argv)
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
    print()
    for file, text in texts.items():
        _write(file, text)
        print(f"written: {file}")
    for warning in load(path).resolve().warnings:
        print(f"  note     {warning}")
    print(f"\nstart: hal teleop --sim --config {args.out}")
    return 0


def _options(args: argparse.Namespace) -> ArkOptions:
    return ArkOptions(
        start=args.start,
        arms=_pairs("--arm", args.arm),
        urdfs={name: Path(file).expanduser() for name, file in _pairs("--urdf", args.urdf).items()},
        without=frozenset(args.without),
        camera_model=args.camera_model,
    )


def _pairs(option: str, given: Sequence[str]) -> dict[str, str]:
    pairs = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise CommandError(f"{option} {text}: must be NAME=..., with a robot's or object's name in Ark's files")
        pairs[name] = value
    return pairs


def _report(imported: Imported) -> list[str]:
    width = max(100, min(160, shutil.get_terminal_size((120, 24)).columns))
    lines = [*table(imported.rows, imported.source.parent, width), "", summary(imported.rows)]
    if imported.left_out:
        lines.append(f"left out (--without): {', '.join(imported.left_out)}")
    for name, model in imported.models.items():
        lines += ["", f"{name}: Ark's files do not describe this arm completely. Check in its model:"]
        lines += [f"  - {text}" for text in model.to_fill_in]
    return lines


def _write(path: Path, text: str) -> None:
    """Write a file completely or not at all."""
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
