"""A RealSense camera made of software."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.specs import CameraSpec

from .context import Place
from .device import Device
from .feeder import Feeder, Sent
from .figures import serial_of, title_of
from .library import load_realsense
from .options import Emulation

__all__ = ["SoftwareCamera"]


class SoftwareCamera:
    """A D435 that can be plugged into any number of contexts, streams what is asked of it, and can be unplugged.

    ``spec`` gives its title, and rate, sizes, formats, lenses and places of its streams (those it says nothing about
    are as a D435's, about); ``options`` are the fields of :class:`~.options.Emulation`. All streams are offered, in
    more modes than the spec asks for, whatever the spec wants.

    It is fed by a thread of this process, which rests while nobody streams and ends with ``close``, with this object,
    or with the program. Raises DriverMissing, CommandError (an option that there is not).
    """

    def __init__(self, spec: CameraSpec, **options: Any) -> None:
        load_realsense()
        self.emulation = Emulation.of(options)
        self.serial = self.emulation.serial or str(spec.options.get("serial") or "") or serial_of(spec)
        self._feeder = Feeder(spec, self.emulation)
        self._title = title_of(spec)
        self._finalizer = weakref.finalize(self, self._feeder.end)
        self._contexts: list[Any] = []
        self._places: list[Place] = []
        self._left: list[Place] = []
        self._times = 0  # plugged in
        self._device: Device | None = None
        self._push_in()

    @property
    def plugged(self) -> bool:
        """Is it there for those contexts that it is attached to?"""
        return self._device is not None

    def attach(self, context: Any) -> None:
        """Connect it to a context, now and at every ``replug``; does nothing when that is so.

        Best is one made by :func:`~.context.emulated_context`; with any other, see :mod:`.context`.
        """
        if any(known is context for known in self._contexts):
            return
        self._contexts.append(context)
        if self._device is not None:
            self._places.append(Place(context, self._device))

    def unplug(self) -> None:
        """Pull its cable: no picture after this, gone from every list, and those who asked are told. Idempotent.

        A pipeline that streams from it gets nothing any more, replugged or not.
        """
        self.inject(disconnect=True)

    def replug(self) -> None:
        """Plug it in again: the library lists and announces it, with the same serial number. Idempotent."""
        self.inject(disconnect=False)

    def stall(self, on: bool = True) -> None:
        """It stays listed and sends nothing, until told otherwise; the numbers of its pictures go on."""
        self.inject(freeze=on)

    def drop(self, every: int, stream: str | None = None) -> None:
        """Lose every n-th picture, of all streams or of one; 0 for none. Raises CommandError."""
        self.inject(drop=every, drop_stream=stream)

    def skew(self, seconds: float) -> None:
        """Stamp colour that much later than it was taken, s."""
        self.inject(skew=seconds)

    def inject(self, **knobs: object) -> None:
        """Turn :class:`~.knobs.Knobs`; those not named stay as they are. Raises CommandError."""
        turned = self._feeder.knobs.turned(knobs)
        self._feeder.knobs = turned
        if turned.disconnect:
            self._pull()
        else:
            self._push_in()

    def expected(self, number: int, modes: Mapping[str, Any] | None = None) -> dict[str, NDArray[Any]]:
        """Exactly what the picture of that number is in each stream: of those that are on, else of all four.

        Depth in its units (``depth_unit``), colour in the format that is streamed; see
        :meth:`~.pictures.Pictures.expected`. The number of a frame is that which the library gives to depth.
        """
        chosen = modes or self.modes
        return {name: self._feeder.pictures.expected(name, mode, number) for name, mode in chosen.items()}

    def truth(self, number: int, view: str = "color") -> NDArray[np.float64]:
        """Depth (H, W) of the ``scene`` in the view of a stream, m: not rounded, and without the drawn number."""
        return self._feeder.pictures.truth(view, self.modes[view], number)

    @property
    def modes(self) -> Mapping[str, Any]:
        """How each stream is on; without any, how the spec would have all of them."""
        return self._feeder.modes or {name: stream.mode for name, stream in self._feeder.streams.items()}

    @property
    def streaming(self) -> bool:
        """Is it being streamed from, as far as its thread has seen?"""
        return bool(self._feeder.modes)

    @property
    def sent(self) -> tuple[Sent, ...]:
        """The newest sets that were sent, the oldest first, with their times."""
        return tuple(self._feeder.sent)

    @property
    def late(self) -> int:
        """How many sets were taken more than a period late, because this process held up the camera's thread."""
        return self._feeder.late

    def close(self) -> None:
        """Unplug it for good. Idempotent."""
        self._pull()
        self._contexts.clear()
        self._finalizer()

    def _pull(self) -> None:
        if self._device is None:
            return
        self._feeder.plug(None)
        self._device = None
        places, self._places = self._places, []
        self._left += places
        for place in places:
            place.leave()

    def _push_in(self) -> None:
        if self._device is not None or not self._finalizer.alive:
            return
        self._left = [place for place in self._left if not place.forgotten()]
        self._times += 1
        self._device = Device(
            self._feeder.streams,
            title=self._title,
            serial=self.serial,
            usb=self.emulation.usb,
            port=f"emulated/{id(self):x}/{self._times}",
            global_time=self.emulation.clock == "global",
        )
        self._feeder.plug(self._device)
        self._places = [Place(context, self._device) for context in self._contexts]

    def __repr__(self) -> str:
        return f"<SoftwareCamera {self.serial}, {'plugged in' if self.plugged else 'unplugged'}>"
