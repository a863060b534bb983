"""An input system with a hand on the plugs, for the evdev driver."""

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
from hal.drivers.evdev.node import Event
from hal.drivers.evdev.pad import EvdevPad
from hal.drivers.evdev.system import NodeInfo
from hal.pads.codes import ABS, EV_ABS, EV_REL, EV_SYN, KEY, SYN_REPORT
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
        """Does it report how it stands as soon as it is opened? Until a pad does, nothing is known of it."""
        self.open_ends = 0
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
        """The kernel hangs up; a reader that comes before it looked sees ENODEV."""
        if hang_up:
            self._ends[1].close()
        else:
            self.gone = True
            os.write(self._writer, b".")

    def written(self) -> bytes:
        """What was written to the device since."""
        try:
            return os.read(self._writer, 65536)
        except BlockingIOError:
            return b""

    def claim(self) -> bool:
        free, self._claimed = not self._claimed, True
        self._refused += not free
        return free

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
        if self._refused:  # whoever was refused closes it first
            self._refused -= 1
        else:
            self._claimed = False

    def dispose(self) -> None:
        """The test is over."""
        for end in self._ends:
            end.close()


class FakeInput:
    """The driver's input system."""

    def __init__(self) -> None:
        self.plugged: dict[str, tuple[NodeInfo, FakeNode]] = {}
        self.forbidden: set[str] = set()
        self.changes = 0
        self.opened: list[str] = []
        self.made: list[FakeNode] = []

    def plug(self, identity: Identity, *, number: int = 3, uniq: str = "aa:bb", pad: bool = True) -> FakeNode:
        """A gamepad with the usual controls, or a device that is none."""
        axes = AXES if pad else {ABS["ABS_RX"]: AxisRange(-32768, 32767)}
        node = FakeNode(f"/dev/input/event{number}", axes, [KEY["BTN_SOUTH"]] if pad else [])
        return self.put(node, identity, uniq=uniq, pad=pad)

    def put(
        self, node: FakeNode, identity: Identity, *, uniq: str = "aa:bb", pad: bool = True, joystick: bool = False
    ) -> FakeNode:
        """Plug in a device of the test's own."""
        self.plugged[node.path] = NodeInfo(node.path, identity, uniq, f"/sys/{uniq}", pad, joystick), node
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
    """Makes open pads on that system: ``make(model, **options)``."""
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
    """Poll until a reading is as it should be; the driver looks for pads only a few times a second."""
    end = time.monotonic() + limit
    while not true(reading := pad.poll(time.monotonic(), 0.01)):
        assert time.monotonic() < end, f"it did not happen; the last reading is {reading}"
    return reading
