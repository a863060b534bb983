"""Driver of the xArm Gripper, on the RS-485 line at the arm's flange. Tested against an emulator, not a real one.

The SDK's calls wait for the gripper's answer, which comes through the control box. So it has a process, and a
connection, of its own. Nothing here changes the arm: neither its errors nor the speed of its line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import inf
from time import monotonic
from typing import Any

from hal.driver import GripperDriver, GripperReading
from hal.errors import ConnectionLost, Fault
from hal.preflight import CheckResult
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .faults import NO_CONTROLLER, NO_GRIPPER, gripper_fault
from .link import connect, probe
from .settings import XArmGripperSettings

_OPEN, _BEYOND = 850, -10
"""Position when open; 0 is closed. A position at which closed fingers press: the least that UFACTORY Studio offers."""
_TOP = 5000
"""Greatest speed of its motor, r/min: that of the model's ``speed``, which is an assumption."""
_BAUD = 2_000_000
"""Of the line at the flange, as the gripper is delivered."""
_NEAR = 5
"""Distance from its goal at which it counts as there."""
_REST = 0.15
"""Time without motion after which it is at rest, s."""
_SILENCE = 0.1
"""Longest time that an answer takes, s."""
_RETRY = 0.5
"""Time between attempts to connect again, s."""
_ANSWERED = (0, 1, 2)
"""Codes of the SDK for an answer: good, and where the arm has an error or a warning."""


class XArmGripper(GripperDriver):
    """An xArm Gripper (settings: :class:`~.settings.XArmGripperSettings`). Its force cannot be chosen."""

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = XArmGripperSettings.of(spec)
        self._api: Any = None
        self._is_open = False
        self._forget()

    def _forget(self) -> None:
        self._seq, self._position, self._error = 0, 0, 0
        self._on = False
        """Whether its motor was switched on since its last error."""
        self._goal: int | None = None
        """Position of the newest command."""
        self._target: float | None = None
        """Width of the newest command, m; None before the first one."""
        self._failed: Fault | None = None
        """Why the newest command failed."""
        self._t_moved = self._t_tried = -inf
        self._still_at: int | None = None
        """Position from which on it has not moved; None after it did not answer: it may have moved meanwhile."""
        self._t_back = -inf
        """When it answered again, s."""

    def open(self) -> None:
        """Connect, and ask for its position. Nothing moves."""
        if not self._is_open:
            self._forget()
            self._is_open = True
            try:
                self._ask()
            except BaseException:
                self.close()
                raise

    def close(self) -> None:
        """Stop moving fingers, keep a grasp, and disconnect. Idempotent."""
        try:
            if self._api is not None and self._is_moving(monotonic()):
                self.stop()
        except ConnectionLost:
            pass
        self._is_open, api, self._api = False, self._api, None
        if api is not None:
            api.disconnect()

    # State.

    def read(self, now: float) -> GripperReading:
        offset = now - monotonic()
        began = monotonic()
        self._ask()
        self._seq += 1
        fault = gripper_fault(self._error) if self._error else None
        if fault is not None:
            self._fail(fault)
            self._goal = None
        width = min(self.spec.width_max, max(0.0, self.spec.width_at(self._position / _OPEN)))
        moving = self._is_moving(began) or (self._goal is not None and began - self._t_back < _REST)
        return GripperReading(
            t=began + offset,
            t_device=began,
            seq=self._seq,
            width=width,
            width_target=width if self._target is None else self._target,
            moving=moving,
            grasped=self._on and self._goal is not None and not moving and self._position - max(0, self._goal) > _NEAR,
            outcome=None if self._failed is None else GripperOutcome.FAILED,
            fault=self._failed or fault,
        )

    def _is_moving(self, now: float) -> bool:
        goal = self._goal
        return goal is not None and abs(self._position - max(0, goal)) > _NEAR and now - self._t_moved < _REST

    def _fail(self, fault: Fault) -> None:
        """Note that its motor may be off; a motion that was under way has failed."""
        if self._is_moving(monotonic()):
            self._failed = fault
        self._on, self._still_at = False, None

    def _reach(self) -> Any:
        """Return the SDK's calls. Raises ConnectionLost."""
        if not self._is_open:
            raise ConnectionLost(f"{self.spec.name} is not open", code="closed")
        if self._api is not None and not self._api.connected:
            self._api = self._still_at = None
            raise ConnectionLost.of(self.spec.name, replace(NO_CONTROLLER, cause="it hung up"))
        if self._api is None:
            now, host = monotonic(), self.settings.host
            why = "it hung up"
            if now - self._t_tried > _RETRY:
                self._t_tried = now
                why = probe(host)
            if not why:
                try:
                    self._api = connect(host, enable_report=False, baud_checkset=False)
                    self._api.set_timeout(_SILENCE)
                except OSError as error:
                    why = str(error)
            if why:
                raise ConnectionLost.of(self.spec.name, replace(NO_CONTROLLER, cause=why))
        assert self._api is not None
        return self._api.core

    def _check(self, answer: list[int]) -> list[int]:
        """Return the values of an answer. Raises ConnectionLost where there is none."""
        if answer[0] not in _ANSWERED:
            self._fail(NO_GRIPPER)
            raise ConnectionLost.of(self.spec.name, NO_GRIPPER)
        return answer[1:]

    def _ask(self) -> None:
        core = self._reach()
        (self._position,) = self._check(core.gripper_modbus_get_pos())
        if self._still_at is None:
            self._still_at, self._t_back = self._position, monotonic()
        elif abs(self._position - self._still_at) > 1:
            self._still_at, self._t_moved = self._position, monotonic()
        (self._error,) = self._check(core.gripper_modbus_get_errcode())

    # Commands.

    def move(self, width: float, speed: float, force: float) -> None:
        """Move the fingers to ``width`` (m), or until they meet something, which they hold with their own force."""
        self._target = min(max(width, 0.0), self.spec.width_max)
        self._failed = None
        self._ask()
        if self._error:
            self._failed, self._goal = gripper_fault(self._error), None
            return
        share = 1.0 if width >= self.spec.width_max else self.spec.travel_at(self._target)
        goal = _BEYOND if width <= self.spec.width_min else round(_OPEN * share)
        core = self._reach()
        if not self._on:
            self._check(core.gripper_modbus_set_mode(0))  # positions
            self._check(core.gripper_modbus_set_en(1))
            self._on = True
        self._check(core.gripper_modbus_set_posspd(max(1, min(_TOP, round(_TOP * speed / self.spec.speed)))))
        self._send(goal)

    def home(self) -> None:
        """Clear its error. Nothing moves."""
        self._failed = None
        self._check(self._reach().gripper_modbus_clean_err())

    def stop(self) -> None:
        """Stop the fingers if they were seen to move: a gripper that holds would let go.

        Raises:
            ConnectionLost: It does not answer; after that it takes some readings to see whether they move.
        """
        self._ask()
        if self._is_moving(monotonic()):
            self._send(self._position)

    def _send(self, goal: int) -> None:
        core = self._reach()
        self._goal, self._t_moved = goal, monotonic()  # the gripper may take it although the answer is lost
        self._check(core.gripper_modbus_set_pos(goal))


def check(spec: GripperSpec, duration: float) -> Iterator[CheckResult]:
    """Check that a gripper answers, and has no error. Nothing moves."""
    driver = XArmGripper(spec)
    try:
        driver.open()
        reading = driver.read(monotonic())
        _, baud = driver._api.get_rs485_baudrate()
    except ConnectionLost as error:
        yield CheckResult("gripper", "fail", str(error), (error.fault or NO_CONTROLLER).remedy)
        return
    finally:
        driver.close()
    if reading.fault is not None:
        yield CheckResult("gripper", "warn", reading.fault.cause, reading.fault.remedy)
    elif baud != _BAUD:
        found = f"the line at the flange has {baud} bit/s, the gripper {_BAUD} as delivered"
        yield CheckResult("gripper", "warn", found, "set it in UFACTORY Studio")
    else:
        yield CheckResult("gripper", "ok", f"answers, {1e3 * reading.width:.0f} mm open")
