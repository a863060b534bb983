"""``recover``: whatever a program that was killed, or a full disk, left behind becomes an episode."""

from __future__ import annotations

from pathlib import Path

from ..errors import CommandError, HalError
from .finalise import finalise
from .layout import Layout, locked
from .library import require

__all__ = ["recover", "recover_all"]


def recover(out: str | Path) -> list[str]:
    """Repair the dataset in the folder ``out``; what was done comes back in words, nothing when nothing was to be done.

    Every episode that was begun and not finished is closed with its last whole row, and becomes part of the dataset,
    unmarked (``success`` is None) unless it had been marked already.

    Raises DriverMissing, CommandError (no such folder, or another program is recording into it), OSError (the disk),
    and HalError for what cannot be made an episode.
    """
    require()
    layout = Layout(out)
    if not layout.root.is_dir():
        raise CommandError(f"there is no folder {layout.root}")
    if not layout.episodes.is_dir():
        return []
    with locked(layout):
        return recover_all(layout)


def recover_all(layout: Layout) -> list[str]:
    """The same, of a dataset that is locked."""
    layout.sweep()
    done = []
    for partial in layout.partials():
        try:
            number = finalise(layout, partial)
        except OSError:
            raise
        except Exception as error:  # damaged in a way that no crash leaves behind
            why = f"{type(error).__name__}: {error}"
            raise HalError(f"{partial} cannot be made an episode ({why}); move it elsewhere, and go on") from error
        if number is None:
            done.append(f"{partial.name} held no whole row and was removed")
        else:
            done.append(f"{partial.name} was not finished: recovered as episode {number}")
    return done
