"""Show a dataset: its statistics, a page to edit it, an episode as a picture or for rerun; check and repair it.

hal review data/demo
hal review data/demo --page
hal review data/demo --episode 3
hal review data/demo --episode 3 --rrd look.rrd
hal review data/demo --check
"""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import hal
from hal.apps._common import ACTION_NEEDED, program
from hal.apps._display import count_episodes
from hal.errors import CommandError, DatasetError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hal.recording.dataset import Dataset, Episode
    from hal.recording.review import DatasetSummary

LEAVE_OUT = (
    "restore the files of a damaged episode from a copy, or leave it out with hal export --episodes; "
    "docs/record.md describes how to remove the last one"
)

_COLOURS = Path(hal.__file__).with_name("drivers") / "web" / "page" / "base.css"
"""Style of the console's page, which is that of the page of episodes."""
_MARK = {True: "success", False: "failure", None: "-"}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal review",
        description="Show a dataset: its statistics, one episode as a picture or for rerun; check and repair it.",
        epilog="The dataset is only read, except by --repair and the buttons of the page. "
        "The exit status is 2 if an episode cannot be read or repaired, or --check finds a problem, else 0.",
    )
    made.add_argument("dataset", metavar="DATASET", help="the folder of a recording")
    made.add_argument(
        "--episode",
        type=int,
        metavar="N",
        help="only this episode, with a picture of it: images over time, joints, gripper, stops",
    )
    made.add_argument("--svg", metavar="FILE", help="file of the picture (default: beside the dataset)")
    made.add_argument(
        "--rrd", metavar="FILE", help="write a file for the rerun viewer instead; needs the extra [review]"
    )
    files = made.add_mutually_exclusive_group()
    files.add_argument(
        "--check", action="store_true", help="compare every file with the index: rows, images, depth, time stamps"
    )
    files.add_argument(
        "--page",
        type=int,
        nargs="?",
        const=0,
        metavar="PORT",
        help="serve a page to rank, look at, replay, mark and delete episodes, to this computer only, until Ctrl-C",
    )
    files.add_argument(
        "--repair",
        action="store_true",
        help="finish interrupted episodes and rebuild a lost index",
    )
    made.add_argument("--json", action="store_true", help="print the statistics as one JSON object")
    made.add_argument("--force", action="store_true", help="overwrite an existing picture or .rrd file")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.recording import Dataset
    from hal.recording.exporters.content import select_episodes
    from hal.recording.review import summarize, summary_as_json

    if args.repair:
        return _repair(args)
    dataset = Dataset(args.dataset)
    if args.check:
        return _check(args, dataset)
    if args.page is not None:
        return _serve(args, dataset)
    if args.episode is None:
        if args.svg or args.rrd:
            raise CommandError("--svg and --rrd show one episode: select it with --episode N")
        found = summarize(dataset)
    else:
        (episode,) = select_episodes(dataset, [args.episode], successful_only=False)
        found = summarize(dataset, [episode])
    for note in dataset.notes:
        print(f"note: {note}", file=sys.stderr)
    print(summary_as_json(found) if args.json else "\n".join(_table(found)))
    if args.episode is None:
        _warn_of_index(dataset, found)
    if args.episode is not None and not found.broken:
        for path in _write_picture(args, dataset.root, episode):
            print(f"wrote {path}", file=sys.stderr if args.json else sys.stdout)
    return ACTION_NEEDED if found.broken else 0


def _check(args: argparse.Namespace, dataset: Dataset) -> int:
    from hal.recording.checking import check_dataset
    from hal.recording.exporters.content import select_episodes
    from hal.recording.index import repair_command
    from hal.recording.layout import DatasetLayout

    if args.svg or args.rrd:
        raise CommandError("--check cannot be used with --svg or --rrd")
    wanted = None if args.episode is None else [args.episode]
    count = len(select_episodes(dataset, wanted, successful_only=False))
    found = list(dict.fromkeys(str(error) for error in check_dataset(dataset, wanted)))
    if args.json:
        print(json.dumps({"path": str(dataset.root), "episodes": count, "wrong": found}, indent=2))
    else:
        remedy = f"; next: {repair_command(DatasetLayout(dataset.root))}" if found else ""
        end = f"{count_episodes(count)} checked, {len(found)} problem(s){remedy}"
        print("\n".join([*found, end]))
    return ACTION_NEEDED if found else 0


def _serve(args: argparse.Namespace, dataset: Dataset) -> int:
    from hal.recording.review_page import ReviewServer

    if args.episode is not None or args.svg or args.rrd or args.json:
        raise CommandError("--page is for the whole dataset and cannot be used with other options")
    with ReviewServer(dataset.root, args.page, _COLOURS.read_bytes()) as server:
        print(f"Open this in a browser; Ctrl-C ends it:\n\n    {server.link}\n", flush=True)
        with suppress(KeyboardInterrupt):
            server.serve_forever()
    return 0


def _repair(args: argparse.Namespace) -> int:
    from hal.recording import Dataset, repair
    from hal.recording.review import summarize

    if args.episode is not None or args.svg or args.rrd or args.json:
        raise CommandError("--repair is for the whole dataset and cannot be used with other options")
    done, damaged = [], []
    try:
        done = repair(args.dataset)
        with suppress(CommandError):  # no episode
            damaged = summarize(Dataset(args.dataset)).broken
    except DatasetError as error:
        if error.episode is None:
            raise
        damaged = [str(error)]
    lines = [*done, *(f"cannot be repaired: {line}" for line in damaged)]
    if damaged:
        lines.append(LEAVE_OUT)
    print("\n".join(lines or ["nothing to repair; --check compares every file with the index"]))
    return ACTION_NEEDED if damaged else 0


def _warn_of_index(dataset: Dataset, found: DatasetSummary) -> None:
    """Print the first problem in ``meta/``, apart from the episodes that cannot be read."""
    from hal.recording.checking import check_index
    from hal.recording.index import repair_command
    from hal.recording.layout import DatasetLayout

    layout = DatasetLayout(dataset.root)
    wrong = next((str(error) for error in check_index(layout) if str(error) not in found.broken), None)
    if wrong is not None:
        print(f"warning: the index is damaged: {wrong}; rebuild it with: {repair_command(layout)}", file=sys.stderr)


def _write_picture(args: argparse.Namespace, root: Path, episode: Episode) -> Iterator[Path]:
    """Write the picture or the .rrd file of an episode; yield its path."""
    from hal.recording.exporters.output import write_atomically

    if args.rrd:
        from hal.recording.exporters.rrd import write_rrd

        path = Path(args.rrd).expanduser().absolute()
        with write_atomically(path, force=args.force, is_ours=Path.is_file) as new:
            write_rrd(episode, new)
        yield path
    if args.svg or not args.rrd:
        from hal.recording.review import draw_sheet

        beside = root.with_name(f"{root.name}_episode_{episode.number:06d}.svg")
        path = Path(args.svg or beside).expanduser().absolute()
        with write_atomically(path, force=args.force, is_ours=Path.is_file) as new:
            new.write_text(draw_sheet(episode), encoding="utf-8")
        yield path


def _table(found: DatasetSummary) -> Iterator[str]:
    """Yield the statistics, line by line."""
    from hal.recording.metadata import SLOW_PACE

    many = count_episodes(len(found.episodes))
    yield f"{found.path}: {many} of {found.robot_type}, {found.rows} rows at {found.fps} Hz, {found.seconds:.1f} s"
    marked = found.successes + found.failures
    share = f" ({100 * found.successes / marked:.0f} % of those marked)" if marked else ""
    yield f"{found.successes} succeeded{share}, {found.failures} failed, {found.unmarked} not marked"
    yield f"{found.dropped} rows dropped; the whole dataset takes {_size(found.bytes)}"
    yield ""
    yield f"{'episode':>7}  {'rows':>6}  {'seconds':>7}  {'mark':8}  {'dropped':>7}  {'stops':>5}  task"
    for line in found.episodes:
        end = f"{line.dropped:7d}  {line.trips:5d}  {line.task}" + (f"  [{line.trouble}]" if line.trouble else "")
        yield f"{line.number:7d}  {line.rows:6d}  {line.seconds:7.2f}  {_MARK[line.success]:8}  {end}"
    for line in found.episodes:
        if line.pace is not None and line.pace < SLOW_PACE:
            yield f"episode {line.number}: the simulation ran at {line.pace:.2f} of real time; its speeds are too low"
    yield from (f"cannot be read: {line}" for line in found.broken)
    if found.broken:
        yield LEAVE_OUT
    if not found.timing:
        return
    yield ""
    width = max(len(each.source) for each in found.timing)
    yield f"{'times, ms':{width}}  {'period':>8} {'jitter':>8} {'longest':>8} {'age':>8} {'oldest':>8}  repeated"
    for each in found.timing:
        values = (each.period, each.jitter, each.longest, each.age, each.oldest)
        yield f"{each.source:{width}}  {' '.join(f'{value:8.2f}' for value in values)}  {each.repeated:8d}"


def _size(count: float) -> str:
    for unit in ("bytes", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


if __name__ == "__main__":
    sys.exit(main())
