"""A thread that makes the calls of a vendor's library for an arm: the cycle must not wait for them."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable
from math import inf
from typing import ClassVar

from ..errors import Fault
from ..lock import DeviceLock
from .scheduling import note_threads

_STALE = 1.0
"""Time after which a request to get ready is not carried out any more, s: the session that wanted it has given up."""
_END = 4.0
"""Longest time that its end takes, s."""

Job = Callable[[], object]


class LibraryThread:
    """The base of a driver's link. The cycle and the thread share it."""

    LIBRARY: ClassVar[str]
    """Name of the library, for messages."""
    NOT_STARTED: ClassVar[Fault]
    """Of an arm that did not get ready for set-points."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.ready = False
        """Whether the arm takes set-points."""
        self.t_ready = -inf
        """When the newest attempt to make it ready ended, s."""
        self.refused: Fault | None = None
        """Why it did not get ready."""
        self.sent: list[float] | None = None
        """The newest set-point that was sent since it got ready, rad; None for none."""
        self._wake = threading.Condition()
        self._jobs: list[Job] = []
        self._target: list[float] | None = None
        self._asked: float | None = None
        """When the start that is under way was asked for, s; None for none."""
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        self._lock: DeviceLock | None = None

    # Called by the cycle.

    def reserve(self, lock: DeviceLock) -> None:
        """Keep a lock until :meth:`close`."""
        self._lock = lock

    def begin(self, turn: Callable[[threading.Event], None], leave: Job) -> None:
        """Start the thread: ``turn`` again and again, with an event that is set once it has to end, then ``leave``."""
        self.refused, self._jobs = None, []
        ended = self._ended = threading.Event()

        def run() -> None:
            while not ended.is_set():
                try:
                    turn(ended)
                except Exception as error:  # such as an answer that the library cannot read
                    print(f"{self.name}: {self.LIBRARY}: {type(error).__name__}: {error}", file=sys.stderr)
                    self.fail(ended)
            with contextlib.suppress(Exception):
                leave()

        with note_threads():
            self._thread = threading.Thread(target=run, name=f"{self.LIBRARY}-{self.name}", daemon=True)
            self._thread.start()

    def start(self) -> None:
        """Make the arm ready soon: then ``ready`` is True, or ``refused`` says why not."""
        asked = self._asked = time.monotonic()
        self.ready, self.refused = False, None
        self.call(lambda: self._start(asked))

    @property
    def starting(self) -> bool:
        """Whether the arm is being made ready."""
        return self._asked is not None

    def call(self, job: Job) -> None:
        """Do a job soon."""
        with self._wake:
            self._jobs.append(job)
            self._wake.notify()

    def finish(self, job: Callable[[threading.Event], object], timeout: float) -> bool:
        """Wait until the thread has done a job; return whether it has.

        Args:
            job: Gets an event that is set once nobody waits any more. Then it is not begun.
            timeout: Longest wait, s.
        """
        over, given_up, done = threading.Event(), threading.Event(), []

        def run() -> None:
            try:
                if not given_up.is_set():
                    job(given_up)
                    done.append(True)
            finally:
                over.set()

        self.call(run)
        if not over.wait(timeout):
            given_up.set()
        return bool(done)

    def lose(self) -> None:
        """Note that the controller is silent: what it does is no longer known."""
        with self._wake:
            self.ready, self._asked, self._target = False, None, None

    def close(self) -> None:
        """End the thread, and give the arm free. Idempotent."""
        with self._wake:
            self._ended.set()
            self._wake.notify()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_END)
        self.lose()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    # The thread.

    @property
    def busy(self) -> bool:
        """Whether jobs and set-points have to wait."""
        return False

    def fail(self, ended: threading.Event) -> None:
        """Do what an error of the library needs."""
        self.lose()

    def prepare(self) -> Fault | None:
        """Make the arm ready for set-points; return why that was not possible."""
        raise NotImplementedError

    def abandon(self) -> None:
        """Undo :meth:`prepare`, as nobody wants it any more."""

    def take(self, patience: float) -> tuple[Job | None, list[float] | None]:
        """Return what waits, for which it waits itself at most ``patience`` s: a job, or else the newest set-point."""
        with self._wake:
            if not self._jobs and self._target is None:
                self._wake.wait(patience)
            if self.busy:
                self._target = None
            elif self._jobs:
                return self._jobs.pop(0), None
            target, self._target = self._target, None
            return None, target

    def _start(self, asked: float) -> None:
        if asked != self._asked:  # the connection was lost meanwhile
            return
        refused: Fault | None = self.NOT_STARTED
        try:
            if time.monotonic() - asked < _STALE:
                refused = self.prepare()
        finally:
            with self._wake:
                if asked == self._asked:
                    self.ready, self.t_ready = refused is None, time.monotonic()
                    self.refused, self._asked = refused, None
                elif refused is None:
                    self.abandon()
