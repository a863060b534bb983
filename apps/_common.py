"""The part that all programs share: options, checks before a rig is opened, errors as messages."""

from __future__ import annotations

import argparse
import io
import json
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hal import registry
from hal.apps._display import list_devices
from hal.errors import CommandError, ConnectionLost, DeviceNotFound, HalError
from hal.registry import ENGINES
from hal.types import STREAMS

if TYPE_CHECKING:
    from hal.config.mapping import TeleopMapping
    from hal.deadman import Deadman
    from hal.gamepad import Gamepad
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.specs import Plan

ACTION_NEEDED = 2
"""Exit status when the user has to fix something first."""

# Options.


def add_config_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the options that choose and change a rig's configuration."""
    rig = parser.add_argument_group("rig")
    rig.add_argument(
        "--config", default="panda_table", metavar="FILE", help="rig file, or name of a built-in one (%(default)s)"
    )
    flag = rig.add_mutually_exclusive_group()
    flag.add_argument("--sim", dest="sim", action="store_true", default=None, help="simulate every device")
    flag.add_argument("--real", dest="sim", action="store_false", help="use the real devices")
    rig.add_argument(
        "--engine",
        metavar="NAME",
        help=f"engine of the simulation: {', '.join(ENGINES)}, auto (the first of these that is installed), or a "
        "driver with a world (default: the rig's)",
    )
    rig.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a key of the rig, for example --set cameras.wrist.output.width=320; may be repeated",
    )
    return rig


def add_rig_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a program that opens a rig."""
    rig = add_config_options(parser)
    rig.add_argument(
        "--pad",
        default="auto",
        metavar="auto|web|evdev|terminal|demo|none|FILE",
        help="gamepad: a page in a browser, a plugged-in gamepad, the keys of this terminal, the recorded tour, none, "
        "or a recording; %(default)s: a plugged-in gamepad, else the page",
    )
    rig.add_argument(
        "--viewer",
        choices=["3d", "none"],
        default="none",
        help="3D view on the page of the console",
    )
    rig.add_argument("--console", action="store_true", help="serve the page also when another gamepad drives")
    rig.add_argument(
        "--listen", metavar="ADDRESS[:PORT]", help="address of the page (default: reachable from this computer only)"
    )
    rig.add_argument(
        "--realtime",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="request real-time priority and locked memory for the servos (default)",
    )
    rig.add_argument("--dry-run", action="store_true", help="check everything and list the devices; open nothing")


def add_driving_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the options of a program in which the user drives an arm."""
    drive = parser.add_argument_group("driving")
    drive.add_argument(
        "--robot",
        metavar="NAMES",
        help="arm to drive (default: the first), or several, as left,right: at once with a pad each, one after the "
        "other with one pad",
    )
    drive.add_argument(
        "--independent", action="store_true", help="a stop of one of several arms does not hold the others"
    )
    drive.add_argument("--mapping", metavar="FILE", help="gamepad mapping (default: the pad's own)")
    drive.add_argument("--speed", type=float, metavar="SCALE", help="speed scale, 0-1 (default: 1)")
    return drive


def add_deadman_options(group: argparse._ArgumentGroup) -> None:
    """Add the options of a program that moves an arm by itself."""
    who = group.add_mutually_exclusive_group()
    who.add_argument("--deadman", action="store_true", help="require the dead-man for simulated arms too")
    who.add_argument("--unattended", action="store_true", help="move a real arm without a dead-man: keep clear of it")


def config_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of :func:`hal.config.load` for the options of :func:`add_config_options`."""
    return {"config": args.config, "sim": args.sim, "engine": args.engine, "overrides": args.overrides}


def add_episode_options(group: argparse._ArgumentGroup) -> None:
    """Add the options of a program in which a policy drives episodes."""
    group.add_argument("--robot", metavar="NAME", help="arm to drive (default: the first)")
    group.add_argument(
        "--rate", type=float, default=20.0, metavar="HZ", help="calls of the policy per second (%(default)g)"
    )
    group.add_argument(
        "--history", type=int, default=1, metavar="N", help="observations passed to each call (%(default)s)"
    )
    group.add_argument("--episodes", type=int, default=1, metavar="N", help="number of episodes (%(default)s)")
    group.add_argument("--seconds", type=float, default=30.0, metavar="S", help="length of an episode (%(default)g)")
    group.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="object placement seed of the first episode; each next one adds 1 (0)",
    )
    group.add_argument(
        "--reset", metavar="MODULE:NAME", help="function of the rig and a random generator, called after each reset"
    )
    group.add_argument(
        "--success",
        metavar="MODULE:NAME",
        help="function of the rig and an observation; True ends an episode as a success",
    )
    add_recording_options(group)


def add_recording_options(group: argparse._ArgumentGroup) -> None:
    """Add the options of a program that records."""
    group.add_argument(
        "--fps", type=int, default=30, metavar="N", help="rows of the recording per second (%(default)s)"
    )
    group.add_argument("--task", default="", metavar="TEXT", help="task, saved with each episode")
    group.add_argument("--report", metavar="FILE", help="write the results to a JSON file")


def add_stream_options(group: argparse._ArgumentGroup) -> None:
    """Add the options that choose what is recorded."""
    group.add_argument("--cameras", metavar="NAMES", help="cameras to record, or none (default: all)")
    group.add_argument(
        "--streams",
        default="color,depth",
        metavar="NAMES",
        help=f"streams to record: {', '.join(STREAMS)}; objects: their poses as an observation (%(default)s)",
    )
    group.add_argument("--codec", choices=["auto", "h264", "av1"], default="auto", help="video codec (%(default)s)")


def check_episode_options(args: argparse.Namespace, *places: str) -> None:
    """Check the options of :func:`add_episode_options`, and import the functions that options name.

    Args:
        args: The parsed options.
        places: Options that name a ``MODULE:NAME``.

    Raises:
        CommandError: A number is out of range, or a function cannot be imported.
    """
    for name in ("rate", "episodes", "seconds", "history"):
        if not getattr(args, name) > 0:
            raise CommandError(f"--{name} must be positive, not {getattr(args, name):g}")
    if args.seed < 0:
        raise CommandError(f"--seed must be 0 or more, not {args.seed}")
    check_one_robot(args)
    check_report(args.report)
    for what in places:
        load_named(args, what)


def load_named(args: argparse.Namespace, option: str) -> Any:
    """Return the object ``MODULE:NAME`` that an option names, also of a module in the working directory; else None.

    Raises:
        CommandError: It cannot be imported.
    """
    from hal.learning.policy import load_object

    if not getattr(args, option):
        return None
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    return load_object(getattr(args, option), f"--{option}")


def split_names(text: str | None) -> list[str] | None:
    """Return the names of an option such as ``--cameras A,B``; none for ``none``, None if it is not given."""
    if text is None:
        return None
    return [] if text == "none" else [name.strip() for name in text.split(",") if name.strip()]


def rig_options(args: argparse.Namespace, *, pad: bool = True) -> dict[str, Any]:
    """Return the arguments of :func:`hal.open` for the options of :func:`add_rig_options`; without a pad on request."""
    return {
        **config_options(args),
        "pad": args.pad if pad else "none",
        "viewer": args.viewer,
        "console": args.console or args.listen is not None,
        "listen": args.listen,
        "realtime": args.realtime,
    }


# Before a rig is opened.


def resolve_plan(
    args: argparse.Namespace, *details: str, cameras: Iterable[str] = (), clock: str | None = None
) -> Plan:
    """Return the rig that the options name; check its real arms before it is opened.

    Args:
        args: Options of :func:`add_rig_options`, and ``robot``.
        details: Further lines to print with ``--dry-run``.
        cameras: Names of cameras that must exist.
        clock: ``lock_step``, whatever the rig file has, for a program in which nothing real moves; None for the rig's.

    Raises:
        ConfigError: The configuration is wrong.
        DeviceNotFound: There is no such robot or camera.
        SystemExit: After ``--dry-run``, for which everything is checked and listed; or a check of a real arm failed.
    """
    from hal.apps.check import may_open
    from hal.config import load
    from hal.errors import suggest

    try:
        plan = load(**config_options(args), clock=clock).resolve()
    except ConnectionLost as error:
        error.args = (f"{error}" + "; --sim --dry-run checks this rig without it" * args.dry_run,)
        raise
    robots = [robot.name for robot in plan.robots]
    for name in robot_names(args):
        if name not in robots:
            raise DeviceNotFound(f"--robot: this rig has no robot {name!r}{suggest(name, robots)}")
    known = [camera.name for camera in plan.cameras]
    for name in cameras:
        if name not in known:
            raise DeviceNotFound(f"--cameras: this rig has no camera {name!r}{suggest(name, known)}")
    if args.dry_run:
        check_everything(plan, args)
        notes = [*plan.warnings, *_world_warnings(plan)]
        print(f"{plan.source} is valid; it would open:")
        shown = replace(plan, pads=()) if args.pad == "none" else plan
        lines = [*list_devices(shown), *(f"note     {note}" for note in notes), *details]
        print("\n".join(f"  {line}" for line in lines))
        sys.exit(0)
    if clock is None and not may_open(plan):
        sys.exit(ACTION_NEEDED)
    return plan


def check_everything(plan: Plan, args: argparse.Namespace) -> None:
    """Raise the errors that opening the rig would raise, as far as they are known without a device or a process."""
    from hal.rig import check_opening
    from hal.views import Listen

    if args.listen is not None:
        Listen.parse(args.listen).check()
    pads = check_opening(plan, args.pad, args.viewer, args.console or args.listen is not None)
    for robot in (robot for robot in plan.robots if robot.at is None):
        registry.load(robot.driver, "robot")
        if robot.gripper is not None:
            registry.load(robot.gripper.driver, "gripper")
    for camera in plan.cameras:
        registry.load(camera.driver, "camera")
    for chosen in pads:
        registry.load(chosen.spec.driver, chosen.spec.kind)(chosen.spec)  # checks its options; opens nothing


def _world_warnings(plan: Plan) -> list[str]:
    """Load the simulated world, which touches no device, and return its warnings.

    Raises:
        ConfigError: It cannot be loaded, or arms start inside each other.
    """
    if plan.world is None:
        return []
    world = registry.load(plan.world.driver, "world")(plan.world)
    try:
        return list(getattr(world, "warnings", ()))
    finally:
        world.close()


def check_driving_options(args: argparse.Namespace) -> None:
    """Check the options of :func:`add_driving_options`.

    Raises:
        CommandError: The speed is out of range.
        ConfigError: The mapping is wrong.
        DeviceNotFound: There is no such pad.
    """
    from hal.config.mapping import load_mapping
    from hal.pads.choice import check_wanted

    check_speed(args)
    load_mapping(args.mapping or "default")
    if args.pad == "none":
        raise CommandError("--pad none: this program needs a gamepad")
    check_wanted(args.pad)


def check_speed(args: argparse.Namespace) -> None:
    """Check ``--speed``. Raises CommandError."""
    if args.speed is not None and not 0.0 < args.speed <= 1.0:
        raise CommandError(f"--speed must be above 0 and at most 1, not {args.speed:g}")


def check_report(path: str | None) -> None:
    """Check that the file of ``--report`` can be written, so that this does not fail after the run.

    Raises:
        CommandError: It cannot.
    """
    if not path:
        return
    if os.path.isdir(path) or (os.path.exists(path) and not os.access(path, os.W_OK)):
        raise CommandError(f"--report {path}: is a folder, or a file that cannot be written")
    folder = Path(path).resolve().parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise CommandError(f"--report {path}: the folder {folder} does not exist or cannot be written to")


def write_report(path: str | None, report: Mapping[str, Any]) -> None:
    """Write the file of ``--report``, if there is to be one."""
    from hal.recording.layout import make_plain

    if path:
        Path(path).write_text(json.dumps(make_plain(report), indent=2) + "\n")


def robot_names(args: argparse.Namespace) -> list[str]:
    """Return the names of ``--robot``. Raises CommandError if one is given twice."""
    names = [name.strip() for name in (args.robot or "").split(",") if name.strip()]
    if len(set(names)) < len(names):
        raise CommandError(f"--robot {args.robot}: an arm is named twice", code="duplicate_name")
    return names


def check_one_robot(args: argparse.Namespace) -> None:
    """Check the ``--robot`` of a program that moves one arm.

    Raises:
        CommandError: It names several.
    """
    if len(robot_names(args)) > 1:
        message = f"--robot {args.robot}: this program moves one arm, and the others stand still; name one of them"
        raise CommandError(message, code="one_robot")


def select_robots(rig: Rig, args: argparse.Namespace) -> list[Robot]:
    """Return the arms that ``--robot`` names, or the first.

    Raises:
        CommandError: The rig has no robot.
    """
    names = robot_names(args) or list(rig.robots)[:1]
    if not names:
        raise CommandError(f"{rig.plan.source} has no robot to drive", code="no_robot")
    return [rig.robots[name] for name in names]


def needs_deadman(plan: Plan, args: argparse.Namespace) -> bool:
    """Whether a dead-man must be held: for real devices unless ``--unattended``, else with ``--deadman``."""
    return bool(args.deadman) or (any(robot.attended for robot in plan.robots) and not args.unattended)


def find_pad(rig: Rig, robot: Robot | None = None) -> Gamepad | None:
    """Return the first gamepad, or the leader that leads an arm in a takeover; None if there is neither."""
    pads = rig.gamepads.values()
    leaders = [pad for pad in pads if robot and pad.driver.spec.leader and pad.driver.spec.drives in (None, robot.name)]
    return next(iter([*leaders, *pads]), None)


def find_deadman(rig: Rig, robot: Robot | None = None, *, steps: bool = False) -> tuple[Deadman, TeleopMapping, str]:
    """Return the dead-man of the rig's pad, the pad's mapping, and the name of the dead-man's control.

    With ``steps`` it may be a pad that makes a step for each press.

    Raises:
        CommandError: The rig has no pad (code ``no_gamepad``), or its pad's controls cannot be held (``cannot_hold``).
    """
    from hal.config.mapping import load_mapping

    pad = find_pad(rig, robot)
    if pad is None:
        message = f"{rig.plan.source} has no gamepad to hold as the dead-man; see --pad and --unattended"
        raise CommandError(message, code="no_gamepad")
    if not pad.can_hold and not steps:
        message = "keys of this terminal make one step for each press, and the dead-man must be held: use --pad web"
        raise CommandError(message, code="cannot_hold")
    mapping = load_mapping(pad.mapping or "default")
    return pad.hold(mapping.deadman), mapping, pad.control_name(mapping.deadman)


# Running.


@contextmanager
def interruptible() -> Iterator[None]:
    """Treat a closed terminal and SIGTERM as Ctrl-C: everything stops and closes before the program ends."""

    def interrupt(signum: int, frame: object) -> None:
        raise KeyboardInterrupt

    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {name: signal.signal(getattr(signal, name), interrupt) for name in names}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


class Program(Protocol):
    """The function of a program: of the command line, or None for that of the process, to the exit status."""

    def __call__(self, argv: list[str] | None = None) -> int:
        """Run the program."""


def program(parser: Callable[[], argparse.ArgumentParser]) -> Callable[[Callable[[Any], int]], Program]:
    """Make a function of the parsed options one of the command line, without arguments of that of the process."""

    def decorate(main: Callable[[Any], int]) -> Program:
        @wraps(main)
        def run(argv: list[str] | None = None) -> int:
            return run_app(main, parser(), argv)

        return run

    return decorate


def run_app(main: Any, parser: argparse.ArgumentParser, argv: list[str] | None) -> int:
    """Parse the command line and run ``main(args)``; an error that the user can fix is a message, not a traceback.

    Returns:
        The exit status. The output is written by then, or known to be lost.
    """
    _open_standard_streams()
    link = logging.getLogger("hal.console")
    before, link.disabled = link.disabled, True  # the banner prints the link
    try:
        try:
            args = parser.parse_args(argv)
            with interruptible():
                try:
                    status = int(main(args))
                except SystemExit as end:  # of resolve_plan
                    if not isinstance(end.code, int | None):
                        raise  # a message of a user's module
                    status = int(end.code or 0)
        finally:
            sys.stdout.flush()  # while what fails can still be reported
        return status
    except HalError as error:
        return _report_failure(f"{type(error).__name__}: {error}")
    except BrokenPipeError:  # nothing reads the output any more, as behind "| head"
        discard_output()
        return 1
    except OSError as error:  # a device or a file that cannot be opened, or an output that cannot be written
        return _report_failure(f"{type(error).__name__}: {error}")
    except KeyboardInterrupt:
        return 130
    finally:
        link.disabled = before
        if argv is None and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # a further Ctrl-C would be a traceback of Python's own end


def _report_failure(message: str) -> int:
    with suppress(OSError):
        print(message, file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:
        discard_output()
    return ACTION_NEEDED


def discard_output() -> None:
    """Redirect standard output to nowhere, so that the interpreter's flush at the end cannot fail either."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with suppress(OSError, ValueError):
        os.dup2(nowhere, sys.stdout.fileno())


def _open_standard_streams() -> None:
    """Let output never fail for a missing stream, as of a program that a scheduler started, or for a letter."""
    from hal.host.process import fill_standard_descriptors

    fill_standard_descriptors()
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115  # used until the program ends
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a path may have letters that this terminal has not
