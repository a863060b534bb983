"""Many copies of one simulated environment as a Gymnasium ``VectorEnv``, spread over a few processes.

    from hal.gym import make_vec

    envs = make_vec("hal/PickCube-v0", 16)
    observations, infos = envs.reset(seed=1)
    observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())

Each process (:class:`~hal.host.process.Child`) holds several environments and steps them one after the other: a
servo in Python keeps one core busy, and a process costs more memory than a world. What every step takes and returns is
in memory that all share, the rest in messages. The processes end with the program, however it ends.
"""

from __future__ import annotations

import base64
import gc
import os
import pickle
import time
import traceback
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import pairwise
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import gymnasium
import numpy as np
from gymnasium.spaces import Dict, Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ..arguments import choice, integer
from ..errors import CommandError, ConnectionLost, HalError, NotSupported
from ..host.process import START_TIMEOUT, Channel, Child, SharedMemory, pack_error, serve, unpack_error
from . import gym
from .spaces import ObservationDict, entry_key

_LONGEST = 3600.0
"""Longest time of a call, s: functions of the user run in it."""
_CLOSE_TIMEOUT = 10.0
_AWAKE = 5e-4
"""A process that made a step awaits the next one so long without sleeping, s: waking up takes a tenth of a ms."""
_IDLE = 0.5
"""Longest sleep of a process, s, before it checks that the program is there."""

VectorResult = tuple[ObservationDict, dict[str, Any]]
VectorStep = tuple[ObservationDict, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


def make_vec(
    env: str | Callable[..., gymnasium.Env[Any, Any]],
    num_envs: int = 1,
    *,
    processes: int | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    **options: Any,
) -> RigVectorEnv:
    """Return copies of a simulated environment that step together, as a Gymnasium ``VectorEnv``.

    World ``k`` of ``reset(seed=s)`` is, to the bit, the environment with the seed ``s + k``.

    Args:
        env: Name of a registered environment such as ``hal/PickCube-v0``, or :class:`.RigEnv`, or a class of yours. A
            class that no module has is copied into the processes by cloudpickle.
        num_envs: Number of worlds.
        processes: Number of processes that share them; None for one per core.
        autoreset_mode: What follows the end of an episode, as in Gymnasium: ``NextStep`` resets that world in the next
            step, whose action it ignores; ``SameStep`` resets it at once, and the end is in ``infos["final_obs"]`` and
            ``infos["final_info"]``; ``Disabled`` leaves it to ``reset(options={"reset_mask": ...})``.
        options: Arguments of the environment, for example ``robot="fr3"``.

    Raises:
        CommandError: An argument is wrong.
        ConfigError: The rig file is wrong.
        NotSupported: The rig has real arms (code ``not_simulated``).
        DriverMissing: gymnasium is not installed.
    """
    processes = _cores() if processes is None else processes
    for name, count in (("num_envs", num_envs), ("processes", processes)):
        integer(name, count, least=1, code="bad_count")
    if not isinstance(autoreset_mode, AutoresetMode):
        choice("autoreset_mode", autoreset_mode, [mode.value for mode in AutoresetMode], "bad_autoreset")
    if callable(env):
        make = partial(env, **options)
    else:
        try:  # str: also of a rig file, or the data of one, which are no name
            make = partial(gymnasium.make, gymnasium.spec(str(env)), disable_env_checker=True, **options)
        except gymnasium.error.Error as error:
            text = f"{error} A class of environments is passed itself: make_vec(RigEnv, 4, rig={env!r})"
            raise CommandError(text, code="unknown_environment") from None
    return RigVectorEnv(make, int(num_envs), int(min(num_envs, processes)), AutoresetMode(autoreset_mode))


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class RigVectorEnv(VectorEnv[ObservationDict, NDArray[np.float32], NDArray[Any]]):
    """Worlds that step together; made by :func:`make_vec`.

    If a world raises an error, the others have finished that step, the error names the world, and the next ``reset``
    starts again. If a process is killed, all end. ``make`` makes one world; it is called in the processes.
    """

    def __init__(
        self, make: Callable[[], gymnasium.Env[Any, Any]], num_envs: int, processes: int, autoreset_mode: AutoresetMode
    ) -> None:
        self.num_envs = num_envs
        self._parts = [slice(*ends) for ends in pairwise(num_envs * k // processes for k in range(processes + 1))]
        """Worlds of each process."""
        self._children: list[Child] = []
        self._memory = SharedMemory()  # grows when the spaces are known
        self._finalizer = weakref.finalize(self, _close, self._children, self._memory)
        common = {"make": base64.b64encode(cloudpickle.dumps(make)).decode(), "mode": autoreset_mode.value}
        try:
            for part in self._parts:
                own = common | {"first": part.start, "end": part.stop, "count": num_envs}
                name = f"make_vec (worlds {part.start} to {part.stop - 1})"
                self._children.append(Child(name, "hal.learning.vector:main", own, [self._memory]))
            for child, part in zip(self._children, self._parts, strict=True):
                child.wait_ready(START_TIMEOUT * (part.stop - part.start))
            spaces = _unpack(self._children[0].ready)
            self.single_observation_space, self.single_action_space, self.metadata, self.render_mode, rendered = spaces
            self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
            self.observation_space = batch_space(self.single_observation_space, num_envs)
            self.action_space = batch_space(self.single_action_space, num_envs)
            self._rendered = rendered
            sizes = _WorldRecords.dtypes(*spaces[:2])
            os.ftruncate(self._memory.fd, num_envs * sum(size.itemsize for size in sizes))
            self._records = _WorldRecords(self._memory, sizes, num_envs)
            self._run("attach", [()] * processes)
        except BaseException:
            self.close()
            raise

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]  # as in AsyncVectorEnv
        """Copies of the worlds' random generators."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Seeds of the worlds."""
        return self.get_attr("np_random_seed")

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> VectorResult:
        """Reset all worlds, or those of ``options["reset_mask"]``.

        Args:
            seed: Seed of the first world, the others count on from it; or the seed of each. None continues the random
                sequence of each world.
            options: As for :meth:`.RigEnv.reset`, for all worlds alike; ``reset_mask`` (num_envs,) bool selects worlds.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise CommandError(f"reset_mask has shape ({self.num_envs},), bool, some True", code="bad_reset_mask")
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        elif len(seeds := list(seed)) != self.num_envs:
            raise CommandError(f"seed: {self.num_envs} seeds, not {len(seeds)}", code="bad_seed")
        answers = self._run("reset", [(mask[part], seeds[part], options) for part in self._parts])
        return self._batch(), self._infos([info for infos in answers for info in infos], {})

    def step(self, actions: NDArray[np.float32]) -> VectorStep:
        """Send an action to every world, (num_envs, numbers of an action); returns Gymnasium's five values.

        Raises:
            CommandError: ``reset`` was not called (code ``not_reset``), or the shape is wrong (``bad_action``).
            ConnectionLost: A process ended (code ``process_ended``); then all are closed.
        """
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape:
            raise CommandError(f"actions have shape {self.action_space.shape}, not {actions.shape}", code="bad_action")
        steps = self._records.steps
        try:
            steps["action"] = actions
        except (TypeError, ValueError) as error:
            raise CommandError(f"actions are numbers: {error}", code="bad_action") from None
        answers = self._request("step", [{}] * len(self._parts))
        elapsed = steps["elapsed"].copy()
        infos: dict[str, Any] = {"elapsed": elapsed, "_elapsed": ~np.isnan(elapsed)}
        for part, answer in zip(self._parts, answers, strict=True):
            if answer is not None:
                infos = self._infos(_unpack(answer), infos, part.start)
        results = (steps[name].copy() for name in ("reward", "terminated", "truncated"))
        return self._batch(), *results, infos

    def render(self) -> tuple[NDArray[np.uint8] | None, ...]:  # type: ignore[override]  # None without a camera
        """Return the newest colour picture (H, W, 3) of each world's first camera."""
        if self._rendered and not self.closed:
            return tuple(self._records.observations[self._rendered].copy())  # without a message
        return self.call("render")

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every world, or read an attribute of it; return the copied results, one for each world."""
        answers = self._run("call", [(name, args, kwargs)] * len(self._parts))
        return tuple(result for answer in answers for result in answer)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return copies of an attribute, one for each world."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every world: to one value each of a list or tuple, or all to the same value."""
        values = list(values) if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(values) != self.num_envs:
            raise CommandError(f"{name}: {self.num_envs} values, not {len(values)}", code="bad_count")
        self._run("set_attr", [(name, values[part]) for part in self._parts])

    def close_extras(self, **kwargs: Any) -> None:
        """Close every world and end the processes."""
        self._finalizer()

    def _batch(self) -> ObservationDict:
        return _copy_of(self._records.observations)

    def _infos(self, infos: Sequence[dict[str, Any]], found: dict[str, Any], first: int = 0) -> dict[str, Any]:
        """Return ``found`` with the infos of the worlds from the ``first`` one on, in Gymnasium's form.

        That is name -> an array, ``_name`` -> which worlds have it.
        """
        for k, info in enumerate(infos, first):
            if "final_obs" in info:
                info["final_obs"] = _copy_of(self._records.final[k])
            found = self._add_info(found, info, k)
        return found

    def _run(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Run a method in all processes at the same time, each with its own arguments; return their answers."""
        return [_unpack(answer) for answer in self._request(method, [{"data": _pack(own)} for own in arguments])]

    def _request(self, method: str, params: Sequence[dict[str, Any]]) -> list[Any]:
        """Send a request to all processes, each with its own parameters; return their answers."""
        if self.closed:
            raise HalError("the environments are closed", code="closed")
        answers: list[Any] = []
        errors: list[HalError] = []
        numbers: list[int] = []
        try:
            for child, own in zip(self._children, params, strict=True):
                numbers.append(child.send_request(method, own, _LONGEST))
            for child, number in zip(self._children, numbers, strict=True):
                try:
                    answers.append(child.wait_result(number, method, _LONGEST))
                except HalError as error:
                    child.check()
                    errors.append(error)
        except ConnectionLost:
            self.close()
            raise
        if errors:
            raise errors[0]
        return answers


def _close(children: Sequence[Child], memory: SharedMemory) -> None:
    for child in children:  # all at the same time
        with suppress(ConnectionLost):
            child.notify("close", timeout=0.5)
    for child in children:
        child.close(_CLOSE_TIMEOUT)
    memory.close()


def _pack(value: Any) -> str:
    return base64.b64encode(pickle.dumps(value)).decode()


def _unpack(text: str) -> Any:
    return pickle.loads(base64.b64decode(text))


class _WorldRecords:
    """Arrays (worlds,) in memory that all processes share: observations, and what else a step takes and returns."""

    def __init__(self, memory: SharedMemory, dtypes: Sequence[np.dtype[Any]], count: int) -> None:
        buffer, start, arrays = SharedMemory(fd=memory.fd).buffer, 0, []
        for dtype in dtypes:
            arrays.append(np.ndarray(count, dtype, buffer, start))
            start += count * dtype.itemsize
        self.observations: NDArray[Any] = arrays[0]
        """The newest one of each world."""
        self.final: NDArray[Any] = arrays[1]
        """The last one of the episode that ended."""
        self.steps: NDArray[Any] = arrays[2]
        """``action``, ``reward``, ``elapsed`` (of the infos), ``terminated`` and ``truncated`` of the newest step."""

    @staticmethod
    def dtypes(observation: Dict, action: Space[Any]) -> tuple[np.dtype[Any], ...]:
        """Return the types of the elements of :attr:`observations`, :attr:`final` and :attr:`steps`."""
        seen = np.dtype([(key, box.dtype, box.shape) for key, box in observation.items()], align=True)
        numbers = [("action", float, action.shape), ("reward", float), ("elapsed", float)]
        return seen, seen, np.dtype([*numbers, ("terminated", bool), ("truncated", bool)], align=True)


def _copy_of(records: NDArray[Any]) -> ObservationDict:
    return {key: records[key].copy() for key in records.dtype.names or ()}


# --- in the processes ------------------------------------------------------------------------------------------------


class _Worlds:
    """The worlds of one process."""

    def __init__(
        self, envs: Sequence[gymnasium.Env[Any, Any]], first: int, count: int, mode: AutoresetMode, memory: SharedMemory
    ) -> None:
        self._envs, self._first, self._mode = envs, first, mode
        self._order = list(range(len(envs)))
        self._ended = [False] * len(envs)
        self._stepped = 0.0
        self._memory, self._count = memory, count

    def attach(self) -> None:
        """Map the memory of the observations, which has its size now."""
        env = self._envs[0]
        assert isinstance(env.observation_space, Dict)
        dtypes = _WorldRecords.dtypes(env.observation_space, env.action_space)
        self._records = _WorldRecords(self._memory, dtypes, self._count)

    def reset(self, mask: Sequence[bool], seeds: Sequence[int | None], options: dict[str, Any]) -> list[dict[str, Any]]:
        """Reset the worlds of ``mask``; return the infos of all."""

        def reset(k: int) -> dict[str, Any]:
            if not mask[k]:
                return {}
            seen, info = self._envs[k].reset(seed=seeds[k], options=options)
            self._ended[k] = False
            self._write(self._records.observations, k, seen)
            return info

        return self._run_each(reset)

    def step(self) -> str | None:
        """Step every world; return their packed infos, without those in shared memory; None if nothing is left."""
        steps = self._records.steps[self._first : self._first + len(self._envs)]
        results = steps[["reward", "elapsed", "terminated", "truncated"]]

        def step(k: int) -> dict[str, Any]:
            env = self._envs[k]
            if self._mode is AutoresetMode.NEXT_STEP and self._ended[k]:
                seen, info = env.reset()
                reward, terminated, truncated = 0.0, False, False
            else:
                seen, paid, terminated, truncated, info = env.step(steps["action"][k].copy())
                reward = float(paid)
            self._ended[k] = terminated or truncated
            if self._mode is AutoresetMode.SAME_STEP and self._ended[k]:
                self._write(self._records.final, k, seen)
                final = {"final_info": info, "final_obs": None}  # read from memory
                seen, info = env.reset()
                info = final | info
            self._write(self._records.observations, k, seen)
            results[k] = reward, info.pop("elapsed", np.nan), terminated, truncated
            return info

        try:
            infos = self._run_each(step)
            return _pack(infos) if any(infos) else None
        finally:
            self._stepped = time.monotonic()

    def pause(self) -> float:
        """Return how long to sleep until the next message, s; right after a step not at all."""
        if time.monotonic() - self._stepped > _AWAKE:
            return _IDLE
        os.sched_yield()  # the program may need this core
        return 0.0

    def call(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> list[Any]:
        found = [env.get_wrapper_attr(name) for env in self._envs]
        return self._run_each(lambda k: found[k](*args, **kwargs) if callable(found[k]) else found[k])

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        for env, value in zip(self._envs, values, strict=True):
            env.set_wrapper_attr(name, value)

    def _write(self, records: NDArray[Any], k: int, seen: ObservationDict) -> None:
        for key, values in seen.items():
            records[key][self._first + k] = values

    def _run_each(self, run: Callable[[int], Any]) -> list[Any]:
        """Run a function for every world, and raise the first world's error after all.

        Each time in the other direction: the worlds that were last are still in the processor's cache.
        """
        self._order.reverse()
        results: list[Any] = [None] * len(self._envs)
        errors: dict[int, HalError] = {}
        for k in self._order:
            try:
                results[k] = run(k)
            except Exception as error:
                packed = pack_error(error)
                trace = "" if isinstance(error, HalError) else "\n" + traceback.format_exc()
                packed["text"] = f"world {self._first + k}: {packed['text']}{trace}"
                errors[k] = unpack_error(packed)
        if errors:
            raise errors[min(errors)]
        return results


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the worlds of one process, until the program closes them or is gone."""
    gym.simulated_only = True
    make: Callable[[], gymnasium.Env[Any, Any]] = _unpack(config["make"])
    with ExitStack() as closing:
        envs = []
        for _ in range(config["first"], config["end"]):
            envs.append(env := make())
            closing.callback(env.close)
        worlds = _Worlds(envs, config["first"], config["count"], AutoresetMode(config["mode"]), memories[0])
        if not isinstance(env.observation_space, Dict):
            text = f"make_vec: observations are a dict, not {env.observation_space}"
            raise NotSupported(f"{text}; wrap the VectorEnv instead", code="no_dict")
        shown = entry_key(next(iter(getattr(env.unwrapped, "_cameras", ())), ""), "color")
        rendered = shown if shown in env.observation_space.spaces else ""
        spaces = (env.observation_space, env.action_space, env.metadata, env.render_mode, rendered)
        channel.send({"ready": _pack(spaces)})

        def answer(method: Callable[..., Any]) -> Callable[[str], str]:
            return lambda data: _pack(method(*_unpack(data)))

        methods = (worlds.attach, worlds.reset, worlds.call, worlds.set_attr)
        gc.freeze()  # worlds have many objects, which no collection needs to look at
        handlers = {method.__name__: answer(method) for method in methods} | {"step": worlds.step}
        serve(channel, handlers, worlds.pause, _LONGEST)
