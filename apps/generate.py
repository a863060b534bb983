"""Generate a dataset in simulation: seeded episodes of a policy or a scripted skill, on several workers at once.

hal generate --skill examples.pick:pick --episodes 200 --workers 4 --out data/picks
hal generate --policy my_policy:Act --success my_task:done --episodes 1000 --workers 8 --out data/eval
hal generate --skill my_skill:stack --episodes 10000 --workers 64 --ray auto --out /shared/stack
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal import registry
from hal.apps._common import (
    add_config_options,
    add_episode_options,
    add_stream_options,
    check_episode_options,
    config_options,
    program,
    resolve_plan,
    split_names,
    write_report,
)
from hal.apps._display import StatusLine, list_devices
from hal.errors import CommandError, ConfigError, HalError

if TYPE_CHECKING:
    from hal.learning.episode_worker import EpisodeRecipe, EpisodeResult
    from hal.learning.generate import GenerateProgress
    from hal.specs import Plan

_PERIOD = 10.0
"""Time between two lines of progress if the output is not a terminal, s."""
EXAMPLES = """\
examples:
  hal generate --skill examples.pick:pick --episodes 200 --workers 2 --out data/picks
  hal generate --policy my_policy:Act --success my_task:done --episodes 1000 --workers 8 --out data/eval
  hal generate --skill my_skill:stack --episodes 10000 --workers 64 --ray auto --out /shared/stack

The same command continues an interrupted run, and with a larger --episodes extends a dataset. Episode k has the seed
--seed + k, and the same rows whatever the number of workers. Until it is complete, the workers' datasets are in
OUT.parts. The exit status is 0 if the dataset is complete.
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal generate",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Generate a dataset in simulation, in lock-step, on several workers at once.",
        epilog=EXAMPLES,
    )
    rig = add_config_options(made)
    rig.add_argument("--dry-run", action="store_true", help="check everything and list the devices; open nothing")
    run = made.add_argument_group("running")
    what = run.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--policy", default="", metavar="MODULE:NAME", help="policy: a function, or a class; see docs/evaluate.md"
    )
    what.add_argument(
        "--skill",
        default="",
        metavar="MODULE:NAME",
        help="function of the rig and a random generator that drives by itself and returns whether it succeeded",
    )
    add_episode_options(run)
    run.add_argument("--out", required=True, metavar="DIR", help="dataset to generate")
    add_stream_options(run)
    where = made.add_argument_group("workers")
    where.add_argument("--workers", type=int, default=1, metavar="N", help="number of workers (%(default)s)")
    where.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="run the workers on the Ray cluster at this address (auto: the one this computer belongs to; local: start "
        "one on this computer); its nodes need this package, your modules, and the folder --out or --upload",
    )
    where.add_argument(
        "--gpus", type=float, default=0.0, metavar="N", help="with --ray: graphics cards of each worker, such as 0.25"
    )
    where.add_argument(
        "--runtime-env", metavar="FILE", help="with --ray: YAML file of Ray's runtime environment for the workers"
    )
    where.add_argument(
        "--upload",
        metavar="URL",
        help="workers record into temporary folders, and upload each episode to this address of fsspec, of this run "
        "alone, such as s3://bucket/run; no folder has to be shared",
    )
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from contextlib import ExitStack

    from hal.learning.generate import LocalWorker, StartWorker, generate, parts_folder
    from hal.recording.layout import require_libraries

    check_episode_options(args, "policy", "skill", "reset", "success")
    runtime_env = _check_workers(args)
    args.pad, args.viewer, args.console, args.listen = "none", "none", False, None
    cameras = split_names(args.cameras)
    where = f"the Ray cluster {args.ray}" if args.ray else "this computer"
    details = (
        f"{'skill ' if args.skill else 'policy'}   {args.skill or args.policy}",
        f"dataset  {args.out}: {args.episodes} episode(s), {args.workers} worker(s) on {where}",
    )
    require_libraries()
    try:
        plan = resolve_plan(args, *details, cameras=cameras or (), clock="lock_step")
    except ConfigError as error:
        raise _explain_real_devices(error, args) from None
    _check_plan(plan)
    if plan.engine is not None:
        registry.check_engine(plan.engine)
    shown = (f"rig      {plan.source}", *list_devices(replace(plan, pads=())), *details)
    print("\n".join(f"  {text}" for text in shown), flush=True)
    line = StatusLine()
    with ExitStack() as cluster:
        start_worker: StartWorker = LocalWorker
        if args.ray:
            from hal.learning.ray_workers import join_cluster

            joined = join_cluster(args.ray, args.workers, gpus=args.gpus, runtime_env=runtime_env)
            start_worker = cluster.enter_context(joined)
        try:
            made = generate(
                _recipe(args, plan, cameras),
                args.out,
                args.episodes,
                workers=args.workers,
                upload=args.upload,
                start_worker=start_worker,
                on_progress=_show_progress(line),
                on_event=lambda text: line.event(f"  {text}"),
            )
        except BaseException:
            line.clear()
            if args.upload or any(parts_folder(args.out).glob("*/meta/info.json")):
                place = args.upload or parts_folder(args.out)
                print(f"  finished episodes are in {place}; the same command continues", flush=True)
            raise
    line.clear()
    _print_results(args, made)
    return 0


def _check_workers(args: argparse.Namespace) -> dict[str, Any]:
    """Check the options of the workers; return Ray's runtime environment.

    Raises:
        CommandError: One is wrong.
    """
    import yaml

    from hal.learning.uploads import is_address

    if args.workers < 1:
        raise CommandError(f"--workers must be 1 or more, not {args.workers}")
    if not 0.0 <= args.gpus < float("inf"):
        raise CommandError(f"--gpus must be 0 or more, not {args.gpus:g}")
    if not args.ray and (args.gpus or args.runtime_env):
        raise CommandError("--gpus and --runtime-env are for --ray")
    if args.upload and not is_address(args.upload):
        raise CommandError(f"--upload {args.upload} is no address: write s3://bucket/run, or file:///shared/run")
    if not args.runtime_env:
        return {}
    try:
        found = yaml.safe_load(Path(args.runtime_env).read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise CommandError(f"--runtime-env {args.runtime_env}: {error}") from error
    if not isinstance(found, dict):
        raise CommandError(f"--runtime-env {args.runtime_env} must be a map of keys such as working_dir and pip")
    return found


def _explain_real_devices(error: ConfigError, args: argparse.Namespace) -> HalError:
    """Return the error for this program, in which nothing else than a simulation would help against real devices."""
    if {problem.code for problem in error.problems} - {"real_in_lock_step", "emulated_in_lock_step"}:
        return error
    real = ", ".join(problem.key for problem in error.problems)
    remedy = "leave out --real" if args.sim is False else "add --sim"
    text = f"real devices: {real}; episodes are generated in simulation only: {remedy}"
    return CommandError(text, code="attended")


def _check_plan(plan: Plan) -> None:
    """Raise CommandError for a rig that cannot run in lock-step, without anyone present."""
    if plan.attended:
        raise CommandError(
            f"{plan.source} has a real arm; episodes are generated in simulation only: add --sim", code="attended"
        )
    if not plan.robots:
        raise CommandError(f"{plan.source} has no robot", code="no_robot")


def _recipe(args: argparse.Namespace, plan: Plan, cameras: list[str] | None) -> EpisodeRecipe:
    from hal.learning.episode_worker import EpisodeRecipe
    from hal.specs import to_json

    config = str(Path(args.config).resolve()) if Path(args.config).is_file() else args.config
    resolved = {key: value for key, value in to_json(plan).items() if key not in ("pads", "clock")}
    return EpisodeRecipe(
        rig=config_options(args) | {"config": config, "engine": plan.engine},
        policy=args.policy,
        skill=args.skill,
        reset=args.reset or "",
        success=args.success or "",
        robot=args.robot or "",
        rate_hz=args.rate,
        history=args.history,
        seconds=args.seconds,
        seed=args.seed,
        fps=args.fps,
        task=args.task,
        cameras=cameras,
        streams=split_names(args.streams) or [],
        codec=args.codec,
        plan=hashlib.sha256(json.dumps(resolved, sort_keys=True, default=str).encode()).hexdigest()[:16],
    )


def _show_progress(line: StatusLine) -> Callable[[GenerateProgress], None]:
    """Return a function that shows the progress: in the terminal's last line, or else in a line every 10 s."""
    next_line = time.monotonic() + _PERIOD

    def show(progress: GenerateProgress) -> None:
        nonlocal next_line
        if sys.stdout.isatty():
            line.update(lambda: f"  {describe(progress)}")
        elif time.monotonic() >= next_line:
            next_line = time.monotonic() + _PERIOD
            line.event(f"  {describe(progress)}")

    return show


def describe(progress: GenerateProgress) -> str:
    """Return the progress in one line."""
    parts = [f"{progress.done} of {progress.total} episodes"]
    if progress.left is not None:
        minutes, seconds = divmod(round(progress.left), 60)
        parts += [f"{progress.rate:.2f}/s", f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d} left"]
    if progress.judged:
        share = 100 * progress.succeeded / progress.judged
        parts.append(f"{progress.succeeded} succeeded ({share:.0f} % of {progress.judged})")
    if progress.waiting:
        parts.append(f"{progress.waiting} worker(s) waiting for a place")
    if progress.restarts:
        parts.append(f"{progress.restarts} worker(s) replaced")
    return ", ".join(parts)


def _print_results(args: argparse.Namespace, made: list[EpisodeResult]) -> None:
    """Print the results, and write the report."""
    from hal.recording import Dataset

    dataset = Dataset(args.out)
    marks = [episode.success for episode in dataset.episodes]
    judged = [mark for mark in marks if mark is not None]
    rate = f", {sum(judged)} of {len(judged)} succeeded" if judged else ""
    new = f" ({len(made)} new)" if len(made) < len(marks) else ""
    print(f"  {dataset.root}: {len(marks)} episodes{new}, {dataset.info['total_frames']} rows{rate}")
    for reason, count in Counter(result.reason for result in made if result.reason).most_common(5):
        print(f"    {count} stopped: {reason}")
    report = {
        "out": str(dataset.root),
        "workers": args.workers,
        "episodes": len(marks),
        "succeeded": sum(judged),
        "made": [vars(result) for result in made],
    }
    write_report(args.report, report)


if __name__ == "__main__":
    sys.exit(main())
