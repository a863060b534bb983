"""A worker of ``hal generate``: makes episodes of a policy or a scripted skill and records them into its own dataset.

Every episode runs in a rig of its own, opened for it, whose clock starts at 0: its rows depend on the recipe and on the
episode's number only, and not on the episodes that the worker made before.
"""

from __future__ import annotations

import os
import random
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import CommandError, ConfigError, ConnectionLost, DeviceNotFound, DriverMissing, HalError, NotSupported
from ..host.process import Channel, SharedMemory, serve
from ..recording import Dataset, Recorder
from ..recording.finish import finalise
from ..recording.layout import MOVES, DatasetLayout, lock_dataset
from .episode import reset_scene
from .policy import Policy, PolicyRunner, is_made_with_rig, load_object, load_policy
from .uploads import EpisodeUploader, is_address

if TYPE_CHECKING:
    from ..rig import Rig
    from ..robot import Robot

_MISTAKES = (ConfigError, DeviceNotFound, DriverMissing, NotSupported)
"""Errors that no episode can be about: the skill, or the installation, is wrong."""


@dataclass(frozen=True)
class EpisodeRecipe:
    """Everything that the rows of an episode depend on, apart from its number: plain data."""

    rig: dict[str, Any]
    """Arguments of :func:`hal.open`: ``config``, ``sim``, ``overrides`` ..."""
    policy: str = ""
    """``module:name`` of a policy; empty with a skill."""
    skill: str = ""
    """``module:name`` of a function of the rig and a random generator, which drives and returns its success."""
    reset: str = ""
    """``module:name`` of a function of the rig and a random generator, called after the reset of the scene."""
    success: str = ""
    """``module:name`` of a function of the rig and an observation that judges the episode."""
    robot: str = ""
    """The arm; empty for the first."""
    rate_hz: float = 20.0
    """Calls of the policy per simulated second."""
    history: int = 1
    """Observations that each call of the policy gets."""
    seconds: float = 30.0
    """Longest simulated time of an episode, s."""
    seed: int = 0
    """Seed of episode 0; each next one has one more."""
    fps: int = 30
    """Rows per simulated second."""
    task: str = ""
    """Description of the task, stored with each episode."""
    cameras: Sequence[str] | None = None
    """Recorded cameras; None for all."""
    streams: Sequence[str] = field(default_factory=lambda: ["color", "depth"])
    """Recorded streams of the cameras."""
    codec: str = "auto"
    """Video codec."""
    plan: str = ""
    """Hash of the resolved rig, so that a rig file that changed is noticed."""


@dataclass(frozen=True)
class EpisodeResult:
    """Outcome of one episode."""

    number: int
    seed: int
    success: bool | None
    """None if it was not judged."""
    ended: str
    """``done`` (a skill returned), ``success``, ``time``, ``stopped`` (the arm stopped, or the skill gave up) or
    ``error`` (an error of the user's code; the episode is not saved)."""
    reason: str = ""
    """Why it was stopped; the traceback of an error."""
    rows: int = 0
    wall_s: float = 0.0
    """Time that making it took, s."""


class _TimeOver(BaseException):
    """A skill exceeded the longest time of an episode. No ``except Exception`` of the skill catches it."""


class EpisodeWorker:
    """Makes episodes into the dataset in ``folder``.

    Args:
        recipe: Fields of an :class:`EpisodeRecipe`.
        folder: The worker's dataset, made with the first episode; or an address, to which the episodes of a dataset in
            a temporary folder are uploaded.
        path: Further entries of ``sys.path``, where the user's modules are.
        home: Working directory of the program. A rig file in it that this computer lacks is taken from the same place
            in the working directory here.

    Raises:
        CommandError: A module or function of the recipe cannot be imported, or the address is wrong.
        DriverMissing: fsspec, or its package for this kind of address, is not installed.
    """

    def __init__(self, recipe: dict[str, Any], folder: str, path: Sequence[str] = (), home: str = "") -> None:
        sys.path.extend(entry for entry in path if entry not in sys.path)
        self.recipe = EpisodeRecipe(**recipe)
        r = self.recipe
        self._rig = r.rig | {"config": _file_here(r.rig["config"], home)}
        self._uploader = EpisodeUploader(folder) if is_address(folder) else None
        self._folder = folder
        places = {name: getattr(r, name) for name in ("policy", "skill", "reset", "success")}
        self._functions = {name: load_object(place, f"--{name}") for name, place in places.items() if place}
        self._policy: Policy | None = None
        self._recorder: Recorder | None = None

    def make(self, number: int) -> dict[str, Any]:
        """Make and save one episode; return the fields of its :class:`EpisodeResult`.

        Raises:
            HalError: The scene cannot be reset, or the episode cannot be recorded.
        """
        import hal

        start = time.perf_counter()
        r = self.recipe
        seed = r.seed + number
        _seed_everything(seed)
        if self._uploader is not None and self._uploader.is_full:
            self._close_recorder()
            self._uploader.begin()
        with hal.open(**self._rig, clock="lock_step", pad="none") as rig:
            robot = rig.robots[r.robot or next(iter(rig.robots))]
            generator = np.random.default_rng(seed)
            try:
                reset_scene(rig, robot, random=generator, seed=seed)
                if "reset" in self._functions:
                    self._functions["reset"](rig, generator)
            except Exception as error:
                return vars(EpisodeResult(number, seed, None, "error", _trace(error)))
            recorder = self._get_recorder(rig)
            recorder.start(seed=seed, info={"episode": number, "recipe": vars(r)})
            try:
                success, ended, reason = self._perform(rig, robot, generator, seed)
            except BaseException:
                recorder.discard()
                raise
            status = recorder.status()
            if ended == "error" or status.dropped:
                recorder.discard()
                if ended != "error":
                    raise ConnectionLost(f"{status.dropped} rows were lost: {status.trouble}", code="rows_lost")
            else:
                recorder.save(success, wait=True)
                if self._uploader is not None:
                    self._uploader.upload(number, success)
        spent = time.perf_counter() - start
        return vars(EpisodeResult(number, seed, success, ended, reason, status.frames, spent))

    def close(self) -> None:
        """End the recorder. Idempotent."""
        self._close_recorder()
        if self._uploader is not None:
            self._uploader.close()
            self._uploader = None

    def _close_recorder(self) -> None:
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None

    def _get_recorder(self, rig: Rig) -> Recorder:
        """Return the recorder, for this rig; its process is started once."""
        r = self.recipe
        if self._recorder is None:
            folder = self._folder if self._uploader is None else self._uploader.folder
            self._recorder = Recorder(rig, folder, r.fps, r.task, cameras=r.cameras, streams=r.streams, codec=r.codec)
            self._recorder.source = lambda: "policy" if r.policy else "program"
        else:
            self._recorder.switch_rig(rig)
        return self._recorder

    def _perform(
        self, rig: Rig, robot: Robot, generator: np.random.Generator, seed: int
    ) -> tuple[bool | None, str, str]:
        """Run the policy or the skill; return its success, how it ended, and why."""
        judge = self._functions.get("success")
        if "skill" in self._functions:
            return self._run_skill(self._functions["skill"], rig, generator, judge)
        r = self.recipe
        policy = self._policy
        if policy is None:
            policy = load_policy(r.policy, rig)
            if not is_made_with_rig(self._functions["policy"]):
                self._policy = policy
        runner = PolicyRunner(
            rig, policy, robots=[robot], rate_hz=r.rate_hz, seconds=r.seconds, history=r.history, success=judge
        )
        outcome = runner.run(seed)
        reason = _trace(outcome.error) if outcome.ended == "error" and outcome.error else outcome.reason
        success = False if outcome.ended == "stopped" else outcome.success
        return success, outcome.ended, reason

    def _run_skill(
        self, skill: Callable[..., Any], rig: Rig, generator: np.random.Generator, judge: Callable[..., Any] | None
    ) -> tuple[bool | None, str, str]:
        def expire() -> None:
            raise _TimeOver

        detach = rig.clock.call_every(self.recipe.seconds, expire)  # type: ignore[attr-defined]  # a LockStepClock
        try:
            returned = skill(rig, generator)
            success = None if returned is None else bool(returned)
            if judge is not None and success is not False:
                success = bool(judge(rig, rig.observe()))
            return success, "done", ""
        except _TimeOver:
            return False, "time", ""
        except _MISTAKES as error:
            return None, "error", _trace(error)
        except HalError as error:
            return False, "stopped", str(error)
        except Exception as error:
            return None, "error", _trace(error)
        finally:
            detach()


def _file_here(config: Any, home: str) -> Any:
    """Return where a rig file of a program in the folder ``home`` is on this computer; anything else as it is."""
    path = Path(str(config))
    if home and path.is_absolute() and not path.exists() and path.is_relative_to(home):
        return str(Path.cwd() / path.relative_to(home))
    return config


def _seed_everything(seed: int) -> None:
    """Seed the global generators, for user code that uses them."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(seed)


def _trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(error))


def clean_part(folder: str | Path, recipe: dict[str, Any]) -> dict[int, bool | None]:
    """Bring a dataset to rest after the process that recorded it has ended.

    An episode that was being recorded is removed; one that was being saved is finished.

    Args:
        folder: The dataset; it may not exist.
        recipe: Fields of the recipe with which it must have been generated.

    Returns:
        The number of each finished episode, with its mark.

    Raises:
        CommandError: Another process still writes to it (code ``dataset_locked``), or it was generated with another
            recipe, or not generated (``other_recipe``).
        DatasetError: The dataset is damaged.
    """
    layout = DatasetLayout(folder)
    if not layout.episodes.is_dir():
        return {}
    with lock_dataset(layout):
        layout.sweep()
        for partial in layout.partials():
            if (partial / MOVES).exists():
                finalise(layout, partial)
            else:
                layout.remove(partial)
        if not layout.info.exists():
            return {}
        episodes = Dataset(folder).episodes
    found: dict[int, bool | None] = {}
    for episode in episodes:
        info = episode.info["info"]
        check_recipe(str(layout.root), info.get("recipe"), recipe)
        found[int(info["episode"])] = episode.success
    return found


def check_recipe(place: str, made: Any, recipe: dict[str, Any]) -> None:
    """Raise CommandError (code ``other_recipe``) if the episodes at a place were ``made`` with another recipe."""
    if made != recipe:
        raise CommandError(f"{place} {_difference(made, recipe)}; choose another place", code="other_recipe")


def _difference(made: Any, recipe: dict[str, Any]) -> str:
    """Describe how the recipe of an episode on the disk differs."""
    if not isinstance(made, dict):
        return "has episodes that were not generated"
    old, new = _flatten_options(made), _flatten_options(recipe)
    other = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    if other == ["plan"]:
        return "was generated with a rig that has changed since, or with another version of it"
    return "was generated with " + ", ".join(
        f"{key} {old.get(key)!r} instead of {new.get(key)!r}" for key in other if key != "plan"
    )


def _flatten_options(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a recipe, with the options of its rig among them."""
    return {**{key: value for key, value in recipe.items() if key != "rig"}, **recipe.get("rig", {})}


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the worker's process: serve requests until the app closes it, and end with the app at any time."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, name="hal-worker-watch", daemon=True).start()
    worker = EpisodeWorker(**config)
    channel.send({"ready": os.getpid()})
    try:
        serve(channel, {"make": worker.make})
    finally:
        worker.close()
