"""Pre-flight check of an arm on a servo bus: its motors, their calibration, supply and temperature, and lost answers.

Nothing moves, and nothing is written.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from time import monotonic, sleep

from hal import registry
from hal.errors import ConfigError, ConnectionLost, DeviceNotFound
from hal.preflight import CheckResult
from hal.specs import RobotSpec

from .arm import ServoArm
from .bus import find_latency
from .chain import Chain
from .gripper import ServoGripper
from .protocol import MotorState

_HOT = 55
"""Temperature from which a check warns, deg C: the motors' own limit is 70 as delivered."""
_WEAK = 0.8
"""Share of the nominal voltage below which a check warns: 12 V motors on a supply for 7.4 V."""
_LOST = 0.01
"""Share of lost answers from which a check warns."""
_OFF = 0.1
"""Difference between an end of a calibrated range and the model's from which a check warns, rad."""


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    """Check one arm, and its gripper on the same bus; measure the answers for ``duration`` s."""
    arm: ServoArm = registry.load(spec.driver, "robot")(spec)
    devices: list[ServoArm | ServoGripper] = [arm]
    if spec.gripper is not None and spec.gripper.driver == spec.driver:
        devices.append(registry.load(spec.driver, "gripper")(spec.gripper))
    try:
        for device in devices:
            device.open()
            states = device.chain.read(monotonic())
            yield from _check_motors(device.chain, states)
        late, remedy = find_latency(arm.settings.port)
        if late > 1:
            yield CheckResult("adapter", "warn", f"it collects answers for {late} ms", remedy)
        yield from _check_ranges(arm)
        yield _check_answers(arm, max(duration, 0.2))
    except (ConfigError, ConnectionLost, DeviceNotFound) as error:
        for text in [one.message for one in error.problems] if isinstance(error, ConfigError) else [str(error)]:
            found, _, remedy = text.partition("; ")
            yield CheckResult("motors", "fail", found, remedy)
    finally:
        for device in devices:
            device.close()


def _check_motors(chain: Chain, states: Sequence[MotorState]) -> Iterator[CheckResult]:
    lowest, hottest = min(s.voltage for s in states), max(s.temperature for s in states)
    kinds = Counter((r.model, r.nominal) for r in chain.stored.values())
    kind = ", ".join(f"{count} {model} for {nominal:g} V" for (model, nominal), count in kinds.items())
    found = f"{chain.name}: {kind}; {lowest:.1f} V, {hottest} deg C"
    fault = chain.fault(states)
    weak = [r.nominal for r, s in zip(chain.registers, states, strict=True) if s.voltage < _WEAK * r.nominal]
    remedy = "let them cool down" if hottest >= _HOT else ""
    if weak and weak[0] > 10.0:
        remedy = f"a supply of {weak[0]:g} V: with less, the motors are weaker than the model"
    if fault is not None:
        yield CheckResult("motors", "fail", fault.cause, fault.remedy)
    else:
        yield CheckResult("motors", "warn" if remedy else "ok", found, remedy)
    slow = [chain.motors[id] for id, r in chain.stored.items() if r.return_delay]
    if slow:
        remedy = "set the return delay to 0: hal calibrate arm does"
        yield CheckResult("return delay", "warn", f"{', '.join(slow)} answers late by its return delay", remedy)


def _check_ranges(arm: ServoArm) -> Iterator[CheckResult]:
    """Compare the ends of the calibrated ranges with the model's limits."""
    limits, far = arm.spec.limits, []
    for k, (label, (lower, upper)) in enumerate(zip(arm.chain.labels, arm.find_ranges(), strict=True)):
        if lower > limits.lower[k] + _OFF or upper < limits.upper[k] - _OFF:
            model = f"{limits.lower[k]:.2f} to {limits.upper[k]:.2f} rad"
            far.append(f"{label} reaches {lower:.2f} to {upper:.2f} rad, {model} in the model")
    fault = arm.chain.find_outside(arm.chain.read(monotonic()))
    if fault is not None:
        yield CheckResult("range", "fail", fault.cause, fault.remedy)
    elif far:
        yield CheckResult("range", "warn", "; ".join(far), "calibrate it through its whole range: hal calibrate arm")
    else:
        yield CheckResult("range", "ok", "every joint is inside its calibrated range, which has the model's limits")


def _check_answers(arm: ServoArm, duration: float) -> CheckResult:
    """Read the arm at its rate, and count lost answers."""
    bus, dt = arm.chain.check(), 1.0 / arm.spec.rate_hz
    bus.reset_statistics()
    end, longest = monotonic() + duration, 0.0
    while (began := monotonic()) < end:
        arm.read(began)
        longest = max(longest, monotonic() - began)
        sleep(max(0.0, began + dt - monotonic()))
    asked = bus.cycles * len(bus.ids)
    found = f"{bus.lost} of {asked} answers lost, longest reading {1e3 * longest:.1f} ms"
    if bus.lost <= _LOST * asked and not bus.spoilt:
        return CheckResult("answers", "ok", found)
    remedy = "check the cables between board and motors; connect the adapter directly, without a hub"
    return CheckResult("answers", "warn", f"{found}, {bus.spoilt} spoilt, {bus.surplus} too late or twice", remedy)
