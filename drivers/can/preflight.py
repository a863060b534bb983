"""Pre-flight checks of arms on a CAN bus: the interface, who answers, their registers or limits, and the bus load.

Nothing moves, and no motor is switched on. The checks run in the order in which they can succeed; a check that depends
on a failed one is left out.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence
from typing import NamedTuple

from hal.errors import ConfigError, DeviceNotFound
from hal.lock import DeviceLock
from hal.preflight import CheckResult
from hal.specs import RobotSpec

from .bus import CanBus, bring_up
from .damiao_chain import DamiaoChain
from .damiao_motor import find_turned, register_problems
from .damiao_protocol import REGISTER_ID, TIMEOUT_UNIT, MotorRegister, encode_register_read
from .interfaces import CanInterface, read_interfaces
from .piper_link import PiperLink, arm_fault, gripper_fault
from .piper_protocol import (
    FEEDBACK_IDS,
    JOINTS,
    PARAMETER_IDS,
    FirmwarePiece,
    FirmwareQuery,
    GripperStatus,
    GripperStroke,
    JointAngles,
    JointLimits,
    JointStatus,
    LimitQuery,
    ParameterQuery,
    PiperFeedback,
    PiperStatus,
    find_firmware,
)
from .settings import (
    EMULATED_INTERFACES,
    BusSettings,
    DamiaoArmSettings,
    DamiaoGripperSettings,
    PiperArmSettings,
    PiperGripperSettings,
)

_CLASSIC_BITS = 130
"""Length of a classic frame with 8 bytes, with the usual number of stuff bits and the gap after it, bits."""
_FD_BITS = 40, 95
"""The same of a CAN-FD frame: bits at the bit rate, and at that of its data."""
_PIPER_REPORTS = 14 * 200.0 + 6 * 40.0
"""Frames that a PiPER sends without being asked, 1/s."""
_HIGH_LOAD, _FULL_LOAD = 0.8, 0.95
"""Bus load above which frames come late, and above which they pile up."""
_OTHERS = 1.3
"""Measured load over the expected one above which another program or device must use the bus, too."""
_FEW_LOST, _MANY_LOST = 0.002, 0.05
"""Share of rounds with a missing answer from which a check warns, and fails."""
_LONG_TIMEOUT = 1.0
"""TIMEOUT of a motor above which a check warns, s."""
_ANSWER = 0.3
"""Longest time to wait for an answer that an arm may not give, s."""
_RANGE_TOLERANCE = 0.003
"""Largest difference between the arm's own range, exact to 0.1 degrees, and the rig's, rad."""
_PLAUSIBLE_RANGE = 0.2
"""Narrowest range of a joint that is no mistake, rad."""
_WIRING = "check the wiring, the termination (120 ohm at both ends) and the bit rate"
_END_OTHERS = "end the other program, or take the other device off the bus"

_Steps = Generator[CheckResult, None, bool]
"""Results of some checks; returns whether the next ones make sense."""


# The interface


def _check_interface(settings: BusSettings) -> _Steps:
    """Check the adapter without opening it."""
    name = "interface"
    where = f"{settings.interface} {settings.channel}"
    if settings.interface in EMULATED_INTERFACES:
        yield CheckResult(name, "ok", f"{where}: a bus of this computer, for an emulator")
        return True
    if settings.interface != "socketcan":
        given = settings.bus.get("bitrate", settings.bit_rate)
        if given != settings.bit_rate:
            found = f"{where} is opened at {given} bit/s, and `bit_rate` is {settings.bit_rate}"
            yield CheckResult(name, "fail", found, "give both the bit rate of the arm")
            return False
        yield CheckResult(name, "unknown", f"{where}: its state and bit rate cannot be read")
        return True
    interfaces = read_interfaces()
    if interfaces is None:
        yield CheckResult(name, "unknown", f"{where}: `ip` does not run", "sudo apt install iproute2")
        return True
    found_one = next((one for one in interfaces if one.name == settings.channel), None)
    if found_one is None:
        there = ", ".join(one.name for one in interfaces) or "none"
        remedy = "plug in the adapter, or correct `channel`; hal check --can lists what there is"
        yield CheckResult(name, "fail", f"there is no CAN interface {settings.channel}; interfaces: {there}", remedy)
        return False
    result = judge_interface(found_one, settings)
    yield result
    return result.level != "fail"


def judge_interface(found: CanInterface, settings: BusSettings) -> CheckResult:
    """Return whether a SocketCAN interface is set up as the rig has it."""
    again = f"sudo ip link set {found.name} down; {bring_up(settings)}"
    if not found.up:
        return CheckResult("interface", "fail", f"{found.name} is down", bring_up(settings))
    if found.state == "BUS-OFF":
        return CheckResult(
            "interface", "fail", f"{found.name} is bus-off: too many errors", f"{_WIRING}; then: {again}"
        )
    if not found.virtual and found.bit_rate != settings.bit_rate:
        text = f"{found.name} runs at {found.bit_rate} bit/s, the rig has {settings.bit_rate}"
        return CheckResult("interface", "fail", text, again)
    if settings.fd and not found.virtual and found.data_bit_rate != settings.data_bit_rate:
        present = f"a data bit rate of {found.data_bit_rate}" if found.data_bit_rate else "no CAN-FD"
        text = f"{found.name} has {present}, the rig has `fd` with {settings.data_bit_rate} bit/s"
        return CheckResult("interface", "fail", text, again)
    if found.state in ("ERROR-WARNING", "ERROR-PASSIVE"):
        return CheckResult("interface", "warn", f"{found.name} has many errors ({found.state})", _WIRING)
    return CheckResult("interface", "ok", f"{found.name}: {found}")


# Bus load


def bus_load(frames: float, settings: BusSettings) -> float:
    """Return the share of the time that a bus is busy with so many frames of 8 bytes in a second."""
    if not settings.fd:
        return frames * _CLASSIC_BITS / settings.bit_rate
    slow, fast = _FD_BITS
    return frames * (slow / settings.bit_rate + fast / settings.data_bit_rate)


class _Traffic(NamedTuple):
    seconds: float
    frames: int
    errors: int
    strangers: tuple[int, ...]
    """Ids that no device of the rig has."""


def _judge_load(expected: float, traffic: _Traffic, frames: float, settings: BusSettings) -> CheckResult:
    """Return whether the bus is fast enough for the frames per second when driven; ``frames`` are those at rest."""
    load, measured = bus_load(expected, settings), bus_load(traffic.frames / traffic.seconds, settings)
    found = f"{1e2 * load:.0f} % load expected when driven, {1e2 * measured:.0f} % measured at rest"
    if traffic.strangers:
        found += f"; ids of no device in the rig: {', '.join(f'{id:#x}' for id in traffic.strangers[:8])}"
    if traffic.errors:
        return CheckResult("bus", "fail", f"{found}; {traffic.errors} error frames", _WIRING)
    if load > _FULL_LOAD or measured > _FULL_LOAD:
        remedy = "use CAN-FD (`fd: true`) if the motors have it, a lower `rate_hz`, or a second adapter"
        return CheckResult("bus", "fail", found, remedy)
    if measured > _OTHERS * bus_load(frames, settings) + 0.02:
        return CheckResult("bus", "warn", f"{found}: others send here, too", _END_OTHERS)
    if load > _HIGH_LOAD:
        return CheckResult("bus", "warn", found, "use CAN-FD if the motors have it, or a lower `rate_hz`")
    return CheckResult("bus", "ok", found)


# Damiao motors


def check_damiao(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Check an arm of Damiao motors, and its gripper of this driver; measure the answers for ``duration`` s."""
    settings = DamiaoArmSettings.of(spec)
    if not (yield from _check_interface(settings)):
        return
    bus = CanBus.acquire(settings.shared)
    chains = [
        DamiaoChain(
            spec.name, "real.motors", settings, settings.motors, spec.joints, settings.mosfet_limit, spec.source
        ),
    ]
    gripper = spec.gripper
    if gripper is not None and gripper.driver == spec.driver:
        own = DamiaoGripperSettings.of(gripper)
        fingers = DamiaoChain(
            gripper.name, "real.motor", own, (own.motor,), ("gripper",), own.mosfet_limit, spec.source
        )
        chains.append(fingers)
    try:
        if (yield from _check_motors(chains, bus)):
            yield from _check_states(chains)
            turned = find_turned(chains[0].motors, spec.limits)
            if turned is not None:
                yield CheckResult("position", "fail", turned.cause, turned.remedy)
            yield _check_firmware(chains)
            yield from _measure_answers(chains, spec.rate_hz, duration)
    finally:
        for chain in chains:
            chain.close()
        bus.release()


def _check_motors(chains: Sequence[DamiaoChain], bus: CanBus) -> _Steps:
    """Check that every motor answers, and that its registers fit the rig."""
    fits = True
    for chain in chains:
        try:
            chain.open()
        except DeviceNotFound as error:
            yield _missing_motors(chain, bus, str(error))
            fits = False
        except ConfigError:
            fits = False
            for motor in chain.motors:
                for register, message, _ in register_problems(motor.settings, motor.registers):
                    found, _, remedy = message.partition("; ")
                    yield CheckResult("registers", "fail", f"{motor.label}: {register} {found}", remedy)
    if not fits:
        return False
    motors = [motor for chain in chains for motor in chain.motors]
    types: dict[str, list[str]] = {}
    for motor in motors:
        types.setdefault(motor.settings.type, []).append(str(motor.id))
    who = "; ".join(f"{', '.join(ids)} ({kind})" for kind, ids in types.items())
    yield CheckResult("motors", "ok", f"{len(motors)} answer: {who}")
    timeouts = [TIMEOUT_UNIT * motor.registers[MotorRegister.TIMEOUT] for motor in motors]
    found = f"ranges as in the rig, MIT mode; TIMEOUT {min(timeouts):.2f} to {max(timeouts):.2f} s"
    if max(timeouts) > _LONG_TIMEOUT:
        remedy = "set it to 8000 (0.4 s), the factory's value: so long a motor drives on without a program"
        yield CheckResult("registers", "warn", found, remedy)
    else:
        yield CheckResult("registers", "ok", found)
    return True


def _missing_motors(chain: DamiaoChain, bus: CanBus, error: str) -> CheckResult:
    """Return who answers and who does not."""
    remedy = error.rpartition("; ")[2]
    errors = bus.statistics()["error_frames"]
    answer = [motor for motor in chain.motors if motor.registers]
    silent = [motor for motor in chain.motors if not motor.registers]
    if not answer and errors:
        found = f"no motor answers, and there are {errors} error frames: the motors may have another bit rate"
        return CheckResult("motors", "fail", found, _WIRING)
    if not answer and len(chain.motors) > 1:
        return CheckResult("motors", "fail", f"no motor answers on {chain.settings.channel}", remedy)
    if not silent:  # one that stopped in the middle
        return CheckResult("motors", "fail", error.partition("; ")[0], remedy)
    found = f"{', '.join(motor.label for motor in silent)} does not answer"
    if answer:
        found += f"; {', '.join(str(motor.id) for motor in answer)} do"
        remedy = "check its power, its plugs and its ids (ESC_ID is `id`, MST_ID is `master`)"
    return CheckResult("motors", "fail", found, remedy)


def _check_states(chains: Sequence[DamiaoChain]) -> Iterator[CheckResult]:
    """Check the motors' states. A fault is only a warning: the app can recover from it."""
    faults = [fault for chain in chains if (fault := chain.fault(engaged=False)) is not None]
    for fault in faults:
        yield CheckResult("state", "warn", fault.cause, fault.remedy)
    motors = [motor for chain in chains for motor in chain.motors]
    if not faults:
        hottest = max(max(motor.rotor, motor.mosfet) for motor in motors)
        yield CheckResult("state", "ok", f"no motor has a fault; the hottest has {hottest} deg C")


def _check_firmware(chains: Sequence[DamiaoChain]) -> CheckResult:
    motors = [motor for chain in chains for motor in chain.motors]
    for chain in chains:
        for motor in chain.motors:
            chain.usable.send(REGISTER_ID, encode_register_read(motor.id, MotorRegister.SW_VERSION))
    deadline = time.monotonic() + _ANSWER
    while any(MotorRegister.SW_VERSION not in motor.registers for motor in motors) and time.monotonic() < deadline:
        chains[0].usable.poll()
        time.sleep(1e-3)
    versions: dict[float | None, list[int]] = {}
    for motor in motors:
        versions.setdefault(motor.registers.get(MotorRegister.SW_VERSION), []).append(motor.id)
    if set(versions) == {None}:
        return CheckResult("firmware", "unknown", "no motor reports a version")
    texts = [f"{version:g}" if version is not None else "unknown" for version in versions]
    of = [f"{text} (motors {', '.join(map(str, ids))})" for text, ids in zip(texts, versions.values(), strict=True)]
    return CheckResult("firmware", "ok", texts[0] if len(texts) == 1 else "; ".join(of))


def _measure_answers(chains: Sequence[DamiaoChain], rate_hz: float, duration: float) -> Iterator[CheckResult]:
    """Ask every motor for its state at the arm's rate, and count the answers."""
    bus = chains[0].usable
    motors = [motor for chain in chains for motor in chain.motors]
    bus.poll()
    bus.reset_statistics()
    for motor in motors:
        motor.replies = 0
    times: list[float] = []
    rounds = answers = incomplete = 0
    began = time.monotonic()
    while (start := time.monotonic()) < began + duration:
        rounds += 1
        for chain in chains:
            for motor in chain.motors:
                chain.ask_state(motor)
        left = True
        while left and time.monotonic() < start + 1.0 / rate_hz:
            bus.poll()
            left = any(not motor.replies for motor in motors)
            if left:
                time.sleep(1e-4)
        if left:
            incomplete += 1
        else:
            times.append(time.monotonic() - start)
        answers += sum(motor.replies for motor in motors)
        for motor in motors:
            motor.replies = 0
        time.sleep(max(0.0, start + 1.0 / rate_hz - time.monotonic()))
    seconds = time.monotonic() - began
    yield _judge_answers(rounds, incomplete, sorted(times), rate_hz, chains[0].settings)
    figures = bus.statistics()
    sent = len(motors) * rounds
    traffic = _Traffic(
        seconds, sent + answers + figures["unexpected"], figures["error_frames"], tuple(figures["unexpected_ids"])
    )
    yield _judge_load(2 * len(motors) * rate_hz, traffic, 2 * sent / seconds, chains[0].settings)


def _judge_answers(
    rounds: int, incomplete: int, times: Sequence[float], rate_hz: float, settings: BusSettings
) -> CheckResult:
    share = incomplete / rounds
    cause = "check whether the emulator still runs" if settings.interface in EMULATED_INTERFACES else _WIRING
    found = f"{rounds} rounds at {rate_hz:g} Hz, {incomplete} not answered in time"
    if times:
        median, late = times[len(times) // 2], times[min(len(times) - 1, int(0.99 * len(times)))]
        found += f"; all answers after {1e3 * median:.2f} ms (median), {1e3 * late:.2f} ms (99 %)"
    if share > _MANY_LOST:
        return CheckResult("answers", "fail", found, f"{cause}; end busy programs; use a lower `rate_hz`")
    if share > _FEW_LOST:
        return CheckResult("answers", "warn", found, f"end busy programs; {cause}")
    return CheckResult("answers", "ok", found)


# PiPER


class _PiperReports:
    """What an arm has reported."""

    def __init__(self) -> None:
        self.frames = 0
        self.status: PiperStatus | None = None
        self.joints: dict[int, JointStatus] = {}
        self.limits: dict[int, JointLimits] = {}
        self.gripper: GripperStatus | None = None
        self.stroke: GripperStroke | None = None
        self.pairs: set[int] = set()
        self.firmware: list[bytes] = []

    def take(self, record: PiperFeedback) -> None:
        self.frames += 1
        match record:
            case PiperStatus():
                self.status = record
            case JointStatus():
                self.joints[record.joint] = record
            case JointLimits():
                self.limits[record.motor] = record
            case GripperStatus():
                self.gripper = record
            case GripperStroke():
                self.stroke = record
            case JointAngles():
                self.pairs.add(record.first)
            case FirmwarePiece():
                self.firmware.append(record.text)

    def missing(self) -> str:
        """Return what has not been reported, in words; empty if the arm is complete."""
        if not self.frames:
            return "no PiPER reports"
        silent = [str(k + 1) for k in range(JOINTS) if k not in self.joints]
        if silent:
            return f"the motor of joint {', '.join(silent)} does not report"
        return "" if self.status is not None and len(self.pairs) == JOINTS // 2 else "the arm's positions are missing"


def check_piper(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Check a PiPER, with its gripper; measure the bus load for ``duration`` s."""
    settings = PiperArmSettings.of(spec)
    if not (yield from _check_interface(settings)):
        return
    where = " ".join(settings.key)
    reports = _PiperReports()
    link = PiperLink(spec.name, settings, reports.take, (*FEEDBACK_IDS, *PARAMETER_IDS), spec.source)
    lock: DeviceLock | None = None
    try:
        if settings.interface != "virtual":
            lock = DeviceLock(f"piper-{where}", f"the PiPER on {where}")
        link.open(reports.missing)
        yield CheckResult("motors", "ok", f"a PiPER reports on {settings.channel}, with all {JOINTS} joints")
        yield from _check_piper(spec, settings, link, reports, duration)
    except DeviceNotFound as error:
        yield CheckResult("motors", "fail", reports.missing(), str(error).rpartition("; ")[2])
    finally:
        link.close()
        if lock is not None:
            lock.release()


def _check_piper(
    spec: RobotSpec, settings: PiperArmSettings, link: PiperLink, reports: _PiperReports, duration: float
) -> Iterator[CheckResult]:
    link.send(LimitQuery(motor).frame() for motor in range(1, JOINTS + 1))
    link.send([FirmwareQuery().frame(), ParameterQuery().frame()])
    link.wait(lambda: len(reports.limits) == JOINTS and find_firmware(reports.firmware) is not None, _ANSWER)
    firmware = find_firmware(reports.firmware)
    if firmware is None:
        yield CheckResult("firmware", "unknown", "the arm does not report its version")
    else:
        yield CheckResult("firmware", "ok", firmware)
    yield _judge_limits(spec, reports.limits)
    assert reports.status is not None
    fault = arm_fault(reports.status, [reports.joints[k].flags for k in range(JOINTS)])
    if fault is not None:
        yield CheckResult("state", "warn", fault.cause, fault.remedy)
    else:
        volts = min(joint.voltage for joint in reports.joints.values())
        hottest = max(joint.motor_temperature for joint in reports.joints.values())
        yield CheckResult("state", "ok", f"no error; at least {volts:.1f} V, the hottest motor has {hottest} deg C")
    yield from _check_piper_gripper(spec, reports)
    bus = link.bus
    assert bus is not None
    bus.reset_statistics()
    before, began = reports.frames, time.monotonic()
    link.wait(lambda: False, duration)
    seconds, figures = time.monotonic() - began, bus.statistics()
    frames = reports.frames - before + figures["unexpected"]
    traffic = _Traffic(seconds, frames, figures["error_frames"], tuple(figures["unexpected_ids"]))
    driven = _PIPER_REPORTS + 3 * spec.rate_hz + (spec.rate_hz if spec.gripper is not None else 0.0)
    yield _judge_load(driven, traffic, _PIPER_REPORTS, settings)


def _judge_limits(spec: RobotSpec, limits: dict[int, JointLimits]) -> CheckResult:
    """Compare the limits that are set in the arm with the rig's."""
    if len(limits) < JOINTS:
        return CheckResult("ranges", "unknown", "the arm does not report the limits of its joints")
    wrong, slow = [], []
    for k in range(JOINTS):
        own = limits[k + 1]
        if own.upper - own.lower < _PLAUSIBLE_RANGE:
            found = f"joint {k + 1} has a range of {own.lower:.3f} to {own.upper:.3f} rad in the arm"
            return CheckResult("ranges", "fail", found, "set the arm's limits to their defaults with the vendor's tool")
        lower, upper = spec.limits.lower[k], spec.limits.upper[k]
        if lower < own.lower - _RANGE_TOLERANCE or upper > own.upper + _RANGE_TOLERANCE:
            wrong.append(f"joint {k + 1}: {own.lower:.3f} to {own.upper:.3f} rad")
        if spec.limits.velocity[k] > own.velocity + 1e-3:
            slow.append(f"joint {k + 1}: {own.velocity:g} rad/s")
    if wrong or slow:
        remedy = "narrow `limits` in the rig, or set the arm's own to their defaults with the vendor's tool"
        return CheckResult("ranges", "fail", f"the arm's own limits are narrower: {'; '.join(wrong + slow)}", remedy)
    return CheckResult("ranges", "ok", "the arm's own limits contain those of the rig")


def _check_piper_gripper(spec: RobotSpec, reports: _PiperReports) -> Iterator[CheckResult]:
    gripper = spec.gripper
    if gripper is None or gripper.driver != spec.driver:
        return
    PiperGripperSettings.of(gripper)
    if reports.gripper is None:
        yield CheckResult("gripper", "fail", "does not report", "check its plug, or set `gripper: {enabled: false}`")
        return
    fault = gripper_fault(reports.gripper)
    stroke = reports.stroke
    if fault is not None:
        yield CheckResult("gripper", "warn", fault.cause, fault.remedy)
    elif stroke is not None and stroke.stroke_mm and 1e-3 * stroke.stroke_mm < gripper.width_max - 1e-6:
        found = f"opens to {stroke.stroke_mm} mm, the rig has {1e3 * gripper.width_max:g}"
        yield CheckResult("gripper", "fail", found, "correct `width_max` of the gripper")
    else:
        yield CheckResult("gripper", "ok", f"reports a width of {1e3 * reports.gripper.width:.1f} mm")
