"""The Damiao motors of one device, an arm or a gripper: their states, registers, faults and links.

The chain sends frames and takes what has come, once per cycle; nothing waits, except :meth:`DamiaoChain.open` and
:meth:`DamiaoChain.lower`. A motor answers every frame with its state, so a motor that is asked in each cycle is known
in each cycle, one cycle late.

Every motor that this program switched on, and that still is on, has to get a command in each cycle: after TIMEOUT
without one it damps, and what it carries sinks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

from hal.errors import ConfigError, ConnectionLost, DeviceNotFound, Fault, HalError, Problem
from hal.lock import DeviceLock

from .bus import CanBus, describe_losses
from .damiao_motor import CHECKED_REGISTERS, HEAT_MARGIN, MILD_FAULTS, ChainMotor, motor_fault, register_problems
from .damiao_protocol import (
    CLEAR_ERROR,
    DISABLE,
    ENABLE,
    REGISTER_ID,
    encode_register_read,
)
from .settings import BusSettings, DamiaoMotorSettings, emulator_remedy, is_emulated

Weight = Callable[[Sequence[float]], Sequence[float]]
"""Function that returns the torques (n,), Nm, that carry a device at joint positions (n,), rad."""

SILENCE = 0.1
"""Silence after which a motor counts as lost, s,"""
_UNANSWERED = 5
"""and the least number of frames in a row that it has not answered: after a pause of this program one tells nothing."""
SWITCHING = 0.03
"""Time in which a motor that was switched on must report it, s."""
_OPENING = 1.5
"""Longest time to read all registers, s,"""
_FIRST_ANSWER = 0.5
"""and until each motor has answered at all."""
_ROUND = 0.01
"""Longest time to wait for the answers of one round of requests, s."""
_LOCK_PATIENCE = 2.0
"""Longest time to wait for another program to release the motors, s."""
_LOWERING = 6.0
"""Longest time that an arm is lowered before it is left to the damping of its motors, s."""
_SINKING = 0.4
"""Speed with which the joints of an arm that is lowered sink, rad/s."""
_LOWERING_PERIOD = 0.004
"""Time between two commands while it sinks, s."""
_AT_REST = 2e-3
"""Largest way of a joint at rest in :data:`_REST`, rad."""
_REST = 0.2
"""s."""


_FOREIGN_RATE = 12.0
"""Answers of a motor that nothing here asked for, 1/s: so many are none of another program's commands, but a bus that
repeats a frame now and then."""
_FOREIGN_LIMIT = 5.0
"""Number of answers beyond those of that rate that count as another program."""
_CALM = 0.05
"""Time without such an answer after which the other program counts as gone, s."""


class DamiaoChain:
    """The motors of one device on a bus: the bus's settings, and those of each motor with its label, such as "joint1".

    Args:
        name: The device's name, for messages.
        where: Key of the motors in the rig, for messages; ``source`` is the rig's file.
        mosfet_limit: Temperature at which their electronics switch off, deg C.
    """

    def __init__(
        self,
        name: str,
        where: str,
        settings: BusSettings,
        motors: Sequence[DamiaoMotorSettings],
        labels: Sequence[str],
        mosfet_limit: float,
        source: str = "",
    ) -> None:
        self.name = name
        self.where = where
        self.source = source
        self.settings = settings.shared
        self.motors = tuple(
            ChainMotor(motor, f"{label} (motor {motor.id})") for motor, label in zip(motors, labels, strict=True)
        )
        self.mosfet_limit = mosfet_limit
        self._mosfet_warning = mosfet_limit - HEAT_MARGIN
        self.lost: ConnectionLost | None = None
        """Why the device counts as lost; None while it answers."""
        self.bus: CanBus | None = None
        self._sent_ids = (REGISTER_ID, *(motor.id for motor in self.motors))
        self._subscribed = False
        self._locks: list[DeviceLock] = []
        self._lowering: Iterator[bool] | None = None
        """Its remaining steps; None before the first."""
        self._contested: ChainMotor | None = None
        """A motor that another program seems to command, or did."""
        self._asked = False
        """Whether frames were sent since the last update."""
        self._t_asked = 0.0
        self._now = 0.0
        self.cycles = self.incomplete = self.losses = 0

    # Opening.

    def open(self) -> None:
        """Open the bus, and check the registers of every motor. Nothing moves, and nothing is switched on.

        Raises:
            ControlTaken: Another program on this computer uses one of the motors.
            DeviceNotFound: There is no such bus, or a motor does not answer; names it.
            ConnectionLost: The interface is down.
            ConfigError: A register differs from what the rig says; names motor and register, all of them.
        """
        self.close()
        try:
            where = "-".join(self.settings.key)
            for motor in self.motors:
                what = f"{self.name}: {motor.label} on {self.settings.channel}"
                for id in (motor.id, motor.settings.reply_id):  # a reply at another motor's id would command that one
                    self._locks.append(DeviceLock(f"can-{where}-{id:#x}", what, _LOCK_PATIENCE))
            bus = CanBus.acquire(self.settings)
            self.bus = bus
            bus.drain()  # frames from before
            bus.subscribe(
                {motor.settings.reply_id: motor.receive for motor in self.motors},
                self._sent_ids,
            )
            self._subscribed = True
            for motor in self.motors:
                motor.registers.clear()
                motor.on, motor.replies, motor.asked, motor.silent, motor.gap, motor.t = False, 0, 0, 0, 0, -1.0
                motor.unasked, motor.acknowledged = 0.0, 0
            self._read_registers(bus)
            problems = [problem for motor in self.motors for problem in self._problems(motor)]
            if problems:
                raise ConfigError(problems)
            for motor in self.motors:
                motor.take_registers()
        except BaseException:
            self.close()
            raise
        self.lost = None
        self._asked = False

    def _read_registers(self, bus: CanBus) -> None:
        """Read the registers and the state of every motor, several at a time."""
        began = time.monotonic()
        while asked := [motor for motor in self.motors if self._ask_unknown(bus, motor)]:
            elapsed = time.monotonic() - began
            silent = [motor for motor in self.motors if not motor.registers]
            if elapsed > _OPENING or (silent and elapsed > _FIRST_ANSWER):
                raise self._not_found(bus, silent or asked)
            expected, until = self._count_answers() + len(asked), time.monotonic() + _ROUND
            while time.monotonic() < until and self._count_answers() < expected:
                if not bus.poll():
                    raise bus.error(self.name)
                time.sleep(2e-4)
        for motor in self.motors:
            motor.decode()
            motor.replies = 0

    def _count_answers(self) -> int:
        """Return the number of registers and states that are known while the chain is opened."""
        return sum(len(motor.registers) + bool(motor.replies) for motor in self.motors)

    def _ask_unknown(self, bus: CanBus, motor: ChainMotor) -> bool:
        """Ask a motor for its next register, then for its state; return whether one of them is not known."""
        if self._ask_register(bus, motor):
            return True
        if not motor.replies:
            bus.send(REGISTER_ID, motor.state_request)
        return not motor.replies

    def _ask_register(self, bus: CanBus, motor: ChainMotor) -> bool:
        """Ask a motor for the next register that is not known; return whether there is one."""
        register = next((rid for rid in CHECKED_REGISTERS if rid not in motor.registers), None)
        if register is None:
            return False
        bus.send(REGISTER_ID, encode_register_read(motor.id, register))
        return True

    def _not_found(self, bus: CanBus, silent: Sequence[ChainMotor]) -> DeviceNotFound:
        s = self.settings
        answer = [str(motor.id) for motor in self.motors if motor not in silent]
        who = f"; motors that answer: {', '.join(answer)}" if answer else "; no motor answers"
        if bus.unexpected_ids:
            found = ", ".join(f"{id:#x}" for id in sorted(bus.unexpected_ids)[:8])
            who += f"; unexpected ids: {found} (`master` is the id that a motor answers with)"
        if is_emulated({"interface": s.interface}):
            remedy = emulator_remedy(self.source)
        elif answer:
            remedy = "check its power, its plugs and its id"
        else:
            remedy = "check power, cable (CAN_H, CAN_L), termination and bit rate"
        missing = ", ".join(motor.label for motor in silent)
        return DeviceNotFound(
            f"{self.name}: {missing} does not answer on {s.interface} {s.channel}{who}; {remedy}", code="motor_missing"
        )

    def _problems(self, motor: ChainMotor) -> Iterator[Problem]:
        for register, message, code in register_problems(motor.settings, motor.registers):
            yield Problem("<rig>", self.where, f"{motor.label}, register {register}: {message}", code)

    def close(self) -> None:
        """Give up the bus and the motors, without any frame. Idempotent."""
        bus, self.bus = self.bus, None
        self._lowering = None
        if bus is not None:
            if self._subscribed:
                bus.unsubscribe((motor.settings.reply_id for motor in self.motors), self._sent_ids)
            bus.release()
        self._subscribed = False
        for motor in self.motors:
            motor.on = False
        while self._locks:
            self._locks.pop().release()

    @property
    def usable(self) -> CanBus:
        """The bus of a chain that answers.

        Raises:
            ConnectionLost: It is not open, or lost.
        """
        if self.lost is not None:
            raise self.lost
        if self.bus is None:
            raise ConnectionLost(f"{self.name} is not open", code="closed")
        return self.bus

    # Every cycle.

    def update(self, now: float) -> None:
        """Take what has come, and update the motors and :attr:`lost`. Never waits, never raises for a lost link."""
        bus = self.bus
        if bus is None:
            self.lost = None
            return
        self._now = now
        if not bus.poll() and not bus.try_reopen():
            for motor in self.motors:
                motor.on = False
                motor.registers.clear()
                motor.replies = motor.asked = motor.gap = 0
            self._count_loss()
            self.lost = bus.error(self.name)
            return
        if self._asked:
            self._asked = False
            self.cycles += 1
            self.incomplete += any(motor.asked and not motor.replies for motor in self.motors)
        silent = [motor for motor in self.motors if self._take_replies(motor)]
        if silent:
            self._count_loss()
            self.lost = self._silence_error(silent)
        elif self.lost is not None:
            self._check_return()

    def _take_replies(self, motor: ChainMotor) -> bool:
        """Take what a motor has answered since the last update; return whether it counts as lost."""
        count, surplus = motor.replies, motor.replies - motor.asked
        motor.replies = motor.asked = 0
        if count:
            motor.decode()
            motor.silent = 0
            motor.t = self._t_asked
            if motor.on and motor.status != 1 and self._now - motor.switched_at > SWITCHING:
                motor.on = False
                if motor.status == 0:
                    motor.registers.clear()  # it was switched off and on again
        if surplus > 0:
            late = min(surplus, motor.gap)
            motor.late += late
            motor.gap = 0
            if surplus > late:
                self._note_unasked(motor, surplus - late)
        elif surplus < 0:
            motor.missing -= surplus
            motor.gap -= surplus
            if not count:
                if not motor.silent:
                    motor.silent_since = self._t_asked
                motor.silent += 1
                if motor.silent >= _UNANSWERED and self._now - motor.silent_since > SILENCE:
                    motor.on = False
                    motor.registers.clear()  # it may come back as another one
                    return True
        return False

    def _note_unasked(self, motor: ChainMotor, count: int) -> None:
        """Count answers that nothing here asked for. Own frames that come back are none: they have other ids."""
        motor.doubled += count
        motor.unasked = max(0.0, motor.unasked - _FOREIGN_RATE * (self._now - motor.t_unasked)) + count
        motor.t_unasked = self._now
        if motor.unasked > _FOREIGN_LIMIT:
            self._contested = motor

    def _count_loss(self) -> None:
        self.losses += self.lost is None

    def _silence_error(self, silent: Sequence[ChainMotor]) -> ConnectionLost:
        names = "all motors" if len(silent) == len(self.motors) > 1 else ", ".join(motor.label for motor in silent)
        fault = Fault(
            "motor_silent",
            f"no answer from {names} on {self.settings.channel} for {1e3 * SILENCE:.0f} ms",
            "check its power and its cable; the arm may sink",
        )
        return ConnectionLost.of(self.name, fault)

    def ask_registers(self) -> bool:
        """Ask motors that were off for their registers, one at a time; return whether some are still missing.

        Raises:
            ConnectionLost: The bus does not work.
        """
        bus = self.bus
        assert bus is not None
        missing = [self._ask_register(bus, motor) for motor in self.motors]
        return any(missing)

    def register_fault(self) -> Fault | None:
        """Return the first register that does not fit the rig; None if those that were read do."""
        problem = next((problem for motor in self.motors for problem in self._problems(motor)), None)
        return None if problem is None else Fault(problem.code, problem.message, "open the rig again")

    def _check_return(self) -> None:
        """Ask motors that answer again for their registers, and end the loss when all fit."""
        try:
            waiting = self.ask_registers() or any(motor.silent for motor in self.motors)
        except ConnectionLost as error:
            self.lost = error
            return
        fault = self.register_fault()
        if fault is not None:
            self.lost = ConnectionLost.of(self.name, fault)
        elif not waiting:
            self.lost = None

    def send(self, motor: ChainMotor, data: bytes) -> None:
        """Send a command to a motor. Raises ConnectionLost."""
        self._send(motor, motor.id, data)

    def ask_state(self, motor: ChainMotor) -> None:
        """Ask a motor for its state, which changes nothing. Raises ConnectionLost."""
        self._send(motor, REGISTER_ID, motor.state_request)

    def _send(self, motor: ChainMotor, id: int, data: bytes) -> None:
        if self.bus is None:
            raise ConnectionLost(f"{self.name} is not open", code="closed")
        motor.asked += 1
        self._asked = True
        self._t_asked = self._now
        self.bus.send(id, data)

    # Faults.

    def fault(self, *, engaged: bool) -> Fault | None:
        """Return the gravest fault of a motor, naming it; None without one.

        A motor that is not ``engaged``, in use, may have lost communication: that is its rest.
        """
        mild: Fault | None = None
        for motor in self.motors:
            if motor.status > 1 or motor.rotor >= motor.rotor_warning or motor.mosfet >= self._mosfet_warning:
                fault = motor_fault(motor, self.mosfet_limit, engaged=engaged)
                if fault is not None and fault.code not in MILD_FAULTS:
                    return fault
                mild = mild or fault
        contested = self._contested
        if contested is not None and self._now - contested.t_unasked > _CALM:
            for motor in self.motors:
                motor.unasked = 0.0
            self._contested = contested = None
        if mild is None and contested is not None:
            cause = f"{contested.label} answers more often than it is asked: another program commands it"
            mild = Fault("other_program", cause, "end the other program, on any computer on this bus")
        return mild

    def acknowledge_errors(self) -> None:
        """Count the errors that motors report as none until they are switched on, which clears them."""
        for motor in self.motors:
            motor.acknowledged = motor.status

    def switch_on(self, motor: ChainMotor, hold: bytes, first: bool) -> None:
        """Switch a motor on and give it its first command at once, so that nothing sags in between.

        Only the ``first`` attempt clears an error. Later ones may meet a motor that is on, whose answers are late: it
        would let go.
        """
        if motor.status > 1 and first:
            self.send(motor, CLEAR_ERROR)
        self.send(motor, ENABLE)
        self.send(motor, hold)
        motor.on, motor.switched_at, motor.acknowledged = True, self._now, 0

    def lower(self, weight: Weight | None = None) -> None:
        """Do all steps of :meth:`lower_further`, and wait in between."""
        while not self.lower_further(weight):
            time.sleep(_LOWERING_PERIOD)

    def lower_further(self, weight: Weight | None = None) -> bool:
        """Let the motors that are on sink to rest, slowly and damped, and switch them off: one step. Never raises.

        A motor's damping alone is too small for an arm's weight. So the part of the weight that would sink faster
        than :data:`_SINKING` is carried, and let go of once everything rests. An arm that does not rest within 6 s is
        left to its motors, which damp after TIMEOUT until they are switched off by hand: it is never dropped.

        Args:
            weight: What the device weighs; None if it weighs nothing.

        Returns:
            Whether this was the last step.
        """
        if self._lowering is None:
            self._lowering = self._lower(weight)
        return next(self._lowering, True)

    def _lower(self, weight: Weight | None) -> Iterator[bool]:
        """Yield False after each step."""
        bus = self.bus
        on = [k for k, motor in enumerate(self.motors) if motor.on]
        if bus is None or not on:
            return
        try:
            if (yield from self._sink(bus, on, weight)):
                for _ in range(2):  # one may be lost
                    for k in on:
                        self.send(self.motors[k], DISABLE)
                    yield False
        except HalError:
            return  # the motors damp by themselves after TIMEOUT

    def _sink(self, bus: CanBus, on: list[int], weight: Weight | None) -> Generator[bool, None, bool]:
        """Let the motors ``on`` sink, and yield False after each step; return whether they rest without help."""
        deadline = time.monotonic() + _LOWERING
        at, since, carried = self._positions(), time.monotonic(), True
        heard: set[int] = set()  # since then: a motor that does not answer is not known to rest
        while (now := time.monotonic()) < deadline:
            q = self._positions()
            if any(abs(q[k] - at[k]) > _AT_REST for k in on):
                at, since, carried, heard = q, now, True, set()
            elif now - since > _REST and heard.issuperset(on):
                if not carried or weight is None:
                    return True
                since, carried, heard = now, False, set()
            tau = weight(q) if weight is not None and carried else (0.0,) * len(q)
            for k in on:
                motor = self.motors[k]
                free = _SINKING * motor.kd
                held = tau[k] - min(max(tau[k], -free), free)
                self.send(motor, motor.command(motor.q, 0.0, 0.0, motor.kd, held))
            yield False
            if not bus.poll():
                return False
            for k, motor in enumerate(self.motors):
                if motor.replies:
                    motor.decode()
                    motor.replies = 0
                    heard.add(k)
        return False

    def _positions(self) -> list[float]:
        return [motor.q for motor in self.motors]

    # Statistics.

    def reset_statistics(self) -> None:
        self.cycles = self.incomplete = self.losses = 0
        for motor in self.motors:
            motor.reset_statistics()
        if self.bus is not None:
            self.bus.reset_statistics()

    def statistics(self) -> dict[str, Any]:
        """Return counters and temperatures.

        ``incomplete`` counts cycles without the reply of every motor, ``missing`` the replies, of which ``late`` came
        afterwards; ``doubled`` replies came twice; ``unexpected`` frames have an id that no device on the bus has.
        """
        motors = self.motors
        lost = sum(motor.missing - motor.late for motor in motors)
        return {
            "warnings": describe_losses(self.name, self.settings.channel, lost, self.cycles * len(motors)),
            "cycles": self.cycles,
            "incomplete": self.incomplete,
            "missing": sum(motor.missing for motor in motors),
            "late": sum(motor.late for motor in motors),
            "doubled": sum(motor.doubled for motor in motors),
            "foreign": sum(motor.foreign for motor in motors),
            "losses": self.losses,
            "rotor_deg_c": [motor.rotor for motor in motors],
            "mosfet_deg_c": [motor.mosfet for motor in motors],
            "bus": self.bus.statistics() if self.bus is not None else {},
        }
