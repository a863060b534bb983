"""Driver of a Franka arm: reads a state and answers it with a set-point, 1000 times a second, at the robot's own pace.

* ``write`` starts a motion, then sends one set-point per state; ``halt`` ends the motion.
* When the robot ends a motion (reflex, user stop), the driver reports a fault until ``recover``.
* When the robot does not answer, the connection counts as lost. The driver tries to connect again; a motion that was
  interrupted does not resume.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import Any, ClassVar

from hal.config.data_files import find_data
from hal.config.schema import is_own_host
from hal.driver import Reading, RobotDriver, Setpoint
from hal.dynamics import Dynamics
from hal.errors import ConnectionLost, DriverMissing, Fault, HalError, NotSupported, RobotFault
from hal.histogram import Histogram
from hal.lock import DeviceLock
from hal.preflight import has_realtime_kernel
from hal.specs import RobotSpec

from . import DRIVER
from .call_limit import LONGEST_CALL, CallLimit
from .faults import ARM_PORT, fault_of, fault_of_exception, is_connection_lost
from .flags import FLAGS
from .link import ArmLink, ArmMode, ArmSample, StreamKind
from .network import PortState, lock_arm, probe_port, resolve_host
from .settings import ArmSettings

_RECOVERY_TIMEOUT = 3.0
"""Longest time until the robot is idle after a recovery, s."""
_RATED_COMMANDS = 200
"""Commands after which the success rate, an average of the last 100 cycles, is recorded."""
_NO_TORQUE = (0.0,) * 7
_MAX_START_SPEED = 5e-3
"""Largest speed of the first set-point of a motion by positions, rad/s (5 rad/s2 for one cycle): it starts at rest."""
_NOT_SHOWN: tuple[ArmMode | None, Fault | None] = (None, None)
_READY_MODES = frozenset({ArmMode.IDLE, ArmMode.MOVE})
_MANUAL_MODES = frozenset({ArmMode.USER_STOPPED, ArmMode.GUIDING, ArmMode.OTHER})
"""Modes that a person starts and ends, at the arm or in Desk."""


class FrankaArm(RobotDriver):
    """An FR3 or a Panda, as its settings say (:class:`~.settings.ArmSettings`)."""

    modes: ClassVar[frozenset[str]] = frozenset({"position", "velocity", "torque"})
    paces_itself: ClassVar[bool] = True
    extrapolates: ClassVar[bool] = True

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = ArmSettings.of(spec)
        self._connection = ArmConnection(spec.name, self.settings)
        self._sample: ArmSample | None = None
        self._fault: Fault | None = None
        """Fault that ended a motion; kept until recover(), even if the robot is idle again."""
        self._transient = self._reported = False
        """Whether the fault clears itself once the robot is ready again, and whether it has been reported."""
        self._shown = _NOT_SHOWN
        """Last mode that was interpreted, and its fault."""
        self._dynamics = _dynamics(spec)
        """Read here: with large meshes that takes longer than the arm waits for a set-point."""
        self.success_min = inf
        """Lowest success rate so far."""
        self._t_received = 0.0
        self.reset_statistics()

    # Connection.

    def open(self) -> None:
        """Connect, and send the rig's settings to the robot. Nothing moves."""
        self._sample = self._connection.open()

    def own_tcp(self) -> list[float] | None:
        """Return the end effector's pose as the robot reports it: 4x4 by columns, in the base frame, m."""
        link = self._connection.link
        return None if link is None else link.tcp()

    def close(self) -> None:
        """End the motion, if one is running, and disconnect. Idempotent."""
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
            self._sample = connection.try_reconnect() or self._sample
            return
        if self._transient and self._reported:
            self._fault, self._transient = None, False
        before = self._sample
        try:
            with connection.limit:
                self._sample = connection.link.read()
        except connection.library_errors as error:
            self._handle_failure(error)
        self._t_received = time.perf_counter()
        if before is not None and self._sample is not None:
            self.lost_states += max(0, round(1e3 * (self._sample.t - before.t)) - 1)

    def read(self, now: float) -> Reading:
        s, link = self._sample, self._connection.link
        if link is None or s is None:
            raise self._connection.error()
        if s.mode in _READY_MODES:
            fault, self._shown = self._fault, _NOT_SHOWN
        else:
            fault = self._present_fault(link, s.mode)
        self._reported = fault is not None
        # In torque mode tau_d is what drives the arm; otherwise it is what the arm's own controller commands.
        taken = s.tau_d if link.motion is StreamKind.TORQUE else _NO_TORQUE
        seq = round(1e3 * s.t)
        return Reading(now, s.t, seq, s.q, s.dq, s.tau, s.q_d, s.dq_d, s.tau_ext, s.wrench_ext, fault, taken)

    def write(self, setpoint: Setpoint) -> bool:
        s, link = self._sample, self._connection.link
        if link is None or s is None:
            raise self._connection.error()
        if self._fault is not None or s.mode not in _READY_MODES:
            self.withheld["not ready"] += 1
            return False
        kind = self._kind(setpoint)
        # The robot ended the last motion: positions have to come to rest first. Torques begin with none, and the speed
        # in their set-points is the measured one, of an arm that may not have settled.
        if link.motion is None and setpoint.tau is None and max(map(abs, setpoint.dq)) > _MAX_START_SPEED:
            self.withheld["no motion begins at a speed"] += 1
            return False
        try:
            if link.motion is not kind:
                self.withheld["a motion began"] += 1
                self._start_motion(link, kind, s, setpoint)
                return False
            link.send(self._values(kind, setpoint, s))
        except self._connection.library_errors as error:
            self._handle_failure(error)
            return False
        self.commands += 1
        if not link.owns_loop:
            self.answer_times.add(time.perf_counter() - self._t_received)
        if self.commands > _RATED_COMMANDS:
            self.success_min = min(self.success_min, s.success_rate)
        return True

    def _kind(self, setpoint: Setpoint) -> StreamKind:
        if setpoint.tau is not None:
            return StreamKind.TORQUE
        return StreamKind.VELOCITY if self.settings.stream == "velocity" else StreamKind.POSITION

    def _values(self, kind: StreamKind, setpoint: Setpoint, s: ArmSample) -> Any:
        if kind is StreamKind.TORQUE:
            return setpoint.tau
        if kind is StreamKind.POSITION:
            return setpoint.q
        # The velocity that brings the controller's own position to the set-point within one cycle. The servo follows
        # that position by the robot's rule; a report is rounded, and may be late.
        start = s.q_d if setpoint.q_from is None else setpoint.q_from
        return [(q - q_d) * self.spec.rate_hz for q, q_d in zip(setpoint.q, start, strict=True)]

    def _start_motion(self, link: ArmLink, kind: StreamKind, s: ArmSample, setpoint: Setpoint) -> None:
        """Start a motion of this kind, or end the one that is running."""
        held = link.motion is not StreamKind.TORQUE
        if link.motion is not None:
            with self._connection.limit:
                link.finish()
        if link.motion is None:  # a library with its own loop ends a motion when the cycle returns to it
            self._connection.configure(s)
            link.still = setpoint.q if held else None  # torques may have moved the arm on since it was measured
            with self._connection.limit:
                link.start(kind)

    def mass_matrix(self, q: Sequence[float]) -> Any:
        """Return the joint-space inertia (n, n), kg m2, at ``q`` (n,), rad.

        For a URDF without the published inertials it is that of an FR3 with its hand: every Franka arm has the same
        lengths and nearly the same masses.
        """
        return self._dynamics.mass_matrix(q)

    def halt(self) -> None:
        link = self._connection.link
        if link is None or link.motion is None:
            return
        try:
            with self._connection.limit:
                link.finish()
        except self._connection.library_errors as error:
            self._handle_failure(error)

    @property
    def wants_loop(self) -> bool:
        """Whether the motion has to run in the library's own loop (Panda)."""
        link = self._connection.link
        return link is not None and link.owns_loop and link.motion is not None

    def loop(self, turn: Callable[[], None]) -> None:
        """Run the motion that was started in the library's loop; ``turn`` is one cycle."""
        link = self._connection.link
        assert link is not None
        failed: list[BaseException] = []
        limit = self._connection.limit

        def guarded_turn() -> None:
            limit.stop()
            try:
                turn()
            except BaseException as error:
                failed.append(error)  # an error of the cycle must not count as a fault of the robot
                raise
            self.answer_times.add(time.perf_counter() - self._t_received)  # the answer leaves when the turn is over
            limit.start()

        try:
            with limit:
                link.run(guarded_turn)
        except BaseException as error:
            if failed or not isinstance(error, self._connection.library_errors):
                raise
            self._handle_failure(error)

    # Faults.

    def _handle_failure(self, error: Exception) -> None:
        """Handle an exception of the library: either the connection is lost, or the robot ended the motion."""
        connection = self._connection
        link = connection.link
        assert link is not None
        if connection.limit.expired():
            connection.lose(_UNANSWERED)
            return
        with connection.limit:
            link.abandon()
        if is_connection_lost(error):
            connection.lose(connection.explain(error))
            return
        self.aborts += 1
        self._fault = fault_of_exception(error, realtime_kernel=has_realtime_kernel())
        self._transient = self._reported = False
        try:
            self._sample = s = link.read()
        except connection.library_errors as other:
            connection.lose(connection.explain(other))
            return
        self._transient = s.mode in _MANUAL_MODES

    def _present_fault(self, link: ArmLink, mode: ArmMode) -> Fault | None:
        """Return what keeps the robot from moving now.

        A reflex is best explained by the fault that ended the motion; every other mode by the present state.
        """
        if mode is ArmMode.REFLEX and self._fault is not None:
            return self._fault
        if mode is not self._shown[0]:
            fault = fault_of(link.errors(FLAGS), mode.name.lower(), realtime_kernel=has_realtime_kernel())
            self._shown = (mode, fault)
        return self._shown[1]

    def recover(self) -> None:
        """Run the automatic error recovery, and wait until the robot is idle.

        Raises RobotFault where that does not help (user stop, guiding), ConnectionLost if the robot does not answer.
        """
        link, s = self._connection.link, self._sample
        if link is None or s is None:
            raise self._connection.error()
        if link.motion is not None:
            return
        try:
            if s.mode is ArmMode.REFLEX:
                link.recover()
            self._await_idle(link)
        except RobotFault:
            raise
        except self._connection.library_errors as error:
            fault = fault_of_exception(error, realtime_kernel=has_realtime_kernel())
            raise RobotFault(fault.cause, fault.remedy, code=fault.code) from None
        self._fault = None

    def _await_idle(self, link: ArmLink) -> None:
        deadline = time.monotonic() + _RECOVERY_TIMEOUT
        while True:
            self._sample = s = link.read()
            if s.mode is ArmMode.IDLE:
                return
            if s.mode in (ArmMode.USER_STOPPED, ArmMode.GUIDING) or time.monotonic() > deadline:
                fault = self._present_fault(link, s.mode)
                fault = fault or Fault("not_ready", "the robot did not become ready", "look at Desk")
                raise RobotFault(fault.cause, fault.remedy, code=fault.code)

    # Statistics.

    def reset_statistics(self) -> None:
        self.commands = self.lost_states = self.aborts = 0
        self.withheld: Counter[str] = Counter()
        """Set-points that were not passed on, by reason."""
        self.success_min = inf
        self.answer_times = Histogram(2e-6, 2500)

    def statistics(self) -> dict[str, Any]:
        return {
            "commands": self.commands,
            "lost_states": self.lost_states,
            "success_rate_min": None if self.success_min == inf else self.success_min,
            "received_to_sent_s": self.answer_times.summary(),
            "withheld": dict(self.withheld),
            "aborts": self.aborts,
            "reconnects": self._connection.reconnects,
        }


def _dynamics(spec: RobotSpec) -> Dynamics:
    """Return the dynamics of an arm; those of an FR3 with its hand where the URDF is without sound inertials."""
    try:
        return Dynamics.of(spec)
    except NotSupported:
        joints = tuple(f"fr3_joint{k}" for k in range(1, 8))
        urdf = str(find_data("robots", "fr3.urdf"))
        return Dynamics(replace(spec.kinematics, urdf=urdf, joints=joints, base_link=None, tcp_link="fr3_hand"))


def create_link(arm: str) -> ArmLink:
    """Create a link to an arm, ``fr3`` or ``fer`` (the Panda), not connected yet. Raises DriverMissing."""
    try:
        if arm == "fr3":
            from .fr3 import Fr3Link

            return Fr3Link()
        from .panda import PandaLink

        return PandaLink()
    except ImportError as error:
        advice = DRIVER.requires["pylibfranka" if arm == "fr3" else "panda_py"]
        message = f"driver 'franka' does not import: {error}; install it with: {advice}"
        raise DriverMissing(message, name=error.name) from error


_RETRY_PERIOD = 0.5
"""s between attempts to find a lost robot again."""
_FIRST_PROBE, _RETRY_PROBE = 2.0, 0.05
"""Time-out of the check whether the robot's port is open, at first and after a loss, s."""
_PROBE_PAUSE = 0.02
"""s between that check and the connection, so that the robot does not take the two for two clients."""
_PORT_MESSAGES = {
    PortState.REFUSED: "Connection to FCI refused",
    PortState.SILENT: "Connection timeout",
    PortState.NO_ROUTE: "Connection error",
}
"""Messages of the libraries for the same conditions."""
_UNANSWERED = Fault(
    "unanswered",
    f"the robot ended a motion, or was to, and did not answer for {LONGEST_CALL:g} s: the connection was closed",
    "the driver connects again; look at Desk if the robot does not answer then",
)
_START_EMULATOR = "start it in another terminal: hal emulate franka --host {} (--help for more)"


class ArmConnection:
    """A link to one arm that may be lost and found again, reserved for this process.

    Attributes:
        link: The vendor's library, connected; None while the connection is lost.
        lost: Reason for the loss, or None.
        library_errors: Exception classes that the library raises.
        limit: Limits the library's calls that wait for an answer.
        reconnects: How often a lost robot was found again.
    """

    def __init__(self, name: str, settings: ArmSettings) -> None:
        self.name = name
        self.settings = settings
        self.link: ArmLink | None = None
        self.lost: Fault | None = None
        self.library_errors: tuple[type[Exception], ...] = (RuntimeError,)
        self.limit = CallLimit()
        self.reconnects = 0
        self._lock: DeviceLock | None = None
        self._configured = False
        self._retry_at = 0.0

    def open(self) -> ArmSample:
        """Reserve the arm, connect, and return its first state.

        Raises ControlTaken, DriverMissing, and ConnectionLost with the fault's ``code`` if the robot cannot be reached.
        """
        self._lock = lock_arm(resolve_host(self.settings.host) or self.settings.host)
        try:
            link = create_link(self.settings.arm)
            self._probe(_FIRST_PROBE)
            return self._connect(link)
        except BaseException as error:
            self.close()
            if isinstance(error, self.library_errors) and not isinstance(error, HalError):
                raise self.error(self.explain(error)) from None
            raise

    def _probe(self, timeout: float) -> None:
        """Raise ConnectionLost if the robot's port is not open: a library may hang for a minute in that case."""
        host = self.settings.host
        if resolve_host(host) is None:
            raise self.error(self.explain(RuntimeError("Host not found")))
        port = probe_port(host, ARM_PORT, timeout)
        if port is PortState.REFUSED and is_own_host({"host": host}):
            cause = f"no emulator listens at {host}, port {ARM_PORT}"
            raise self.error(Fault("refused", cause, _START_EMULATOR.format(host)))
        if port is not PortState.OPEN:
            raise self.error(self.explain(RuntimeError(_PORT_MESSAGES[port])))
        time.sleep(_PROBE_PAUSE)

    def _connect(self, link: ArmLink) -> ArmSample:
        self.link = link
        self.library_errors = link.library_errors
        link.connect(self.settings.host)
        self.limit = CallLimit(resolve_host(self.settings.host), ARM_PORT)
        self._configured = False
        sample = link.read()
        self.configure(sample)
        self.lost = None
        return sample

    def configure(self, sample: ArmSample) -> None:
        """Send the rig's settings to the robot, once. A robot that is not idle accepts none; it gets them later."""
        if not self._configured and self.link is not None and sample.mode is ArmMode.IDLE:
            self.link.configure(self.settings)
            self._configured = True

    def lose(self, reason: Fault) -> None:
        """Discard the link: the robot does not answer."""
        self.lost = reason
        self._retry_at = time.monotonic() + _RETRY_PERIOD
        self.limit.close()
        link, self.link = self.link, None
        if link is not None:
            with contextlib.suppress(*self.library_errors):  # the library may fail to sign off
                link.disconnect()

    def try_reconnect(self) -> ArmSample | None:
        """Try once to connect again, if it is time; otherwise pause for 10 ms in place of the robot's pace."""
        if time.monotonic() < self._retry_at:
            time.sleep(0.01)
            return None
        try:
            self._probe(_RETRY_PROBE)
            sample = self._connect(create_link(self.settings.arm))
        except ConnectionLost as error:
            self.lose(error.fault or self.explain(error))
        except self.library_errors as error:
            self.lose(self.explain(error))
        else:
            self.reconnects += 1
            return sample
        return None

    def explain(self, error: BaseException) -> Fault:
        """Return the fault that an exception of the library stands for."""
        return fault_of_exception(error, host=self.settings.host)

    def error(self, fault: Fault | None = None) -> ConnectionLost:
        return ConnectionLost.of(self.name, fault or self.lost or Fault("closed", "it is not open", "open the rig"))

    def close(self) -> None:
        """Disconnect, and release the arm for other programs. Idempotent."""
        self.limit.close()
        link, self.link = self.link, None
        try:
            if link is not None:
                link.disconnect()
        finally:
            if self._lock is not None:
                self._lock.release()
                self._lock = None
