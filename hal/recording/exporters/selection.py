"""Which episodes."""

from __future__ import annotations

import re
from collections.abc import Collection

from ...errors import CommandError
from ..reader import Dataset, Episode

__all__ = ["chosen", "episode_numbers"]

_PART = re.compile(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?")


def episode_numbers(text: str) -> list[int]:
    """Numbers out of a text such as ``0,3-5``. CommandError for anything else."""
    found: list[int] = []
    for part in text.split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise CommandError(f"episodes are numbers and ranges such as 0,3-5, not {text!r}")
        first = int(match[1])
        last = first if match[2] is None else int(match[2])
        if last < first or last - first > 1_000_000:
            raise CommandError(f"{part.strip()} is no range of episodes")
        found.extend(range(first, last + 1))
    return found


def chosen(dataset: Dataset, wanted: str | Collection[int] | None, *, successful_only: bool) -> tuple[Episode, ...]:
    """Those episodes, each once, in the dataset's order. CommandError where there are none."""
    there = range(len(dataset.episodes))
    numbers = there if wanted is None else set(episode_numbers(wanted) if isinstance(wanted, str) else wanted)
    if unknown := sorted(set(numbers) - set(there)):
        raise CommandError(f"there is no episode {unknown[0]} in {dataset.root}; there are {len(there)}, from 0 on")
    found = [dataset.episodes[number] for number in sorted(numbers)]
    if successful_only:
        found = [episode for episode in found if episode.success]
    if not found:
        raise CommandError("none of these episodes is marked a success" if successful_only else "no episode was chosen")
    return tuple(found)
