"""A gamepad that is plugged in, through the kernel's input events."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from types import MappingProxyType

from pydantic import BaseModel, ConfigDict

from hal.errors import NotSupported
from hal.gamepad import GamepadDriver, PadReading, Plugged
from hal.pads.guess import guess_model, guess_warning
from hal.pads.model import choose_model, pad_model, validated
from hal.specs import PadSpec
from hal.types import AXES

from .link import Link
from .node import Node, evdev_module
from .system import InputSystem, LinuxInput, NodeInfo, permission_note

__all__ = ["EvdevPad"]

_RESCAN = 0.2  # s between two looks at what is plugged in
_RELEASED = MappingProxyType(dict.fromkeys(AXES, 0.0))


class Options(BaseModel):
    """What a rig may say under ``options:`` of its pad."""

    model_config = ConfigDict(extra="forbid")

    device: str | None = None
    """Only this device, for example ``/dev/input/event3``."""
    name: str | None = None
    """Only a pad with this in its name, in any case of letters."""
    accept_silent_pad: bool = False
    """Let a wireless pad that falls silent without a sign be the dead-man of a real arm."""


class EvdevPad(GamepadDriver):
    """The first pad that is plugged in, or that the options name; one that is unplugged may come back at any time.

    Pads are told from other devices by their buttons and sticks, and take the model of ``spec.models`` that matches
    best, or are guessed with a warning in ``notes``. With ``spec.model`` only a pad that it matches is taken, unless
    the options name one.
    """

    def __init__(self, spec: PadSpec, source: object | None = None, *, system: InputSystem | None = None) -> None:
        super().__init__(spec, source)
        place = f"gamepads.{spec.name}"
        self._options = validated(Options, spec.options, place)
        chosen = (spec.model,) if spec.model is not None else spec.models
        self._models = tuple(pad_model(data, f"{place}, model {data.get('name')}") for data in chosen)
        self._system = system
        self._is_open = False
        self._link: Link | None = None
        self._seen: object = None
        self._next_look = -math.inf
        self._seq = 0
        self._last = PadReading(-math.inf, -math.inf, 0.0, 0, _RELEASED, frozenset(), connected=False)

    @classmethod
    def plugged(cls) -> Plugged:
        if sys.platform != "linux":
            return Plugged(())
        pads = [info for info in LinuxInput().nodes() if info.is_pad]
        readable = [info for info in pads if os.access(info.path, os.R_OK)]
        return Plugged(
            tuple(info.describe() for info in readable),
            tuple(permission_note(info) for info in pads if info not in readable),
        )

    def open(self) -> None:
        """Raises NotSupported anywhere but on Linux, and DriverMissing."""
        if self._system is None:
            if sys.platform != "linux":
                raise NotSupported("the evdev driver reads gamepads on Linux only")
            evdev_module()
            self._system = LinuxInput()
        self._is_open = True
        self._look()

    def poll(self, now: float, timeout: float) -> PadReading:
        if time.monotonic() >= self._next_look and (self._link is None or self._link.lacks_motion):
            self._look()
        if self._link is None:
            if timeout > 0.0:
                time.sleep(timeout)
            return self._last
        try:
            self._link.poll(now, timeout)
        except OSError:
            return self._lose(now)
        link = self._link
        self.proves_liveness = link.proves_liveness
        self._last = PadReading(
            t=link.t,
            t_alive=link.t_alive,
            t_device=link.t_device,
            seq=self._seq + link.events,
            axes=MappingProxyType(dict(link.mapper.axes)),
            buttons=link.mapper.buttons,
            connected=True,
            unknown=link.mapper.unknown,
        )
        return self._last

    def _lose(self, t: float) -> PadReading:
        if self._link is not None:
            self._seq += self._link.events + 1
            self._drop_link()
        self._seen = None
        self._last = self._last._replace(
            t=t, seq=self._seq, axes=_RELEASED, buttons=frozenset(), connected=False, unknown=()
        )
        return self._last

    def _drop_link(self) -> None:
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.close()
        self._link = None
        self.proves_liveness = False

    # Looking for it.

    def _look(self) -> None:
        """Open the pad, or its motion sensor, if something changed since the last look."""
        if self._system is None or not self._is_open:
            return
        self._next_look = time.monotonic() + _RESCAN
        mark = self._system.fingerprint()
        if mark == self._seen:
            return
        self._seen = mark
        nodes = self._system.nodes()
        if self._link is None:
            self._find_pad([info for info in nodes if info.is_pad])
        if self._link is not None and self._link.lacks_motion:
            self._find_motion(self._link, nodes)

    def _find_pad(self, pads: list[NodeInfo]) -> None:
        wanted = [info for info in pads if self._wanted(info)]
        others = ", ".join(info.describe() for info in pads)
        self.notes = (f"not the pad that the rig asks for: {others}",) if pads and not wanted else ()
        for info in wanted:
            self._connect(info)
            if self._link is not None:
                return

    def _wanted(self, info: NodeInfo) -> bool:
        options = self._options
        if options.device is not None or options.name is not None:
            by_name = options.name is None or options.name.lower() in info.identity.name.lower()
            return by_name and (options.device is None or os.path.realpath(options.device) == info.path)
        return self.spec.model is None or choose_model(self._models, info.identity) is not None

    def _connect(self, info: NodeInfo) -> None:
        node = self._try_open(info)
        if node is None:
            return
        found = choose_model(self._models, info.identity)
        if found is not None:
            model, rule = found
        elif self.spec.model is not None:
            model, rule = self._models[0], None
        else:
            model = guess_model(info.identity, node.axes, node.keys)
            rule = None
            self.notes = (*self.notes, guess_warning(model))
        try:
            self._link = Link(info, node, model, rule)
        except OSError:  # unplugged again already
            node.close()
            return
        self.flat = self._link.mapper.flat

    def _find_motion(self, link: Link, nodes: list[NodeInfo]) -> None:
        ending = link.model.motion_node or ""
        for info in nodes:
            if info.identity.name.endswith(ending) and info.belongs_to(link.info) and not info.is_pad:
                motion = self._try_open(info)
                if motion is not None:
                    link.listen_to(motion)
                    return

    def _try_open(self, info: NodeInfo) -> Node | None:
        """None where it went away, or may not be read: udev sets the permissions a moment after it appears."""
        assert self._system is not None
        try:
            return self._system.open(info.path)
        except PermissionError:
            note = permission_note(info)
            if note not in self.notes:
                self.notes = (*self.notes, note)
        except OSError:
            self._seen = None
        return None

    # The rest.

    def describe(self) -> str:
        if self._link is None:
            return "no gamepad" if not self.notes else f"no gamepad: {self.notes[0]}"
        title = self._link.model.title
        info = self._link.info
        return info._replace(identity=info.identity._replace(name=title)).describe()

    def close(self) -> None:
        self._drop_link()
        self._last = self._last._replace(axes=_RELEASED, buttons=frozenset(), connected=False, unknown=())
        self._is_open = False
