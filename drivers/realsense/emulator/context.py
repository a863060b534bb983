"""Plugging and unplugging, as far as librealsense can be told of it, and the rest in its place.

What the library does itself: a software device that is added to a context is listed, and announced to whoever asked
for it with ``set_devices_changed_callback``. It leaves the list when the last one lets go of it; but a pipeline lets go
of no device that it ever saw before it is deleted, and nothing announces that a device left (measured with 2.59, and so
in its ``src/context.cpp`` and ``src/device_hub.cpp``). So the context that an emulated camera is attached to should be
an :func:`emulated_context`: an ``rs.context`` like any other, which keeps unplugged cameras out of its lists and
announces them. With a plain ``rs.context`` an unplugged camera loses its serial number instead.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from .device import Device
from .library import load_realsense

__all__ = ["Change", "Place", "emulated_context"]


class Change:
    """What a client is told when devices come or go: as the library's ``event_information``."""

    def __init__(self, removed: tuple[str, ...]) -> None:
        self._removed = removed  # ports

    def was_removed(self, device: Any) -> bool:
        """Is this one of those that went?"""
        return _port(device) in self._removed

    def was_added(self, device: Any) -> bool:
        """Is this one of those that came? Those are announced by the library itself."""
        return False

    def get_new_devices(self) -> list[Any]:
        """Those that came."""
        return []


def emulated_context() -> Any:
    """A new ``rs.context`` from which emulated cameras can be unplugged. Raises DriverMissing."""
    rs = load_realsense()

    class EmulatedContext(rs.context):  # type: ignore[misc, name-defined]  # its base is known when the library is
        def __init__(self) -> None:
            super().__init__()
            self._callback: Callable[[Any], None] | None = None
            self._gone: set[str] = set()
            self._newest: Any = None
            me = weakref.ref(self)  # the library must not keep this alive

            def heard(change: Any) -> None:
                here = me()
                if here is not None:
                    here.hear(change)

            super().set_devices_changed_callback(heard)

        def query_devices(self, *mask: int) -> list[Any]:
            return [device for device in super().query_devices(*mask) if _port(device) not in self._gone]

        @property
        def devices(self) -> list[Any]:
            return self.query_devices()

        def set_devices_changed_callback(self, callback: Callable[[Any], None]) -> None:
            self._callback = callback

        def hear(self, change: Any) -> None:
            self._newest = change.get_new_devices()
            if self._callback is not None:
                self._callback(change)

        def join(self, device: Device) -> Any:
            """What keeps the device on the list comes back: the library's own note of it."""
            device.native.add_to(self)
            note, self._newest = self._newest, None
            return note

        def leave(self, device: Device) -> None:
            self._gone.add(device.port)
            if self._callback is not None:
                self._callback(Change((device.port,)))

    return EmulatedContext()


class Place:
    """A device's place in a context, until it leaves."""

    def __init__(self, context: Any, device: Device) -> None:
        self._context = context
        self._device = device
        # The library crashes on a device that is listed and no more, so it lives for as long as the context.
        self._life = weakref.finalize(context, _let_go, device.native)
        self._life.atexit = False
        # And its list forgets a device that nobody holds.
        if hasattr(context, "join"):
            self._keeper = context.join(device)
        else:
            self._keeper = load_realsense().pipeline(context)
            device.native.add_to(context)

    def leave(self) -> None:
        """Unplug it. Whoever asked is called from this thread."""
        self._keeper = None
        self._device.forget_serial()
        if hasattr(self._context, "leave"):
            self._context.leave(self._device)

    def forgotten(self) -> bool:
        """After it left: does nobody hold it any more? Then the device may go."""
        listed = load_realsense().context.query_devices(self._context)
        if any(_port(device) == self._device.port for device in listed):
            return False
        self._life.detach()
        return True


def _let_go(device: Any) -> None:
    """Its last reference was held for this call."""


def _port(device: Any) -> str:
    key = load_realsense().camera_info.physical_port
    try:
        return str(device.get_info(key)) if device.supports(key) else ""
    except RuntimeError:  # it went in this moment
        return ""
