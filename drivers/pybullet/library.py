"""PyBullet itself: imported when first used, silenced, and bound to one world at a time."""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from hal.errors import DriverMissing

__all__ = ["Chatter", "Client", "load_pybullet", "silenced"]


class Chatter:
    """What a silenced block printed; complete once the block has ended."""

    text: str = ""


@contextmanager
def silenced() -> Iterator[Chatter]:
    """Catch what C code prints, for example PyBullet's import line and its URDF warnings.

    Only the file descriptors can be caught, and they are the whole process's: keep the block short.
    """
    chatter = Chatter()
    with tempfile.TemporaryFile() as file:
        _flush()
        kept = {}
        for descriptor in (1, 2):
            with suppress(OSError):  # a process may have closed them
                kept[descriptor] = os.dup(descriptor)
                os.dup2(file.fileno(), descriptor)
        try:
            yield chatter
        finally:
            _flush()
            for descriptor, original in kept.items():
                os.dup2(original, descriptor)
                os.close(original)
            file.seek(0)
            chatter.text = file.read().decode(errors="replace")


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # they may be replaced, or closed
            stream.flush()
    ctypes.CDLL(None).fflush(None)


def load_pybullet() -> Any:
    """The ``pybullet`` module. Raises DriverMissing when it is not installed."""
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    try:
        with silenced():
            import pybullet
    except ImportError as error:
        raise DriverMissing(
            f"the simulation needs PyBullet ({error}); install it with: pip install 'robot-hal[sim]'"
        ) from error
    return pybullet


class Client:
    """PyBullet's functions with the id of one world filled in; ``client.stepSimulation()`` steps that world.

    Each function is bound once, so a call costs no look-up (``pybullet_utils``' client binds it at every call).
    """

    def __init__(self, *, gui: bool = False) -> None:
        self._module = load_pybullet()
        with silenced():
            self.id: int = self._module.connect(self._module.GUI if gui else self._module.DIRECT)
        if self.id < 0:
            raise DriverMissing("PyBullet could not open its window; is there a display (see the DISPLAY variable)?")

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._module, name)
        if isinstance(attribute, Callable) and not isinstance(attribute, type):  # type: ignore[arg-type]  # its error
            attribute = partial(attribute, physicsClientId=self.id)
        setattr(self, name, attribute)
        return attribute

    def close(self) -> None:
        """End the world and free its memory. Idempotent."""
        number, self.id = self.id, -1
        if number >= 0:
            with suppress(self._module.error):
                self._module.disconnect(physicsClientId=number)

    def __del__(self) -> None:
        if "id" in self.__dict__:  # made to the end
            self.close()
