"""What every app's command line shares: the rig's options, and errors that a person can read."""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from hal.config.mapping import TeleopMapping
    from hal.deadman import Deadman
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.specs import CameraSpec, GripperSpec, Plan, RobotSpec
    from hal.types import RobotState

__all__ = [
    "ACTION_NEEDED",
    "RunReport",
    "StatusLine",
    "add_config_options",
    "add_driving_options",
    "add_rig_options",
    "banner",
    "check_everything",
    "check_writable",
    "held_by",
    "interruptible",
    "invitation",
    "listing",
    "needs_holding",
    "planned",
    "rig_options",
    "run_app",
]

# [opening.py] What an app does between its command line and an open rig.


def planned(args: argparse.Namespace, *more: str, cameras: Iterable[str] = ()) -> Plan | None:
    """The plan of the rig that the options name. None after ``--dry-run``, which has told what would be opened.

    ``more`` are lines that follow. Raises ConfigError, and DeviceNotFound for a ``--robot``, or one of ``cameras``,
    that is not there.
    """
    # FOLD: import dropped
    from hal.config import load
    from hal.config.files import nearest
    from hal.errors import DeviceNotFound

    plan = load(args.config, sim=args.sim, overrides=args.overrides).resolve()
    names = [robot.name for robot in plan.robots]
    if args.robot and args.robot not in names:
        raise DeviceNotFound(f"--robot: this rig has no robot {args.robot!r}{nearest(args.robot, names)}")
    known = [camera.name for camera in plan.cameras]
    for name in cameras:
        if name not in known:
            raise DeviceNotFound(f"--cameras: this rig has no camera {name!r}{nearest(name, known)}")
    if not args.dry_run:
        return plan
    check_everything(plan, args)
    notes = [*plan.warnings, *_world_warnings(plan)]
    print(f"{plan.source} is in order; it would open:")
    print("\n".join(f"  {line}" for line in [*listing(plan), *(f"note     {note}" for note in notes), *more]))
    return None


def check_everything(plan: Plan, args: argparse.Namespace) -> None:
    """Raise what opening the rig would raise, as far as it is known without a device or a process."""
    from hal import registry
    from hal.rig import check_opening
    from hal.views import Listen

    if args.listen is not None:
        Listen.parse(args.listen).check()
    console = args.console or args.listen is not None
    for robot in plan.robots:
        registry.load(robot.driver, "robot")
        if robot.gripper is not None:
            registry.load(robot.gripper.driver, "gripper")
    for camera in plan.cameras:
        registry.load(camera.driver, "camera")
    for chosen in check_opening(plan, args.pad, args.viewer, console):
        registry.load(chosen.spec.driver, "gamepad")(chosen.spec)  # checks its options; opens nothing


def _world_warnings(plan: Plan) -> list[str]:
    """Load the simulated world, which touches no device, and return its warnings.

    Raises:
        ConfigError: It cannot be loaded, or arms start inside each other.
    """
    from hal import registry

    if plan.world is None:
        return []
    world = registry.load(plan.world.driver, "world")(plan.world)
    try:
        return list(getattr(world, "warnings", ()))
    finally:
        world.close()


# [banner.py] What drives what: printed before anything moves.


def listing(plan: Plan) -> list[str]:
    """The devices of a rig that is not open, one a line."""
    lines = []
    for robot in plan.robots:
        simulated = not robot.attended or (plan.world is not None and robot.driver == plan.world.driver)
        where = f"simulated ({robot.driver})" if simulated else _real(robot, robot)
        gripper = robot.gripper
        hand = f", gripper 0..{gripper.width_max:g} m" if gripper else ""
        if gripper and robot.attended and simulated:
            hand += f", {_real(robot, gripper)}"
        lines.append(f"robot    {robot.name:10s} {robot.model}, {where}, {robot.rate_hz:g} Hz{hand}")
        if robot.attended:
            lines.append(f"limits   {robot.name:10s} {_limits(robot)}")
    for camera in plan.cameras:
        streams = "+".join(camera.streams)
        lines.append(
            f"camera   {camera.name:10s} {camera.model} ({camera.driver}{_stands_in(camera)}), "
            f"{camera.width}x{camera.height} {streams} at {camera.rate_hz:g} Hz"
        )
    lines.extend(f"gamepad  {pad.name:10s} {pad.driver}" for pad in plan.pads)
    if plan.world is not None:
        things = ", ".join(body.name for body in plan.world.bodies) or "nothing else"
        lines.append(f"world    {plan.world.driver}, {plan.world.physics_hz:g} Hz: {things}")
    lines.append(f"clock    {plan.clock.replace('_', ' ')}")
    return lines


def _stands_in(camera: CameraSpec) -> str:
    """What a real camera's pictures come from where that is no camera."""
    if camera.options.get("emulated"):
        return ", EMULATED"
    played = camera.options.get("play")
    return f", playing {played}" if played else ""


def _real(robot: RobotSpec, device: RobotSpec | GripperSpec) -> str:
    """What drives a device that counts as real, and where: nobody may take a robot for its stand-in."""
    host = f" at {device.options['host']}" if "host" in device.options else ""
    return f"{'EMULATED' if robot.emulated else 'REAL'} ({device.driver}{host})"


def _limits(robot: RobotSpec) -> str:
    """What holds an arm back that really moves."""
    box = robot.workspace
    where = "no workspace" if box is None else f"workspace {_triple(box.lower)} to {_triple(box.upper)} m"
    most = f"at most {max(robot.limits.acceleration):g} rad/s2, {max(robot.limits.jerk):g} rad/s3"
    return f"{robot.speed:g} of the joint speeds, tcp {robot.tcp_speed:g} m/s, {most}; {where}"


def _triple(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


def banner(rig: Rig) -> str:
    """The same for an open rig, with what was found."""
    plan = rig.plan
    lines = [f"rig      {plan.source}"]
    for line in listing(plan):
        if line.startswith("gamepad"):
            continue
        lines.append(line)
        if line.startswith("world") and rig.renderer:
            lines.append(f"renderer {rig.renderer}")
    lines.extend(f"gamepad  {pad.name:10s} {pad.describe()}" for pad in rig.gamepads.values())
    lines.extend(f"note     {note}" for note in rig.notes)
    return "\n".join(f"  {line}" for line in lines)


def invitation(rig: Rig) -> str:
    """What a person should open in a browser; nothing where there is nothing to open."""
    lines = []
    if rig.console is not None:
        does = "drive, watch and stop" if rig.console.driven_by is None else "watch and stop"
        lines += [
            "",
            f"  Open this in a browser to {does}:",
            "",
            f"      {rig.console.link}",
            "",
        ]
        if rig.console.tunnel:
            lines += ["  From another computer, type this there first:", "", f"      {rig.console.tunnel}", ""]
    if rig.viewer3d is not None:
        if not lines:
            lines.append("")
        lines += ["  The arms in three dimensions, on this machine:", "", f"      {rig.viewer3d.link}", ""]
        if rig.console is not None and rig.console.tunnel:
            port = urlsplit(rig.viewer3d.link).port
            lines += [f"  (from another computer, add to the ssh line: -L {port}:127.0.0.1:{port})", ""]
    return "\n".join(lines)


# [status.py] The live line of an app: what the arm does, in one line that is drawn again and again.


class StatusLine:
    """One line at the bottom of a terminal; where there is none, only :meth:`event` prints."""

    def __init__(self, stream: TextIO | None = None, period: float = 0.1) -> None:
        self._stream = sys.stdout if stream is None else stream
        self._live = self._stream.isatty()
        self._period = period
        self._next = 0.0
        self._drawn = False

    def update(self, text: Callable[[], str]) -> None:
        """Draw the line anew, if its period is over; ``text`` is called only then."""
        now = time.monotonic()
        if not self._live or now < self._next:
            return
        self._next = now + self._period
        width = shutil.get_terminal_size().columns - 1
        self._write("\r\x1b[K" + text()[:width])
        self._drawn = True

    def event(self, text: str) -> None:
        """Print a line that stays."""
        self.clear()
        self._write(text + "\n")

    def clear(self) -> None:
        """Take the live line away."""
        if self._drawn:
            self._write("\r\x1b[K")
            self._drawn = False

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:  # the terminal was closed: the arm must still be brought to rest
            self._live = False


# [report.py] ``--report``: how a run went, measured, as JSON.


class RunReport:
    """Collects while an app runs; :meth:`write` asks the rig for the rest. Times in ms, lengths in m."""

    def __init__(self, rig: Rig, robot: Robot) -> None:
        from hal.histogram import Histogram

        self._rig = rig
        self._robot = robot
        self.start = rig.clock.now()
        self._ages = Histogram(1e-4, 5000)
        self._travel = 0.0
        self._position: Any = None
        self.trips: list[dict[str, Any]] = []
        self.faults: list[dict[str, Any]] = []

    def follow(self, robot: Robot) -> None:
        """Report about this arm, which is driven from now on. The travel of all of them adds up."""
        self._robot, self._position = robot, None

    def saw(self, state: RobotState) -> None:
        """Note a state that the app looked at."""
        self._ages.add(self._rig.clock.now() - state.stamp.t)
        position = state.tcp.position
        if self._position is not None:
            delta = position - self._position
            self._travel += float(delta @ delta) ** 0.5
        self._position = position

    def tripped(self, reason: str) -> None:
        """Note a trip."""
        self.trips.append({"t_s": round(self._rig.clock.now() - self.start, 3), "reason": reason})

    def faulted(self, cause: str) -> None:
        """Note a fault."""
        self.faults.append({"t_s": round(self._rig.clock.now() - self.start, 3), "cause": cause})

    def collect(self, clean_exit: bool) -> dict[str, Any]:
        """Everything so far. Call it while the rig is open."""
        rig, robot = self._rig, self._robot
        group = next(g for g in rig.statistics().values() if robot.name in g["robots"])
        own = group["robots"][robot.name]
        latency = own["latency_s"]
        cameras = {}
        for name, camera in rig.cameras.items():
            counts = camera.counts()
            cameras[name] = {
                "frames": counts.frames,
                "fps": counts.fps,
                "age_ms_p50": _ms(counts.age_p50),
                "dropped": counts.dropped,
            }
        return {
            "backend": robot.spec.driver,
            "clock": rig.plan.clock,
            "duration_s": rig.clock.now() - self.start,
            "servo": {
                "rate_hz": robot.spec.rate_hz,
                "ticks": group["ticks"],
                "missed": group.get("missed", 0),
                "period_ms": _summary(group.get("period_s")),
                **{key: own[key] for key in ("reanchored", "reports", "report_lag", "report_noise", "mismatches")},
                "driver": own["driver"],
            },
            "latency_ms": {"p50": _ms(latency["p50"]), "p99": _ms(latency["p99"])},
            "state_age_ms": _summary(self._ages.summary()),
            "tcp_travel_m": self._travel,
            "tcp_end": self._end(),
            "peak": own["peak"],
            "cameras": cameras,
            "trips": self.trips,
            "faults": self.faults,
            "clean_exit": clean_exit,
        }

    def _end(self) -> dict[str, list[float]]:
        """Where the tcp is now, in the arm's base frame, m and xyzw."""
        tcp = self._robot.state(max_age=float("inf")).tcp
        return {"position": tcp.position.tolist(), "orientation": tcp.orientation.tolist()}

    @staticmethod
    def write(path: str, report: dict[str, Any]) -> None:
        """Write a report that :meth:`collect` made."""
        Path(path).write_text(json.dumps(report, indent=2) + "\n")


def check_writable(path: str) -> None:
    """Raise CommandError now rather than after the run when no file can be written there."""
    from hal.errors import CommandError

    if os.path.isdir(path) or (os.path.exists(path) and not os.access(path, os.W_OK)):
        raise CommandError(f"--report {path}: is a folder, or a file that cannot be written")
    folder = Path(path).resolve().parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise CommandError(f"--report {path}: the folder {folder} does not exist or cannot be written to")


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


def _summary(summary: dict[str, float | None] | None) -> dict[str, float | None] | None:
    return None if summary is None else {name: _ms(value) for name, value in summary.items()}


# [holding.py] Who must hold a dead-man, in programs that move an arm by themselves.


def needs_holding(plan: Plan, args: argparse.Namespace) -> bool:
    """Must somebody hold a dead-man? Where something really moves, unless ``--unattended``; else with ``--deadman``."""
    return bool(args.deadman) or (any(robot.attended for robot in plan.robots) and not args.unattended)


def held_by(rig: Rig) -> tuple[Deadman, TeleopMapping]:
    """The dead-man of the rig's pad, and what the pad's controls are. CommandError where there is no pad."""
    from hal.config.mapping import load_mapping
    from hal.errors import CommandError

    pad = next(iter(rig.gamepads.values()), None)
    if pad is None:
        raise CommandError(f"{rig.plan.source}: no pad is open that could be the dead-man; see --pad, --unattended")
    mapping = load_mapping(pad.mapping or "default")
    return pad.hold(mapping.deadman), mapping


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
    link = logging.getLogger("hal.console")
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
