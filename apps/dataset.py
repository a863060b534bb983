"""Curate a dataset: list its episodes, delete, mark, re-task or extract some, merge several datasets.

python apps/dataset.py list data/demo --failed
python apps/dataset.py delete data/demo 3,5-7
python apps/dataset.py mark data/demo 4 success
python apps/dataset.py merge data/monday data/tuesday --out data/all
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from hal.apps._common import run_app
from hal.errors import CommandError

if TYPE_CHECKING:
    from collections.abc import Callable

    from hal.recording import Dataset, Episode

__all__ = ["main", "parser"]

MARKS: dict[str, bool | None] = {"success": True, "failure": False, "none": None}
NAMES = {mark: name if mark is not None else "-" for name, mark in MARKS.items()}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="dataset",
        description="List the episodes of a dataset; delete, mark, re-task or extract some; merge several datasets.",
        epilog="EPISODES are numbers such as 0,3-5. Pictures and depth are never encoded again; a result replaces the "
        "dataset when it is complete. hal-review shows an episode, checks and repairs.",
    )
    commands = made.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, what: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=what, description=what[0].upper() + what[1:] + ".")

    listing = add("list", "list the episodes, or some of them")
    listing.add_argument("dataset", metavar="DATASET", help="folder of a recording")
    marks = listing.add_mutually_exclusive_group()
    marks.add_argument("--succeeded", dest="mark", action="store_const", const="success", help="marked a success")
    marks.add_argument("--failed", dest="mark", action="store_const", const="failure", help="marked a failure")
    marks.add_argument("--unmarked", dest="mark", action="store_const", const="none", help="without a mark")
    listing.add_argument("--task", metavar="TEXT", help="whose task contains this text")
    listing.add_argument("--shorter", type=float, metavar="S", help="shorter than this, s")
    listing.add_argument("--longer", type=float, metavar="S", help="longer than this, s")
    listing.add_argument("--dropped", action="store_true", help="in which rows were dropped")
    listing.add_argument("--numbers", action="store_true", help="print only the numbers, for another command")

    for name, what in (("delete", "delete episodes"), ("extract", "write some episodes into a new dataset")):
        some = add(name, what)
        some.add_argument("dataset", metavar="DATASET", help="folder of a recording")
        some.add_argument("episodes", metavar="EPISODES", help="numbers, for example 0,3-5")
        if name == "delete":
            some.add_argument("--yes", action="store_true", help="do not ask")
        else:
            some.add_argument("--out", required=True, metavar="DIR", help="new folder")

    mark = add("mark", "mark episodes as a success or a failure, or remove the mark")
    mark.add_argument("dataset", metavar="DATASET", help="folder of a recording")
    mark.add_argument("episodes", metavar="EPISODES", help="numbers, for example 0,3-5")
    mark.add_argument("mark", choices=MARKS, help="the mark")

    task = add("task", "change the task of episodes")
    task.add_argument("dataset", metavar="DATASET", help="folder of a recording")
    task.add_argument("task", metavar="TEXT", help="description of the task")
    task.add_argument("--episodes", metavar="EPISODES", help="numbers, for example 0,3-5 (default: all)")

    merging = add("merge", "merge datasets that were recorded with the same rig")
    merging.add_argument("datasets", nargs="+", metavar="DATASET", help="folders of recordings; they are only read")
    merging.add_argument("--out", required=True, metavar="DIR", help="new folder")
    return made


def main(argv: list[str] | None = None) -> int:
    """Run the program; return the exit status."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    from hal.recording import Dataset, delete_episodes, extract, mark_episodes, merge, set_task
    from hal.recording.exporters.content import select_episodes

    if args.command == "merge":
        count = merge(args.datasets, args.out, on_episode=_progress())
        print(f"{args.out}: {_many(count)}")
        return 0
    dataset = Dataset(args.dataset)
    if args.command == "list":
        _list(dataset, args)
        return 0
    chosen = [episode.number for episode in select_episodes(dataset, args.episodes, successful_only=False)]
    if args.command == "extract":
        print(f"{args.out}: {_many(extract(args.dataset, chosen, args.out))}")
    elif args.command == "mark":
        mark_episodes(args.dataset, dict.fromkeys(chosen, MARKS[args.mark]))
        print(f"{_many(len(chosen))} of {dataset.root}: {args.mark}")
    elif args.command == "task":
        set_task(args.dataset, args.task, chosen)
        print(f"{_many(len(chosen))} of {dataset.root}: {args.task}")
    elif args.yes or _confirmed(dataset, len(chosen)):
        print(f"{dataset.root}: {_many(delete_episodes(args.dataset, chosen))} left")
    else:
        print("nothing was deleted")
    return 0


def _list(dataset: Dataset, args: argparse.Namespace) -> None:
    found = [episode for episode in dataset.episodes if _matches(episode, args)]
    if args.numbers:
        print(",".join(str(episode.number) for episode in found))
        return
    print(f"{'episode':>7}  {'seconds':>7}  {'mark':8}  {'dropped':>7}  task")
    for episode in found:
        dropped = episode.info["dropped"] or 0
        end = f"{NAMES[episode.success]:8}  {dropped:7d}  {episode.task}"
        print(f"{episode.number:7d}  {episode.length / episode.fps:7.2f}  {end}")
    print(f"{len(found)} of {_many(len(dataset))} of {dataset.root}")


def _matches(episode: Episode, args: argparse.Namespace) -> bool:
    seconds = episode.length / episode.fps
    return (
        (args.mark is None or episode.success is MARKS[args.mark])
        and (args.task is None or args.task.lower() in episode.task.lower())
        and (args.shorter is None or seconds < args.shorter)
        and (args.longer is None or seconds > args.longer)
        and (not args.dropped or bool(episode.info["dropped"]))
    )


def _confirmed(dataset: Dataset, count: int) -> bool:
    question = f"delete {count} of {_many(len(dataset))} of {dataset.root}, for good?"
    if not sys.stdin.isatty():
        raise CommandError(f"{question} repeat the command with --yes", code="not_confirmed")
    return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


def _progress() -> Callable[[int, int], None]:
    from hal.apps._display import StatusLine

    line = StatusLine()

    def show(done: int, total: int) -> None:
        line.update(lambda: f"  {done} of {total} episodes")
        if done == total:
            line.clear()

    return show


def _many(count: int) -> str:
    return f"{count} episode{'' if count == 1 else 's'}"


if __name__ == "__main__":
    sys.exit(main())
