"""Convert the raw events of a gamepad into the axes and buttons that are the same for every pad."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from ..deadman import Threshold
from ..types import AXES, BUTTONS, ONE_SIDED
from .codes import ABS, EV_ABS, EV_KEY, EV_REL, KEY, REL

if TYPE_CHECKING:
    from .model import PadModel

REL_SILENCE = 0.1
"""Time without an event after which a ``REL_`` axis is at rest, s: no event is sent when it is released. A pushed cap
reports at the rate of USB, every 8 or 16 ms, so late reports do not interrupt a motion. The time is shorter than the
120 ms after which a silent pad stops the arm."""


class AxisRange(NamedTuple):
    """Range of one axis, in the pad's own units."""

    minimum: int
    maximum: int
    flat: int = 0
    """Distance from the middle that counts as rest."""

    def normalise(self, value: int, one_sided: bool) -> float:
        """Return a value from -1 to 1 for a stick, from 0 to 1 for a one-sided axis."""
        share = (value - self.minimum) / (self.maximum - self.minimum)
        share = min(1.0, max(0.0, share))
        return share if one_sided else 2.0 * share - 1.0


class _Axis(NamedTuple):
    control: str
    sign: float
    range: AxisRange

    def value(self, raw: int) -> float:
        one_sided = self.control in ONE_SIDED
        share = self.range.normalise(raw, one_sided)
        return 1.0 - share if one_sided and self.sign < 0.0 else self.sign * share + 0.0  # no -0.0


class PadMapper:
    """The canonical state of one pad, updated from its events or from the state that the kernel reports.

    An axis is unknown, with the value 0, until its first event or until :meth:`sync`. If the triggers of a pad are only
    axes, or only buttons, the other is computed.

    Args:
        model: The pad's model.
        ranges: Event code -> range of the ``ABS_`` axes that the pad reports.
        rels: Event codes of its ``REL_`` axes. An axis of the model that is in neither does not exist.
    """

    def __init__(self, model: PadModel, ranges: Mapping[int, AxisRange], rels: Collection[int] = ()) -> None:
        self.model = model
        self._axes: dict[int, _Axis] = {}
        self._rels: dict[int, _Axis] = {}
        for code_name, text in model.axes.items():
            control, sign = text.removeprefix("-"), -1.0 if text.startswith("-") else 1.0
            known = AxisRange(*model.ranges[code_name]) if code_name in model.ranges else None
            if code_name in REL:
                if REL[code_name] in rels and known is not None:
                    self._rels[REL[code_name]] = _Axis(control, sign, known)
                continue
            span = ranges.get(ABS[code_name])
            if span is not None and known is not None:
                span = known._replace(flat=span.flat)
            if span is not None and span.maximum > span.minimum:
                self._axes[ABS[code_name]] = _Axis(control, sign, span)
        self._keys = {KEY[name]: control for name, control in model.buttons.items()}
        axes = (*self._axes.values(), *self._rels.values())
        reported = self._reported = frozenset(axis.control for axis in axes)
        pressed = set(self._keys.values())
        self._computed_axes = tuple(name for name in AXES if name in pressed - reported)
        self._thresholds = {name: Threshold() for name in BUTTONS if name in reported - pressed}
        directions = {control[1:] for control in pressed if control[0] in "+-"}
        self._controls = (*sorted(reported | directions), *self._computed_axes)
        self.flat: Mapping[str, float] = {
            axis.control: axis.range.flat / (axis.range.maximum - axis.range.minimum) * _measure_range(axis.control)
            for axis in axes
        }
        """Share of each axis' travel from neutral that the pad declares as rest."""
        self._heard: dict[int, float] = {}
        """Time of the last event of each ``REL_`` axis, or of the first check without one."""
        self._fed: set[str] = set()
        """Controls that an event has set."""
        self.axes: dict[str, float] = {}
        self.buttons: frozenset[str] = frozenset()
        self.unknown: frozenset[str] = frozenset()
        """Axes without an event yet; their value is 0."""
        self.release()

    def release(self) -> None:
        """Make every control neutral and every axis unknown."""
        self.axes = dict.fromkeys(self._controls, 0.0)
        self.buttons = frozenset()
        self.unknown = frozenset(axis.control for axis in (*self._axes.values(), *self._rels.values()))
        self._heard.clear()
        self._fed.clear()
        for threshold in self._thresholds.values():
            threshold.held = False

    def feed(self, kind: int, code: int, value: int, t: float = 0.0) -> bool:
        """Apply an event of time ``t`` (s, the clock of :meth:`expire`); return whether the model has its control."""
        if kind == EV_ABS and code in self._axes:
            axis = self._axes[code]
            self._fed.add(axis.control)
            self._set_axis(axis.control, axis.value(value))
        elif kind == EV_REL and code in self._rels:
            axis = self._rels[code]
            self._heard[code] = t
            self._fed.add(axis.control)
            self._set_axis(axis.control, axis.value(value))
        elif kind == EV_KEY and code in self._keys:
            self._fed.add(self._keys[code])
            self._set_key(self._keys[code], value != 0)
        else:
            return False
        return True

    def expire(self, now: float) -> bool:
        """Reset the ``REL_`` axes that have had no event for :data:`REL_SILENCE`; return whether one changed."""
        changed = False
        for code, axis in self._rels.items():
            silent = now - self._heard.setdefault(code, now) >= REL_SILENCE
            if silent and self.axes[axis.control]:
                self._set_axis(axis.control, 0.0)
                changed = True
        return changed

    def sync(self, values: Mapping[int, int], keys: Iterable[int], *, rest: bool = False) -> None:
        """Apply the state that the kernel reports.

        Only for a pad that has sent a report: before the first one the kernel's state is wrong (hid-sony: 0, a stick
        held to the left; hid-playstation and xpad: a pad at rest). The kernel has no state of ``REL_`` axes: they are
        reset until their next event.

        Args:
            values: Event code -> value of the axes.
            keys: Event codes of the pressed buttons.
            rest: Only set the controls that no event has set yet.
        """
        for code, value in values.items():
            axis = self._axes.get(code)
            if axis is not None and not (rest and axis.control in self._fed):
                self._set_axis(axis.control, axis.value(value))
        for axis in self._rels.values():
            if not (rest and axis.control in self._fed):
                self._set_axis(axis.control, 0.0)
        down = {self._keys[code] for code in keys if code in self._keys}
        for control in set(self._keys.values()):
            if rest and control in self._fed:
                continue
            if control in down or control[1:] not in self._reported:  # else the d-pad's axis has set it
                self._set_key(control, control in down)

    def press(self, control: str, down: bool) -> None:
        """Press or release a button that another device of the pad reports."""
        self._set_button(control, down)

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


def _measure_range(control: str) -> float:
    return 1.0 if control in ONE_SIDED else 2.0
