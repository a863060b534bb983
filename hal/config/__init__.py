"""A rig's configuration: read, checked as a whole, and resolved into a :class:`~hal.specs.Plan`.

Start with :func:`load` in ``loader``. ``rigfile`` is the schema of a rig's file; ``models`` and ``objects`` are the
schemas of the files that it names, all built from ``schema``. ``files`` reads YAML and collects problems; ``resolve``
and its neighbours check everything against each other and make the records that drivers get.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .loader import RigConfig, load

__all__ = ["RigConfig", "load"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from . import loader  # on first use: it imports pydantic and yaml, which data_files does not need

        return getattr(loader, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
