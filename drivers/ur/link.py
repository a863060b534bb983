"""Connection to a UR controller through ur_rtde, and the thread that makes every call which may block.

ur_rtde's constructors keep Python's lock while they wait, so they are called in :meth:`UrLink.open` only, once the
ports have answered. Its other calls release the lock. Its objects are never deleted, as that keeps the lock, too.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import dashboard_client
import rtde_control
import rtde_receive

from hal.errors import ConnectionLost, Fault
from hal.host.scheduling import note_threads
from hal.lock import DeviceLock

from .faults import LOCAL, NO_CONTROLLER, NOT_STARTED, OTHER_PROGRAM, PLAYING, REGISTERS_TAKEN, STOPPED
from .settings import UrSettings

__all__ = ["WATCHDOG_HZ", "UrLink", "lock_arm", "probe"]

RTDE, DASHBOARD, SCRIPTS = 30004, 29999, 30002
WATCHDOG_HZ = 8.0
"""The controller ends the control program if nothing comes for the inverse of this: 125 ms."""
_KICK = 0.02
"""Time after which the watchdog is kicked if no set-point was sent, s."""
_START = 0.8
"""Longest time until the control program runs, s."""
_STALE = 1.0
"""Time after which a request to start it is not carried out any more, s: the session that wanted it has given up."""
_ANSWER = 3.0
"""Longest time that a caller waits for the dashboard, s."""
_END = 0.3
"""Longest time until a program that is ended is over, s."""
_RETRY = 0.5
"""Time between attempts to connect again, s."""
_VARIABLES = ["timestamp", "target_q", "actual_q", "actual_qd", "actual_TCP_pose", "actual_TCP_force", "robot_mode"]
_VARIABLES += ["safety_mode", "runtime_state", "speed_scaling", "target_speed_fraction", "safety_status_bits"]
_VARIABLES += ["robot_status_bits"]
_PAYLOAD = ["payload", "payload_cog"]
_kept: list[Any] = []
"""Objects of ur_rtde, until the process ends."""


def lock_arm(host: str) -> DeviceLock:
    """Reserve the arm at ``host`` for this process. Raises ControlTaken."""
    return DeviceLock(f"ur-{host}", f"the arm at {host}", patience=1.0)


def probe(host: str, timeout: float = 1.0) -> str:
    """Return why a controller does not answer, naming the port; an empty text if it does.

    Its RTDE port must answer a request, and its dashboard must greet.
    """
    for port, request in ((DASHBOARD, b""), (RTDE, b"\0\5V\0\2"), (SCRIPTS, None)):
        try:
            with socket.create_connection((host, port), timeout) as line:
                if request is not None:
                    line.sendall(request)
                    if not line.recv(64):
                        return f"port {port} of {host} hangs up"
        except OSError as error:
            return f"port {port} of {host}: {error.strerror or error}"
    return ""


class UrLink:
    """A connection. The attributes are written by one thread and read by the other.

    Args:
        name: The arm's name.
        settings: Its settings.
        rate_hz: Rate of states and set-points.
        tcp: The tcp in the frame of the flange (m, rotation vector in rad); None to leave the installation's.
    """

    def __init__(self, name: str, settings: UrSettings, rate_hz: float, tcp: list[float] | None) -> None:
        self.name, self.settings, self.rate_hz, self.tcp = name, settings, rate_hz, tcp
        self.receive: Any = None
        """ur_rtde's RTDEReceiveInterface; None until open."""
        self.running = False
        """Whether the control program runs, and takes set-points."""
        self.refused: Fault | None = None
        """Why the control program was not started."""
        self.local = False
        """Whether the controller was in local control when that was last asked."""
        self.sent: list[float] | None = None
        """The newest set-point that was sent, rad; None before the first one of a program."""
        self.longest_gap = 0.0
        """Longest time between two messages since the program started, s."""
        self.t_late = 0.0
        """When this computer was last silent for nearly as long as the watchdog allows, s."""
        self.version, self.rate, self.has_payload = "", 0.0, False
        """Of the controller: PolyScope, cycles in a second, and whether it reports the payload."""
        self._target: list[float] | None = None
        self._wake = threading.Condition()
        self._jobs: list[Callable[[], None]] = []
        self._thread: threading.Thread | None = None
        self._asked: float | None = None
        """When the start that is under way was asked for, s; None for none."""
        self._ours = False
        """Whether the program that runs is ours."""
        self._end_by = 0.0
        """Until when a program that was ours is to be ended, s."""
        self._ended = threading.Event()
        """Ends the thread."""
        self._lock: DeviceLock | None = None

    # Called by the cycle.

    def open(self) -> None:
        """Connect. Raises ConnectionLost and ControlTaken."""
        host = self.settings.host
        self._lock = lock_arm(host)
        why = probe(host)
        if why:
            raise ConnectionLost(f"{self.name}: {why}; {NO_CONTROLLER.remedy}", code=NO_CONTROLLER.code)
        with note_threads():
            self._connect(host)

    def _connect(self, host: str) -> None:
        try:
            self._dashboard = dashboard_client.DashboardClient(host)
            self._dashboard.connect()
            self.version = str(self._dashboard.polyscopeVersion())
            version = [int(part) for part in self.version.split(".")[:2]]
            self.rate = 125.0 if version < [4, 0] else 500.0
            self._has_remote = version >= [5, 6]
            self.has_payload = self._has_remote or [3, 11] <= version < [4, 0]
            variables = _VARIABLES + (_PAYLOAD if self.has_payload else [])
            upper = self.settings.upper_registers
            self.receive = rtde_receive.RTDEReceiveInterface(host, self.rate_hz, variables, False, upper)
            flags = rtde_control.RTDEControlInterface
            chosen = int(flags.FLAG_NO_WAIT) | int(flags.FLAG_DISABLE_REMOTE_CONTROL_CHECK)  # no program is started
            chosen |= int(flags.FLAG_NO_EXT_FT)  # an input that is not used, and that another client may have
            chosen |= int(flags.FLAG_UPPER_RANGE_REGISTERS) if upper else 0
            self._control = rtde_control.RTDEControlInterface(host, self.rate_hz, chosen)
        except (RuntimeError, ValueError) as error:  # all that ur_rtde raises
            self.receive = None
            if "registers are already in use" in str(error):
                raise ConnectionLost.of(self.name, REGISTERS_TAKEN) from None
            raise ConnectionLost(f"{self.name}: {error}; {NO_CONTROLLER.remedy}", code=NO_CONTROLLER.code) from error
        _kept.extend((self._dashboard, self.receive, self._control))
        self.lose()
        self._end_by, self._jobs, self.refused = 0.0, [], None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, args=[self._ended], name=f"ur-{self.name}", daemon=True)
        self._thread.start()

    def send(self, q: list[float]) -> None:
        """Send a set-point soon; a newer one replaces one that is waiting."""
        with self._wake:
            self._target = q
            self._wake.notify()

    def start(self) -> None:
        """Start the control program soon: then ``running`` is True, or ``refused`` says why not."""
        asked = time.monotonic()
        self.refused, self._asked = None, asked
        self._call(lambda: self._start(asked))

    @property
    def starting(self) -> bool:
        """Whether the control program is being started."""
        return self._asked is not None

    def note_stopped(self) -> None:
        """Note that no program is running, or that it is paused."""
        if not self.starting:
            self.end()

    def end(self) -> None:
        """End the control program soon: one that is left running, or resumes, still moves to its last set-point."""
        with self._wake:
            if self._ours:
                self.running, self._ours, self._end_by = False, False, time.monotonic() + _STALE
                self._wake.notify()

    def ask_remote(self) -> None:
        """Ask soon whether the controller is in local control."""
        self._call(self._ask_remote)

    def unlock(self) -> str:
        """Unlock a protective stop; return why that was not possible. Blocks for at most 3 s."""
        answers: list[str] = []

        def unlock(given_up: threading.Event) -> None:
            try:
                self._dashboard.closeSafetyPopup()
                if not given_up.is_set():
                    self._dashboard.unlockProtectiveStop()
                    answers.append("")
            except RuntimeError as error:  # the controller's own words
                answers.append(str(error))

        self._finish(unlock)
        return answers[0] if answers else "the dashboard does not answer in time, and may unlock it late: keep away"

    def ask_local(self) -> bool | None:
        """Return whether the controller is in local control; None if it does not say. Blocks for at most 3 s."""
        answers: list[bool] = []

        def ask(given_up: threading.Event) -> None:
            self._ask_remote()
            answers.append(self.local)

        self._finish(ask)
        return answers[0] if answers else None

    def _finish(self, job: Callable[[threading.Event], None]) -> None:
        """Wait until the thread has done a job; ``given_up`` is set once this stops waiting."""
        done, given_up = threading.Event(), threading.Event()

        def run() -> None:
            try:
                if not given_up.is_set():
                    job(given_up)
            finally:
                done.set()

        self._call(run)
        if not done.wait(_ANSWER):
            given_up.set()

    def lose(self) -> None:
        """Note that the controller is silent: what it does is no longer known, and its watchdog ends our program."""
        with self._wake:
            self.running = self._ours = False
            self._asked = self._target = None

    def close(self) -> None:
        """End the control program, and disconnect. Idempotent."""
        with self._wake:
            self._ended.set()
            self._wake.notify()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(4.0)
        self.running, self.receive = False, None
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _call(self, job: Callable[[], None]) -> None:
        with self._wake:
            self._jobs.append(job)
            self._wake.notify()

    # The thread.

    def _run(self, ended: threading.Event) -> None:
        receive, control = self.receive, self._control
        last = time.monotonic()
        while not ended.is_set():
            with self._wake:
                if not self._jobs and self._target is None:
                    self._wake.wait(_KICK)
                target, self._target = self._target, None
                ending = time.monotonic() < self._end_by  # that comes first, and is tried again
                jobs, self._jobs = ([], self._jobs) if ending else (self._jobs, [])
            self._note_gap(time.monotonic() - last)
            try:
                if not receive.isConnected() or not control.isConnected():
                    self.lose()
                    self._reconnect(receive, control, ended)
                elif ending:
                    self._end_program()
                elif jobs:
                    self._reach_dashboard()
                    for job in jobs:
                        job()
                elif self.running:
                    self._serve(control, target)
            except Exception as error:  # RuntimeError, but for answers that it cannot read
                print(f"{self.name}: ur_rtde: {error}", file=sys.stderr)
                self.lose()
            last = time.monotonic()
        with contextlib.suppress(RuntimeError):
            self._disconnect(receive, control)

    def _disconnect(self, receive: Any, control: Any) -> None:
        if time.monotonic() < self._end_by and control.isConnected():
            self._end_program()
        if self._ours and control.isConnected():
            control.stopScript()
        control.disconnect()
        receive.disconnect()

    def _note_gap(self, gap: float) -> None:
        """Note the time since the last message, s."""
        if gap > 0.7 / WATCHDOG_HZ:
            self.t_late = time.monotonic()
        self.longest_gap = max(self.longest_gap, gap)

    def _serve(self, control: Any, target: list[float] | None) -> None:
        if target is None:
            control.kickWatchdog()
        elif control.servoJ(target, 0.0, 0.0, 1.0 / self.rate_hz, self.settings.lookahead_time, self.settings.gain):
            self.sent = target

    def _reconnect(self, receive: Any, control: Any, ended: threading.Event) -> None:
        if ended.wait(_RETRY) or probe(self.settings.host):
            return
        if not receive.isConnected():
            receive.reconnect()
        if not control.isConnected():
            control.reconnect()
        self._dashboard.disconnect()
        self._dashboard.connect()

    def _reach_dashboard(self) -> None:
        if not self._dashboard.isConnected():  # it hangs up after an answer that was late
            self._dashboard.disconnect()
            self._dashboard.connect()

    def _ask_remote(self) -> None:
        self.local = self._has_remote and not self._dashboard.isInRemoteControl()

    def _end_program(self) -> None:
        """End the control program, and clear the command in its register, which the next program would execute."""
        if self.receive.getRuntimeState() != STOPPED:
            self._reach_dashboard()
            with contextlib.suppress(RuntimeError):  # over already, or in local control, where it is over soon
                self._dashboard.stop()
            end = time.monotonic() + _END
            while self.receive.getRuntimeState() != STOPPED and time.monotonic() < end:
                time.sleep(0.002)
        if self.receive.getRuntimeState() == STOPPED:
            self._control.kickWatchdog()  # without a program it only clears the register
            self._end_by = 0.0

    def _start(self, asked: float) -> None:
        if asked != self._asked:  # the connection was lost meanwhile
            return
        refused: Fault | None = NOT_STARTED
        try:
            if time.monotonic() - asked < _STALE:
                refused = self._start_program()
        finally:
            with self._wake:
                if asked == self._asked:
                    self.running, self.refused, self._asked = refused is None, refused, None
                elif refused is None:
                    self._end_by = time.monotonic() + _STALE

    def _start_program(self) -> Fault | None:
        """Start the control program with its watchdog; return why that was not possible."""
        control, load = self._control, self.settings.load
        self._ask_remote()
        if self.local:
            return LOCAL
        end = time.monotonic() + _END  # of ours that was lost, and of states that come late
        while self.receive.getRuntimeState() != STOPPED and not self._ours:
            if time.monotonic() > end:
                return OTHER_PROGRAM
            time.sleep(0.002)
        self._ours, self._target, self.sent, self.longest_gap = True, None, None, 0.0
        end = time.monotonic() + _START
        if self.receive.getRuntimeState() == STOPPED:
            control.kickWatchdog()  # clears the register, where the set-point of an ended program may be
        control.reuploadScript()  # also ends an old one of ours
        while not (control.isProgramRunning() and self.receive.getRuntimeState() == PLAYING):
            if time.monotonic() > end:
                return NOT_STARTED
            time.sleep(0.002)
        ready = control.setWatchdog(WATCHDOG_HZ)
        ready = ready and (self.tcp is None or control.setTcp(self.tcp))
        if load is not None and ready:
            com = load.com if any(load.com) else (0.0, 0.0, 1e-6)  # for zeros ur_rtde keeps the present centre
            ready = control.setPayload(load.mass, list(com))
        return None if ready else NOT_STARTED
