"""The keyboard of the viewer's window as a gamepad."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar, NamedTuple

from hal.errors import ConnectionLost, NotSupported
from hal.gamepad import GamepadDriver, PadReading
from hal.host.mailbox import Mailbox

__all__ = [
    "AXIS_KEYS",
    "BUTTON_KEYS",
    "HELP",
    "KEYS",
    "LAYOUT",
    "KeyboardPad",
    "KeyboardRecord",
    "KeyboardSource",
    "grip",
]

AXIS_KEYS = {
    "Up": ("dpad_y", 1.0),
    "Down": ("dpad_y", -1.0),
    "Right": ("dpad_x", 1.0),
    "Left": ("dpad_x", -1.0),
    "w": ("left_y", 1.0),
    "s": ("left_y", -1.0),
    "d": ("left_x", 1.0),
    "a": ("left_x", -1.0),
    "i": ("right_y", 1.0),
    "k": ("right_y", -1.0),
    "l": ("right_x", 1.0),
    "j": ("right_x", -1.0),
    "space": ("l2", 1.0),
}
"""X's name of a key -> the axis that it pushes, and how far."""
BUTTON_KEYS = {
    "space": "l2",
    "Prior": "l1",
    "Next": "r1",
    "1": "south",
    "2": "east",
    "3": "west",
    "4": "north",
    "Return": "start",
    "Tab": "select",
    "Home": "home",
}
"""X's name of a key -> the button that it is."""
_CLOSE, _OPEN, _SLOW = "g", "h", "Shift_L"
_SLOWER = 0.3
"""How far keys push while the slow key is held."""
_GRIP_SPEED = 1.0
"""How fast r2 goes while its keys are held, full travels/s. It stays where it is when they are let go of."""

KEYS = (*dict.fromkeys((*AXIS_KEYS, *BUTTON_KEYS)), _CLOSE, _OPEN, _SLOW)
"""All keys that are looked at; a key's place here is its bit in the record."""
HELP = (
    "hold Space to move (l2); arrows: d-pad; Page Up/Down: l1/r1; WASD and IJKL: left and right stick; "
    "G/H: r2, close/open; 1 2 3 4: south east west north; Return: start; Home: home; Shift: slower"
)

LAYOUT = "ddQQd"
_LOOK = 0.005
"""s between two looks at a record that has not changed."""


class KeyboardRecord(NamedTuple):
    """What the viewer's process says of its keyboard, in a mailbox of :data:`LAYOUT`."""

    t_alive: float
    """When it last looked, s, on the monotonic clock."""
    t_event: float
    """When that last was another picture than before."""
    events: int
    mask: int
    """Bit k: key k of :data:`KEYS` is down, in a window that has the focus."""
    grip: float
    """r2, 0..1."""


def grip(value: float, held: frozenset[str], dt: float) -> float:
    """r2 after its keys were as in ``held`` for ``dt`` s."""
    return min(1.0, max(0.0, value + _GRIP_SPEED * dt * ((_CLOSE in held) - (_OPEN in held))))


class KeyboardSource(NamedTuple):
    """Where :class:`KeyboardPad` gets its record from."""

    mailbox: Mailbox
    clock: Callable[[], float]
    """The clock of the record's stamps."""
    check: Callable[[], None]
    """Raises ConnectionLost when the window is gone."""


class KeyboardPad(GamepadDriver):
    """Keys of the viewer's window; ``source`` is a :class:`KeyboardSource`.

    A window without the focus has no key down. When its process hangs, ``t_alive`` grows old; when the window is
    closed, the pad is not connected.
    """

    simulated: ClassVar[bool] = True
    _seen = 0

    def open(self) -> None:
        if not isinstance(self.source, KeyboardSource):
            raise NotSupported("the keyboard is that of the viewer's window: add --viewer gui")

    def poll(self, now: float, timeout: float) -> PadReading:
        source = self.source
        assert isinstance(source, KeyboardSource)
        self._wait(source, timeout)
        found = source.mailbox.read()
        connected = found is not None and self._there(source)
        if found is None or not connected:
            return PadReading(now, now, now, 0, {}, frozenset(), connected=False)
        record = KeyboardRecord(*found[1])
        shift = now - source.clock()  # from the record's clock to the rig's
        axes, buttons = _controls(record)
        t_event, t_alive = record.t_event + shift, record.t_alive + shift
        return PadReading(t_event, t_alive, record.t_event, record.events, axes, buttons, connected=True)

    def _wait(self, source: KeyboardSource, timeout: float) -> None:
        """The record has news of its own life every few ms; without a wait the poller would spin."""
        if timeout > 0.0 and source.mailbox.seq() == self._seen:
            time.sleep(min(timeout, _LOOK))
        self._seen = source.mailbox.seq()

    @staticmethod
    def _there(source: KeyboardSource) -> bool:
        try:
            source.check()
        except ConnectionLost:
            return False
        return True

    def describe(self) -> str:
        return f"keyboard of the viewer's window: {HELP}"

    def close(self) -> None:
        """Nothing to let go of: the window is the rig's."""


def _controls(record: KeyboardRecord) -> tuple[dict[str, float], frozenset[str]]:
    held = {key for bit, key in enumerate(KEYS) if record.mask >> bit & 1}
    reach = _SLOWER if _SLOW in held else 1.0
    axes = dict.fromkeys((axis for axis, _ in AXIS_KEYS.values()), 0.0)
    for key, (axis, value) in AXIS_KEYS.items():
        if key in held:
            axes[axis] += value if axis == "l2" else reach * value
    buttons = {button for key, button in BUTTON_KEYS.items() if key in held}
    if record.grip > 0.5:
        buttons.add("r2")
    return axes | {"r2": record.grip}, frozenset(buttons)
