"""A gamepad in memory, operated by a test."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import ClassVar

from hal.driver import GamepadDriver, PadReading
from hal.errors import CommandError
from hal.specs import PadSpec
from hal.types import AXES, BUTTONS, ONE_SIDED

from .faults import MockDevice, MockPadFaults

_TRIGGERS = tuple(name for name in BUTTONS if name in AXES)
_TRIGGER_PRESSED = 0.1  # travel from which on a trigger, which is also a button, counts as pressed


class MockPad(MockDevice[MockPadFaults], GamepadDriver):
    """A pad whose sticks and buttons a test moves: ``press``, ``release``, ``stick``, ``set``.

    A change becomes an event at the next ``poll``, with that poll's time. Triggers are axis and button in one, as on a
    real pad: pressing ``l2`` moves its axis to 1, and moving its axis presses it. Any thread may move them. Faults:
    :class:`~hal.drivers.mock.faults.MockPadFaults`.
    """

    kind: ClassVar[str] = "gamepad"
    simulated: ClassVar[bool] = True
    proves_liveness: bool = True

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self.faults = MockPadFaults()
        self.meant_for: str | None = None
        """Value of :attr:`mapping`."""
        self.rumbles: list[tuple[float, float, float]] = []
        """Every call of ``rumble``: shares of the heavy and the light motor, and s."""
        self._axes = dict.fromkeys(AXES, 0.0)
        self._buttons: frozenset[str] = frozenset()
        self._lock = threading.Lock()
        self._news = threading.Event()
        self._t_first: float | None = None
        self._reading: PadReading | None = None

    # Operating it.

    def press(self, *buttons: str) -> None:
        """Press buttons (of ``hal.types.BUTTONS``) and keep them pressed. Raises CommandError for another name."""
        self._set_buttons(buttons, True)

    def release(self, *buttons: str) -> None:
        """Release buttons. Raises CommandError for another name."""
        self._set_buttons(buttons, False)

    def stick(self, axis: str, value: float) -> None:
        """Move one axis (of ``hal.types.AXES``): -1..1, triggers 0..1. Raises CommandError for anything else."""
        self.set(axes={axis: value})

    def set(self, axes: Mapping[str, float] | None = None, buttons: Iterable[str] | None = None) -> None:
        """Move the named axes, and press exactly the given buttons; None leaves them as they are.

        Raises CommandError for an unknown name (code ``unknown_control``) or a value out of range (``out_of_range``);
        nothing changes.
        """
        wanted = None if buttons is None else frozenset(buttons)
        _check(axes or {}, wanted or frozenset())
        with self._lock:
            if wanted is not None:
                self._buttons = wanted
                self._axes.update({name: float(name in wanted) for name in _TRIGGERS})
            for name, value in (axes or {}).items():
                self._axes[name] = float(value)
                if name in _TRIGGERS:
                    pressed = value >= _TRIGGER_PRESSED
                    self._buttons = self._buttons | {name} if pressed else self._buttons - {name}
        self._news.set()

    def _set_buttons(self, buttons: tuple[str, ...], pressed: bool) -> None:
        _check({}, buttons)
        with self._lock:
            self._buttons = self._buttons.union(buttons) if pressed else self._buttons.difference(buttons)
            self._axes.update({name: float(pressed) for name in _TRIGGERS if name in buttons})
        self._news.set()

    # As a driver.

    def open(self) -> None:
        self.is_open = True

    def poll(self, now: float, timeout: float) -> PadReading:
        if timeout > 0.0:
            self._news.wait(timeout)
        self._news.clear()
        if self._t_first is None:
            self._t_first = now
        last = self._reading
        if self.faults.freeze and last is not None:
            return last
        with self._lock:
            axes, buttons = dict(self._axes), self._buttons
        connected = self.is_open and not self.faults.disconnect
        if not connected:
            axes, buttons = dict.fromkeys(AXES, 0.0), frozenset()
        changed = last is None or (last.axes, last.buttons, last.connected) != (axes, buttons, connected)
        t = now if changed or last is None else last.t
        self._reading = PadReading(
            t=t,
            t_alive=now if connected else (last.t_alive if last is not None else float("-inf")),
            t_device=t - self._t_first,
            seq=(last.seq if last is not None else 0) + int(changed),
            axes=MappingProxyType(axes),
            buttons=buttons,
            connected=connected,
        )
        return self._reading

    @property
    def mapping(self) -> str | None:
        return self.meant_for

    def rumble(self, strong: float, weak: float, seconds: float) -> bool:
        self.rumbles.append((strong, weak, seconds))
        return True

    def describe(self) -> str:
        return "a mock pad"

    def inject(self, **faults: object) -> None:
        super().inject(**faults)
        self._news.set()

    def clear(self) -> None:
        """Remove every fault: the pad is plugged in and sends."""
        super().clear()
        self._news.set()

    def close(self) -> None:
        self.is_open = False


def _check(axes: Mapping[str, float], buttons: Iterable[str]) -> None:
    for name in buttons:
        if name not in BUTTONS:
            raise CommandError(f"unknown button {name!r}; buttons: {', '.join(BUTTONS)}", code="unknown_control")
    for name, value in axes.items():
        if name not in AXES:
            raise CommandError(f"unknown axis {name!r}; axes: {', '.join(AXES)}", code="unknown_control")
        lowest = 0.0 if name in ONE_SIDED else -1.0
        if not lowest <= value <= 1.0:
            raise CommandError(f"{name} is from {lowest:g} to 1, not {value!r}", code="out_of_range")
