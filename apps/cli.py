"""What every app's command line shares: the rig's options, and errors that a person can read."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

__all__ = [
    "ACTION_NEEDED",
    "add_config_options",
    "add_driving_options",
    "add_rig_options",
    "interruptible",
    "rig_options",
    "run_app",
]

ACTION_NEEDED = 2
"""Exit status when a person must mend something first."""


def add_config_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Options that choose and change a rig's configuration; the same in every app."""
    rig = parser.add_argument_group("rig")
    rig.add_argument(
        "--config",
        default="panda_table",
        metavar="FILE",
        help="a rig's file, or the name of a built-in one (%(default)s)",
    )
    flag = rig.add_mutually_exclusive_group()
    flag.add_argument("--sim", dest="sim", action="store_true", default=None, help="simulate every device")
    flag.add_argument("--real", dest="sim", action="store_false", help="use the real devices")
    rig.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change any key of the rig, for example --set cameras.wrist.output.width=320; may be repeated",
    )
    return rig


def add_rig_options(parser: argparse.ArgumentParser) -> None:
    """Those, and what an open rig consists of besides its devices."""
    rig = add_config_options(parser)
    rig.add_argument(
        "--pad",
        default="auto",
        metavar="auto|web|evdev|terminal|demo|none|FILE",
        help="what drives: a page in a browser, a plugged-in pad, the keys of this terminal, the recorded tour, "
        "a recording; %(default)s: a plugged-in pad, else the page",
    )
    rig.add_argument(
        "--viewer",
        choices=["gui", "3d", "none"],
        default="none",
        help="a window onto the simulated world, or a page with the arms in three dimensions",
    )
    rig.add_argument("--console", action="store_true", help="serve the page also when another pad drives")
    rig.add_argument(
        "--listen",
        metavar="ADDRESS[:PORT]",
        help="where the page is served; only this machine can open it unless you say otherwise",
    )
    rig.add_argument(
        "--realtime",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="ask for real-time priority and locked memory for the servos (default)",
    )
    rig.add_argument(
        "--dry-run", action="store_true", help="check everything, list what would be opened, touch nothing"
    )


def add_driving_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """What an app needs to know in which a person drives."""
    drive = parser.add_argument_group("driving")
    drive.add_argument("--robot", metavar="NAME", help="which arm, where the rig has several (the first)")
    drive.add_argument("--mapping", metavar="FILE", help="what the pad's controls do (what the pad is meant for)")
    drive.add_argument("--speed", type=float, metavar="SHARE", help="share of the mapping's speeds, above 0, at most 1")
    return drive


def rig_options(args: argparse.Namespace) -> dict[str, Any]:
    """The arguments of :func:`hal.open` that the options stand for."""
    return {
        "config": args.config,
        "sim": args.sim,
        "overrides": args.overrides,
        "pad": args.pad,
        "viewer": args.viewer,
        "console": args.console or args.listen is not None,
        "listen": args.listen,
        "realtime": args.realtime,
    }


@contextmanager
def interruptible() -> Iterator[None]:
    """A closed terminal or a polite kill is like Ctrl-C: everything stops and closes before the program ends."""

    def interrupt(signum: int, frame: object) -> None:
        raise KeyboardInterrupt

    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {name: signal.signal(getattr(signal, name), interrupt) for name in names}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


def run_app(main: Any, parser: argparse.ArgumentParser, argv: list[str] | None) -> int:
    """Parse the command line and run ``main(args)``; an error that a person can fix is a message, not a traceback.

    The parser's ``prog`` is the program's name (``teleop``); its usage shows the command that was typed instead.

    Returns:
        The exit status. The output is written by then, or known to be lost.
    """
    from hal.errors import HalError

    _open_standard_streams()
    parser.prog = _typed(parser.prog)
    link = logging.getLogger("hal.views")
    before, link.disabled = link.disabled, True  # the banner says it
    try:
        try:
            args = parser.parse_args(argv)
            with interruptible():
                status = int(main(args))
        finally:
            sys.stdout.flush()  # while what fails can still be reported
        return status
    except HalError as error:
        return _failed(f"{type(error).__name__}: {error}")
    except BrokenPipeError:  # nothing reads the output any more, as behind "| head"
        _discard_output()
        return 1
    except OSError as error:  # a device or a file that cannot be opened, or an output that cannot be written
        return _failed(f"{type(error).__name__}: {error}")
    except KeyboardInterrupt:
        return 130
    finally:
        link.disabled = before


def _typed(name: str) -> str:
    """Return how the program ``name`` was called: ``hal teleop``, ``hal-teleop`` or ``teleop.py``."""
    command, *rest = name.split()
    typed = Path(sys.argv[0]).name
    if typed in ("hal", "main.py") and command != "hal":
        rest = [command, *rest]
    return " ".join([typed, *rest])


def _failed(message: str) -> int:
    with suppress(OSError):
        print(message, file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:
        _discard_output()
    return ACTION_NEEDED


def _discard_output() -> None:
    """Lead standard output nowhere, so that the interpreter's flush at the end cannot fail either."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with suppress(OSError, ValueError):
        os.dup2(nowhere, sys.stdout.fileno())


def _open_standard_streams() -> None:
    """Give a program that was started without standard streams, as by a scheduler, ones that lead nowhere."""
    from hal.host.process import fill_standard_descriptors

    fill_standard_descriptors()
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115  # for as long as the program runs
