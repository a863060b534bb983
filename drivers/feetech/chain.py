"""The motors of one device on a servo bus, an arm or a gripper: what they are, how they are, and what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, pi
from typing import NamedTuple

from hal.errors import ConfigError, ConnectionLost, DeviceNotFound, Fault, Problem, RobotFault

from .bus import PING, MotorState, ServoBus, signed
from .settings import Calibration, FeetechSettings

COUNT = 2.0 * pi / 4096
"""rad"""
MODEL = 777
"""Number of an STS3215."""
STALL_TORQUES = {12.0: 2.94, 7.4: 1.91}
"""Stall torque by the nominal voltage, Nm: 30 and 19.5 kg cm, by Feetech's data sheets of the STS3215."""
STIFFNESS = 28.0 / 32.0
"""Torque for each rad off the goal, Nm/rad, for each unit of the gain P: about 25 counts under 1.5 kg at 0.1 m and 45
degrees with the gain as delivered, 32 (issue 134 of TheRobotStudio/SO-ARM100)."""
SILENCE = 0.1
"""Silence after which a motor counts as lost, s."""
OUTSIDE = 0.05
"""How far a joint may be outside of its calibrated range, rad, and still be driven: it may rest on its stop."""
ACCELERATION, SPEED = 254, 4000
"""Of the motors' own profile, 100 counts/s2 and counts/s: more than a motor reaches, so that it makes no profile."""
_TWIN = 0.003
"""Time to wait for the answer of a second motor with the same id, s."""
_SCAN = 20
"""Highest id that is tried where one is missing."""
_IDENTIFY_PERIOD = 0.5
"""s between two checks of the motors of a port that came back."""
_SPANS = 0.6, 1.3
"""Calibrated range of a joint as a share of the model's: outside of it the motor is not calibrated, or another one."""
ERRORS = {
    1: (
        "voltage",
        "has a supply of {0.voltage:.1f} V",
        "check the supply: 12 V for a 12 V motor, 5 to 7.4 V for others",
    ),
    2: (
        "sensor",
        "has a faulty angle sensor",
        "switch the power off and on, with the arm supported; replace the motor",
    ),
    4: ("too_hot", "has {0.temperature} deg C", "let it cool down; lower its load or its speed"),
    8: ("overcurrent", "draws too much current", "check what the arm touches, and its load"),
    32: ("overload", "is overloaded, and has reduced its torque", "check what the arm touches, and its load"),
}
"""Bit of a motor's errors -> code, what is wrong, remedy."""


class Registers(NamedTuple):
    """What a motor has stored, as far as it matters."""

    model: int
    return_delay: int
    """2 us"""
    calibration: Calibration
    voltage_max: float
    """V"""
    torque_max: int
    """1/1000"""
    multi_turn: bool
    gain: int
    mode: int

    @property
    def stall_torque(self) -> float:
        """Torque at which it stalls, Nm: its greatest voltage tells the two kinds apart."""
        return STALL_TORQUES[12.0 if self.voltage_max > 10.0 else 7.4]


def decode_registers(data: bytes) -> Registers:
    """Return what is in the registers 0 to 39."""

    def word(address: int) -> int:
        return data[address] | data[address + 1] << 8

    calibration = Calibration(signed(word(31), 11), word(9), word(11))
    multi_turn = bool(data[18] & 0x10)
    return Registers(word(3), data[7], calibration, data[14] / 10, word(16), multi_turn, data[21], data[33])


class Chain:
    """The motors of a device.

    Args:
        name: The device's name, for messages.
        settings: The bus, and LeRobot's file.
        ids: Ids of the motors.
        labels: The motors in words.
        spans: Range of each joint in the model, rad.

    Attributes:
        registers: What each motor has stored.
    """

    def __init__(
        self, name: str, settings: FeetechSettings, ids: Sequence[int], labels: Sequence[str], spans: Sequence[float]
    ) -> None:
        self.name, self.settings, self.ids = name, settings, tuple(ids)
        self.labels = {id: f"{label} (motor {id})" for id, label in zip(ids, labels, strict=True)}
        self._spans = dict(zip(ids, spans, strict=True))
        self.bus: ServoBus | None = None
        self.registers: list[Registers] = []
        self.lost: ConnectionLost | None = None
        self._opened, self._t_identified = 0, -inf
        self._t_heard: dict[int, float] = {}

    def open(self) -> None:
        """Open the bus, and check every motor. Nothing moves, and nothing is written.

        Raises:
            ControlTaken: Another program uses the bus.
            ConnectionLost: The port does not work.
            DeviceNotFound: A motor does not answer, or two have the same id.
            ConfigError: A motor is of another kind, or calibrated otherwise; names all that is wrong.
        """
        self.close()
        self.bus = ServoBus.acquire(self.settings.port)
        try:
            self._identify(self.bus)
        except BaseException:
            self.close()
            raise
        self.bus.ids += self.ids
        self._t_heard, self.lost = {}, None

    def close(self) -> None:
        """Give up the bus, without any frame: the motors keep their goals. Idempotent."""
        bus, self.bus = self.bus, None
        if bus is not None:
            bus.release(self.ids)

    def _identify(self, bus: ServoBus) -> None:
        missing = [id for id in self.ids if not self._ping(bus, id)]
        if missing:
            text = f"{self.name}: no answer from {', '.join(self.labels[id] for id in missing)} on {bus.port}"
            hint = self._explain_missing(bus, missing) if self.lost is None else ""
            raise DeviceNotFound(text + hint, code="motor_missing")
        blocks = [bus.read(id, 0, 40) for id in self.ids]
        unread = [self.labels[id] for id, block in zip(self.ids, blocks, strict=True) if block is None]
        if unread:
            raise DeviceNotFound(f"{self.name}: {', '.join(unread)} answers no question; check its cable")
        self.registers = [decode_registers(block) for block in blocks if block is not None]
        problems = [
            Problem("<rig>", f"{self.name}.real", f"{self.labels[id]}: {message}", code)
            for id, registers in zip(self.ids, self.registers, strict=True)
            for message, code in self._check_registers(id, registers)
        ]
        if problems:
            raise ConfigError(problems)
        self._opened = bus.opened

    def _ping(self, bus: ServoBus, id: int) -> bool:
        """Return whether a motor answers. Raises DeviceNotFound if two do."""
        surplus, spoilt = bus.surplus, bus.spoilt
        for _ in range(3):
            if bus.ask(id, PING, b"", (id,), linger=_TWIN) and (bus.surplus, bus.spoilt) == (surplus, spoilt):
                return True
            if bus.surplus + bus.spoilt >= surplus + spoilt + 3:
                raise DeviceNotFound(
                    f"{self.name}: two motors have the id {id}; connect one at a time, and give each its own: "
                    "lerobot-setup-motors",
                    code="id_twice",
                )
        return bool(bus.ask(id, PING, b"", (id,)))

    def _explain_missing(self, bus: ServoBus, missing: Sequence[int]) -> str:
        """Return why motors may be missing, and what to do about it."""
        if len(missing) < len(self.ids):
            others = [str(id) for id in range(_SCAN + 1) if id not in self.labels and bus.ask(id, PING, b"", (id,))]
            found = f"; these ids answer, too: {', '.join(others)}" if others else ""
            return f"{found}; check its plugs and its id (lerobot-setup-motors)"
        baud = bus.find_baud(missing[0])
        if baud is not None:
            return f" at 1000000 bit/s, but at {baud}; set it with lerobot-setup-motors"
        if bus.port.endswith(".emulated"):
            return "; start the emulator in another terminal: hal emulate feetech --config RIG"
        return "; switch on the motors' power supply, and check the cable between board and arm"

    def _check_registers(self, id: int, found: Registers) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with a motor: message and code."""
        if found.model != MODEL:
            yield f"is of the model {found.model}, not an STS3215 ({MODEL})", "wrong_model"
            return
        if found.mode != 0 or found.multi_turn:
            yield "is not set to positions within one turn; calibrate it: lerobot-calibrate", "wrong_mode"
        stored = found.calibration
        span = (stored.range_max - stored.range_min) * COUNT
        least, most = (share * self._spans[id] for share in _SPANS)
        if not least <= span <= most:
            message = (
                f"its range is {span:.2f} rad, {self._spans[id]:.2f} in the model; calibrate it: lerobot-calibrate"
            )
            yield message, "not_calibrated"
        wanted = self.settings.read_calibration().get(id, stored)
        for name, ours, theirs in zip(Calibration._fields, wanted, stored, strict=True):
            if ours != theirs:
                message = f"{name} is {theirs}, and {ours} in {self.settings.calibration}; another arm, or lerobot-"
                yield f"{message}calibrate writes the file into the motors", "calibration_differs"

    def read(self, now: float) -> list[MotorState]:
        """Return the newest states, after asking for them where that is due.

        Raises:
            ConnectionLost: The port does not work, or a motor is silent.
        """
        bus = self.bus
        if bus is None:
            raise ConnectionLost(f"{self.name} is not open", code="not_open")
        try:
            for _ in range(4):  # of motors that are new, also where an answer is lost
                bus.exchange(self, now)
                if all(id in bus.states for id in self.ids):
                    break
            if self._opened != bus.opened:
                self._identify_again(bus, now)
        except ConnectionLost as error:
            self.lost = ConnectionLost.of(self.name, error.fault) if error.fault is not None else error
            raise self.lost from None
        except (DeviceNotFound, ConfigError) as error:
            self.lost = ConnectionLost.of(self.name, Fault(error.code, str(error), "open the rig again"))
            raise self.lost from None
        states = bus.states
        for id in self.ids:
            heard = states[id].t if id in states else -inf
            self._t_heard[id] = max(heard, self._t_heard.get(id, now))
        silent = [self.labels[id] for id in self.ids if now - self._t_heard[id] > SILENCE or id not in states]
        if silent:
            self.lost = self._silence(bus, silent)
            raise self.lost
        self.lost = None
        return [states[id] for id in self.ids]

    def _identify_again(self, bus: ServoBus, now: float) -> None:
        """Check the motors of a port that was plugged in again, now and then: it may be another arm."""
        if self.lost is not None and now - self._t_identified < _IDENTIFY_PERIOD:
            raise self.lost
        self._t_identified = now
        before = self.registers
        self._identify(bus)
        if self.registers != before:
            self.registers, self._opened = before, 0
            raise DeviceNotFound(f"{self.name}: other motors, or calibrated otherwise than before", code="other_motors")
        self._t_heard.clear()

    def _silence(self, bus: ServoBus, silent: Sequence[str]) -> ConnectionLost:
        names = "all motors" if len(silent) == len(self.ids) > 1 else ", ".join(silent)
        remedy = "check the motors' power supply and their plugs; a joint without power falls"
        if bus.surplus > bus.lost // 2:
            remedy = f"answers come late ({bus.surplus} so far): connect the adapter directly, end busy programs"
        fault = Fault("motor_silent", f"no answer from {names} for {1e3 * SILENCE:.0f} ms", remedy)
        return ConnectionLost.of(self.name, fault)

    def check(self) -> ServoBus:
        """Return the bus of a device that answers. Raises ConnectionLost."""
        if self.lost is not None:
            raise self.lost
        if self.bus is None:
            raise ConnectionLost(f"{self.name} is not open", code="not_open")
        return self.bus

    def write(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write registers of its motors at once. Raises ConnectionLost, also while the device counts as lost."""
        self.check().write(address, values)

    def write_goals(self, goals: Sequence[int]) -> None:
        """Send the motors' goals, counts."""
        self.write(42, {id: goal.to_bytes(2, "little") for id, goal in zip(self.ids, goals, strict=True)})

    def prepare(self, goals: Sequence[int], limits: Sequence[int]) -> None:
        """Give motors that are off their goals, counts, and torque limits, 1/1000, and take away their profile."""
        values = {}
        for id, goal, limit in zip(self.ids, goals, limits, strict=True):
            words = (goal, 0, SPEED, limit)
            values[id] = bytes((ACCELERATION,)) + b"".join(word.to_bytes(2, "little") for word in words)
        self.write(41, values)

    def switch_on(self) -> None:
        """Switch the torque of all motors on, which also ends an overload."""
        self.write(40, dict.fromkeys(self.ids, b"\x01"))

    def fault(self, states: Sequence[MotorState]) -> Fault | None:
        """Return the most telling of the motors' errors; None if there is none."""
        for bit, (code, what, remedy) in ERRORS.items():
            for id, state in zip(self.ids, states, strict=True):
                if state.error & bit:
                    shown = state._replace(voltage=state.voltage / 10)  # type: ignore[arg-type]
                    return Fault(code, f"{self.labels[id]} {what.format(shown)}", remedy)
        return None

    def clear(self, wait: Callable[[], Sequence[MotorState]]) -> None:
        """End overloads by writing the torque of their motors again, on or off, and check that nothing else is wrong.

        Args:
            wait: Returns the states one cycle later.

        Raises:
            RobotFault: An error stays.
        """
        states = wait()
        hold = {id: bytes((state.on,)) for id, state in zip(self.ids, states, strict=True) if state.error & 0x28}
        if hold:
            here = {id: state.position for id, state in zip(self.ids, states, strict=True) if id in hold}
            self.write(42, {id: max(0, count).to_bytes(2, "little") for id, count in here.items()})
            self.write(40, hold)
            states = wait()
        fault = self.fault(states)
        if fault is not None:
            raise RobotFault(f"{self.name}: {fault.cause}", fault.remedy, code=fault.code)
