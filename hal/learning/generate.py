"""Generate a dataset: seeded episodes of a policy or a scripted skill, on several workers at once.

Each worker (:mod:`hal.learning.episode_worker`) records into a dataset of its own, in ``OUT.parts/``, or uploads its
episodes (:mod:`hal.learning.uploads`). What is there is the only record of what is done: an interrupted run continues,
and the episode of a worker that died is made again. At the end the parts are merged into ``OUT``, in the order of the
episodes' numbers.
"""

from __future__ import annotations

import json
import shutil
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import CommandError, ConnectionLost, HalError
from ..host.process import Child
from ..recording.layout import DatasetLayout, require_libraries
from ..recording.merging import merge
from .episode_worker import EpisodeRecipe, EpisodeResult, check_recipe, clean_part
from .uploads import UploadedEpisodes

_DEATHS = 3
"""Number of workers that may die while they make the same episode."""
LONGEST = 3600.0
"""A worker that needs longer for an episode counts as dead, s of wall-clock time."""
_START = 120.0
"""Longest time in which a worker must be ready, s: importing a policy may take a while."""
_WRITING = 60.0
"""Time that the recorder of a dead worker may take to finish, s."""
_UPDATE = 0.2
"""Period of the calls of ``on_progress``, s."""


class EpisodeFailed(HalError):
    """An episode cannot be made. The episodes that are finished are kept, and the run can be continued."""

    code = "episode_failed"

    def __init__(self, message: str, *, episode: int, seed: int, code: str | None = None) -> None:
        super().__init__(f"episode {episode} (seed {seed}): {message}", code=code)
        self.episode = episode
        """Number of the episode."""
        self.seed = seed
        """Its seed."""


class GenerateProgress(NamedTuple):
    """State of a run."""

    done: int
    """Finished episodes, those of earlier runs included."""
    total: int
    succeeded: int
    """Finished episodes that were judged a success."""
    judged: int
    """Finished episodes that were judged."""
    rate: float
    """Episodes per second in this run; 0 before the first."""
    left: float | None
    """Time to the last episode at that rate, s; None before the first."""
    restarts: int
    """Workers that died and were replaced."""
    waiting: int = 0
    """Workers that have not started yet, such as those that a cluster has no room for."""


class WorkerHandle(ABC):
    """A worker, as the program sees it. One thread calls :meth:`make`; any thread may call :meth:`kill`."""

    def wait_ready(self) -> None:  # noqa: B027  # most are ready when they are made
        """Block until the worker can make episodes, however long that takes.

        Raises:
            ConnectionLost: The worker died, or :meth:`kill` was called.
            HalError: Whatever prevents every worker from starting.
        """

    @abstractmethod
    def make(self, number: int) -> EpisodeResult:
        """Make an episode.

        Raises:
            ConnectionLost: The worker is dead, or cannot record.
            HalError: Whatever making the episode raised.
        """

    @abstractmethod
    def kill(self) -> None:
        """End the worker at once. Idempotent."""

    @abstractmethod
    def close(self) -> None:
        """End the worker, which is idle. Idempotent."""


StartWorker = Callable[[dict[str, Any], str, int], WorkerHandle]
"""Starts a worker: of the recipe's fields, the folder of its dataset or the address for uploads, and its number."""


class LocalWorker(WorkerHandle):
    """A worker in a process of this computer, which ends with this program."""

    def __init__(self, recipe: dict[str, Any], folder: str, index: int) -> None:
        config = {"recipe": recipe, "folder": folder}
        self._child = Child(f"worker {index}", "hal.learning.episode_worker:main", config)
        try:
            self.pid = int(self._child.wait_ready(_START))
            """Its process."""
        except BaseException:
            self.kill()
            self.close()
            raise

    def make(self, number: int) -> EpisodeResult:
        """Make an episode; see :meth:`WorkerHandle.make`."""
        return EpisodeResult(**self._child.request("make", {"number": number}, LONGEST))

    def kill(self) -> None:
        """End the process at once."""
        self._child.process.kill()
        self._child.process.wait()

    def close(self) -> None:
        """End the process."""
        self._child.close()


def parts_folder(out: str | Path) -> Path:
    """Return the folder of the workers' datasets while a dataset is generated."""
    root = DatasetLayout(out).root
    return root.with_name(f"{root.name}.parts")


def generate(
    recipe: EpisodeRecipe,
    out: str | Path,
    episodes: int,
    *,
    workers: int = 1,
    upload: str | None = None,
    start_worker: StartWorker = LocalWorker,
    on_progress: Callable[[GenerateProgress], object] = lambda progress: None,
    on_event: Callable[[str], object] = lambda text: None,
) -> list[EpisodeResult]:
    """Generate a dataset of the episodes 0 to ``episodes - 1``, or the rest of one.

    Episode k has the seed ``recipe.seed + k``. Its rows are the same whatever the number of workers.

    Args:
        recipe: What the episodes are.
        out: Folder of the dataset. One that was generated with the same recipe is extended.
        episodes: Number of episodes in the dataset.
        workers: Number of workers. Those that have no place when the last episode begins are not needed.
        upload: Address of :mod:`hal.learning.uploads`, of this run alone, to which workers upload their episodes; the
            datasets of the workers are then in temporary folders. None for workers that share the folder beside
            ``out`` with this program.
        start_worker: Starts a worker; called from several threads.
        on_progress: Called about every 0.2 s, and at the end.
        on_event: Called with a line of text, from several threads, when a worker is replaced.

    Returns:
        The results of the episodes that were made in this call.

    Raises:
        EpisodeFailed: The user's code raised an error in an episode (code ``episode_failed``), or workers died again
            and again while they made it (``worker_dies``).
        CommandError: The folder has other content, or was generated with another recipe (code ``other_recipe``).
        DriverMissing: A library is not installed.
        HalError: A worker cannot be started, or cannot record; or the address cannot be used.
    """
    require_libraries()
    run = _GenerateRun(recipe, out, episodes, upload, start_worker, on_event)
    made = run.make_missing(workers, on_progress)
    run.merge_parts()
    return made


class _GenerateRun:
    """One run: what is done, what is left, and the threads that each drive one worker."""

    def __init__(
        self,
        recipe: EpisodeRecipe,
        out: str | Path,
        episodes: int,
        upload: str | None,
        start_worker: StartWorker,
        on_event: Callable[[str], object],
    ) -> None:
        self._seed = recipe.seed
        self._recipe: dict[str, Any] = json.loads(json.dumps(asdict(recipe)))
        self._out = DatasetLayout(out).root
        self._parts = parts_folder(out)
        self._uploads = None if upload is None else UploadedEpisodes(upload, self._recipe)
        self._start_worker, self._on_event = start_worker, on_event
        self._marks = self._find_done()
        """Number of a finished episode -> its mark."""
        if (beyond := max(self._marks, default=-1)) >= episodes:
            raise CommandError(
                f"{self._out} has episodes up to number {beyond} already; ask for at least {beyond + 1}",
                code="fewer_episodes",
            )
        self._total = episodes
        self._left = [number for number in range(episodes) if number not in self._marks]
        self._left.reverse()  # the next one is the last of the list
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._results: list[EpisodeResult] = []
        self._handles: dict[int, WorkerHandle] = {}
        self._waiting: set[int] = set()
        """Workers that have not been ready yet, and make no episode."""
        self._restarts = 0
        self._started_at: float | None = None

    def _find_done(self) -> dict[int, bool | None]:
        """Return the episodes that earlier runs finished. Raises CommandError for a folder with other content."""
        known = DatasetLayout(self._out).info.exists() or not self._out.exists()
        if not known and not (self._out.is_dir() and not any(self._out.iterdir())):
            raise CommandError(f"{self._out} holds no generated dataset; choose a new folder", code="output_exists")
        found: dict[int, bool | None] = {}
        if self._uploads is not None:
            check_recipe(self._uploads.address, self._uploads.recipe, self._recipe)
            found = self._uploads.marks()
        for folder in (self._out, *self._part_folders()):
            found |= clean_part(folder, self._recipe)
        return found

    def _part_folders(self) -> list[Path]:
        return sorted(self._parts.glob("worker-*"))

    def make_missing(self, workers: int, on_progress: Callable[[GenerateProgress], object]) -> list[EpisodeResult]:
        count = min(workers, len(self._left))
        if count:
            self._parts.mkdir(parents=True, exist_ok=True)
        threads = [
            threading.Thread(target=self._drive, args=(index,), name=f"hal-generate-{index}", daemon=True)
            for index in range(count)
        ]
        try:
            for thread in threads:
                thread.start()
            while any(thread.is_alive() for thread in threads):
                on_progress(self._progress())
                self._stop_wait(threads)
        except BaseException:  # Ctrl-C
            self._abort()
            for thread in threads:
                thread.join()
            raise
        on_progress(self._progress())
        if self._error is not None:
            raise self._error
        return sorted(self._results, key=lambda result: result.number)

    def _stop_wait(self, threads: list[threading.Thread]) -> None:
        end = time.monotonic() + _UPDATE
        for thread in threads:
            thread.join(max(0.0, end - time.monotonic()))

    def _progress(self) -> GenerateProgress:
        with self._lock:
            done, made, marks = len(self._marks), len(self._results), [*self._marks.values()]
            begun, restarts, waiting = self._started_at, self._restarts, len(self._waiting)
        spent = time.monotonic() - begun if begun is not None else 0.0
        rate = made / spent if made and spent > 0.0 else 0.0
        left = (self._total - done) / rate if rate else None
        judged = len(marks) - marks.count(None)
        return GenerateProgress(done, self._total, marks.count(True), judged, rate, left, restarts, waiting)

    # One worker.

    def _drive(self, index: int) -> None:
        """Make episodes with one worker after the other, until none is left or the run fails."""
        try:
            if self._start_first(index):
                while (number := self._take()) is not None:
                    self._make(index, number)
            with self._lock:
                handle = self._handles.pop(index, None)
            if handle is not None:
                handle.close()
        except BaseException as error:
            with self._lock:
                self._error = self._error or error
            self._stop.set()  # the others finish the episodes that they are making
            self._kill_unneeded()
            self._drop(index)

    def _start_first(self, index: int) -> bool:
        """Start the first worker of this number. Return False if it had no place until it was not needed any more."""
        with self._lock:
            self._waiting.add(index)
        try:
            for death in range(1, _DEATHS + 1):
                try:
                    self._handle(index)
                    return True
                except ConnectionLost as lost:
                    self._drop(index)
                    if self._is_over():
                        return False
                    if death == _DEATHS:
                        raise
                    self._note_restart(f"worker {index} died before it was ready, and is started again: {lost}")
            return False
        finally:
            with self._lock:
                self._waiting.discard(index)

    def _is_over(self) -> bool:
        """Return whether no episode has to be begun any more."""
        with self._lock:
            return self._stop.is_set() or not self._left

    def _take(self) -> int | None:
        with self._lock:
            number = None if self._stop.is_set() or not self._left else self._left.pop()
        self._kill_unneeded()
        return number

    def _kill_unneeded(self) -> None:
        """End the workers that are not ready yet, if no episode has to be begun any more."""
        if self._is_over():
            with self._lock:
                handles = [self._handles[index] for index in self._waiting & self._handles.keys()]
            for handle in handles:
                handle.kill()

    def _make(self, index: int, number: int) -> None:
        """Make one episode, again if the worker dies."""
        for death in range(1, _DEATHS + 1):
            try:
                result = self._handle(index).make(number)
            except ConnectionLost as lost:
                self._drop(index)
                if self._stop.is_set():
                    return
                marks = self._marks_after_death(index)
                if number in marks:  # it was being saved when the worker died
                    result = EpisodeResult(number, self._seed + number, marks[number], "saved")
                elif death == _DEATHS:
                    raise EpisodeFailed(
                        f"{_DEATHS} workers died while they made it: {lost}",
                        episode=number,
                        seed=self._seed + number,
                        code="worker_dies",
                    ) from lost
                else:
                    self._note_restart(f"worker {index} died in episode {number}, which is made again")
                    continue
            if result.ended == "error":
                raise EpisodeFailed(result.reason, episode=number, seed=result.seed)
            with self._lock:
                self._marks[number] = result.success
                self._results.append(result)
            return

    def _marks_after_death(self, index: int) -> dict[int, bool | None]:
        """Return the finished episodes among those that a dead worker may have made.

        Without uploads, :func:`.clean_part` is called when the worker's recorder has finished what it had received.
        """
        if self._uploads is not None:
            return self._uploads.marks()
        end = time.monotonic() + _WRITING
        while True:
            try:
                return clean_part(self._part(index), self._recipe)
            except CommandError as error:
                if error.code != "dataset_locked" or time.monotonic() > end:
                    raise
            time.sleep(_UPDATE)

    def _part(self, index: int) -> Path:
        return self._parts / f"worker-{index:04d}"

    def _handle(self, index: int) -> WorkerHandle:
        """Return the worker of this number when it is ready; start it if there is none."""
        handle = self._handles.get(index)
        if handle is not None:
            return handle
        place = str(self._part(index)) if self._uploads is None else self._uploads.address
        handle = self._start_worker(self._recipe, place, index)
        with self._lock:
            self._handles[index] = handle
        if self._stop.is_set() or (index in self._waiting and self._is_over()):  # during the start
            handle.kill()
        handle.wait_ready()
        with self._lock:
            self._started_at = self._started_at or time.monotonic()
        return handle

    def _note_restart(self, text: str) -> None:
        with self._lock:
            self._restarts += 1
        self._on_event(text)

    def _drop(self, index: int) -> None:
        """End a worker that is dead or not wanted any more."""
        with self._lock:
            handle = self._handles.pop(index, None)
        if handle is not None:
            handle.kill()
            handle.close()

    def _abort(self) -> None:
        """End all workers at once. Episodes that they are making are removed when the run is continued."""
        self._stop.set()
        with self._lock:
            handles = list(self._handles.values())
        for handle in handles:
            handle.kill()

    def merge_parts(self) -> None:
        """Merge the workers' datasets, and what earlier runs merged, into the result; then remove the parts."""
        parts = [part for part in self._part_folders() if DatasetLayout(part).info.exists()]
        if self._uploads is not None:
            downloads = self._parts / "uploaded"
            shutil.rmtree(downloads, ignore_errors=True)  # those of a run that was interrupted here
            parts += self._uploads.download(downloads)
        if parts:
            have = [self._out] if DatasetLayout(self._out).info.exists() else []
            merge([*have, *parts], self._out, key=lambda episode: int(episode.info["info"]["episode"]))
        shutil.rmtree(self._parts, ignore_errors=True)
        if self._uploads is not None:
            self._uploads.remove()
