"""Change the marks of finished episodes where they are.

Only the files that hold these episodes are written, anew, in ``episodes/change.partial``. Then a list of their
destinations is written: from here on the change counts as made, and whatever opens the dataset next to write into it
completes it (:mod:`~hal.recording.finish`). Files that are linked into other datasets stay as they are there.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError
from .about import read_about
from .codecs import column_stats, exchange_flags, stats_as_lists
from .dataset import Dataset
from .finish import last_row, move_files, recover_all, write_table
from .foreign import is_foreign
from .index import column_values, make_column, read_stats, read_table
from .layout import (
    MOVES,
    SUCCESS,
    DatasetLayout,
    EpisodePlace,
    lock_dataset,
    read_json,
    sync_to_disk,
    write_json,
)
from .validation import dataset_errors, wrong_file


def mark_episodes(dataset: str | Path | Dataset, marks: Mapping[int, bool | None]) -> None:
    """Mark episodes as a success (True), a failure (False) or neither (None).

    Takes as long as the files of these episodes need, however many others there are.

    Raises:
        CommandError: There is no such episode (code ``no_episodes``), the dataset has changed since it was opened
            (``dataset_changed``), or it was edited by another program (``foreign_dataset``).
        DatasetError: The dataset is damaged; nothing was changed.
        OSError: The disk refuses; nothing was changed.
    """
    with open_to_change(dataset) as opened:
        existing_episodes(opened, marks)
        before = {number: opened.episodes[number].success for number in marks}
        changed = {number: mark for number, mark in marks.items() if mark is not before[number]}
        has_rows = SUCCESS in opened.info["features"]
        rows = {
            number: last_row(opened.episodes[number].length, mark is True)
            for number, mark in changed.items()
            if has_rows and (mark is True) is not (before[number] is True)
        }
        if changed:
            _change_marks(DatasetLayout(opened.root), changed, rows)


def existing_episodes(dataset: Dataset, episodes: Iterable[int]) -> frozenset[int]:
    """Return the numbers of episodes, all of which exist. Raises CommandError (code ``no_episodes``)."""
    count, chosen = len(dataset), frozenset(episodes)
    if unknown := sorted(chosen - set(range(count))):
        raise CommandError(
            f"there is no episode {unknown[0]} in {dataset.root}; there are {count}, from 0 on", code="no_episodes"
        )
    if not chosen:
        raise CommandError("no episode was selected", code="no_episodes")
    return chosen


def refuse_foreign(layout: DatasetLayout) -> None:
    """Raise CommandError (code ``foreign_dataset``) for a dataset without this project's own files."""
    if is_foreign(layout):
        raise CommandError(
            f"{layout.root} was edited or recorded by another program, and has no episodes/; it can be read and "
            "exported, and LeRobot's own tools edit it",
            code="foreign_dataset",
        )


@contextlib.contextmanager
def open_to_change(dataset: str | Path | Dataset) -> Iterator[Dataset]:
    """Hold the lock of a dataset, whose interrupted episodes and changes are finished first.

    Raises CommandError as :func:`mark_episodes`.
    """
    known = dataset if isinstance(dataset, Dataset) else None
    root = known.root if known is not None else Path(dataset)  # type: ignore[arg-type]
    layout = DatasetLayout(root.expanduser().resolve())
    refuse_foreign(layout)
    if not layout.info.exists():
        Dataset(root)  # raises what is wrong; the lock would make a folder
    with lock_dataset(layout):
        if known is not None and known.has_changed():
            raise CommandError(f"{root} has changed since it was opened; nothing was done", code="dataset_changed")
        recover_all(layout)  # this adds episodes, or completes marks; the numbers stay
        yield known if known is not None and not known.has_changed() else Dataset(layout.root)


def _change_marks(
    layout: DatasetLayout, marks: Mapping[int, bool | None], rows: Mapping[int, NDArray[np.bool_]]
) -> None:
    """Change marks in a dataset that is locked (:func:`open_to_change`); all of them or, on an error, none.

    ``rows`` has new values (rows, 1) of the column of successes.
    """
    folder, moves = layout.change, list[tuple[str, str]]()

    def put(target: Path, write: Callable[..., object], *content: Any) -> None:
        new = folder / f"{len(moves):06d}{target.suffix}"
        write(new, *content)
        moves.append((new.name, str(target.relative_to(layout.root))))

    folder.mkdir()
    try:
        places = {number: EpisodePlace.of(number, read_about(layout, number)) for number in marks}
        for file in sorted({places[number].data[0] for number in rows}):
            first = {number: places[number].data[1] for number in rows if places[number].data[0] == file}
            put(layout.data(file), _write_rows, layout, file, first, rows)
        before, after = {}, {}
        for path in sorted({layout.entry(place.entry) for place in places.values()}):
            with dataset_errors(layout, path):
                before[path] = read_table(path)
                after[path] = _changed_entries(before[path], marks, rows)
            put(path, write_table, after[path])
        for number, mark in marks.items():
            put(layout.about(number), write_json, read_json(layout.about(number)) | {"success": mark}, None)
        if rows:
            put(layout.stats, write_json, _changed_stats(layout, before, after))
        put(layout.info, _copy, layout.info)  # last, and new, so that the change is noticed
        write_json(folder / MOVES, moves)
    except BaseException:
        with contextlib.suppress(OSError):
            layout.remove(folder)
        raise
    move_files(layout, folder)


def _copy(new: Path, source: Path) -> None:
    shutil.copyfile(source, new)
    sync_to_disk(new)


def _write_rows(
    new: Path, layout: DatasetLayout, file: int, first: Mapping[int, int], rows: Mapping[int, NDArray[np.bool_]]
) -> None:
    """Write a file of rows with the changed successes; ``first`` has the place of each episode's first row in it."""
    import pyarrow.parquet as pq

    path = layout.data(file)
    with dataset_errors(layout, path), pq.ParquetFile(path, page_checksum_verification=True) as old:
        sizes = [old.metadata.row_group(k).num_rows for k in range(old.metadata.num_row_groups)]
        table = old.read(use_threads=False)
    owners, field = table["episode_index"].to_numpy(), table.schema.field(SUCCESS)
    values = column_values(table[SUCCESS]).copy()
    for number, begin in first.items():
        end = begin + len(rows[number])
        if set(owners[begin:end].tolist()) != {number}:
            raise wrong_file(layout, path, "has rows of another episode", number)
        values[begin:end] = rows[number]
    table = table.set_column(table.schema.get_field_index(SUCCESS), field, make_column(values).cast(field.type))
    with pq.ParquetWriter(new, table.schema, write_page_checksum=True) as writer:
        begin = 0
        for size in sizes:
            writer.write_table(table.slice(begin, size), row_group_size=size)
            begin += size
    sync_to_disk(new)


def _changed_stats(layout: DatasetLayout, old: Mapping[Path, Any], new: Mapping[Path, Any]) -> dict[str, Any]:
    """Return ``meta/stats.json`` after marks in files of ``meta/episodes`` have changed; no other file is read."""
    with dataset_errors(layout, layout.stats):
        stats: dict[str, Any] = read_json(layout.stats)
        found = {name: np.asarray(value) for name, value in stats[SUCCESS].items()}
        for path in old:
            before, after = (read_stats(each[path], {SUCCESS})[SUCCESS] for each in (old, new))
            found = exchange_flags(found, before, after)
    return stats | stats_as_lists({SUCCESS: found})


def _changed_entries(table: Any, marks: Mapping[int, bool | None], rows: Mapping[int, NDArray[np.bool_]]) -> Any:
    """Return the rows of a file of ``meta/episodes`` with new marks and statistics."""
    import pyarrow as pa

    numbers = table["episode_index"].to_pylist()
    new: dict[str, dict[int, Any]] = {}
    for number in marks.keys() & set(numbers):
        row = numbers.index(number)
        if "success" in table.column_names:
            new.setdefault("success", {})[row] = marks[number]
        for name, value in column_stats(rows[number]).items() if number in rows else ():
            new.setdefault(f"stats/{SUCCESS}/{name}", {})[row] = value.tolist()
    for name, changed in new.items():
        values = table[name].to_pylist()
        for row, value in changed.items():
            values[row] = value
        field = table.schema.field(name)
        table = table.set_column(table.schema.get_field_index(name), field, pa.array(values, field.type))
    return table
