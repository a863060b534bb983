"""Sleep of objects at rest: MuJoCo computes neither contacts nor motion of what would not move anyway."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

SLOWEST_START = 0.012
"""An object sleeps if it is slower for ten of MuJoCo's steps than one that starts with this acceleration, m/s2.

So what begins to slide or to tip faster than that stays awake, whatever the length of a step.
"""
_STEPS = 10
"""Steps of MuJoCo's for which an object has to be slow (``mjMINAWAKE``)."""
_LISTS = ("tree_asleep", "tree_awake", "body_awake", "body_awake_ind", "parent_awake_ind", "dof_awake_ind")
_COUNTS = ("ntree_awake", "nbody_awake", "nparent_awake", "nv_awake")


class Sleep:
    """Which objects of one world sleep. The model is changed: it may sleep from now on.

    Only objects with a free base and no joints of their own fall asleep, each together with all that it touches. A
    contact with something that is awake, a force and a changed pose or velocity wake them (MuJoCo's own rules); all
    other changes of the world have to call :meth:`wake`. Nothing of an object that sleeps changes.

    MuJoCo's own state of a simulation (``mj_getState``) is without sleep, so :meth:`save` and :meth:`restore` add it.
    """

    def __init__(self, mujoco: Any, model: Any, data: Any) -> None:
        self._mujoco, self._model, self._data = mujoco, model, data
        self._flag = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        model.opt.enableflags |= self._flag
        model.opt.sleep_tolerance = SLOWEST_START * _STEPS * model.opt.timestep
        free = [
            model.dof_treeid[model.jnt_dofadr[joint]]
            for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        ]
        alone = [tree for tree in free if model.tree_dofnum[tree] == 6]
        model.tree_sleep_policy[:] = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
        model.tree_sleep_policy[alone] = mujoco.mjtSleepPolicy.mjSLEEP_ALLOWED
        self._awake = self._read()

    def wake(self) -> None:
        """Wake all, as in a world that has just been made, and read where fixed bases are now."""
        self._write(self._awake)
        with self.off():
            self._mujoco.mj_kinematics(self._model, self._data)

    @contextmanager
    def off(self) -> Iterator[None]:
        """Compute in this block without sleep, and the poses of fixed bases, too."""
        self._model.opt.enableflags &= ~self._flag
        try:
            yield
        finally:
            self._model.opt.enableflags |= self._flag

    def sleepers(self) -> NDArray[np.intp]:
        """Return MuJoCo's numbers of the bodies that sleep."""
        return np.flatnonzero(self._data.body_awake == 0)

    def save(self) -> dict[str, Any]:
        """Return what sleeps, and for how long the others have been slow."""
        return {name: part.tolist() for name, part in self._read().items()}

    def check(self, state: Mapping[str, Any]) -> dict[str, NDArray[np.int64]]:
        """Return a state of :meth:`save`, ready for :meth:`restore`; raises ValueError if it is none of this world."""
        parts = {name: np.array(part) for name, part in state.items()}
        for name, own in self._awake.items():
            if parts[name].shape != own.shape or parts[name].dtype.kind != "i":
                raise ValueError("it has another size")
        size = max(self._model.nbody, self._model.nv)
        if any(part.min(initial=0) < -_STEPS - 1 or part.max(initial=0) > size for part in parts.values()):
            raise ValueError("its numbers of bodies are not of this world")
        trees = parts["tree_asleep"]
        asleep = np.flatnonzero(trees >= 0)
        if sorted(trees[asleep]) != asleep.tolist():  # each names the next one of those that sleep together
            raise ValueError("what sleeps in it does not fit")
        return parts

    def restore(self, state: Mapping[str, NDArray[np.int64]]) -> None:
        """Restore what sleeps, after everything else was restored and :meth:`wake` was called."""
        if (state["tree_asleep"] >= 0).any():
            with self.off():
                self._mujoco.mj_forward(self._model, self._data)  # what MuJoCo remembers of sleepers, from their poses
        self._write(state)

    def _read(self) -> dict[str, NDArray[np.int64]]:
        return {name: np.array(getattr(self._data, name)) for name in (*_LISTS, *_COUNTS)}

    def _write(self, state: Mapping[str, NDArray[np.int64]]) -> None:
        for name in _LISTS:
            getattr(self._data, name)[:] = state[name]
        for name in _COUNTS:
            setattr(self._data, name, int(state[name]))
