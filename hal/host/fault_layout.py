"""How a fault lies in memory: a mark that there is one, then three texts of fixed length."""

from __future__ import annotations

import struct
from typing import Any

from ..types import Fault

__all__ = ["FORMAT", "fault_at", "fault_of", "fault_values"]

_TEXTS = (48, 160, 240)  # bytes for a fault's code, cause and remedy
FORMAT = "?" + "".join(f"{size}s" for size in _TEXTS)
"""For :mod:`struct`; four values."""
_FAULT = struct.Struct("<" + FORMAT)
_NO_FAULT = (False, b"", b"", b"")


def fault_values(fault: Fault | None) -> tuple[Any, ...]:
    """The values of a record; texts that are too long are cut."""
    if fault is None:
        return _NO_FAULT
    texts = (fault.code, fault.cause, fault.remedy)
    return (True, *(text.encode()[:size] for text, size in zip(texts, _TEXTS, strict=True)))


def fault_of(there: bool, *texts: bytes) -> Fault | None:
    """The fault that such values stand for."""
    return Fault(*(text.rstrip(b"\0").decode(errors="ignore") for text in texts)) if there else None


def fault_at(record: bytes, offset: int) -> Fault | None:
    """The fault that lies in a record; most have none, which one byte says."""
    return fault_of(*_FAULT.unpack_from(record, offset)) if record[offset] else None
