"""The joints of one device on a servo bus, an arm or a gripper: what their motors are, how they are, what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import inf
from time import monotonic
from typing import NamedTuple

from hal.errors import ConfigError, ConnectionLost, DeviceNotFound, Fault, Problem, RobotFault

from .bus import ServoBus, find_latency
from .protocol import COUNT, PING, TURN, Calibration, MotorState, Registers, ServoProtocol
from .settings import ServoSettings

SILENCE = 0.1
"""Silence after which a motor counts as lost, s."""
OUTSIDE = 0.05
"""How far a joint may be outside of its calibrated range, rad, and still be driven: it may rest on its stop."""
_TWIST = 0.1
"""How far two motors of a joint may be apart, rad: further, they work against each other. Chosen."""
_PING = 0.06
"""Longest time to wait for its first answer, s: a late one must not look like that of a second motor."""
_TWIN = 0.003
"""Time to wait for the answer of a second motor with the same id, s."""
_SCAN = 20
"""Highest id that is tried where one is missing."""
_IDENTIFY_PERIOD = 0.5
"""s between two checks of the motors of a port that came back."""
SPANS = 0.6, 1.3
"""Calibrated range of a joint as a share of the model's: outside of it the motor is not calibrated, or another one."""


class Joint(NamedTuple):
    """A joint, and the motors that turn it together."""

    label: str
    ids: tuple[int, ...]
    span: float
    """Its range in the model, rad; 0 if the motor's is not compared."""


class Chain:
    """The joints of a device. What it returns and takes for them is that of their first motors.

    Args:
        name: The device's name, for messages.
        protocol: Of its motors.
        settings: The bus, and LeRobot's file.
        joints: The joints.
        watch: Whether its motors shall stop when they hear nothing, where they can.

    Attributes:
        registers: What the first motor of each joint has stored.
        stored: What each motor has stored, by id.
        labels: The joints in words.
        motors: The motors in words, by id.
    """

    def __init__(
        self, name: str, protocol: ServoProtocol, settings: ServoSettings, joints: Sequence[Joint], watch: bool
    ) -> None:
        self.name, self.protocol, self.settings, self.joints, self._watch = name, protocol, settings, joints, watch
        self._watched = False
        """Whether the motors stop when they hear nothing."""
        self.motors = {id: f"{joint.label} (motor {id})" for joint in joints for id in joint.ids}
        self.labels = [
            f"{joint.label} (motor{'s' * (len(joint.ids) > 1)} {', '.join(map(str, joint.ids))})" for joint in joints
        ]
        self.ids = tuple(self.motors)
        self.bus: ServoBus | None = None
        self.stored: dict[int, Registers] = {}
        self.lost: ConnectionLost | None = None
        self._opened, self._t_identified = 0, -inf
        self._t_heard: dict[int, float] = {}
        self._turns: dict[int, int] = {}
        """Turns that each motor counts too many, of those that keep them."""

    @property
    def registers(self) -> list[Registers]:
        return [self.stored[joint.ids[0]] for joint in self.joints]

    def open(self) -> None:
        """Open the bus, and check every motor. Nothing moves, and nothing is written.

        Raises:
            ControlTaken: Another program uses the bus.
            ConnectionLost: The port does not work.
            DeviceNotFound: A motor does not answer, or two have the same id.
            ConfigError: A motor is of another kind, or calibrated otherwise; names all that is wrong.
        """
        self.close()
        self.bus = ServoBus.acquire(self.settings.port, self.protocol, self.settings.baud)
        try:
            self._identify(self.bus)
        except BaseException:
            self.close()
            raise
        self.bus.ids += self.ids
        self._t_heard, self._turns, self.lost = {}, {}, None

    def close(self) -> None:
        """Give up the bus: the motors keep their goals, and need no frames any more. Idempotent."""
        bus, self.bus = self.bus, None
        if bus is not None:
            if self._watched and self.protocol.watchdog is not None:
                with suppress(ConnectionLost):
                    bus.write(self.protocol.watchdog, dict.fromkeys(self.ids, b"\0"))
            bus.release(self.ids)
        self._watched = False

    def _identify(self, bus: ServoBus) -> None:
        missing = [id for id in self.ids if not self._ping(bus, id)]
        if missing:
            text = f"{self.name}: no answer from {', '.join(self.motors[id] for id in missing)} on {bus.port}"
            hint = self._explain_missing(bus, missing) if self.lost is None else ""
            raise DeviceNotFound(text + hint, code="motor_missing")
        blocks = {id: bus.read(id, *self.protocol.stored) for id in self.ids}
        unread = [self.motors[id] for id, block in blocks.items() if block is None]
        if unread:
            raise DeviceNotFound(f"{self.name}: {', '.join(unread)} answers no question; check its cable")
        self.stored = {id: self.protocol.decode_registers(block) for id, block in blocks.items() if block is not None}
        problems = [
            Problem("<rig>", f"{self.name}.real", f"{self.motors[id]}: {message}", code)
            for joint in self.joints
            for id in joint.ids
            for message, code in self._check_registers(id, joint, self.stored[id])
        ]
        if problems:
            raise ConfigError(problems)
        self._opened = bus.opened

    def _ping(self, bus: ServoBus, id: int) -> bool:
        """Return whether a motor answers. Raises DeviceNotFound if two do."""
        surplus, spoilt = bus.surplus, bus.spoilt
        for _ in range(3):
            if bus.ask(id, PING, b"", (id,), _PING, _TWIN) and (bus.surplus, bus.spoilt) == (surplus, spoilt):
                return True
            if bus.surplus + bus.spoilt >= surplus + spoilt + 3:
                raise DeviceNotFound(
                    f"{self.name}: two motors have the id {id}; connect one at a time, and give each its own: "
                    "hal setup-motors",
                    code="id_twice",
                )
        return bool(bus.ask(id, PING, b"", (id,)))

    def _explain_missing(self, bus: ServoBus, missing: Sequence[int]) -> str:
        """Return why motors may be missing, and what to do about it."""
        if len(missing) < len(self.ids):
            others = [str(id) for id in range(_SCAN + 1) if id not in self.motors and bus.ask(id, PING, b"", (id,))]
            found = f"; these ids answer, too: {', '.join(others)}" if others else ""
            return f"{found}; check its plugs and its id (hal setup-motors)"
        baud = bus.find_baud(missing[0])
        if baud is not None:
            return f" at {bus.baud} bit/s, but at {baud}; set it with hal setup-motors"
        if bus.port.endswith(".emulated"):
            return "; start the emulator in another terminal: hal emulate --config RIG"
        return "; switch on the motors' power supply, and check the cable between board and arm"

    def _check_registers(self, id: int, joint: Joint, found: Registers) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with a motor: message and code."""
        if not found.model:
            kind = f"not one of the {self.protocol.name} motors that are known here"
            yield f"is of the model {found.number}, {kind}", "wrong_model"
            return
        if found.wrong:
            yield found.wrong, "wrong_mode"
        if found.follows in self.ids and found.follows != joint.ids[0]:
            yield f"follows the motor {found.follows}, too: its secondary id; set it to 255", "wrong_mode"
        stored = found.calibration
        span = (stored.range_max - stored.range_min) * COUNT
        least, most = (share * joint.span for share in SPANS)
        if joint.span and not least <= span <= most:
            message = f"its range is {span:.2f} rad, {joint.span:.2f} in the model; calibrate it: hal calibrate arm"
            yield message, "not_calibrated"
        wanted = self.settings.read_calibration().get(id, stored)
        for name, ours, theirs in zip(Calibration._fields, wanted, stored, strict=True):
            if ours != theirs:
                message = f"{name} is {theirs}, and {ours} in {self.settings.calibration}; another arm, or hal "
                yield f"{message}calibrate arm --restore writes the file into the motors", "calibration_differs"

    def read(self, now: float) -> list[MotorState]:
        """Return the newest states of the joints, after asking for them where that is due.

        Raises:
            ConnectionLost: The port does not work, or a motor is silent.
        """
        bus = self.bus
        if bus is None:
            raise ConnectionLost(f"{self.name} is not open", code="not_open")
        try:
            for _ in range(8):  # of motors that are new, also where an answer is lost
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
        silent = [self.motors[id] for id in self.ids if now - self._t_heard[id] > SILENCE or id not in states]
        if silent:
            self.lost = self._silence(bus, silent)
            raise self.lost
        self.lost = None
        found = {id: self._count_turns(states[id], self.stored[id], id) for id in self.ids}
        return [_merge([found[id] for id in joint.ids]) for joint in self.joints]

    def _count_turns(self, state: MotorState, stored: Registers, id: int) -> MotorState:
        """Return a state within the calibrated range: what a motor counts as turns is lost with its power.

        A motor of one turn forgets them by itself when its torque is switched on. The others keep them: the turn that
        is nearest to the middle of the range is chosen while the torque is off.
        """
        if stored.turns == 1 and not state.on:
            return state._replace(position=state.position % TURN)
        if stored.turns < 2:
            return state
        if not state.on or id not in self._turns:
            middle = 0.5 * (stored.calibration.range_min + stored.calibration.range_max)
            self._turns[id] = round((state.position - middle) / TURN)
        more = TURN * self._turns[id]
        return state._replace(position=state.position - more, goal=state.goal - more)

    def _identify_again(self, bus: ServoBus, now: float) -> None:
        """Check the motors of a port that was plugged in again, now and then: it may be another arm."""
        if self.lost is not None and now - self._t_identified < _IDENTIFY_PERIOD:
            raise self.lost
        self._t_identified = now
        before = self.stored
        self._identify(bus)
        if self.stored != before:
            self.stored, self._opened = before, 0
            raise DeviceNotFound(f"{self.name}: other motors, or calibrated otherwise than before", code="other_motors")
        self._t_heard.clear()

    def _silence(self, bus: ServoBus, silent: Sequence[str]) -> ConnectionLost:
        names = "all motors" if len(silent) == len(self.ids) > 1 else ", ".join(silent)
        remedy = "check the motors' power supply and their plugs; a joint without power falls"
        if bus.surplus > bus.lost // 2:
            late, remedy = find_latency(bus.port)
            hint = remedy if late > 1 else "connect the adapter directly, end busy programs"
            remedy = f"answers come late ({bus.surplus} so far): {hint}"
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

    def _spread(self, values: Sequence[int]) -> dict[int, int]:
        """Return values of the joints, or of the first ones, for each of their motors."""
        return {id: value for joint, value in zip(self.joints, values, strict=False) for id in joint.ids}

    def _count_goals(self, goals: Sequence[int]) -> dict[int, int]:
        """Return goals as the motors count them."""
        return {id: goal + TURN * self._turns.get(id, 0) for id, goal in self._spread(goals).items()}

    def write_goals(self, goals: Sequence[int]) -> None:
        """Send the goals of the joints, or of the first ones, counts."""
        address, size = self.protocol.goal
        values = {id: goal.to_bytes(size, "little", signed=True) for id, goal in self._count_goals(goals).items()}
        self.write(address, values)

    def prepare(self, goals: Sequence[int], limits: Sequence[int]) -> None:
        """Give motors that are off their goals, counts, and torque limits, and take away their profile.

        Those of all joints, or of the first ones.
        """
        counts, spread = self._count_goals(goals), self._spread(limits)
        for address, values in self.protocol.prepare([*counts], [*counts.values()], [*spread.values()], self._watch):
            self.write(address, values)
        self._watched = self._watch

    def switch(self, on: bool, joints: int | None = None) -> None:
        """Switch the torque of all joints, or of the first ones; on also ends an overload of a Feetech motor."""
        ids = self._spread([on] * (len(self.joints) if joints is None else joints))
        self.write(self.protocol.torque, dict.fromkeys(ids, bytes((on,))))

    def fault(self, states: Sequence[MotorState]) -> Fault | None:
        """Return the most telling of the motors' errors; None if there is none."""
        for bit, (code, what, remedy) in self.protocol.errors.items():
            for label, state in zip(self.labels, states, strict=True):
                if state.error & bit:
                    return Fault(code, f"{label} {what.format(state)}", remedy)
        for label, state in zip(self.labels, states, strict=True):
            if state.twist * COUNT > _TWIST:
                cause = f"{label} are {state.twist * COUNT:.2f} rad apart, and would work against each other"
                return Fault("twisted", cause, "check their horns; calibrate them: hal calibrate arm")
        return None

    def find_outside(self, states: Sequence[MotorState]) -> Fault | None:
        """Return a fault that names the joints so far outside of their ranges that a motor would pull them in.

        The same for one that is at both ends of a range of a whole turn, so that its motor may be off by one.
        """
        found = []
        for label, state, registers in zip(self.labels, states, self.registers, strict=True):
            low, high = registers.calibration[2:]
            beyond = max(low - state.position, state.position - high) * COUNT
            other = min(abs(state.position - end) for end in (high - TURN, low + TURN)) * COUNT
            if beyond > OUTSIDE:
                found.append(f"{label} is {beyond:.2f} rad outside of its calibrated range")
            elif registers.turns == 2 and not state.on and TURN - (high - low) < TURN / 8 and other < OUTSIDE:
                found.append(f"{label} may be at either end of its range of a whole turn")
        if not found:
            return None
        return Fault("out_of_range", "; ".join(found), "move it inside by hand, or calibrate it: hal calibrate arm")

    def clear(self, wait: Callable[[], Sequence[MotorState]]) -> None:
        """End the errors that a motor keeps; ``wait`` returns the states one cycle later.

        Raises:
            RobotFault: An error stays.
            ConnectionLost: The port does not work, or a motor is silent.
        """
        states, bus = wait(), self.check()
        each = {id: state for joint, state in zip(self.joints, states, strict=True) for id in joint.ids}
        for id, instruction, data in self.protocol.clear(each):
            bus.ask(id, instruction, data, (id,))
        end = monotonic() + self.protocol.restart
        while (fault := self.fault(states)) is not None and monotonic() < end:
            states = wait()
        if fault is not None:
            raise RobotFault(f"{self.name}: {fault.cause}", fault.remedy, code=fault.code)


def _merge(states: Sequence[MotorState]) -> MotorState:
    """Return the state of a joint from that of its motors: what is wrong with one is wrong with it."""
    first = states[0]
    if len(states) == 1:
        return first
    error = 0
    for state in states:
        error |= state.error
    return first._replace(
        t=min(state.t for state in states),
        error=error,
        on=all(state.on for state in states),
        stopped=any(state.stopped for state in states),
        temperature=max(state.temperature for state in states),
        twist=max(abs(state.position - first.position) for state in states),
    )
