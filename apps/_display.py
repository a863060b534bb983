"""Output of the programs: the banner, the live status line, and the report of a run."""

from __future__ import annotations

import io
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TextIO

from hal import registry

if TYPE_CHECKING:
    from hal.rig import Rig
    from hal.robot import Robot
    from hal.session import SessionEvent
    from hal.specs import CameraSpec, GripperSpec, PadSpec, Plan, RobotSpec
    from hal.teleop import ArmTeleop
    from hal.types import RobotState


def count_episodes(count: int) -> str:
    """Return a number of episodes in words."""
    return f"{count} episode{'' if count == 1 else 's'}"


# The banner.


def banner(rig: Rig) -> str:
    """Return the devices of an open rig, its renderer and its notes, one per line."""
    plan = rig.plan
    lines = [f"rig      {plan.source}"]
    for line in list_devices(plan):
        if line.startswith(("gamepad", "leader")):
            continue
        lines.append(line)
        if line.startswith("world") and rig.renderer:
            lines.append(f"renderer {rig.renderer}")
    lines.extend(f"{pad.driver.spec.kind:8s} {pad.name:10s} {pad.describe()}" for pad in rig.gamepads.values())
    lines.extend(f"note     {note}" for note in rig.notes)
    return "\n".join(f"  {line}" for line in lines)


def list_devices(plan: Plan) -> list[str]:
    """Return the devices of a rig that is not open, one per line."""
    lines = []
    for robot in plan.robots:
        simulated = not robot.attended or (plan.world is not None and robot.driver == plan.world.driver)
        where = f"simulated ({robot.driver})" if simulated else _real(robot, robot)
        gripper = robot.gripper
        hand = f", gripper {gripper.width_min:g}..{gripper.width_max:g} m" if gripper else ""
        if gripper and robot.attended and simulated:
            hand += f", {_real(robot, gripper)}"
        at = "" if robot.at is None else f" at {robot.at}"
        lines.append(f"robot    {robot.name:10s} {robot.model}{at}, {where}, {robot.rate_hz:g} Hz{hand}")
        if robot.attended:
            lines.append(f"limits   {robot.name:10s} {_limits(robot)}")
    for camera in plan.cameras:
        streams, at = "+".join(camera.streams), "" if camera.at is None else f" at {camera.at}"
        lines.append(
            f"camera   {camera.name:10s} {camera.model}{at} ({camera.driver}{_image_source(camera)}), "
            f"{camera.width}x{camera.height} {streams} at {camera.rate_hz:g} Hz"
        )
    lines.extend(f"{pad.kind:8s} {pad.name:10s} {_pad(pad)}" for pad in plan.pads)
    if plan.world is not None:
        bodies = ", ".join(body.name for body in plan.world.bodies) or "empty"
        lines.append(f"world    {plan.world.driver}, {plan.world.physics_hz:g} Hz: {bodies}")
    lines.append(f"clock    {plan.clock.replace('_', ' ')}")
    lines += [f"missing  {library}: {command}" for library, command in _missing_libraries(plan).items()]
    return lines


def _missing_libraries(plan: Plan) -> dict[str, str]:
    """Return the libraries of arms and grippers that are not installed -> the command that installs each."""
    here = [robot for robot in plan.robots if robot.at is None]
    devices = [device for robot in here for device in (robot, robot.gripper) if device is not None]
    return {name: command for one in devices for name, command in registry.find_missing(one.driver, one).items()}


def _pad(pad: PadSpec) -> str:
    """Return the model of a gamepad or leader if the rig names one, its driver, and the arm that it drives."""
    model = "" if pad.model is None else f"{pad.model['title']}, "
    drives = "" if pad.drives is None else f", drives {pad.drives}"
    if (leader := pad.leader) is None:
        return f"{model}{pad.driver}{drives}"
    held = leader.deadman or ("its lever" if leader.may_drive_real else "none")
    return f"{leader.title}, {pad.driver} at {pad.options.get('port', 'no port')}, dead-man: {held}{drives}"


def _image_source(camera: CameraSpec) -> str:
    """Return a note if the images of a real camera come from an emulator or a recording."""
    if camera.options.get("emulated"):
        return ", EMULATED"
    played = camera.options.get("play")
    return f", playing {played}" if played else ""


def _real(robot: RobotSpec, device: RobotSpec | GripperSpec) -> str:
    """Return the driver and the address of a real device, or of its emulator."""
    host = f" at {device.options['host']}" if "host" in device.options else ""
    return f"{'EMULATED' if robot.emulated else 'REAL'} ({device.driver}{host})"


def _limits(robot: RobotSpec) -> str:
    """Return the limits of an arm that really moves."""
    box = robot.workspace
    where = "no workspace" if box is None else f"workspace {_triple(box.lower)} to {_triple(box.upper)} m"
    largest = f"at most {max(robot.limits.acceleration):g} rad/s2, {max(robot.limits.jerk):g} rad/s3"
    return f"{100 * robot.speed:g} % of the joint speeds, tcp {robot.tcp_speed:g} m/s, {largest}; {where}"


def _triple(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


def list_links(rig: Rig) -> str:
    """Return the links to open in a browser, with the ssh commands for other computers; empty if there are none."""
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
            lines += ["  On another computer, run this first:", "", f"      {rig.console.tunnel}", ""]
        else:
            lines += [_draw_code(rig.console.link)]
    return "\n".join(lines)


def _draw_code(link: str) -> str:
    """Return the QR code of a link, for a phone; empty without the library for it."""
    try:
        import segno
    except ImportError:
        return ""
    drawn = io.StringIO()
    segno.make(link, error="l", micro=False).terminal(drawn, border=2, compact=True)
    return drawn.getvalue()


# The live line.


_PERIOD = 0.1
"""Shortest time between two updates of the line, s."""


class StatusLine:
    """A live line at the bottom of a terminal. Without a terminal only :meth:`event` prints."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stdout if stream is None else stream
        self._live = self._stream.isatty()
        self._next = 0.0
        self._drawn = False

    def update(self, text: Callable[[], str]) -> None:
        """Draw the line again if its period is over; ``text`` is called only then."""
        now = time.monotonic()
        if not self._live or now < self._next:
            return
        self._next = now + _PERIOD
        width = shutil.get_terminal_size().columns - 1
        self._write("\r\x1b[K" + text()[:width])
        self._drawn = True

    def event(self, text: str) -> None:
        """Print a line above the live one."""
        self.clear()
        self._write(text + "\n")

    def clear(self) -> None:
        """Remove the live line."""
        if self._drawn:
            self._write("\r\x1b[K")
            self._drawn = False

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:  # the terminal was closed: the arm must still be brought to rest
            self._live = False


def show_episodes(stream: TextIO | None = None) -> Callable[[int, int], None]:
    """Return a function that shows in a live line how many episodes of all are done."""
    line = StatusLine(stream)

    def show(done: int, total: int) -> None:
        line.update(lambda: f"  {done} of {total} episodes")
        if done == total:
            line.clear()

    return show


class TeleopDisplay:
    """A :class:`hal.TeleopSession` in a terminal: prints its events, draws the live line and measures the run."""

    def __init__(self, rig: Rig, robots: Sequence[Robot], **options: Any) -> None:
        """Create the session; ``options`` are keyword arguments of :class:`hal.TeleopSession`."""
        from hal.session import TeleopSession

        self.line = StatusLine()
        self.report = RunReport(rig, robots)
        self.note = ""
        """First words of the live line."""
        self.session = TeleopSession(rig, robots, on_event=self._print_event, on_tick=self._draw, **options)

    def _print_event(self, event: SessionEvent) -> None:
        self.line.event(event.text)
        if event.kind == "stopped":
            self.report.add_event(self.report.trips, reason=event.reason)
        elif event.kind == "fault":
            self.report.add_event(self.report.faults, cause=event.reason)
        elif event.kind == "robot_changed":
            self.report.set_robots([arm.robot for arm in self.session.arms])
        elif event.kind == "pad_changed":
            self.line.event(self.session.help())

    def _draw(self) -> None:
        for arm in self.session.arms:
            if arm.state is not None:
                self.report.add_state(arm.robot, arm.state)
        self.line.update(self._text)

    def _text(self) -> str:
        arms = self.session.arms
        parts = [part for arm in arms for part in self._of_arm(arm, named=len(arms) > 1)]
        if self.report.trips:
            parts.append(f"trips {len(self.report.trips)}")
        for name, camera in self.session.rig.cameras.items():
            if (fps := camera.counts().fps) is not None:
                parts.append(f"{name} {fps:.0f} fps")
        return f"  {self.note}{'  '.join(parts)}"

    @staticmethod
    def _of_arm(arm: ArmTeleop, named: bool) -> Iterator[str]:
        """Yield the parts of the live line about one arm."""
        state, pad, gripper = arm.state, arm.pad, arm.robot.gripper
        if state is None:
            yield f"{arm.robot.name} does not answer"
            return
        held = "held" if arm.deadman.held else "released"
        if pad.waiting_for and pad.state().connected:
            held = f"waiting: release, or move once: {', '.join(map(pad.control_name, pad.waiting_for))}"
        yield f"{arm.robot.name if named else 'dead-man'} {held:8s}"
        yield f"{state.status.name.lower():9s}"
        yield "tcp {:6.3f} {:6.3f} {:6.3f} m".format(*state.tcp.position)
        fingers = gripper.peek() if gripper is not None else None
        if fingers is not None and not arm.gripper_trouble:
            yield f"gripper {1e3 * fingers.width:4.0f} mm"
        if state.limited:
            yield f"limited: {state.limited}"


# The report.


class RunReport:
    """Measurements of a run for ``--report``, as JSON. Times in ms, lengths in m."""

    def __init__(self, rig: Rig, robots: Sequence[Robot]) -> None:
        from hal.histogram import Histogram

        self._rig = rig
        self._robots = tuple(robots)
        self.start = rig.clock.now()
        self._ages = Histogram(1e-4, 5000)
        self._travel = 0.0
        self._positions: dict[str, Any] = {}
        self.trips: list[dict[str, Any]] = []
        self.faults: list[dict[str, Any]] = []

    def set_robots(self, robots: Sequence[Robot]) -> None:
        """Report about these arms from now on. The travel of all arms is added up."""
        self._robots = tuple(robots)
        self._positions.clear()

    def add_state(self, robot: Robot, state: RobotState) -> None:
        """Add a state of an arm."""
        self._ages.add(self._rig.clock.now() - state.stamp.t)
        position, before = state.tcp.position, self._positions.get(robot.name)
        if before is not None:
            delta = position - before
            self._travel += float(delta @ delta) ** 0.5
        self._positions[robot.name] = position

    def add_event(self, events: list[dict[str, Any]], **what: str) -> None:
        """Add an event of this moment to :attr:`trips` or :attr:`faults`."""
        events.append({"t_s": round(self._rig.clock.now() - self.start, 3), **what})

    def collect(self, clean_exit: bool) -> dict[str, Any]:
        """Return everything so far. Call it while the rig is open.

        Servo, latency and peaks are those of the first arm; with several, ``arms`` has those of each by name.
        """
        rig, first = self._rig, self._robots[0]
        arms = {robot.name: self._of_arm(robot) for robot in self._robots}
        cameras = {}
        for name, camera in rig.cameras.items():
            counts = camera.counts()
            cameras[name] = {
                "frames": counts.frames,
                "fps": counts.fps,
                "age_ms_p50": to_ms(counts.age_p50),
                "dropped": counts.dropped,
            }
        report = {
            "backend": first.spec.driver,
            "clock": rig.plan.clock,
            "duration_s": rig.clock.now() - self.start,
            **arms[first.name],
            "state_age_ms": _summary(self._ages.summary()),
            "tcp_travel_m": self._travel,
            "cameras": cameras,
            "trips": self.trips,
            "faults": self.faults,
            "clean_exit": clean_exit,
        }
        return report | ({"arms": arms} if len(arms) > 1 else {})

    def _of_arm(self, robot: Robot) -> dict[str, Any]:
        """Return the measurements of one arm's servo, and the tcp's pose in its base frame, m and xyzw."""
        group = next(g for g in self._rig.statistics().values() if robot.name in g["robots"])
        own = group["robots"][robot.name]
        latency, tcp = own["latency_s"], robot.state(max_age=float("inf")).tcp
        return {
            "servo": {
                "rate_hz": robot.spec.rate_hz,
                "ticks": group["ticks"],
                "missed": group.get("missed", 0),
                "period_ms": _summary(group.get("period_s")),
                **{key: own[key] for key in ("reanchored", "lost", "skipped", "mismatches", "report_error")},
                "driver": own["driver"],
            },
            "latency_ms": {"p50": to_ms(latency["p50"]), "p99": to_ms(latency["p99"])},
            "tcp_end": {"position": tcp.position.tolist(), "orientation": tcp.orientation.tolist()},
            "peak": own["peak"],
        }


def to_ms(seconds: float | None) -> float | None:
    """Return a time in ms."""
    return None if seconds is None else 1e3 * seconds


def _summary(summary: dict[str, float | None] | None) -> dict[str, float | None] | None:
    return None if summary is None else {name: to_ms(value) for name, value in summary.items()}
