"""A Franka arm: reads a state and answers it with a set-point, a thousand times a second, at the robot's own pace.

write ─► start a motion, then one set-point per state      halt ─► end it in order
the robot ends it by itself (reflex, user stop) ─► a fault, until recover()
the robot does not answer ─► lost; a new connection is tried, and what moved before does not go on by itself
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import dist, inf
from typing import Any, ClassVar

from hal.config.data_files import find_data
from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import RobotFault
from hal.histogram import Histogram
from hal.kinematics.arm import Kinematics
from hal.preflight import has_realtime_kernel
from hal.specs import RobotSpec
from hal.types import Fault

from .connection import Connection
from .faults import fault_of, fault_of_exception, is_connection_lost
from .flags import FLAGS
from .link import Kind, Link, Mode, Sample
from .settings import ArmSettings

__all__ = ["FrankaArm"]

_RECOVERY = 3.0
"""Longest time that a recovery may take until the robot is idle, s."""
_AVERAGE = 200
"""Commands after which a success rate, which is an average of the last 100, says something."""
_NO_TORQUE = (0.0,) * 7
_STILL = 5e-3
"""A motion begins at rest: no set-point faster than this is its first, rad/s (5 rad/s2 within a cycle)."""
_DRIFT = 1e-6
"""A controller that integrates velocities is no farther than this from its set-points, rad, unless one was lost."""
_NOTHING_SHOWN: tuple[Mode | None, Fault | None] = (None, None)
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
        self._connection = Connection(spec.name, self.settings)
        self._sample: Sample | None = None
        self._fault: Fault | None = None
        """What ended a motion; kept until recover(), though the robot may be idle again."""
        self._passing = self._told = False
        """Does the fault go by itself, once the robot is ready again and it was told?"""
        self._shown = _NOTHING_SHOWN
        """The mode that was looked at last, and what it means."""
        self._inertias: Kinematics | None = None
        self.success_min = inf
        """Lowest success rate so far."""
        self._t_received = 0.0
        self.reset_statistics()

    # The connection.

    def open(self) -> None:
        """Connect, and tell the robot the rig's settings. Nothing moves."""
        self._sample = self._connection.open()

    def own_tcp(self) -> list[float] | None:
        """Where the robot says that its end effector is: 4x4 by columns, in the base frame, m."""
        link = self._connection.link
        return None if link is None else link.tcp()

    def close(self) -> None:
        """End the motion, if there is one, and disconnect. Idempotent."""
        try:
            link = self._connection.link
            if link is not None and not link.owns_loop:
                self.halt()
        finally:
            self._connection.close()

    # Every cycle.

    def wait(self) -> None:
        connection = self._connection
        if connection.link is None:
            self._sample = connection.look_for_it() or self._sample
            return
        if self._passing and self._told:
            self._fault, self._passing = None, False
        before = self._sample
        try:
            self._sample = connection.link.read()
        except connection.troubles as error:
            self._failed(error)
        self._t_received = time.perf_counter()
        if before is not None and self._sample is not None:
            self.lost_states += max(0, round(1e3 * (self._sample.t - before.t)) - 1)

    def read(self, now: float) -> Reading:
        s, link = self._sample, self._connection.link
        if link is None or s is None:
            raise self._connection.error()
        if s.mode in _CALM:
            fault, self._shown = self._fault, _NOTHING_SHOWN
        else:
            fault = self._present_fault(link, s.mode)
        self._told = fault is not None
        # In torque mode: what drives the arm. Else tau_d is what its own controller wants.
        taken = s.tau_d if link.motion is Kind.TORQUE else _NO_TORQUE
        seq = round(1e3 * s.t)
        return Reading(now, s.t, seq, s.q, s.dq, s.tau, s.q_d, s.dq_d, s.tau_ext, s.wrench_ext, fault, taken)

    def write(self, setpoint: Setpoint) -> bool:
        s, link = self._sample, self._connection.link
        if link is None or s is None:
            raise self._connection.error()
        if self._fault is not None or s.mode not in _CALM:
            return False
        kind = self._kind(setpoint)
        if link.motion is None and max(map(abs, setpoint.dq)) > _STILL:
            return False  # the robot ended the last one by itself: the servo comes to rest first
        try:
            if link.motion is not kind:
                self._begin(link, kind, s, setpoint)
                return False
            link.send(self._values(kind, setpoint, s))
        except self._connection.troubles as error:
            self._failed(error)
            return False
        self.commands += 1
        if not link.owns_loop:
            self.answer_times.add(time.perf_counter() - self._t_received)
        if self.commands > _AVERAGE:
            self.success_min = min(self.success_min, s.success_rate)
        return True

    def _kind(self, setpoint: Setpoint) -> Kind:
        if setpoint.tau is not None:
            return Kind.TORQUE
        return Kind.VELOCITY if self.settings.stream == "velocity" else Kind.POSITION

    def _values(self, kind: Kind, setpoint: Setpoint, s: Sample) -> Any:
        if kind is Kind.TORQUE:
            return setpoint.tau
        if kind is Kind.POSITION:
            return setpoint.q
        # The velocity that brings the controller's own position to the set-point in one cycle, so that nothing drifts;
        # a report that is late or noisy is not that position.
        start = s.q_d
        if setpoint.q_from is not None and dist(start, setpoint.q_from) > _DRIFT:
            start = setpoint.q_from
        return [(q - q_d) * self.spec.rate_hz for q, q_d in zip(setpoint.q, start, strict=True)]

    def _begin(self, link: Link, kind: Kind, s: Sample, setpoint: Setpoint) -> None:
        """Start a motion of this kind; where another one runs, end that first."""
        if link.motion is not None:
            link.finish()
        if link.motion is None:  # a library with a loop of its own ends a motion when the cycle returns to it
            self._connection.configure(s)
            link.still = setpoint.q
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
        link = self._connection.link
        if link is None or link.motion is None:
            return
        try:
            link.finish()
        except self._connection.troubles as error:
            self._failed(error)

    @property
    def wants_loop(self) -> bool:
        """A Panda's motion runs in its library's loop."""
        link = self._connection.link
        return link is not None and link.owns_loop and link.motion is not None

    def loop(self, turn: Callable[[], None]) -> None:
        """Run the motion that was begun."""
        link = self._connection.link
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
            if failed or not isinstance(error, self._connection.troubles):
                raise
            self._failed(error)

    # Faults.

    def _failed(self, error: Exception) -> None:
        """A call of the library failed: is the robot gone, or did it end the motion?"""
        connection = self._connection
        link = connection.link
        assert link is not None
        link.abandon()
        if is_connection_lost(error):
            connection.lose(connection.explain(error))
            return
        self.aborts += 1
        self._fault = fault_of_exception(error, realtime_kernel=has_realtime_kernel())
        self._passing = self._told = False
        try:
            self._sample = s = link.read()
        except connection.troubles as other:
            connection.lose(connection.explain(other))
            return
        self._passing = s.mode in _BY_HAND

    def _present_fault(self, link: Link, mode: Mode) -> Fault | None:
        """What keeps the robot from moving. What ended the motion explains a reflex best; the rest is as it is now."""
        if mode is Mode.REFLEX and self._fault is not None:
            return self._fault
        if mode is not self._shown[0]:
            fault = fault_of(link.errors(FLAGS), mode.name.lower(), realtime_kernel=has_realtime_kernel())
            self._shown = (mode, fault)
        return self._shown[1]

    def recover(self) -> None:
        """Automatic error recovery, and wait until the robot is idle.

        Raises RobotFault where that cannot help (user stop, guiding), ConnectionLost when the robot does not answer.
        """
        link, s = self._connection.link, self._sample
        if link is None or s is None:
            raise self._connection.error()
        if link.motion is not None:
            return
        try:
            if s.mode is Mode.REFLEX:
                link.recover()
            self._await_idle(link)
        except RobotFault:
            raise
        except self._connection.troubles as error:
            fault = fault_of_exception(error, realtime_kernel=has_realtime_kernel())
            raise RobotFault(fault.cause, fault.remedy) from None
        self._fault = None

    def _await_idle(self, link: Link) -> None:
        deadline = time.monotonic() + _RECOVERY
        while True:
            self._sample = s = link.read()
            if s.mode is Mode.IDLE:
                return
            if s.mode in (Mode.USER_STOPPED, Mode.GUIDING) or time.monotonic() > deadline:
                fault = self._present_fault(link, s.mode)
                raise RobotFault(
                    fault.cause if fault else "the robot does not get ready", fault.remedy if fault else "look at Desk"
                )

    # Statistics.

    def reset_statistics(self) -> None:
        self.commands = self.lost_states = self.aborts = 0
        self.success_min = inf
        self.answer_times = Histogram(2e-6, 2500)

    def statistics(self) -> dict[str, Any]:
        return {
            "commands": self.commands,
            "lost_states": self.lost_states,
            "success_rate_min": None if self.success_min == inf else self.success_min,
            "received_to_sent_s": self.answer_times.summary(),
            "aborts": self.aborts,
            "reconnects": self._connection.found_again,
        }
