"""Report descriptors of HID devices, by the USB HID specification 1.11, section 6.2.2."""

from __future__ import annotations

__all__ = ["ABSOLUTE", "BUTTONS", "DESKTOP", "INPUT", "NULL_STATE", "OUTPUT", "RELATIVE"]
__all__ += ["collection", "data", "report", "vendor"]

DESKTOP, BUTTONS, _VENDOR = 0x01, 0x09, 0xFF00  # usage pages
INPUT, OUTPUT = 0x80, 0x90  # kinds of report
ABSOLUTE, RELATIVE, NULL_STATE = 0x02, 0x06, 0x42  # kinds of value

_USAGE_PAGE, _USAGE = 0x04, 0x08
_LOGICAL_MINIMUM, _LOGICAL_MAXIMUM, _PHYSICAL_MINIMUM, _PHYSICAL_MAXIMUM = 0x14, 0x24, 0x34, 0x44
_SIZE, _REPORT, _COUNT = 0x74, 0x84, 0x94
_COLLECTION, _END = 0xA0, 0xC0
_APPLICATION = 1


def collection(usage: int, *reports: bytes) -> bytes:
    """A whole device, called ``usage`` of the desktop page."""
    name = _item(_USAGE_PAGE, DESKTOP) + _item(_USAGE, usage)
    return name + _item(_COLLECTION, _APPLICATION) + b"".join(reports) + bytes((_END,))


def report(number: int, *fields: bytes) -> bytes:
    """The report of that number, of ``fields`` one after the other."""
    return _item(_REPORT, number) + b"".join(fields)


def data(page: int, usages: tuple[int, ...], low: int, high: int, bits: int, kind: int = ABSOLUTE) -> bytes:
    """Inputs from ``low`` to ``high``, one of ``bits`` bits for each usage."""
    names = b"".join(_item(_USAGE, usage) for usage in usages)
    limits = _item(_LOGICAL_MINIMUM, low) + _item(_LOGICAL_MAXIMUM, high)
    limits += _item(_PHYSICAL_MINIMUM, low) + _item(_PHYSICAL_MAXIMUM, high)
    return _item(_USAGE_PAGE, page) + names + limits + _fields(INPUT, len(usages), bits, kind)


def vendor(tag: int, count: int, bits: int = 8) -> bytes:
    """Inputs or outputs that only the maker's own driver understands."""
    limits = _item(_LOGICAL_MINIMUM, 0) + _item(_LOGICAL_MAXIMUM, (1 << bits) - 1)
    return _item(_USAGE_PAGE, _VENDOR) + _item(_USAGE, 0x20) + limits + _fields(tag, count, bits, ABSOLUTE)


def _fields(tag: int, count: int, bits: int, kind: int) -> bytes:
    return _item(_SIZE, bits) + _item(_COUNT, count) + _item(tag, kind)


def _item(tag: int, value: int) -> bytes:
    """One item, as short as its value allows."""
    for code, size in ((1, 1), (2, 2), (3, 4)):
        if -(1 << 8 * size - 1) <= value < 1 << 8 * size - 1:
            return bytes((tag | code,)) + value.to_bytes(size, "little", signed=True)
    raise ValueError(f"{value} needs more than 32 bits")
