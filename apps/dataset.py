"""Curate a dataset: list its episodes, delete, mark, re-task, extract or trim some, split it, merge several.

hal dataset list data/demo --failed
hal dataset delete data/demo 3,5-7
hal dataset mark data/demo 4 success
hal dataset merge data/monday data/tuesday --out data/all
hal dataset split data/all --shares train=0.9,val=0.1 --out data/parts
hal dataset trim data/all --dry-run
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from hal.apps._common import program
from hal.apps._display import count_episodes, show_episodes
from hal.errors import CommandError

if TYPE_CHECKING:
    from hal.recording import Dataset, Episode

MARKS: dict[str, bool | None] = {"success": True, "failure": False, "none": None}
PARTS = {True: "success", False: "failure", None: "unmarked"}
NAMES = {mark: name if mark is not None else "-" for name, mark in MARKS.items()}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal dataset",
        description="List the episodes of a dataset; delete, mark, re-task, extract or trim some; split and merge.",
        epilog="EPISODES are numbers such as 0,3-5. Pictures and depth are never encoded again; a result replaces the "
        "dataset when it is complete. hal review shows an episode.",
    )
    commands = made.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, what: str, episodes: bool = False) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=what, description=what[0].upper() + what[1:] + ".")
        if name != "merge":
            command.add_argument("dataset", metavar="DATASET", help="folder of a recording")
        if episodes:
            command.add_argument("episodes", metavar="EPISODES", help="numbers, for example 0,3-5")
        return command

    listing = add("list", "list the episodes, or some of them")
    marks = listing.add_mutually_exclusive_group()
    marks.add_argument("--succeeded", dest="mark", action="store_const", const="success", help="marked a success")
    marks.add_argument("--failed", dest="mark", action="store_const", const="failure", help="marked a failure")
    marks.add_argument("--unmarked", dest="mark", action="store_const", const="none", help="without a mark")
    listing.add_argument("--task", metavar="TEXT", help="whose task contains this text")
    listing.add_argument("--shorter", type=float, metavar="S", help="shorter than this, s")
    listing.add_argument("--longer", type=float, metavar="S", help="longer than this, s")
    listing.add_argument("--dropped", action="store_true", help="in which rows were dropped")
    listing.add_argument("--numbers", action="store_true", help="print only the numbers, for another command")

    deleting = add("delete", "delete episodes", episodes=True)
    deleting.add_argument("--yes", action="store_true", help="do not ask")
    extracting = add("extract", "write some episodes into a new dataset", episodes=True)
    extracting.add_argument("--out", required=True, metavar="DIR", help="new folder")
    marking = add("mark", "mark episodes as a success or a failure, or remove the mark", episodes=True)
    marking.add_argument("mark", choices=MARKS, help="the mark")
    task = add("task", "change the task of episodes")
    task.add_argument("task", metavar="TEXT", help="description of the task")
    task.add_argument("--episodes", metavar="EPISODES", help="numbers, for example 0,3-5 (default: all)")
    merging = add("merge", "merge datasets that were recorded with the same rig")
    merging.add_argument("datasets", nargs="+", metavar="DATASET", help="folders of recordings; they are only read")
    merging.add_argument("--out", required=True, metavar="DIR", help="new folder")

    splitting = add("split", "write several datasets of the episodes of one, which is only read")
    splitting.add_argument("--out", required=True, metavar="DIR", help="new folder, with a folder for each part")
    ways = splitting.add_mutually_exclusive_group(required=True)
    ways.add_argument("--shares", metavar="NAME=SHARE,...", help="at random, for example train=0.8,val=0.2")
    ways.add_argument("--episodes", metavar="NAME=NUMBERS;...", help='for example "train=0,3-9;val=1-2"')
    ways.add_argument("--by-mark", action="store_true", help="into success, failure and unmarked")
    splitting.add_argument("--seed", type=int, default=0, help="of the random order (%(default)s)")

    _add_trim_options(add("trim", "remove the rows at both ends of episodes in which neither arm nor gripper moves"))
    add("pack", "join the files of episodes, which recorders do from 100 on")
    add("check", "compare every file with the index")
    add("repair", "finish interrupted episodes and rebuild a lost index")
    return made


def _add_trim_options(trimming: argparse.ArgumentParser) -> None:
    add = trimming.add_argument
    add("episodes", metavar="EPISODES", nargs="?", help="numbers, for example 0,3-5 (default: all)")
    add("--speed", type=float, default=0.02, metavar="RAD_S", help="slowest motion of a joint, rad/s (%(default)s)")
    add("--width", type=float, default=0.001, metavar="M", help="smallest motion of a gripper, m (%(default)s)")
    kept = "time to keep before and after the motion, s (%(default)s)"
    add("--keep", type=float, default=0.2, metavar="S", help=kept)
    add("--out", metavar="DIR", help="new folder (default: replace the dataset)")
    add("--dry-run", action="store_true", help="only print what would be removed")
    add("--yes", action="store_true", help="do not ask")


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.recording import Dataset, delete_episodes, extract, mark_episodes, merge, pack, set_task, split
    from hal.recording.exporters.content import select_episodes

    if args.command == "merge":
        count = merge(args.datasets, args.out, on_episode=show_episodes())
        print(f"{args.out}: {count_episodes(count)}")
        return 0
    if args.command in ("check", "repair"):
        from hal.apps import review

        return review.main([args.dataset, f"--{args.command}"])
    if args.command == "pack":
        print(f"{args.dataset}: {count_episodes(pack(args.dataset))}, joined")
        return 0
    dataset = Dataset(args.dataset)
    if args.command == "list":
        _list(dataset, args)
        return 0
    if args.command == "split":
        for name, count in split(dataset, _parts(dataset, args), args.out).items():
            print(f"{args.out}/{name}: {count_episodes(count)}")
        return 0
    chosen = [episode.number for episode in select_episodes(dataset, args.episodes, successful_only=False)]
    if args.command == "extract":
        print(f"{args.out}: {count_episodes(extract(dataset, chosen, args.out))}")
    elif args.command == "mark":
        mark_episodes(dataset, dict.fromkeys(chosen, MARKS[args.mark]))
        print(f"{count_episodes(len(chosen))} of {dataset.root}: {args.mark}")
    elif args.command == "task":
        set_task(dataset, args.task, chosen)
        print(f"{count_episodes(len(chosen))} of {dataset.root}: {args.task}")
    elif args.command == "trim":
        _trim(dataset, chosen, args)
    elif args.yes or _ask(f"delete {len(chosen)} of {count_episodes(len(dataset))} of {dataset.root}, for good?"):
        print(f"{dataset.root}: {count_episodes(delete_episodes(dataset, chosen))} left")
    else:
        print("nothing was deleted")
    return 0


def _parts(dataset: Dataset, args: argparse.Namespace) -> dict[str, list[int]]:
    """Return the episodes of each part of a split."""
    from hal.recording.curation import shares
    from hal.recording.exporters.content import parse_episodes

    if args.by_mark:
        found: dict[str, list[int]] = {}
        for episode in dataset.episodes:
            found.setdefault(PARTS[episode.success], []).append(episode.number)
        return found
    pairs = [pair.partition("=") for pair in (args.shares or args.episodes).split("," if args.shares else ";")]
    names = [name.strip() for name, _, _ in pairs]
    try:
        if len(set(names)) < len(names) or not all(names):
            raise ValueError("every part needs a name of its own")
        if args.shares:
            wanted = {name: float(share) for name, (_, _, share) in zip(names, pairs, strict=True)}
            return shares(len(dataset), wanted, args.seed)
    except ValueError as error:
        raise CommandError(f"parts are written as in --help: {error}", code="bad_split") from None
    return {name: parse_episodes(numbers) for name, (_, _, numbers) in zip(names, pairs, strict=True)}


def _trim(dataset: Dataset, chosen: list[int], args: argparse.Namespace) -> None:
    from hal.recording import find_motion, trim

    kept, before, after = {}, 0, 0
    for number in chosen:
        episode = dataset.episodes[number]
        rows = find_motion(episode, speed=args.speed, width=args.width, keep=args.keep)
        start, end = rows.first, episode.length - rows.end
        if start or end:
            kept[number], before, after = rows, before + start, after + end
            times = f"{start / episode.fps:.2f} s at the start, {end / episode.fps:.2f} s at the end"
            print(f"episode {number}: {start + end} of {episode.length} rows, {times}")
    total = f"{before + after} rows of {count_episodes(len(kept))}"
    if args.dry_run or not kept:
        print(f"{total} would be removed" if kept else "nothing to trim")
    elif args.out or args.yes or _ask(f"remove {total} of {dataset.root}, for good?"):
        trim(dataset, kept, args.out, on_episode=show_episodes())
        print(f"{args.out or dataset.root}: {total} removed")
    else:
        print("nothing was removed")


def _list(dataset: Dataset, args: argparse.Namespace) -> None:
    found = [episode for episode in dataset.episodes if _matches(episode, args)]
    if args.numbers:
        print(",".join(str(episode.number) for episode in found))
        return
    print(f"{'episode':>7}  {'seconds':>7}  {'mark':8}  {'dropped':>7}  task")
    for episode in found:
        dropped = episode.info["dropped"] or 0
        end = f"{NAMES[episode.success]:8}  {dropped:7d}  {episode.task}"
        trouble = f"  [{episode.trouble}]" if episode.trouble else ""
        print(f"{episode.number:7d}  {episode.length / episode.fps:7.2f}  {end}{trouble}")
    print(f"{len(found)} of {count_episodes(len(dataset))} of {dataset.root}")
    for note in dataset.notes:
        print(f"note: {note}")


def _matches(episode: Episode, args: argparse.Namespace) -> bool:
    seconds = episode.length / episode.fps
    return (
        (args.mark is None or episode.success is MARKS[args.mark])
        and (args.task is None or args.task.lower() in episode.task.lower())
        and (args.shorter is None or seconds < args.shorter)
        and (args.longer is None or seconds > args.longer)
        and (not args.dropped or bool(episode.info["dropped"]))
    )


def _ask(question: str) -> bool:
    if not sys.stdin.isatty():
        raise CommandError(f"{question} repeat the command with --yes", code="not_confirmed")
    return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


if __name__ == "__main__":
    sys.exit(main())
