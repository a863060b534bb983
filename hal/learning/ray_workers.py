"""Workers of ``hal generate`` on a Ray cluster (``pip install 'robot-hal[ray]'``)."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from ..errors import CommandError, ConnectionLost, import_library
from ..host.process import pack_error, unpack_error
from .episode_worker import EpisodeResult, EpisodeWorker
from .generate import LONGEST, StartWorker, WorkerHandle

_STORE = 80_000_000
"""Memory for Ray's objects on a cluster that is started here, bytes: close to Ray's least. Results are small."""
_START = 120.0
"""Longest time in which a worker that has a place must be ready, s: importing a policy may take a while."""
_CLOSING = 60.0
"""Time in which a worker must have closed its dataset, s."""


@contextmanager
def join_cluster(
    address: str, workers: int, *, gpus: float = 0.0, runtime_env: Mapping[str, Any] | None = None
) -> Iterator[StartWorker]:
    """Connect to a Ray cluster for a ``with`` statement; yield the function that starts a worker there.

    Args:
        address: Of the cluster, as :func:`ray.init` takes it; ``local`` starts one on this computer, with neither
            dashboard nor usage statistics, which ends with the statement.
        workers: Number of workers that it must have room for, if it is started here.
        gpus: Graphics cards of each worker; 0.25 is a quarter of one. Ray shows a worker no others.
        runtime_env: Ray's description of what the workers need: ``working_dir``, ``pip``, ``env_vars`` ...

    Raises:
        DriverMissing: Ray is not installed.
        ConnectionLost: The cluster does not answer (code ``no_cluster``).
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when Ray is imported
    ray = import_library("ray", "--ray", "robot-hal[ray]")
    own: dict[str, Any] = {"runtime_env": dict(runtime_env)} if runtime_env else {}
    with ExitStack() as closing:
        if address == "local":
            folder = tempfile.TemporaryDirectory(prefix="hal-ray-", ignore_cleanup_errors=True)
            own |= {
                "_temp_dir": closing.enter_context(folder),
                "num_cpus": workers,
                "include_dashboard": False,
                "object_store_memory": _STORE,
                "_node_ip_address": "127.0.0.1",
            }
        try:
            ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **own)
        except Exception as error:
            raise ConnectionLost(f"--ray {address}: {error}", code="no_cluster") from error
        closing.callback(ray.shutdown)
        yield lambda recipe, folder, index: RayWorker(ray, recipe, folder, gpus)


class RayWorker(WorkerHandle):
    """A worker in a process of a Ray cluster, on one of its processors, as soon as there is room for it."""

    def __init__(self, ray: Any, recipe: dict[str, Any], folder: str, gpus: float = 0.0) -> None:
        self._ray = ray
        self._config = recipe, folder, [os.path.abspath(entry) for entry in sys.path], os.getcwd()
        self._actor = ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=0)(_EpisodeActor).remote()

    def wait_ready(self) -> None:
        """Block until the cluster has had room for the worker, and it is ready; see :meth:`.WorkerHandle.wait_ready`.

        Raises:
            ConnectionLost: See there.
            CommandError: A node cannot make the runtime environment (code ``bad_runtime_env``), or as
                :class:`.EpisodeWorker`.
            DriverMissing: A node lacks a library.
        """
        try:
            self._ask(self._actor.is_there, None)
        except self._ray.exceptions.RuntimeEnvSetupError as error:
            raise CommandError(f"the runtime environment cannot be made: {error}", code="bad_runtime_env") from error
        self._ask(self._actor.start, _START, *self._config)

    def make(self, number: int) -> EpisodeResult:
        """Make an episode; see :meth:`.WorkerHandle.make`."""
        return EpisodeResult(**self._ask(self._actor.make, LONGEST, number))

    def _ask(self, method: Any, timeout: float | None, *arguments: Any) -> Any:
        """Return the answer of the worker. Raises its error, or ConnectionLost if it does not answer."""
        try:
            answer = self._ray.get(method.remote(*arguments), timeout=timeout)
        except self._ray.exceptions.RayActorError as error:
            raise ConnectionLost(f"the worker's process ended: {error}", code="process_ended") from error
        except self._ray.exceptions.GetTimeoutError as error:
            raise ConnectionLost(f"the worker did not answer within {timeout:g} s", code="process_silent") from error
        if "error" in answer:
            raise unpack_error(answer["error"])
        return answer["result"]

    def kill(self) -> None:
        """End the process at once."""
        self._ray.kill(self._actor)

    def close(self) -> None:
        """End the recorder of the worker, then its process."""
        with suppress(ConnectionLost):
            self._ask(self._actor.close, _CLOSING)
        self.kill()


class _EpisodeActor:
    """The process of a worker. Each method returns ``{"result": ...}``, or ``{"error": ...}`` as plain data."""

    def is_there(self) -> dict[str, Any]:
        return {"result": None}

    def start(self, *config: Any) -> dict[str, Any]:
        def start() -> None:
            self.worker = EpisodeWorker(*config)

        return _pack_result(start)

    def make(self, number: int) -> dict[str, Any]:
        return _pack_result(lambda: self.worker.make(number))

    def close(self) -> dict[str, Any]:
        return _pack_result(self.worker.close)


def _pack_result(call: Callable[[], Any]) -> dict[str, Any]:
    try:
        return {"result": call()}
    except Exception as error:
        return {"error": pack_error(error)}
