"""Checks of arguments: each returns the value, or raises a CommandError that names the argument and what it must be."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import CommandError

Array = NDArray[np.float64]


def freeze(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Return a read-only copy of ``values`` as an array."""
    array = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array


def number(
    name: str, value: Any, unit: str = "", *, least: float = -math.inf, most: float = math.inf, above: bool = False
) -> float:
    """Return one finite number from ``least`` to ``most``, as a float.

    Args:
        name: Name of the argument, for the message.
        value: The argument.
        unit: Unit, for the message.
        least: Smallest value allowed.
        most: Greatest value allowed; infinity itself never is.
        above: Whether the value must be above ``least``, which is then 0, instead of at least that.

    Raises:
        CommandError: Not a number, not finite, or out of range.
    """
    try:
        if isinstance(value, (bool, str, bytes)) or np.ndim(value) != 0:
            raise TypeError
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        raise CommandError(f"{name} must be {_show_range(unit, least, most, above)}, not {_show(value)}") from None
    if not math.isfinite(found) or found < least or found > most or (above and found == least):
        raise CommandError(f"{name} must be {_show_range(unit, least, most, above)}, not {found:g}")
    return found


def integer(name: str, value: Any, *, least: int, code: str | None = None) -> int:
    """Return an integer of at least ``least``. Raises CommandError, with this code, for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise CommandError(f"{name} must be a whole number of at least {least}, not {_show(value)}", code=code)
    return int(value)


def choice(name: str, value: str, choices: Collection[str], code: str | None = None) -> str:
    """Return one of ``choices``. Raises CommandError, with this code, for anything else."""
    if value not in choices:
        raise CommandError(f"{name} must be one of {', '.join(choices)}, not {_show(value)}", code=code)
    return value


def vector(name: str, values: Any, size: int | None = None) -> Array:
    """Return a read-only vector (size,) of finite numbers; of any length if ``size`` is None.

    Raises:
        CommandError: Another shape, not numbers, or a number that is not finite.
    """
    try:
        array = freeze(values)
    except (TypeError, ValueError, OverflowError) as error:
        raise CommandError(f"{name} must be numbers: {error}") from None
    if array.ndim != 1 or (size is not None and array.size != size):
        raise CommandError(f"{name} must have shape ({size if size is not None else 'n'},), not {array.shape}")
    # The sum of the squares is finite when all are; where it is not, it may only be too great.
    if not math.isfinite(array.dot(array)) and not np.isfinite(array).all():
        raise CommandError(f"{name} holds a number that is not finite: {array.tolist()}")
    return array


def _show_range(unit: str, least: float, most: float, above: bool) -> str:
    kind = "a positive number" if above and least == 0.0 else "a finite number"
    low = f" of at least {least:g}" if math.isfinite(least) and not above else ""
    high = f"{' and' if low else ' of'} at most {most:g}" if math.isfinite(most) else ""
    return f"{kind}{low}{high}{f' ({unit})' if unit else ''}"


def _show(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, int) and value.bit_length() > 1000:
        return "a whole number beyond what a float holds"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
