"""Connection to a UR controller through ur_rtde, and the thread that makes every call which may block.

ur_rtde's constructors keep Python's lock while they wait, so they are called in :meth:`UrLink.open` only, once the
ports have answered. Its other calls release the lock. Its objects are never deleted, as that keeps the lock, too.
"""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import replace
from typing import Any, ClassVar

import dashboard_client
import rtde_control
import rtde_receive

from hal.errors import ConnectionLost, Fault
from hal.host.library_thread import LibraryThread
from hal.host.scheduling import note_threads
from hal.lock import DeviceLock
from hal.preflight import probe_ports

from .faults import LOCAL, NO_CONTROLLER, NOT_STARTED, OTHER_PROGRAM, PLAYING, REGISTERS_TAKEN, STOPPED
from .settings import UrSettings

__all__ = ["WATCHDOG_HZ", "UrLink", "probe"]

RTDE, DASHBOARD, SCRIPTS = 30004, 29999, 30002
WATCHDOG_HZ = 8.0
"""The controller ends the control program if nothing comes for the inverse of this: 125 ms."""
_KICK = 0.02
"""Time after which the watchdog is kicked if no set-point was sent, s."""
_START = 0.8
"""Longest time until the control program runs, s."""
_ENDING = 1.0
"""Time for which the end of a program that was ours is tried, s."""
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


def probe(host: str) -> str:
    """Return why a controller does not answer, naming the port; an empty text if it does."""
    return probe_ports(host, {DASHBOARD: b"", RTDE: b"\0\5V\0\2", SCRIPTS: None})


class UrLink(LibraryThread):
    """A connection: ``ready`` is whether the control program runs. Without a ``tcp`` the installation's stays."""

    LIBRARY: ClassVar[str] = "ur_rtde"
    NOT_STARTED: ClassVar[Fault] = NOT_STARTED

    def __init__(self, name: str, settings: UrSettings, rate_hz: float, tcp: list[float] | None) -> None:
        super().__init__(name)
        self.settings, self.rate_hz, self.tcp = settings, rate_hz, tcp
        self.receive: Any = None
        """ur_rtde's RTDEReceiveInterface; None until open."""
        self.local = False
        """Whether the controller was in local control when that was last asked."""
        self.longest_gap = 0.0
        """Longest time between two messages since the program started, s."""
        self.t_late = 0.0
        """When this computer was last silent for nearly as long as the watchdog allows, s."""
        self.version, self.rate, self.has_payload = "", 0.0, False
        """Of the controller: PolyScope, cycles in a second, and whether it reports the payload."""
        self._ours = False
        """Whether the program that runs is ours."""
        self._end_by = 0.0
        """Until when a program that was ours is to be ended, s."""

    # Called by the cycle.

    def open(self) -> None:
        """Connect. Raises ConnectionLost and ControlTaken."""
        host = self.settings.host
        self.reserve(DeviceLock(f"ur-{host}", f"the arm at {host}", patience=1.0))
        if why := probe(host):
            raise ConnectionLost.of(self.name, replace(NO_CONTROLLER, cause=why))
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
            raise ConnectionLost.of(self.name, replace(NO_CONTROLLER, cause=str(error))) from error
        _kept.extend((self._dashboard, self.receive, self._control))
        self.lose()
        self._end_by = 0.0
        receive, control = self.receive, self._control
        self.begin(lambda ended: self._turn(receive, control, ended), lambda: self._disconnect(receive, control))

    def send(self, q: list[float]) -> None:
        """Send a set-point soon; a newer one replaces one that is waiting."""
        with self._wake:
            self._target = q
            self._wake.notify()

    def note_stopped(self) -> None:
        """Note that no program is running, or that it is paused."""
        if not self.starting:
            self.end()

    def end(self) -> None:
        """End the control program soon: one that is left running, or resumes, still moves to its last set-point."""
        with self._wake:
            if self._ours:
                self.ready, self._ours, self._end_by = False, False, time.monotonic() + _ENDING
                self._wake.notify()

    def ask_remote(self) -> None:
        self.call(self._ask_remote)

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

        self.finish(unlock, _ANSWER)
        return answers[0] if answers else "the dashboard does not answer in time, and may unlock it late: keep away"

    def ask_local(self) -> bool | None:
        """Return whether the controller is in local control; None if it does not say. Blocks for at most 3 s."""
        return self.local if self.finish(lambda _: self._ask_remote(), _ANSWER) else None

    def lose(self) -> None:
        """Note that the controller is silent: its watchdog ends our program."""
        super().lose()
        self._ours = False

    def close(self) -> None:
        """End the control program, and disconnect. Idempotent."""
        super().close()
        self.receive = None

    # The thread.

    @property
    def busy(self) -> bool:
        return time.monotonic() < self._end_by  # the end of a program comes first, and is tried again

    def _turn(self, receive: Any, control: Any, ended: threading.Event) -> None:
        if not receive.isConnected() or not control.isConnected():
            self.lose()
            self._reconnect(receive, control, ended)
            return
        before = time.monotonic()
        job, target = self.take(_KICK)
        self._note_gap(time.monotonic() - before)
        if job is not None:
            self._reach_dashboard()
            job()
        elif self.busy:
            self._end_program()
        elif self.ready:
            self._serve(control, target)

    def _disconnect(self, receive: Any, control: Any) -> None:
        if self.busy and control.isConnected():
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

    def abandon(self) -> None:
        self._end_by = time.monotonic() + _ENDING

    def prepare(self) -> Fault | None:
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
