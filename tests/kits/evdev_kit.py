"""A fake input system whose devices a test plugs in and out, for the evdev driver."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from hal.driver import PadReading
from hal.drivers.evdev.finder import Event, NodeInfo
from hal.drivers.evdev.pad import EvdevPad
from hal.pads.codes import ABS, BUS_USB, EV_ABS, EV_REL, EV_SYN, KEY, SYN_REPORT
from hal.pads.mapper import AxisRange
from hal.pads.model import Identity
from hal.specs import PadSpec

ROOT = Path(__file__).parents[2]
MODELS = tuple(
    yaml.safe_load(path.read_text(encoding="utf-8")) for path in sorted((ROOT / "sensors" / "gamepads").glob("*.yaml"))
)
STICKS = ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY")
AXES = {ABS[name]: AxisRange(0, 255, 15) for name in (*STICKS, "ABS_Z", "ABS_RZ")}
AXES |= {ABS[name]: AxisRange(-1, 1) for name in ("ABS_HAT0X", "ABS_HAT0Y")}
REST = [(EV_ABS, ABS[name], 128) for name in STICKS]
DS4 = Identity("Wireless Controller", 0x054C, 0x09CC, BUS_USB, "playstation")


class FakeNode:
    """An input device on a pair of sockets, so that waiting for it, writing to it and losing it are real."""

    def __init__(
        self, path: str, axes: Mapping[int, AxisRange], keys: Collection[int], rels: Collection[int] = ()
    ) -> None:
        self.path = path
        self.axes = dict(axes)
        self.keys = frozenset(keys)
        self.rels = frozenset(rels)
        self.can_rumble = False
        self.shown: dict[int, int] = {code: _rest(code, span) for code, span in self.axes.items()}
        self.down: list[int] = []
        self.gone = False
        self.speaks = True
        """Whether it reports its state as soon as it is opened."""
        self.open_ends = 0
        self.grabbed = False
        self._claimed, self._refused = False, 0
        self._waiting: list[Event] = []
        self._ends = socket.socketpair()
        self._reader, self._writer = (end.fileno() for end in self._ends)
        os.set_blocking(self._writer, False)

    def send(self, *events: tuple[int, int, int], t: float | None = None, whole: bool = True) -> None:
        t = time.monotonic() if t is None else t
        end = [(EV_SYN, SYN_REPORT, 0)] if whole else []
        self._waiting += [Event(*event, t, t) for event in (*events, *end)]
        os.write(self._writer, b".")

    def unplug(self, *, hang_up: bool) -> None:
        """Unplug it: by a hang-up, or as a reader sees it that comes first, by ENODEV."""
        if hang_up:
            self._ends[1].close()
        else:
            self.gone = True
            os.write(self._writer, b".")

    def written(self) -> bytes:
        """Return what was written to the device since the last call."""
        try:
            return os.read(self._writer, 65536)
        except BlockingIOError:
            return b""

    def claim(self) -> bool:
        free, self._claimed = not self._claimed, True
        self._refused += not free
        return free

    def grab(self) -> None:
        self.grabbed = True

    def fileno(self) -> int:
        return self._reader

    def read(self) -> Sequence[Event]:
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")
        events, self._waiting = self._waiting, []
        if events:
            os.read(self._reader, 4096)
        return events

    def snapshot(self) -> tuple[dict[int, int], list[int]]:
        return dict(self.shown), list(self.down)

    def close(self) -> None:
        self.open_ends -= 1
        if self._refused:  # the refused opening closes it first
            self._refused -= 1
        else:
            self._claimed = False

    def dispose(self) -> None:
        """Close its descriptors at the end of the test."""
        for end in self._ends:
            end.close()


class FakeInput:
    """An :class:`~hal.drivers.evdev.finder.LinuxInput` in memory."""

    def __init__(self) -> None:
        self.plugged: dict[str, tuple[NodeInfo, FakeNode]] = {}
        self.forbidden: set[str] = set()
        self.changes = 0
        self.opened: list[str] = []
        self.made: list[FakeNode] = []

    def plug(self, identity: Identity, *, number: int = 3, uniq: str = "aa:bb", pad: bool = True) -> FakeNode:
        """Plug in a gamepad with the usual controls, or another device."""
        axes = AXES if pad else {ABS["ABS_RX"]: AxisRange(-32768, 32767)}
        node = FakeNode(f"/dev/input/event{number}", axes, [KEY["BTN_SOUTH"]] if pad else [])
        return self.put(node, identity, uniq=uniq, pad=pad)

    def put(
        self,
        node: FakeNode,
        identity: Identity,
        *,
        uniq: str = "aa:bb",
        pad: bool = True,
        joystick: bool = False,
        keyboard: bool = False,
    ) -> FakeNode:
        """Plug in a device that the test made."""
        self.plugged[node.path] = NodeInfo(node.path, identity, uniq, f"/sys/{uniq}", pad, joystick, keyboard), node
        self.made.append(node)
        self.changes += 1
        return node

    def unplug(self, node: FakeNode, *, hang_up: bool = True) -> None:
        del self.plugged[node.path]
        self.changes += 1
        node.unplug(hang_up=hang_up)

    def allow(self, path: str) -> None:
        self.forbidden.discard(path)
        self.changes += 1

    def nodes(self) -> list[NodeInfo]:
        return [info for info, _ in self.plugged.values()]

    def fingerprint(self) -> object:
        return self.changes

    def open(self, path: str) -> FakeNode:
        if path in self.forbidden:
            raise PermissionError(errno.EACCES, "Permission denied", path)
        self.opened.append(path)
        info, node = self.plugged[path]
        node.open_ends += 1
        if node.speaks and (info.is_pad or info.is_joystick):
            code, value = next(iter(node.shown.items()), (next(iter(node.rels), 0), 0))
            node.send((EV_ABS if node.shown else EV_REL, code, value))
        return node


def _rest(code: int, span: AxisRange) -> int:
    trigger = code in (ABS["ABS_Z"], ABS["ABS_RZ"], ABS["ABS_GAS"], ABS["ABS_BRAKE"])
    return span.minimum if trigger and span.minimum == 0 else (span.minimum + span.maximum + 1) // 2


MakePad = Callable[..., EvdevPad]


@contextmanager
def pads_on(system: FakeInput) -> Iterator[MakePad]:
    """Yield a function that opens pads on ``system``: ``make(model, **options)``."""
    made: list[EvdevPad] = []

    def make(model: dict[str, Any] | None = None, **options: object) -> EvdevPad:
        pad = EvdevPad(PadSpec("pad", "evdev", model, MODELS, options=options), system=system)
        made.append(pad)
        pad.open()
        return pad

    try:
        yield make
    finally:
        for pad in made:
            pad.close()
        for node in system.made:
            node.dispose()


def poll(pad: EvdevPad) -> PadReading:
    return pad.poll(time.monotonic(), 0.0)


def poll_until(pad: EvdevPad, true: Callable[[PadReading], bool], limit: float = 10.0) -> PadReading:
    """Poll until a reading is as wanted; the driver scans for pads a few times a second."""
    end = time.monotonic() + limit
    while not true(reading := pad.poll(time.monotonic(), 0.01)):
        assert time.monotonic() < end, f"the last reading is {reading}"
    return reading
