"""Workers of ``hal generate`` on a Ray cluster (``pip install 'robot-hal[ray]'``)."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from contextlib import suppress
from types import TracebackType
from typing import Any

from ..errors import ConnectionLost, DriverMissing
from ..host.process import unpack_error
from .episode_worker import EpisodeResult, EpisodeWorker
from .generate import LONGEST, WorkerHandle

__all__ = ["RayCluster", "RayWorker"]

_STORE = 80_000_000
"""Memory for Ray's objects on a cluster that is started here, bytes: close to Ray's least. Results are small."""


_CLOSING = 60.0
"""Time in which a worker must have closed its dataset, s."""


class RayCluster:
    """A connection to a Ray cluster, to be used in a ``with`` statement.

    Args:
        address: Of the cluster, as :func:`ray.init` takes it; ``local`` starts one on this computer, with neither
            dashboard nor usage statistics, which ends with the statement.
        workers: Number of workers that it must have room for, if it is started here.

    Raises:
        DriverMissing: Ray is not installed.
        ConnectionLost: The cluster does not answer (code ``no_cluster``).
    """

    def __init__(self, address: str, workers: int) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when Ray is imported
        try:
            import ray
        except ImportError as error:
            raise DriverMissing("ray is not installed: pip install 'robot-hal[ray]'", name="ray") from error
        self._ray: Any = ray
        own: dict[str, Any] = {}
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        if address == "local":
            self._folder = tempfile.TemporaryDirectory(prefix="hal-ray-", ignore_cleanup_errors=True)
            own = {
                "_temp_dir": self._folder.name,
                "num_cpus": workers,
                "include_dashboard": False,
                "object_store_memory": _STORE,
                "_node_ip_address": "127.0.0.1",
            }
        try:
            ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **own)
        except Exception as error:
            raise ConnectionLost(f"--ray {address}: {error}", code="no_cluster") from error

    def __enter__(self) -> RayCluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ray.shutdown()
        if self._folder is not None:
            self._folder.cleanup()

    def start_worker(self, recipe: dict[str, Any], folder: str, index: int) -> RayWorker:
        """Start a worker; see :data:`~hal.learning.generate.StartWorker`."""
        return RayWorker(self._ray, recipe, folder)


class RayWorker(WorkerHandle):
    """A worker in a process of a Ray cluster, on one of its processors."""

    def __init__(self, ray: Any, recipe: dict[str, Any], folder: str) -> None:
        self._ray = ray
        path = [os.path.abspath(entry) for entry in sys.path]
        self._actor = ray.remote(num_cpus=1, max_restarts=0)(EpisodeWorker).remote(recipe, folder, path)

    def make(self, number: int) -> EpisodeResult:
        """Make an episode; see :meth:`.WorkerHandle.make`."""
        try:
            answer = self._ray.get(self._actor.make_packed.remote(number), timeout=LONGEST)
        except self._ray.exceptions.RayActorError as error:
            raise ConnectionLost(f"the worker's process ended: {error}", code="process_ended") from error
        except self._ray.exceptions.GetTimeoutError as error:
            raise ConnectionLost(f"the worker made no episode within {LONGEST:g} s", code="process_silent") from error
        if "error" in answer:
            raise unpack_error(answer["error"])
        return EpisodeResult(**answer["result"])

    def kill(self) -> None:
        """End the process at once."""
        self._ray.kill(self._actor)

    def close(self) -> None:
        """End the recorder of the worker, then its process."""
        with suppress(self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError):
            self._ray.get(self._actor.close.remote(), timeout=_CLOSING)
        self.kill()
