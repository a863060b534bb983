"""Checks before a real arm moves: this computer, the arms and their network, the cameras and their frame rates.

Nothing moves, and nothing stays open. ``hal check`` prints the results.
"""

from __future__ import annotations

import os
import resource
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from . import registry
from .errors import ControlTaken, HalError
from .specs import CameraSpec, GripperSpec, PadSpec, RobotSpec

if TYPE_CHECKING:
    from .driver import CameraDriver
    from .specs import Plan

Level = Literal["ok", "warn", "fail", "unknown"]
"""``warn``: it may work. ``fail``: it will not. ``unknown``: it could not be checked, which is not ``ok``."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check."""

    name: str
    """What was checked."""
    level: Level
    found: str
    """What was found, in words."""
    remedy: str = ""
    """What to do about it, a command if there is one; empty if nothing is to be done."""


Device = RobotSpec | GripperSpec | CameraSpec
Check = Callable[[RobotSpec, float], Iterator[CheckResult]]
"""A driver's ``DriverSpec.preflight``: its arguments are the arm's record, and how long it may measure, s."""
CameraCheck = Callable[[CameraSpec, float], Iterator[CheckResult]]
"""A driver's ``DriverSpec.camera_preflight``, likewise; ``gripper_preflight`` takes a gripper's record."""


def preflight(
    plan: Plan, duration: float = 2.0, *, machine: bool = True, cameras: bool = True
) -> Iterator[CheckResult]:
    """Check this computer, the simulation and its pictures, real arms and cameras; yield each result at once.

    Errors of a driver's check become results.

    Args:
        plan: The resolved rig.
        duration: Time for which each arm's network and each camera's rate is measured, s.
        machine: Whether to check this computer.
        cameras: Whether to check the cameras, and the leader arms.
    """
    if machine:
        yield from check_machine()
    if plan.engine is not None:
        yield _check_engine(plan.engine)
        if cameras:
            yield from _check_pictures(plan)
    arms = list_real_arms(plan)
    grippers = [arm.gripper for arm in arms if arm.gripper is not None and _find_check(arm.gripper) is not None]
    devices: list[Device] = [*arms, *grippers, *(list_checked_cameras(plan) if cameras else ())]
    for device in devices:
        for result in _check(device, duration):
            yield replace(result, name=f"{device.name}: {result.name}")
    for leader in list_leaders(plan) if cameras else ():
        yield _check_leader(leader, duration)


def list_real_arms(plan: Plan) -> tuple[RobotSpec, ...]:
    """Return the arms of a rig that are real or emulated, and at this computer: another one checks its own."""
    return tuple(robot for robot in plan.robots if robot.at is None and (robot.attended or robot.emulated))


def list_checked_cameras(plan: Plan) -> tuple[CameraSpec, ...]:
    """Return the cameras of a rig whose driver can check them before they are opened."""
    return tuple(camera for camera in plan.cameras if registry.driver(camera.driver).camera_preflight is not None)


def list_leaders(plan: Plan) -> tuple[PadSpec, ...]:
    """Return the leader arms of a rig that are real or emulated."""
    leaders = (pad for pad in plan.pads if pad.leader is not None)
    return tuple(spec for spec in leaders if not registry.load(spec.driver, "leader").simulated)


def _check_leader(spec: PadSpec, duration: float) -> CheckResult:
    """Read a leader for a while: what it is, whether it answers, and how often."""
    name = f"{spec.name}: leader"
    driver = registry.load(spec.driver, "leader")(spec)
    driver.open()
    try:
        end, times = time.monotonic() + duration, set[float]()
        while (now := time.monotonic()) < end:
            reading = driver.poll(now, 0.01)
            times.add(reading.t_alive)
        found = driver.describe()
    finally:
        driver.close()
    if not reading.connected:
        cause, _, remedy = found.partition("; ")
        return CheckResult(name, "fail", cause, remedy)
    if driver.limp:
        found, _, remedy = found.partition("; ")
        return CheckResult(name, "warn", found, remedy)
    rate = (len(times) - 1) / duration
    levels: tuple[Level, Level] = ("ok", "warn")
    remedy = "connect its adapter directly; end busy programs"
    return CheckResult(name, levels[rate < 80.0], f"{found}, {rate:.0f} readings per second", remedy)


def _check_engine(engine: str) -> CheckResult:
    try:
        registry.check_engine(engine)
    except HalError as error:
        return CheckResult("simulation", "fail", engine, str(error))
    version = ", ".join(f"{library} {number}" for library, number in registry.versions(engine).items())
    return CheckResult("simulation", "ok", version or engine)


def _check_pictures(plan: Plan) -> Iterator[CheckResult]:
    """Check that the simulated cameras of a rig can be drawn."""
    world = plan.world
    if world is None or all(camera.driver != world.driver for camera in plan.cameras):
        return
    try:
        check = registry.function(world.driver, registry.driver(world.driver).pictures_preflight)
        if check is not None:
            yield from check(plan)
    except (HalError, OSError) as error:
        yield CheckResult("renderer", "fail", f"{type(error).__name__}: {error}", "or open the rig without its cameras")


def _find_check(device: Device) -> str | None:
    """Return the place of the check of a device's driver; None if it has none."""
    spec = registry.driver(device.driver)
    if isinstance(device, RobotSpec):
        return spec.preflight
    return spec.gripper_preflight if isinstance(device, GripperSpec) else spec.camera_preflight


def _check(device: Device, duration: float) -> Iterator[CheckResult]:
    try:
        check: Callable[[Any, float], Iterator[CheckResult]] | None = registry.function(
            device.driver, _find_check(device)
        )
        if check is None:
            kind = "arm" if isinstance(device, RobotSpec) else "camera"
            yield CheckResult(kind, "unknown", f"its driver {device.driver!r} has no check of its own")
            return
        yield from check(device, duration)
    except ControlTaken as error:
        yield CheckResult("in use", "fail", str(error), "end that program first; nothing else was checked")
    except (HalError, OSError) as error:
        yield CheckResult("check", "fail", f"{type(error).__name__}: {error}", "fix this first, then check again")


# For the checks of drivers

_FIRST, _GRAB = 5.0, 0.2
"""Longest time until the first frame of a camera, and of one wait for a later one, s."""
_SLOW, _LOSSY = 0.95, 0.02
"""Share of the nominal rate below which, and share of lost frames above which something is wrong."""
_FAR, _TURNED = 0.001, 0.005
"""Difference of two tcps that is named, m and rad."""
_LATE = 2.5
"""Periods without a state from which one is late."""


def check_frames(driver: CameraDriver, duration: float, slow: str, lossy: str, silent: str) -> CheckResult:
    """Measure the rate of an open camera's frames, and the share that is lost.

    Args:
        driver: The camera.
        duration: How long frames are counted, s.
        slow: Remedy if the camera takes too few.
        lossy: Remedy if they are lost on their way.
        silent: Remedy if none arrive.
    """
    nominal = min((stream.rate_hz for stream in driver.info.streams.values()), default=driver.spec.rate_hz)
    try:
        first = driver.grab(_FIRST)
        if first is None:
            return CheckResult("frames", "fail", "no frame arrived", silent)
        frames, last, end = 0, first, time.monotonic() + duration
        while time.monotonic() < end:
            if (frame := driver.grab(_GRAB)) is not None:
                frames, last = frames + 1, frame
    except HalError as error:
        return CheckResult("frames", "fail", str(error), silent)
    taken, passed = last.seq - first.seq, max(last.t - first.t, 1e-9)
    lost = taken - frames
    found = f"{frames / passed:.1f} of {nominal:g} Hz, {lost} of {taken} lost"
    if driver.tally.mismatched:
        found += f", {driver.tally.mismatched} frame sets that do not match"
    if taken / passed < _SLOW * nominal:
        return CheckResult("frames", "warn", found, slow)
    if lost > _LOSSY * taken:
        return CheckResult("frames", "warn", found, lossy)
    return CheckResult("frames", "ok", found)


def probe_ports(host: str, ports: Mapping[int, bytes | None], timeout: float = 1.0) -> str:
    """Return why a controller does not answer, naming the port; an empty text if it does.

    Args:
        host: Its address.
        ports: Ports, each with the request that it must answer: empty if it speaks first, None if it need not speak.
        timeout: Longest time for each, s.
    """
    for port, request in ports.items():
        try:
            with socket.create_connection((host, port), timeout) as line:
                if request is not None:
                    line.sendall(request)
                    if not line.recv(64):
                        return f"port {port} of {host} hangs up"
        except OSError as error:
            return f"port {port} of {host}: {error.strerror or error}"
    return ""


def compare_tcp(distance: float, turn: float, remedy: str) -> CheckResult:
    """Return whether the tcp of an arm's controller is that of the model, from how far they are apart, m and rad."""
    found = f"{1e3 * distance:.1f} mm and {turn:.3f} rad between the controller's and the model's"
    same = distance <= _FAR and turn <= _TURNED
    return CheckResult("tcp", "ok", found) if same else CheckResult("tcp", "warn", found, remedy)


def compare_payload(
    wanted: tuple[float, Sequence[float]] | None, mass: float, com: Sequence[float], place: str
) -> CheckResult:
    """Compare a controller's payload, kg and m, with the rig's; None keeps the controller's."""
    found = f"{mass:.2f} kg at [{', '.join(f'{value:.3f}' for value in com)}] m in {place}"
    if wanted is None:
        return CheckResult("payload", "ok", f"{found}; real.load is not set, so it stays")
    if abs(wanted[0] - mass) < 0.01 and max(abs(a - b) for a, b in zip(wanted[1], com, strict=True)) < 0.002:
        return CheckResult("payload", "ok", f"{found}, as the rig has it")
    found += f"; the rig has {wanted[0]:g} kg at {list(wanted[1])} m"
    remedy = "the rig's is set when a session opens; correct the wrong one"
    return CheckResult("payload", "warn", found, remedy)


def measure_gaps(name: str, receive: Callable[[], int], period: float, duration: float) -> CheckResult:
    """Measure when states come.

    Args:
        name: What they are called.
        receive: Returns how many have come since it was last called.
        period: Time between two, s.
        duration: How long to measure, s.
    """
    end = time.monotonic() + max(duration, 0.2)
    receive()
    times: list[float] = []
    while time.monotonic() < end:
        time.sleep(2e-4)
        times += [time.monotonic()] * receive()
    gaps = [b - a for a, b in pairwise(times)] or [inf]
    late = sum(gap > _LATE * period for gap in gaps)
    found = f"{len(times)} {name}, longest gap {1e3 * max(gaps):.1f} ms, {late} late"
    if late <= len(times) // 100:
        return CheckResult(name, "ok", found)
    return CheckResult(name, "warn", found, "connect the cable directly, end busy programs, use a real-time kernel")


# This computer

_ROOT = Path("/")
_GOVERNORS = "sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"
_IPC_LOCK = 14
"""Number of the capability to lock memory without a limit (capabilities(7))."""
REALTIME_RIGHT = (
    'printf \'%s - rtprio 99\\n%s - memlock unlimited\\n\' "$USER" "$USER" | '
    "sudo tee /etc/security/limits.d/99-realtime.conf; then log out and in"
)
"""Command that allows this user real-time scheduling and locked memory."""
_FULL_SPEED = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor (until the next start)"
_KERNELS = {
    "debian": "sudo apt install linux-image-rt-amd64, then start the computer with it",
    "ubuntu": "sudo pro enable realtime-kernel, then start the computer with it",
}
"""Distribution -> how to install a real-time kernel."""


def check_machine(root: Path = _ROOT) -> Iterator[CheckResult]:
    """Check the kernel, the frequency of the processors, and the rights to real-time scheduling and locked memory.

    Args:
        root: Folder in which the system's files are, for tests.
    """
    if not sys.platform.startswith("linux"):
        yield CheckResult("machine", "unknown", f"cannot check {sys.platform}", "use Linux for a real arm")
        return
    yield _check_kernel(root)
    yield _check_frequency(root)
    yield _check_scheduling()
    yield _check_memory(root)


def has_realtime_kernel(root: Path = _ROOT) -> bool | None:
    """Return whether this computer runs a kernel with PREEMPT_RT; None if that is unknown."""
    version = _text(root / "proc/version")
    if version is None:
        return None
    # Older, patched kernels have the file; newer ones have it in their name.
    return _text(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version or "PREEMPT RT" in version


def _check_kernel(root: Path) -> CheckResult:
    realtime = has_realtime_kernel(root)
    if realtime is None:
        return CheckResult("kernel", "unknown", "cannot read /proc/version")
    release = os.uname().release
    if realtime:
        return CheckResult("kernel", "ok", f"{release}, real-time kernel (PREEMPT_RT)")
    found = f"{release}, no real-time kernel: some set-points will be late"
    return CheckResult("kernel", "warn", found, _KERNELS.get(_distribution(root), "install a kernel with PREEMPT_RT"))


def _check_frequency(root: Path) -> CheckResult:
    """Check the frequency governor: processors that slow down to save power wake up late."""
    governors = {text for path in root.glob(_GOVERNORS) if (text := _text(path))}
    if not governors:
        return CheckResult("processor", "unknown", "frequency governor: unknown")
    saving = ", ".join(sorted(governors - {"performance"}))
    if not saving:
        return CheckResult("processor", "ok", "full speed (governor performance)")
    return CheckResult("processor", "warn", f"saves power and then wakes up late (governor {saving})", _FULL_SPEED)


def _check_scheduling() -> CheckResult:
    priority = os.sched_get_priority_max(os.SCHED_FIFO)
    if _may_be_fifo(priority):
        return CheckResult("scheduling", "ok", f"SCHED_FIFO is allowed, up to priority {priority}")
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    found = f"SCHED_FIFO is not allowed up to priority {priority} ('ulimit -r' is {limit})"
    return CheckResult("scheduling", "warn", found, REALTIME_RIGHT)


def _may_be_fifo(priority: int) -> bool:
    """Try it, in a thread of its own, because limits, capabilities and containers all matter."""
    allowed = False

    def attempt() -> None:
        nonlocal allowed
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError:
            return
        allowed = True

    thread = threading.Thread(target=attempt, name="hal-check-scheduling")
    thread.start()
    thread.join()
    return allowed


def may_lock_memory(root: Path = _ROOT) -> bool:
    """Return whether this process may lock all of its memory."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return limit == resource.RLIM_INFINITY or bool((_capabilities(root) or 0) >> _IPC_LOCK & 1)


def _check_memory(root: Path) -> CheckResult:
    if may_lock_memory(root):
        return CheckResult("memory", "ok", "all of a process's memory may be locked")
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    found = f"only {limit / 2**20:.0f} MiB may be locked ('ulimit -l'); a servo's process needs more"
    return CheckResult("memory", "unknown" if _capabilities(root) is None else "warn", found, REALTIME_RIGHT)


def _capabilities(root: Path) -> int | None:
    """Return the capabilities of this process, as bits; None if unknown."""
    lines = (_text(root / "proc/self/status") or "").splitlines()
    return next((int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")), None)


def _distribution(root: Path) -> str:
    """Return the ID of os-release(5): ``debian``, ``ubuntu``, ..."""
    lines = (_text(root / "etc/os-release") or "").splitlines()
    return next((line[3:].strip("\"'") for line in lines if line.startswith("ID=")), "")


def _text(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None
