"""A Franka arm: reads a state and answers it with a set-point, a thousand times a second, at the robot's own pace.

write ─► start a motion, then one set-point per state      halt ─► end it in order
the robot ends it by itself (reflex, user stop) ─► a fault, until recover()
the robot does not answer ─► lost; a new connection is tried, and what moved before does not go on by itself
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import Any, ClassVar

from hal.config.data_files import find_data
from hal.errors import ConnectionLost, HalError, RobotFault
from hal.histogram import Histogram
from hal.kinematics import Kinematics
from hal.machine import has_realtime_kernel
from hal.robot import Reading, RobotDriver, Setpoint
from hal.specs import RobotSpec
from hal.types import Fault

from .claim import Claim
from .faults import ARM_PORT, fault_of, fault_of_exception, is_connection_lost
from .flags import FLAGS
from .link import Kind, Link, Mode, Sample
from .links import link_to
from .preflight_network import Answer, knock
from .settings import ArmSettings

__all__ = ["FrankaArm"]

_RETRY = 0.5
"""s between attempts to find a lost robot again."""
_PATIENCE, _KNOCK = 2.0, 0.05
"""s to wait for a robot that is asked whether it is there, at first and when it was lost."""
_BREATH = 0.02
"""s between that question and the connection, so that the robot does not take them for two clients."""
_SAYS = {
    Answer.REFUSED: "Connection to FCI refused",
    Answer.SILENT: "Connection timeout",
    Answer.NO_WAY: "Connection error",
}
"""How the libraries would say it."""
_RECOVERY = 3.0
"""Longest time that a recovery may take until the robot is idle, s."""
_CALM = frozenset({Mode.IDLE, Mode.MOVE})
_BY_HAND = frozenset({Mode.USER_STOPPED, Mode.GUIDING, Mode.OTHER})
"""What a person brought about at the arm or in Desk, and ends there."""


class FrankaArm(RobotDriver):
    """An FR3 or a Panda. Which of the two, and where, stands in the rig (:class:`~.settings.ArmSettings`)."""

    modes: ClassVar[frozenset[str]] = frozenset({"position", "velocity", "torque"})
    paces_itself: ClassVar[bool] = True

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = ArmSettings.of(spec)
        self._link: Link | None = None
        self._troubles: tuple[type[Exception], ...] = (RuntimeError,)
        """What the library raises of its own."""
        self._claim: Claim | None = None
        self._sample: Sample | None = None
        self._fault: Fault | None = None
        """What ended a motion; kept until recover(), though the robot may be idle again."""
        self._lost: Fault | None = None
        """Why there is no connection."""
        self._configured = False
        self._inertias: Kinematics | None = None
        self._retry_at = 0.0
        self.success_min = inf
        """Lowest success rate so far."""
        self._success: float | None = None
        """The success rate when the last command was sent."""
        self._t_received = 0.0
        self.reset_statistics()

    # The connection.

    def open(self) -> None:
        """Connect, and tell the robot the rig's settings. Nothing moves."""
        self._claim = Claim(self.settings.host)
        try:
            link = link_to(self.settings.arm)
            self._find(_PATIENCE)
            self._connect(link)
        except BaseException as error:
            self.close()
            if isinstance(error, self._troubles) and not isinstance(error, HalError):
                raise self._connection_lost(self._explain(error)) from None
            raise

    def _find(self, patience: float) -> None:
        """Raise ConnectionLost when nobody listens there: a library that calls nobody may hang for a minute."""
        answer = knock(self.settings.host, ARM_PORT, patience)
        if answer is not Answer.OPEN:
            raise self._connection_lost(self._explain(RuntimeError(_SAYS[answer])))
        time.sleep(_BREATH)

    def _connect(self, link: Link) -> None:
        self._link = link
        self._troubles = link.troubles
        link.connect(self.settings.host)
        self._configured = False
        self._sample = link.read()
        self._configure()
        self._lost = None

    def _configure(self) -> None:
        """A robot that is stopped or in reflex takes no settings; it gets them before it moves."""
        if not self._configured and self._link is not None and self._now_in() is Mode.IDLE:
            self._link.configure(self.settings)
            self._configured = True

    def own_tcp(self) -> list[float] | None:
        """Where the robot says that its end effector is: 4x4 by columns, in the base frame, m."""
        return None if self._link is None else self._link.tcp()

    def close(self) -> None:
        """End the motion, if there is one, and disconnect. Idempotent."""
        try:
            if self._link is not None:
                if not self._link.owns_loop:
                    self.halt()
                self._link.disconnect()
        finally:
            self._link = None
            if self._claim is not None:
                self._claim.release()
                self._claim = None

    def _lose(self, reason: Fault) -> None:
        """The robot does not answer: the library's object is of no use any more."""
        self._lost = reason
        self._retry_at = time.monotonic() + _RETRY
        link, self._link = self._link, None
        if link is not None:
            with contextlib.suppress(*self._troubles):  # it may complain that it could not say goodbye
                link.disconnect()

    def _look_for_it(self) -> None:
        """One attempt to connect again, now and then; in between, a pause instead of the robot's pace."""
        if time.monotonic() < self._retry_at:
            time.sleep(0.01)
            return
        try:
            self._find(_KNOCK)
            self._connect(link_to(self.settings.arm))
            self.reconnects += 1
        except ConnectionLost as error:
            self._lose(error.fault or self._explain(error))
        except self._troubles as error:
            self._lose(self._explain(error))

    # Every cycle.

    def wait(self) -> None:
        link = self._link
        if link is None:
            self._look_for_it()
            return
        before = self._sample
        try:
            self._sample = link.read()
        except self._troubles as error:
            self._failed(error)
        self._t_received = time.perf_counter()
        if before is not None and self._sample is not None:
            self.lost_states += max(0, round(1e3 * (self._sample.t - before.t)) - 1)

    def read(self, now: float) -> Reading:
        s = self._sample
        if self._lost is not None or s is None:
            raise self._connection_lost(self._lost)
        fault = self._fault
        if s.mode not in _CALM:
            fault = self._present_fault(s)
        seq = round(1e3 * s.t)
        driven = self._link is not None and self._link.motion is Kind.TORQUE
        taken = s.tau_d if driven else (0.0,) * 7  # else it is what its own controller wants
        return Reading(now, s.t, seq, s.q, s.dq, s.tau, s.q_d, s.dq_d, s.tau_ext, s.wrench_ext, fault, taken)

    def write(self, setpoint: Setpoint) -> None:
        link = self._link
        if link is None:
            raise self._connection_lost(self._lost)
        if self._fault is not None or self._now_in() not in _CALM:
            return
        kind = self._kind(setpoint)
        try:
            if link.motion is not kind:
                self._begin(link, kind)
                return
            link.send(self._values(kind, setpoint))
        except self._troubles as error:
            self._failed(error)
            return
        self.commands += 1
        if not link.owns_loop:
            self.answer_times.add(time.perf_counter() - self._t_received)
        self._note_success()

    def _kind(self, setpoint: Setpoint) -> Kind:
        if setpoint.tau is not None:
            return Kind.TORQUE
        return Kind.VELOCITY if self.settings.stream == "velocity" else Kind.POSITION

    def _values(self, kind: Kind, setpoint: Setpoint) -> Any:
        if kind is Kind.TORQUE:
            return setpoint.tau
        if kind is Kind.POSITION:
            return setpoint.q
        # The velocity that brings the controller's own position to the set-point in one cycle: nothing drifts.
        assert self._sample is not None
        return [(q - q_d) * self.spec.rate_hz for q, q_d in zip(setpoint.q, self._sample.q_d, strict=True)]

    def _begin(self, link: Link, kind: Kind) -> None:
        """Start a motion of this kind; where another one runs, end that first."""
        if link.motion is not None:
            link.finish()
        if link.motion is None:  # a library with a loop of its own ends a motion when the cycle returns to it
            self._configure()
            link.start(kind)

    def mass_matrix(self, q: Sequence[float]) -> Any:
        """Joint-space inertia (n, n), kg m2, at ``q``, by the published inertias of an FR3 with its hand.

        A Panda has the same lengths and nearly the same masses; the URDF that comes with PyBullet invents inertias.
        """
        if self._inertias is None:
            spec = self.spec.kinematics
            if self.settings.arm != "fr3":
                joints = tuple(f"fr3_joint{k}" for k in range(1, 8))
                urdf = str(find_data("robots", "fr3.urdf"))
                spec = replace(spec, urdf=urdf, joints=joints, base_link=None, tcp_link="fr3_hand")
            self._inertias = Kinematics(spec)
        return self._inertias.mass_matrix(q)

    def halt(self) -> None:
        """End the motion: the robot holds by itself."""
        link = self._link
        if link is None or link.motion is None:
            return
        try:
            link.finish()
        except self._troubles as error:
            self._failed(error)

    @property
    def wants_loop(self) -> bool:
        """A Panda's motion runs in its library's loop."""
        return self._link is not None and self._link.owns_loop and self._link.motion is not None

    def loop(self, turn: Callable[[], None]) -> None:
        """Run the motion that was begun."""
        link = self._link
        assert link is not None
        failed: list[BaseException] = []

        def guarded() -> None:
            try:
                turn()
            except BaseException as error:
                failed.append(error)  # not the library's: it must not be taken for a fault of the robot
                raise
            self.answer_times.add(time.perf_counter() - self._t_received)  # the answer goes when the turn is over

        try:
            link.run(guarded)
        except BaseException as error:
            if failed or not isinstance(error, self._troubles):
                raise
            self._failed(error)

    # Faults.

    def _failed(self, error: Exception) -> None:
        """A call of the library failed: is the robot gone, or did it end the motion?"""
        link = self._link
        assert link is not None
        link.abandon()
        if is_connection_lost(error):
            self._lose(self._explain(error))
            return
        self.aborts += 1
        self._fault = fault_of_exception(error, **self._circumstances())
        try:
            self._sample = link.read()
        except self._troubles as other:
            self._lose(self._explain(other))
            return
        if self._sample.mode in _BY_HAND:
            self._fault = None  # it is there for as long as the robot says so

    def _present_fault(self, s: Sample) -> Fault | None:
        """What keeps the robot from moving. What ended the motion explains a reflex best; the rest is as it is now."""
        if s.mode is Mode.REFLEX and self._fault is not None:
            return self._fault
        assert self._link is not None
        return fault_of(self._link.errors(FLAGS), s.mode.name.lower(), **self._circumstances())

    def _circumstances(self) -> dict[str, Any]:
        return {"success_rate": self._success, "realtime_kernel": has_realtime_kernel()}

    def _explain(self, error: BaseException) -> Fault:
        return fault_of_exception(error, host=self.settings.host)

    def _connection_lost(self, fault: Fault | None) -> ConnectionLost:
        fault = fault or Fault("closed", "it is not open", "open the rig")
        error = ConnectionLost(f"{self.spec.name}: {fault.cause}; {fault.remedy}")
        error.fault = fault
        return error

    def _now_in(self) -> Mode | None:
        return None if self._sample is None else self._sample.mode

    def recover(self) -> None:
        """Automatic error recovery, and wait until the robot is idle.

        Raises RobotFault where that cannot help (user stop, guiding), ConnectionLost when the robot does not answer.
        """
        link = self._link
        if link is None:
            raise self._connection_lost(self._lost)
        if link.motion is not None:
            return
        try:
            if self._now_in() is Mode.REFLEX:
                link.recover()
            self._await_idle(link)
        except RobotFault:
            raise
        except self._troubles as error:
            fault = fault_of_exception(error, **self._circumstances())
            raise RobotFault(fault.cause, fault.remedy) from None
        self._fault = None

    def _await_idle(self, link: Link) -> None:
        deadline = time.monotonic() + _RECOVERY
        while True:
            self._sample = s = link.read()
            if s.mode is Mode.IDLE:
                return
            if s.mode in (Mode.USER_STOPPED, Mode.GUIDING) or time.monotonic() > deadline:
                fault = self._present_fault(s) or Fault(s.mode.name.lower(), "the robot is not idle", "look at Desk")
                raise RobotFault(fault.cause, fault.remedy)

    # Statistics.

    def _note_success(self) -> None:
        """The lowest success rate of motions that are longer than what the rate is an average of."""
        assert self._sample is not None
        self._success = self._sample.success_rate
        if self.commands > 200:
            self.success_min = min(self.success_min, self._success)

    def reset_statistics(self) -> None:
        self.commands = self.lost_states = self.reconnects = self.aborts = 0
        self.success_min = inf
        self.answer_times = Histogram(2e-6, 2500)

    def statistics(self) -> dict[str, Any]:
        return {
            "commands": self.commands,
            "lost_states": self.lost_states,
            "success_rate_min": None if self.success_min == inf else self.success_min,
            "received_to_sent_s": self.answer_times.summary(),
            "aborts": self.aborts,
            "reconnects": self.reconnects,
        }
