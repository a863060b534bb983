"""Which vendor's library talks to which arm. The library is imported when it is first used."""

from __future__ import annotations

from hal.errors import DriverMissing

from .link import Link

__all__ = ["link_to"]

_EXTRAS = {"fr3": "franka", "fer": "panda"}


def link_to(arm: str) -> Link:
    """A link, not connected, to an ``fr3`` or a ``fer``. Raises DriverMissing where its library is missing."""
    try:
        if arm == "fr3":
            from .fr3 import Fr3Link

            return Fr3Link()
        from .panda import PandaLink

        return PandaLink()
    except ImportError as error:
        advice = f"install it with: pip install 'robot-hal[{_EXTRAS[arm]}]'"
        raise DriverMissing(f"driver 'franka' does not import: {error}; {advice}", name=error.name) from error
