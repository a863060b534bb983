"""Connections to a UFACTORY control box: its reports, read in the cycle, and the thread that makes the SDK's calls.

Every call of xarm-python-sdk waits for its answer: about 1 ms, and about 0.2 s where the network lost a packet.
"""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any, ClassVar, NamedTuple

from hal.errors import ConnectionLost, Fault
from hal.host.library_thread import LibraryThread
from hal.lock import DeviceLock
from hal.preflight import probe_ports

from .faults import NO_CONTROLLER, NOT_STARTED, PAUSED, POSITION, SERVO, describe_warning, error_fault
from .sdk import XArmAPI, logger, origin_logger
from .settings import XArmSettings

__all__ = ["COMMANDS", "REPORTS", "PERIOD", "Report", "ReportLine", "XArmLink", "connect", "lock_arm", "probe"]

COMMANDS, REPORTS = 502, 30003
PERIOD = 0.01
"""Time between two reports, s."""
_REPORT = struct.Struct("<BH20f")
"""State and mode, commands that wait, 7 angles (rad), pose (mm, rad), 7 torques (Nm); after the size (big endian)."""
_LONGEST_REPORT = 4096
_READS = 16
"""Most reads of the line at a time: what sends without a pause must not keep the cycle."""
_POLL = 0.05
"""Time between two questions for errors while no set-points are sent, s."""
_WATCH = 0.5
"""The same while they are, s."""
_STALL = 0.012
"""Longest time that a set-point waits to be sent, s: one that is older would be a step."""
_TIMEOUT = 0.5
"""Longest time that a call waits for its answer, s."""
_CONNECT = 6.0
"""Longest time until a connection is made, s."""
_ANSWER = 2.0
"""Longest time that a caller waits for the thread, s."""
_RETRY = 0.5
"""Time between attempts to connect again, s."""
_OK, _ERROR = 0, 1
_UNANSWERED = (-1, 3, 8)
"""What the SDK's calls return: not connected, too late, not sent."""


def lock_arm(host: str) -> DeviceLock:
    """Reserve the arm at ``host`` for this process. Raises ControlTaken."""
    return DeviceLock(f"xarm-{host}", f"the arm at {host}", patience=1.0)


def probe(host: str) -> str:
    """Return why a controller does not answer, naming the port; an empty text if it does.

    Without it, the SDK would wait for minutes for one that only accepts connections.
    """
    return probe_ports(host, {COMMANDS: b"\0\1\0\2\0\1\1", REPORTS: b""})  # the first gets the version


def connect(host: str, **options: Any) -> XArmAPI:
    """Return the SDK's connection to a control box that :func:`probe` found. Raises OSError."""
    for log in (logger, origin_logger):  # they would print at every call; what matters is a fault
        log.setLevel(logging.CRITICAL)
    default = socket.getdefaulttimeout()
    address = socket.gethostbyname(host)  # it takes a name for a serial port
    api = XArmAPI(address, is_radian=True, do_not_open=True, check_joint_limit=False, timed_comm=False, **options)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            api.connect()
    except Exception as error:  # it raises nothing else
        raise OSError(str(error)) from error
    finally:
        socket.setdefaulttimeout(default)  # it sets one for the whole process
    api.set_timeout(_TIMEOUT)
    return api


class Report(NamedTuple):
    mode: int
    state: int
    q: tuple[float, ...]
    """7 joint positions, rad; 0 for those that the arm does not have."""
    pose: tuple[float, ...]
    """Position of the controller's tcp, mm, and roll, pitch and yaw, rad."""
    tau: tuple[float, ...]
    """7 torques that the controller estimates, Nm."""

    @property
    def takes_setpoints(self) -> bool:
        """Whether the arm is in servo mode, and neither paused nor stopped."""
        return self.mode == SERVO and self.state < PAUSED


class ReportLine:
    """The connection to the port of the reports; no call waits, but for :meth:`open`."""

    def __init__(self, name: str, host: str) -> None:
        self._name, self._host = name, host
        self._line: socket.socket | None = None
        self._came = b""

    def open(self) -> list[Report]:
        """Connect, and return the first two or more reports. Raises ConnectionLost."""
        self.close()
        reports: list[Report] = []
        try:
            self._line = socket.create_connection((self._host, REPORTS), timeout=1.0)
            self._host = self._line.getpeername()[0]  # retry() must not wait for a name to be looked up
            self._line.setblocking(False)
            end = time.monotonic() + 1.0
            while len(reports) < 2:
                if time.monotonic() > end:
                    raise OSError("it is silent")
                time.sleep(0.001)
                reports += self.receive()
        except OSError as error:
            why = f"port {REPORTS}: {error.strerror or error}"
            raise ConnectionLost.of(self._name, replace(NO_CONTROLLER, cause=why)) from error
        return reports

    def retry(self) -> None:
        """Begin to connect again."""
        self.close()
        self._line = socket.socket()
        self._line.setblocking(False)
        self._line.connect_ex((self._host, REPORTS))

    def close(self) -> None:
        if self._line is not None:
            self._line.close()
        self._line, self._came = None, b""

    def receive(self) -> list[Report]:
        """Return the reports that have come since the last call. Raises OSError if the connection is over."""
        if self._line is None:
            raise OSError("it is closed")
        with contextlib.suppress(BlockingIOError):
            for _ in range(_READS):
                news = self._line.recv(1 << 16)
                if not news:
                    raise OSError("it hung up")
                self._came += news
        reports, came = [], self._came
        while len(came) >= 4:
            size = int.from_bytes(came[:4], "big")
            if not 4 + _REPORT.size <= size <= _LONGEST_REPORT:
                raise OSError(f"a report of {size} bytes")
            if len(came) < size:
                break
            flags, _, *x = _REPORT.unpack_from(came, 4)
            reports.append(Report(flags >> 4, flags & 15, tuple(x[:7]), tuple(x[7:13]), tuple(x[13:])))
            came = came[size:]
        self._came = came
        return reports


class XArmLink(LibraryThread):
    """The SDK's connection: ``ready`` is whether the motors were switched on and the mode was set."""

    LIBRARY: ClassVar[str] = "xarm-python-sdk"
    NOT_STARTED: ClassVar[Fault] = NOT_STARTED

    def __init__(self, name: str, settings: XArmSettings, joints: int) -> None:
        super().__init__(name)
        self.settings, self.joints = settings, joints
        self.error = self.warning = 0
        """Numbers of the controller's error and warning; 0 for none."""
        self.t_errors = 0.0
        """When the last question for errors that was answered was asked, s."""
        self.silent_since = inf
        """When the first call began that the controller has not answered, s."""
        self.longest_answer = 0.0
        """Longest time until a set-point was answered since the motors were switched on, s."""
        self.refused_setpoint = False
        """Whether the controller refused a set-point."""
        self.connected = False
        self._api: Any = None
        self._axis = 0
        """Number of joints of the controller's arm."""
        self._t_target = 0.0

    # Called by the cycle.

    def open(self) -> None:
        """Connect. Raises ConnectionLost and ControlTaken."""
        host = self.settings.host
        self.reserve(lock_arm(host))
        why = probe(host)
        if not why:
            self.begin(self._turn, self._leave)
            if not self.finish(lambda _: None, _CONNECT):
                why = f"port {COMMANDS} of {host}: the SDK does not connect"
        if why:
            raise ConnectionLost.of(self.name, replace(NO_CONTROLLER, cause=why))
        if self._axis != self.joints:
            raise ConnectionLost(
                f"{self.name}: the controller at {host} has an arm with {self._axis} joints, the model has "
                f"{self.joints}; choose the arm's model, or check real.host",
                code="WRONG_ARM",
            )

    def send(self, q: list[float]) -> bool:
        """Send a set-point soon; a newer one replaces one that waits.

        Returns:
            False if the controller does not answer in time: then nothing that waits is sent.
        """
        with self._wake:
            now = time.monotonic()
            if self._target is None:
                self._t_target = now
            if not self.ready or now - self._t_target > _STALL:
                self._target = None
                return False
            self._target = q
            self._wake.notify()
        return True

    def stop(self) -> None:
        """Stop the arm soon."""
        self.end()
        self.call(self._stop)

    def end(self) -> None:
        with self._wake:
            self.ready, self._target = False, None

    def ask(self) -> None:
        self.call(self._ask)

    def clean(self) -> bool:
        """Clear error and warning; return whether the controller answered. Blocks for at most 2 s."""
        began = time.monotonic()
        return self.finish(lambda _: self._clean(), _ANSWER) and self.t_errors >= began

    def forgive(self, now: float) -> None:
        """Count a silence from ``now`` (s) on: this process did not run until then."""
        if self.silent_since < now:
            self.silent_since = now

    def close(self) -> None:
        """Stop the arm if it was ours, and disconnect. Idempotent."""
        super().close()
        self.connected = False

    # The thread.

    def _turn(self, ended: threading.Event) -> None:
        """Do what waits, one call at a time: a job, or a set-point, or a question for errors."""
        if self._api is None or not self._api.connected:
            self._connect(ended)
            return
        job, target = self.take(_POLL)
        if job is not None:
            job()
        elif target is not None:
            self.sent = target
            self._send(target)
        elif not ended.is_set():
            self._ask()

    def fail(self, ended: threading.Event) -> None:
        self._disconnect()
        ended.wait(_RETRY)

    def _leave(self) -> None:
        if self.ready and self.connected:
            self._stop()
        self._disconnect()

    def _connect(self, ended: threading.Event) -> None:
        self._disconnect()
        if probe(self.settings.host):
            ended.wait(_RETRY)
            return
        api = connect(self.settings.host, enable_report=False)
        if ended.is_set():  # given up meanwhile: another thread may be connected
            api.disconnect()
            return
        self._api, self._axis = api, int(api.axis)
        self._ask()
        self.connected = True

    def _disconnect(self) -> None:
        api, self._api, self.connected = self._api, None, False
        self.lose()
        if api is not None:
            api.disconnect()

    def _timed(self, call: Callable[..., Any], *args: Any) -> Any:
        """Make a call that the controller answers at once."""
        self.silent_since = min(self.silent_since, time.monotonic())
        result = call(*args)
        if (result if isinstance(result, int) else result[0]) not in _UNANSWERED:
            self.silent_since = inf
        return result

    def _send(self, q: list[float]) -> None:
        began = time.monotonic()
        code = self._timed(self._api.set_servo_angle_j, q)
        self.longest_answer = max(self.longest_answer, time.monotonic() - began)
        if code not in (_OK, *_UNANSWERED):
            self.refused_setpoint = True
        if code == _ERROR or began - self.t_errors > _WATCH:  # the SDK does not tell of a warning
            self._ask()

    def _ask(self) -> None:
        began, before = time.monotonic(), self.warning
        code, found = self._timed(self._api.get_err_warn_code)
        if code == _OK:
            self.error, self.warning = found
            self.t_errors = began
            if self.warning not in (0, before):
                print(f"{self.name}: warning of the controller: {describe_warning(self.warning)}", file=sys.stderr)

    def prepare(self) -> Fault | None:
        """Switch the motors on and set servo mode; return why that was not possible."""
        api, load = self._api, self.settings.load
        self._ask()
        if self.error:
            return error_fault(self.error)
        self.sent, self.refused_setpoint, self.longest_answer = None, False, 0.0
        codes = [api.motion_enable(True)]
        if load is not None:  # the controller takes it as it takes a motion
            codes += [api.set_mode(POSITION), api.set_state(0)]
            codes.append(api.set_tcp_load(load.mass, [1e3 * x for x in load.com]))
        codes += [api.set_mode(SERVO), api.set_state(0)]
        return NOT_STARTED if any(codes) else None

    def _stop(self) -> None:
        self._timed(self._api.set_state, 4)

    def _clean(self) -> None:
        self._api.clean_error()
        if self.warning:
            self._api.clean_warn()
        self._ask()
