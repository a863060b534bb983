"""The gamepad driver: a pad that is plugged in, through the kernel's input events."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from collections.abc import Mapping
from types import MappingProxyType

from pydantic import BaseModel, ConfigDict

from hal.config.files import Problems, check_record
from hal.config.models import load_pad_models
from hal.driver import GamepadDriver, PadReading, Plugged
from hal.errors import NotSupported
from hal.pads.model import PadModel, choose_model, guess_model, guess_warning, pad_model
from hal.specs import PadSpec
from hal.types import AXES

from .finder import DeviceFinder, EvdevNode, LinuxInput, NodeInfo, evdev_module, permission_note
from .link import PadLink

_RELEASED = MappingProxyType(dict.fromkeys(AXES, 0.0))


class EvdevOptions(BaseModel):
    """Options of an evdev pad in a rig (``gamepads.<name>.options``)."""

    model_config = ConfigDict(extra="forbid")

    device: str | None = None
    """Only this device, for example ``/dev/input/event3``."""
    name: str | None = None
    """Only a pad whose name contains this, in upper or lower case."""
    accept_silent_pad: bool = False
    """Accept a wireless pad, whose loss may go unnoticed, as the dead-man of a real arm."""


class EvdevPad(GamepadDriver):
    """The first pad that is plugged in, or the one that the options name. It may be unplugged and come back.

    Pads are recognised by the events that they can send. Each gets the model of ``spec.models`` that matches best, or
    a guessed one with a warning in ``notes``. With ``spec.model`` only a pad that matches it is used, unless the
    options name one.
    """

    def __init__(self, spec: PadSpec, source: object | None = None, *, system: LinuxInput | None = None) -> None:
        super().__init__(spec, source)
        place = f"gamepads.{spec.name}"
        self._options = check_record(EvdevOptions, spec.options, place)
        chosen = (spec.model,) if spec.model is not None else spec.models
        self._models = tuple(pad_model(data, f"{place}, model {data.get('name')}") for data in chosen)
        self._on_this_machine = system is None
        self._finder = DeviceFinder(LinuxInput() if system is None else system)
        self._is_open = False
        self._link: PadLink | None = None
        self._rumble: tuple[float, float, float] | None = None
        """The wanted rumble, set by any thread. The polling thread plays it, because only that closes the device."""
        self._seq = 0
        self._last = PadReading(-math.inf, -math.inf, 0.0, 0, _RELEASED, frozenset(), connected=False)

    @classmethod
    def list_plugged(cls) -> Plugged:
        if sys.platform != "linux":
            return Plugged(())
        nodes = LinuxInput().nodes()
        models = _built_in() if any(info.is_joystick for info in nodes) else ()
        pads = [info for info in nodes if info.is_pad or (info.is_joystick and choose_model(models, info.identity))]
        readable = [info for info in pads if os.access(info.path, os.R_OK)]
        return Plugged(
            tuple(info.describe() for info in readable),
            tuple(permission_note(info) for info in pads if info not in readable),
            tuple(info.path for info in readable),
        )

    def open(self) -> None:
        """Look for the pad, which may come later. Raises NotSupported except on Linux, and DriverMissing."""
        if self._on_this_machine:
            if sys.platform != "linux":
                raise NotSupported("the evdev driver reads gamepads on Linux only", code="linux_only")
            evdev_module()
        self._is_open = True
        self._scan()

    def poll(self, now: float, timeout: float) -> PadReading:
        if not self._is_open:
            return self._last
        if (self._link is None or self._link.lacks_motion or self._link.lacks_touch) and self._finder.due():
            self._scan()
        if self._link is None:
            if timeout > 0.0:
                time.sleep(timeout)
            return self._last
        try:
            self._link.poll(now, timeout)
            wanted, self._rumble = self._rumble, None
            if wanted is not None:
                self._link.rumble(*wanted)
        except OSError:
            return self._handle_loss(now)
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

    def _handle_loss(self, t: float) -> PadReading:
        if self._link is not None:
            self._seq += self._link.events + 1
            self._drop_link()
        self._finder.forget()
        self._last = self._last._replace(
            t=t, seq=self._seq, axes=_RELEASED, buttons=frozenset(), connected=False, unknown=()
        )
        return self._last

    def _drop_link(self) -> None:
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.close()
        self._link = None
        self._rumble = None
        self.proves_liveness = False

    # Finding the pad and its parts.

    def _scan(self) -> None:
        """Open the pad, its motion sensor and its touchpad, if the devices changed since the last scan."""
        nodes = self._finder.scan()
        if nodes is None:
            return
        if self._link is None:
            self._find_pad(nodes)
        link = self._link
        if link is not None and link.lacks_motion:
            self._find_part(link, link.model.motion_node, nodes)
        if link is not None and link.lacks_touch:
            self._find_part(link, link.model.touch_node, nodes)

    def _find_pad(self, nodes: list[NodeInfo]) -> None:
        named = self.spec.model is not None
        pads = [info for info in nodes if info.is_pad or info.is_joystick or (named and info.is_keyboard)]
        wanted = [info for info in pads if self._is_wanted(info)]
        others = ", ".join(info.describe() for info in pads if info.is_pad)
        self.notes = (f"not the pad that the rig names: {others}",) if others and not wanted else ()
        for info in wanted:
            self._connect(info)
            if self._link is not None:
                return

    def _is_wanted(self, info: NodeInfo) -> bool:
        options = self._options
        if options.device is not None or options.name is not None:
            by_name = options.name is None or options.name.lower() in info.identity.name.lower()
            return by_name and (options.device is None or os.path.realpath(options.device) == info.path)
        if self.spec.model is None and info.is_pad:
            return True
        return choose_model(self._models, info.identity) is not None

    def _connect(self, info: NodeInfo) -> None:
        node = self._try_open(info)
        if node is None:
            return
        if not node.claim():
            node.close()
            self.notes = (
                *self.notes,
                f"{info.describe()} is in use by another gamepad of this rig, or by another program",
            )
            return
        found = choose_model(self._models, info.identity)
        if found is not None:
            model, rule = found
        elif self.spec.model is not None:
            model, rule = self._models[0], None
        else:
            model, rule = guess_model(info.identity, node.axes, node.keys, node.rels), None
            self.notes = (*self.notes, guess_warning(model))
        try:
            if info.is_keyboard:
                node.grab()
            self._link = PadLink(info, node, model, rule)
        except OSError:  # unplugged again already
            node.close()
            return
        self.flat, self.absolute = self._link.mapper.flat, self._link.mapper.model.absolute

    def _find_part(self, link: PadLink, ending: str | None, nodes: list[NodeInfo]) -> None:
        """Open another device of the same pad: the one whose name has that ``ending``."""
        for info in nodes:
            if info.identity.name.endswith(ending or "") and info.belongs_to(link.info) and not info.is_pad:
                part = self._try_open(info, quiet=ending == link.model.touch_node)
                if part is None:
                    continue
                try:
                    if ending == link.model.motion_node:
                        link.add_motion(part)
                    else:
                        link.add_touch(part)
                except OSError:  # unplugged again already; the pad follows
                    part.close()
                return

    def _try_open(self, info: NodeInfo, *, quiet: bool = False) -> EvdevNode | None:
        """Open a device; None where it is gone, or may not be read (udev sets the permissions a moment later).

        ``quiet`` adds no note where it may not be read: a desktop keeps touchpads to itself.
        """
        try:
            return self._finder.open(info)
        except PermissionError:
            note = permission_note(info)
            if note not in self.notes and not quiet:
                self.notes = (*self.notes, note)
        except OSError:
            self._finder.forget()
        return None

    # Rumble, description and end.

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        """Turn the motors in the next poll, at most 10 ms later in a rig. See :meth:`GamepadDriver.rumble`."""
        link = self._link
        if link is None or not link.can_rumble or seconds <= 0.0:
            return False
        self._rumble = strong, weak, seconds
        return True

    @property
    def mapping(self) -> str | None:
        link = self._link
        return link.model.mapping if link is not None else None

    @property
    def control_names(self) -> Mapping[str, str]:
        return self._link.model.control_names if self._link is not None else {}

    def describe(self) -> str:
        link = self._link
        if link is None:
            return "no gamepad" if not self.notes else f"no gamepad: {self.notes[0]}"
        return link.info._replace(identity=link.info.identity._replace(name=link.title)).describe()

    def details(self) -> Mapping[str, str]:
        link = self._link
        if link is None:
            return {}
        identity = link.info.identity
        known = any(model.name == link.model.name for model in self._models)
        return {
            "model": link.model.name if known else f"{link.model.name} (guessed)",
            "system's name": identity.name,
            "ids": f"{identity.vendor:04x}:{identity.product:04x}",
            "kernel driver": identity.driver or "unknown",
            "device": link.info.path,
            "access": "read and write" if os.access(link.info.path, os.W_OK) else "read only, so it cannot rumble",
            "rumbles": "yes" if link.can_rumble else "no",
        }

    def close(self) -> None:
        self._drop_link()
        self._last = self._last._replace(axes=_RELEASED, buttons=frozenset(), connected=False, unknown=())
        self._is_open = False


def _built_in() -> tuple[PadModel, ...]:
    return tuple(pad_model(data) for data in load_pad_models(Problems()).values())
