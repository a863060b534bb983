"""Who drives: one page at a time, and every change of hands is an interruption of the pad."""

from __future__ import annotations

from typing import NamedTuple

from .padmessage import PadWatch

__all__ = ["Change", "Lease"]


class Change(NamedTuple):
    """The lease went from one page to another, or to nobody."""

    before: str | None
    """The page that drove."""
    driver: str | None
    """The page that drives now."""
    t: float
    why: str
    """For people; empty where nobody lost anything."""


class Lease:
    """The right to drive. Pages are known by their names, which are never used twice.

    Whoever takes it gets a new :class:`~.padmessage.PadWatch`, so nothing that a page sent while it did not drive, or
    the last time that it did, counts.
    """

    def __init__(self) -> None:
        self.driver: str | None = None
        self.watch: PadWatch | None = None
        """Judges the driver's pad; None while nobody drives."""
        self.why = ""
        """Of the newest change."""

    def take(self, page: str, now: float) -> Change | None:
        """``page`` drives from now on, whoever did. None where it does already."""
        if page == self.driver:
            return None
        return self._change(page, now, f"{page} took control" if self.driver is not None else "")

    def let_go(self, page: str, now: float, why: str) -> Change | None:
        """``page`` does not drive any more. None where it did not."""
        return self._change(None, now, why) if page == self.driver else None

    def watch_of(self, page: str) -> PadWatch | None:
        """The watch over this page's pad; None where it does not drive."""
        return self.watch if page == self.driver else None

    def _change(self, driver: str | None, now: float, why: str) -> Change:
        before, self.driver, self.why = self.driver, driver, why
        self.watch = PadWatch(now) if driver is not None else None
        return Change(before, driver, now, why)
