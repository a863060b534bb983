"""From a pad's raw events to the canonical axes and buttons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from ..deadman import Threshold
from .codes import ABS, EV_ABS, EV_KEY, KEY

if TYPE_CHECKING:
    from .model import PadModel

__all__ = ["AxisRange", "PadMapper"]

_TRIGGERS = ("l2", "r2")
# An axis that the system shows this near to neutral is believed before its first event.
_AT_REST = 0.25


class AxisRange(NamedTuple):
    """What a pad says about one of its axes, in its own numbers."""

    minimum: int
    maximum: int
    flat: int = 0
    """Values this near to the middle mean nothing."""

    def normalised(self, value: int, trigger: bool) -> float:
        """-1..1 for a stick, 0..1 for a trigger."""
        share = (value - self.minimum) / (self.maximum - self.minimum)
        share = min(1.0, max(0.0, share))
        return share if trigger else 2.0 * share - 1.0


class _Axis(NamedTuple):
    control: str
    sign: float
    range: AxisRange

    def value(self, raw: int) -> float:
        """The canonical value."""
        return self.sign * self.range.normalised(raw, self.control in _TRIGGERS) + 0.0  # no -0.0


class PadMapper:
    """Keeps the canonical state of one pad: feed it events, or what the system says is the present state.

    ``ranges`` holds what the pad says about its axes, by event code; an axis of the model that is not in there does
    not exist. An axis counts as unknown, and shows 0, until its first event: before that the system may show 0, which
    on many pads is a stick held to the left (hid-sony does so until the first report). One that the system shows at
    rest is believed.

    A pad whose triggers are only axes, or only buttons, gets the other one computed.
    """

    def __init__(self, model: PadModel, ranges: Mapping[int, AxisRange]) -> None:
        self.model = model
        self._axes: dict[int, _Axis] = {}
        for code_name, text in model.axes.items():
            code = ABS[code_name]
            span = ranges.get(code)
            if span is not None and code_name in model.ranges:
                span = AxisRange(*model.ranges[code_name], span.flat)
            if span is not None and span.maximum > span.minimum:
                self._axes[code] = _Axis(text.removeprefix("-"), -1.0 if text.startswith("-") else 1.0, span)
        self._keys = {KEY[name]: control for name, control in model.buttons.items()}
        reported = {axis.control for axis in self._axes.values()}
        pressed = set(self._keys.values())
        self._computed_axes = tuple(name for name in _TRIGGERS if name in pressed - reported)
        self._thresholds = {name: Threshold() for name in _TRIGGERS if name in reported - pressed}
        directions = {control[1:] for control in pressed if control[0] in "+-"}
        self._controls = (*sorted(reported | directions), *self._computed_axes)
        self.flat: Mapping[str, float] = {
            axis.control: axis.range.flat / (axis.range.maximum - axis.range.minimum) * _spread(axis.control)
            for axis in self._axes.values()
        }
        """Share of each axis' travel from neutral that the pad says means nothing."""
        self.axes: dict[str, float] = {}
        self.buttons: frozenset[str] = frozenset()
        self.unknown: frozenset[str] = frozenset()
        """Axes that the pad has not spoken of yet; they show 0."""
        self.release()

    def release(self) -> None:
        """Everything neutral, and no axis known."""
        self.axes = dict.fromkeys(self._controls, 0.0)
        self.buttons = frozenset()
        self.unknown = frozenset(axis.control for axis in self._axes.values())
        for threshold in self._thresholds.values():
            threshold.held = False

    def feed(self, kind: int, code: int, value: int) -> bool:
        """Take one event; True when it was about a control that the model knows."""
        if kind == EV_ABS and code in self._axes:
            axis = self._axes[code]
            self._set_axis(axis.control, axis.value(value))
        elif kind == EV_KEY and code in self._keys:
            self._set_key(self._keys[code], value != 0)
        else:
            return False
        return True

    def sync(self, values: Mapping[int, int], keys: Iterable[int], *, trusted: bool) -> None:
        """Take the state that the system shows: axis code -> value, and the codes of the pressed buttons.

        Before a pad's first events (``trusted=False``) only axes at rest are believed.
        """
        for code, value in values.items():
            axis = self._axes.get(code)
            if axis is None:
                continue
            shown = axis.value(value)
            if trusted or abs(shown) <= _AT_REST:
                self._set_axis(axis.control, shown)
        down = set(keys)
        for code, control in self._keys.items():
            self._set_key(control, code in down)

    def _set_axis(self, control: str, value: float) -> None:
        self.axes[control] = value
        self.unknown -= {control}
        if control in self._thresholds:
            self._set_button(control, self._thresholds[control].update(value))

    def _set_key(self, control: str, down: bool) -> None:
        if control[0] in "+-":
            step = 1.0 if control[0] == "+" else -1.0
            name = control[1:]
            if down:
                self.axes[name] = step
            elif self.axes[name] == step:
                self.axes[name] = 0.0
            return
        self._set_button(control, down)
        if control in self._computed_axes:
            self.axes[control] = float(down)

    def _set_button(self, control: str, down: bool) -> None:
        self.buttons = self.buttons | {control} if down else self.buttons - {control}


def _spread(control: str) -> float:
    """Length of an axis' canonical range."""
    return 1.0 if control in _TRIGGERS else 2.0
