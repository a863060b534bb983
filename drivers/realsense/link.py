"""The app's side of a camera's process: requests with time limits, pictures, and an end whatever that process does."""

from __future__ import annotations

import threading
import time
from typing import Any

from hal.driver import CameraTally, RawFrame
from hal.errors import ConnectionLost
from hal.host.process import Child, SharedMemory, unpack_error
from hal.specs import CameraSpec, to_json

from .ring import PictureRing

__all__ = ["CameraLink"]

_READY = 30.0
"""s for the process to start, and in it to import the library."""
_SLICE = 0.05
"""s that one thread listens before another one has a turn."""
_PATIENCE = 1.0
"""s for a process to end by itself."""


class CameraLink:
    """One process with one camera in it. Any thread may call anything."""

    def __init__(self, spec: CameraSpec) -> None:
        """Raises DriverMissing where the library is not installed."""
        self._memory = SharedMemory(PictureRing.size(spec))
        self._ring = PictureRing(self._memory.buffer, spec)
        self._child = Child(
            f"camera {spec.name}", "hal.drivers.realsense.process:main", {"spec": to_json(spec)}, [self._memory]
        )
        self._listening = threading.Lock()
        self._asking = threading.Lock()
        self._taking = threading.Lock()
        self._number = 0
        self._answers: dict[int, dict[str, Any]] = {}
        self._after = 0
        """Number of the last picture that was taken."""
        self._quiet = 0.0
        self.lost = ""
        """Why the camera is gone, in the process's words."""
        self.is_final = False
        """Will it never come back, because it was a recording that has ended?"""
        try:
            self._child.wait_ready(_READY)
        except BaseException:
            self.end()
            raise

    @property
    def alive(self) -> bool:
        """Is the process there?"""
        return self._child.process.poll() is None

    @property
    def quiet(self) -> float:
        """For how long pictures were waited for in which the process said nothing, s."""
        return self._quiet

    @property
    def tally(self) -> CameraTally:
        """What was not handed out since the process began."""
        return self._ring.tally

    def ask(self, method: str, timeout: float, **params: Any) -> Any:
        """Have something done, and wait for the answer; an error there is raised here.

        Raises ConnectionLost when the process is gone, or gives no answer in time: then it hangs, and must be ended.
        """
        with self._asking:
            self._number += 1
            number = self._number
            self._child.check()
            self._child.channel.send({"id": number, "method": method, "params": params}, timeout)
        deadline = time.monotonic() + timeout
        while number not in self._answers:
            self._listen(min(_SLICE, max(0.0, deadline - time.monotonic())))
            if time.monotonic() > deadline and number not in self._answers:
                raise ConnectionLost(f"the camera's process did not answer {method!r} within {timeout:g} s: it hangs")
        answer = self._answers.pop(number)
        if "error" in answer:
            raise unpack_error(answer["error"])
        return answer["result"]

    def begin(self, before: int) -> None:
        """A session began: pictures up to the number ``before`` are not of it."""
        self._after, self._quiet, self.lost = before, 0.0, ""

    def take(self, timeout: float, every: bool) -> RawFrame | None:
        """The newest picture that was not taken, or each one in turn; None when none came within ``timeout`` s.

        Where each one counts, its time is the present: it may have waited for minutes to be asked for.
        Raises ConnectionLost when the process is gone.
        """
        deadline = time.monotonic() + timeout
        listened = False
        while True:
            with self._taking:  # else two threads would take one picture, and the slower one go back to it
                taken = self._ring.take(self._after, every)
                if taken is not None:
                    self._after, frame = taken
                    self._quiet = 0.0
                    return frame._replace(t=time.monotonic()) if every else frame
            now = time.monotonic()
            if self.lost or (listened and now >= deadline):
                return None
            if self._listen(min(_SLICE, max(0.0, deadline - now))):
                self._quiet = 0.0
            else:
                self._quiet += min(time.monotonic() - now, 2.0 * _SLICE)
            listened = True

    def _listen(self, timeout: float) -> bool:
        """Take in one message; whichever thread waits for one does it. False where none came."""
        if not self._listening.acquire(timeout=max(timeout, 1e-3)):
            return False
        try:
            message = self._child.channel.receive(timeout)
        except ConnectionLost:
            self._child.process.wait(_PATIENCE)
            self._child.check()
            raise
        finally:
            self._listening.release()
        if message is None:
            self._child.check()
            return False
        if "id" in message:
            self._answers[message["id"]] = message
        elif "lost" in message:
            self.lost, self.is_final = message["lost"], message["final"]
        return True

    def end(self, timeout: float = _PATIENCE) -> None:
        """End the process, by force when it does not end by itself. Idempotent."""
        self._child.close(timeout)
        self._memory.close()
