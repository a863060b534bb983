"""The libraries that recording needs, and what to say where they are missing."""

from __future__ import annotations

import importlib.util

from ..errors import DriverMissing

__all__ = ["require"]

_LIBRARIES = ("pyarrow", "av", "zstandard")


def require() -> None:
    """Raise DriverMissing, with the command that installs them, where a library is missing. Imports none of them."""
    missing = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise DriverMissing(
            f"recordings need {', '.join(missing)}; install with: pip install 'robot-hal[record]'", name=missing[0]
        )
