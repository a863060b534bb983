"""Pre-flight check of a Franka: reachable, the right arm, ready to move, and a fast network.

The checks run in the order in which they can succeed; a check that depends on a failed one is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from hal import registry
from hal.clock import describe_load
from hal.errors import ConnectionLost, Fault
from hal.host.process import Channel, Child, SharedMemory
from hal.preflight import CheckResult
from hal.specs import RobotSpec

from .faults import (
    ARM_PORT,
    HAND_PORT,
    NO_HAND,
    NO_ROUTE,
    REFUSED,
    UNKNOWN_HOST,
    UNREACHABLE,
    fault_of,
    fault_of_exception,
)
from .flags import FLAGS
from .network import (
    NotMeasured,
    PortState,
    RoundTrips,
    lock_arm,
    measure_round_trips,
    probe_port,
    resolve_host,
    route_to,
)
from .settings import ArmSettings, HandSettings

PATIENCE = 5.0
"""s for the robot to answer, including the start of the process that connects to it; it needs a fraction of that."""
_PORT_ERRORS = {PortState.REFUSED: REFUSED, PortState.SILENT: UNREACHABLE, PortState.NO_ROUTE: NO_ROUTE}
_HAND_LIBRARY = "panda_py"
_START_EMULATOR = "start it in another terminal: hal emulate franka --host {host} (--help for more)"
_IN_USE = "end the program that uses this arm, also on other computers; if there is none, restart the robot in Desk"
_SAMPLES = 50
"""States, 1 ms apart, from which the noise of an arm at rest is measured."""
_GOOD, _BUDGET = 0.3e-3, 1e-3
"""Round-trip times, s. According to Franka's documentation a whole cycle, with the computing time of both sides, has
to fit into 1 ms; the share of 0.3 ms for the network is our choice."""
_ALLOW_PING = "sudo sysctl -w net.ipv4.ping_group_range='0 2147483647'"
"""Allows every user to ping."""
_IMPROVE = "connect the cable directly to Control's LAN port, end busy programs, and use a real-time kernel"


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Check one arm, and measure its network for ``duration`` s. Nothing moves, and no connection stays open."""
    settings = ArmSettings.of(spec)
    lock = lock_arm(settings.host)
    try:
        yield from _check(spec, settings, duration)
    finally:
        lock.release()


def _check(spec: RobotSpec, settings: ArmSettings, duration: float) -> Iterator[CheckResult]:
    host = settings.host
    address = resolve_host(host)
    if address is None:
        yield _report_failure("address", UNKNOWN_HOST.fault(host))
        return
    yield _check_route(host, address)
    port = probe_port(address, ARM_PORT)
    if port is not PortState.OPEN:
        result = _report_failure("robot", _PORT_ERRORS[port].fault(f"{host}:{ARM_PORT}"))
        yield replace(result, remedy=_START_EMULATOR.format(host=host)) if spec.emulated else result
        return
    yield from _check_robot(spec, settings)
    yield from _check_hand(spec)
    try:
        yield rate_round_trips(measure_round_trips(address, duration))
    except NotMeasured as error:
        yield CheckResult("network", "unknown", f"not measured: {error}", _ALLOW_PING)


def _report_failure(name: str, fault: Fault) -> CheckResult:
    return CheckResult(name, "fail", fault.cause, fault.remedy)


def _missing(library: str) -> CheckResult:
    command = registry.find_missing("franka").get(library, "pip install 'robot-hal[franka]'")
    return CheckResult("library", "fail", f"{library} does not import", command)


def _check_route(host: str, address: str) -> CheckResult:
    route = route_to(address)
    named = address if host == address else f"{host} is {address}"
    if route is None:
        return CheckResult("route", "unknown", f"{named}; `ip route get` tells no route there")
    direct = "give a network port of this computer an address in the robot's network, and connect the two directly"
    if route.interface == "lo":
        return CheckResult("route", "ok", f"{named}, this computer: an emulator")
    if route.gateway is not None:
        return CheckResult("route", "warn", f"{named}, through the router {route.gateway} ({route.interface})", direct)
    if route.wireless:
        return CheckResult("route", "warn", f"{named}, by radio ({route.interface})", "use a cable")
    return CheckResult("route", "ok", f"{named}, on the network of {route.interface}")


def _check_robot(spec: RobotSpec, settings: ArmSettings) -> Iterator[CheckResult]:
    host = settings.host
    report = _query_robot(host, settings.arm)
    if report is None:
        found = f"{host}:{ARM_PORT} is open, but does not answer: another program may hold the arm{describe_load()}"
        yield CheckResult("robot", "fail", found, _IN_USE)
    elif "missing" in report:
        yield _missing(report["missing"])
    elif "fault" in report:
        fault = Fault(*report["fault"])
        if fault.code == "closed":
            found = f"{host}:{ARM_PORT} closes the connection: another program may hold the arm{describe_load()}"
            yield CheckResult("robot", "fail", found, _IN_USE)
        else:
            yield _report_failure("robot", fault)
    else:
        found = f"answers; speaks protocol {report['protocol']}, as the model {spec.model!r} requires"
        yield CheckResult("robot", "ok", found)
        yield _check_mode(report["mode"], report["flags"])
        yield _check_noise(report["noise"])


def _check_mode(mode: str, flags: list[str]) -> CheckResult:
    """A robot that is stopped is only a warning: the app can recover it."""
    fault = fault_of(flags, mode)
    if fault is None:
        return CheckResult("state", "ok", "ready to move" if mode == "idle" else f"mode {mode!r}")
    return CheckResult("state", "warn", fault.cause, fault.remedy)


def _check_noise(noise: float) -> CheckResult:
    """Check how exactly an arm at rest reports its set-points."""
    from hal.servo.anchoring import NOISIEST

    found = f"reported within {noise:.1g} rad at rest"
    if noise <= NOISIEST:
        return CheckResult("set-points", "ok", found)
    remedy = f"the servo needs {NOISIEST:g} rad; end the program that moves the arm, then check again"
    return CheckResult("set-points", "fail", found, remedy)


def _check_hand(spec: RobotSpec) -> Iterator[CheckResult]:
    gripper = spec.gripper
    if gripper is None or gripper.driver != spec.driver:
        return
    if _HAND_LIBRARY in registry.find_missing("franka"):
        yield _missing(_HAND_LIBRARY)
    host = HandSettings.of(gripper).host
    address = resolve_host(host)
    if address is not None and probe_port(address, HAND_PORT) is PortState.OPEN:
        yield CheckResult("hand", "ok", f"answers at port {HAND_PORT}")
    else:
        yield _report_failure("hand", NO_HAND.fault(f"{host}:{HAND_PORT}"))


def rate_round_trips(trips: RoundTrips) -> CheckResult:
    """Return whether round trips are short enough for set-points."""
    if not trips.times:
        return CheckResult("network", "unknown", f"not measured: none of {trips.sent} pings came back")
    found = f"round trip {trips}"
    if trips.quantile(0.5) >= _BUDGET:
        return CheckResult("network", "fail", f"{found}: most set-points would be late", _IMPROVE)
    if trips.lost or trips.quantile(0.99) > _GOOD or trips.times[-1] >= _BUDGET:
        found = f"{found}; required: p99 below {1e3 * _GOOD:.1f} ms, each below {1e3 * _BUDGET:.0f} ms, none lost"
        return CheckResult("network", "warn", found, _IMPROVE)
    return CheckResult("network", "ok", found)


# The process that connects to the robot.


def _query_robot(host: str, arm: str) -> dict[str, Any] | None:
    """Return the report of :func:`main` from a process of its own; None if there is no answer in time.

    A process of its own, because the vendors' libraries keep Python's lock while they wait, raise the calling thread
    to the highest permitted priority, and wait forever for a greeting.
    """
    child = Child("check", "hal.drivers.franka.preflight:main", {"host": host, "arm": arm})
    try:
        return dict(child.wait_ready(PATIENCE))
    except ConnectionLost:
        if child.process.poll() is not None:
            raise  # the process failed; it did not hang
        return None
    finally:
        child.close(0.2)


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the process that connects to the robot. Nothing moves.

    It sends ``protocol``, ``mode``, ``flags`` and ``noise`` (rad, by how much the commanded positions differ that an
    arm at rest reports); or ``missing``, the name of a library; or ``fault``: code, cause and remedy.
    """
    import resource

    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))  # a check needs no priority
    channel.send({"ready": _read_report(config["host"], config["arm"])})


def _read_report(host: str, arm: str) -> dict[str, Any]:
    from .arm import create_link

    try:
        link = create_link(arm)
    except ImportError as error:
        return {"missing": error.name or str(error)}
    try:
        link.connect(host)
        sample = link.read()
        report = {"protocol": link.protocol, "mode": sample.mode.name.lower(), "flags": link.errors(FLAGS)}
        reports = [list(link.read().q_d) for _ in range(_SAMPLES)]
        report["noise"] = max(max(values) - min(values) for values in zip(*reports, strict=True))
        link.disconnect()
    except link.library_errors as error:
        fault = fault_of_exception(error, host=host)
        return {"fault": [fault.code, fault.cause, fault.remedy]}
    return report
