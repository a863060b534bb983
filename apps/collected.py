"""What a run of ``apps/collect.py`` has collected."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from concurrent.futures import Future

    from hal.recording import RecorderStatus

__all__ = ["Kept", "summary"]


@dataclass(frozen=True, slots=True)
class Kept:
    """An episode that is being saved, or is."""

    number: int
    seed: int
    success: bool | None
    """None where nobody said: the run ended while it was recorded."""
    status: Future[RecorderStatus]
    """The recorder's, once it is saved."""

    @property
    def failure(self) -> str:
        """Why it could not be saved; nothing as long as that is not so."""
        return str(self.status.exception()) if self.status.done() and self.status.exception() is not None else ""

    def as_json(self) -> dict[str, Any]:
        """For a report, once it is saved or failed."""
        said = {"number": self.number, "seed": self.seed, "success": self.success, "failure": self.failure}
        return said if self.failure else said | self.status.result()._asdict()


def summary(kept: Sequence[Kept], root: Path, discarded: int, ended: str) -> Iterator[str]:
    """How it went, for people, when everything is saved or failed; ``ended`` is why it ended early."""
    saved = [one for one in kept if not one.failure]
    for one in kept:
        if one.failure:
            yield f"NOT SAVED: episode {one.number}: {one.failure}"
    if ended:
        yield f"ended: {ended}"
    found = [one.status.result() for one in saved]
    rows, seconds = sum(status.frames for status in found), sum(status.seconds for status in found)
    dropped, marks = sum(status.dropped for status in found), [one.success for one in saved]
    unmarked = f", {marks.count(None)} not marked" if None in marks else ""
    yield (
        f"{len(saved)} episode(s) saved in {root}: {rows} rows, {seconds:.1f} s, {dropped} dropped; "
        f"{marks.count(True)} succeeded, {marks.count(False)} failed{unmarked}, {discarded} forgotten"
    )
    if saved:
        yield f"look at them: hal-review {root}"
