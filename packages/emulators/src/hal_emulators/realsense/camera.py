"""The emulated camera as tests and rigs use it: plug it in, unplug it, and know what it sends."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.specs import CameraSpec

from .device import ContextEntry, EmulatedDevice, load_realsense
from .feeder import FrameFeeder, SentFrames
from .pictures import make_serial, make_title
from .settings import Emulation


class SoftwareCamera:
    """A D435 that can be plugged into any number of contexts, streams what is requested, and can be unplugged.

    All streams are offered, in more modes than the spec names. A thread of this process feeds it; it rests while nobody
    streams, and ends with ``close``, with this object, or with the program.
    """

    def __init__(self, spec: CameraSpec, **options: Any) -> None:
        """Create the camera, plugged in; options are fields of :class:`~.settings.Emulation`.

        Streams that the spec leaves out are roughly those of a D435. Raises DriverMissing without librealsense,
        CommandError for a wrong option.
        """
        load_realsense()
        self.emulation = Emulation.from_options(options)
        self.serial = self.emulation.serial or str(spec.options.get("serial") or "") or make_serial(spec)
        self._feeder = FrameFeeder(spec, self.emulation)
        self._title = make_title(spec)
        self._finalizer = weakref.finalize(self, self._feeder.stop)
        self._contexts: list[Any] = []
        self._entries: list[ContextEntry] = []
        self._old_entries: list[ContextEntry] = []
        self._plug_count = 0
        self._device: EmulatedDevice | None = None
        self._connect()

    @property
    def plugged(self) -> bool:
        return self._device is not None

    def attach(self, context: Any) -> None:
        """Connect the camera to an :func:`.emulated_context`, now and at every ``replug``. Idempotent."""
        if any(known is context for known in self._contexts):
            return
        self._contexts.append(context)
        if self._device is not None:
            self._entries.append(ContextEntry(context, self._device))

    def unplug(self) -> None:
        """Pull the cable: no further frame, removed from every list, and callbacks are called. Idempotent.

        A pipeline that streams from it receives nothing any more, even after ``replug``.
        """
        self.inject(disconnect=True)

    def replug(self) -> None:
        """Plug it in again: the library lists and announces it, with the same serial number. Idempotent."""
        self.inject(disconnect=False)

    def inject(self, **faults: object) -> None:
        """Set fields of :class:`~.settings.CameraFaults`; the others keep their values. Raises CommandError."""
        updated = self._feeder.faults.updated(faults)
        self._feeder.faults = updated
        if updated.disconnect:
            self._disconnect()
        else:
            self._connect()

    def expected(self, number: int, modes: Mapping[str, Any] | None = None) -> dict[str, NDArray[Any]]:
        """Return exactly the images of the frame that has this number for depth, by stream.

        Depth is in its units (``DEPTH_UNIT``), colour in the format that is streamed; see
        :meth:`.pictures.EmulatedImages.expected`.
        """
        chosen = modes or self.modes
        return {name: self._feeder.images.expected(name, mode, number) for name, mode in chosen.items()}

    def truth(self, number: int, view: str = "color") -> NDArray[np.float64]:
        """Return the depth (H, W) of the ``scene`` in the view of a stream, m: not rounded, and without the number."""
        return self._feeder.images.truth(view, self.modes[view], number)

    @property
    def modes(self) -> Mapping[str, Any]:
        """Modes of the streams that are on; if none is, those that the spec names for all streams."""
        return self._feeder.modes or {name: stream.mode for name, stream in self._feeder.streams.items()}

    @property
    def streaming(self) -> bool:
        return bool(self._feeder.modes)

    @property
    def sent(self) -> tuple[SentFrames, ...]:
        """Times of the newest frame sets that were sent, the oldest first."""
        return tuple(self._feeder.sent)

    @property
    def late(self) -> int:
        """Number of frame sets that were taken more than a period late, because the feeding thread was held up."""
        return self._feeder.late

    def close(self) -> None:
        """Unplug it for good. Idempotent."""
        self._disconnect()
        self._contexts.clear()
        self._finalizer()

    def _disconnect(self) -> None:
        if self._device is None:
            return
        self._feeder.set_device(None)
        self._device = None
        entries, self._entries = self._entries, []
        self._old_entries += entries
        for entry in entries:
            entry.remove()

    def _connect(self) -> None:
        if self._device is not None or not self._finalizer.alive:
            return
        self._old_entries = [entry for entry in self._old_entries if not entry.release_if_unused()]
        self._plug_count += 1
        self._device = EmulatedDevice(
            self._feeder.streams,
            title=self._title,
            serial=self.serial,
            usb=self.emulation.usb,
            port=f"emulated/{id(self):x}/{self._plug_count}",
            global_time=self.emulation.clock == "global",
        )
        self._feeder.set_device(self._device)
        self._entries = [ContextEntry(context, self._device) for context in self._contexts]

    def __repr__(self) -> str:
        return f"<SoftwareCamera {self.serial}, {'plugged in' if self.plugged else 'unplugged'}>"
