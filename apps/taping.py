"""A recorder for a program whose loop must not wait."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from hal.recording import Recorder, RecorderStatus

__all__ = ["Tape"]

T = TypeVar("T")


class Tape:
    """What takes long is done one after the other in a thread of its own; in lock-step at once, as time stands still.

    :meth:`start` and :meth:`discard` come back with a future, which has the error where there was one.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self._at_once = recorder.rig.lock_step
        self._thread = ThreadPoolExecutor(1, "hal-tape")

    def start(self, seed: int, info: Mapping[str, Any]) -> Future[None]:
        """Begin an episode, once the last one is saved."""
        return self._do(lambda: self.recorder.start(seed=seed, info=info))

    def save(self, success: bool | None) -> Future[RecorderStatus]:
        """End it now, and keep it; how many rows it has is known when that is done, later in any case.

        Raises CommandError where none is being recorded.
        """
        self.recorder.save(success)
        return self._thread.submit(self._saved)

    def _saved(self) -> RecorderStatus:
        self.recorder.wait_saved()
        return self.recorder.status()

    def discard(self) -> Future[None]:
        """Forget it."""
        return self._do(self.recorder.discard)

    def _do(self, what: Callable[[], T]) -> Future[T]:
        if not self._at_once:
            return self._thread.submit(what)
        done: Future[T] = Future()
        try:
            done.set_result(what())
        except Exception as error:
            done.set_exception(error)
        return done

    def keep(self) -> Future[RecorderStatus] | None:
        """End what is still being recorded and keep it, unmarked; None where nothing is."""
        self._do(lambda: None).result()  # a start that was under way is over
        return self.save(None) if self.recorder.status().state == "recording" else None

    def close(self) -> None:
        """Wait for all of that. May be called again where that was interrupted."""
        self._thread.shutdown()
        self.recorder.close()
