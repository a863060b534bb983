"""Play a recorded episode back through the servo: in simulation and on the real arm, the same program.

hal replay data/demo --episode 0 --sim
hal replay data/demo --episode 0 --speed 0.5 --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

import hal
from hal.apps._common import (
    add_deadman_options,
    add_rig_options,
    check_one_robot,
    check_report,
    check_speed,
    find_deadman,
    needs_deadman,
    program,
    resolve_plan,
    rig_options,
    write_report,
)
from hal.apps._display import StatusLine, banner, list_links
from hal.errors import CommandError, ConnectionLost, DatasetError, HalError, MotionStopped, RobotFault, StaleStateError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hal.deadman import Deadman
    from hal.learning.replay import TrajectoryPlayer
    from hal.recording import Episode
    from hal.rig import Rig
    from hal.robot import Robot

NOT_FINISHED = 1
"""Exit status if the episode was not played to its end."""
MANY_MISSED = 0.01
"""Share of missed servo ticks above which the arm lags the recording."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal replay",
        description="Replay a recorded episode through the servo, and report the deviation from the recording.",
        epilog="Ctrl-C stops the arm. The exit status is 1 if the episode was not replayed to its end.",
    )
    made.add_argument("dataset", metavar="DATASET", help="the folder of a recording")
    add_rig_options(made)
    play = made.add_argument_group("replaying")
    play.add_argument(
        "--episode", type=int, default=0, metavar="N", help="number of the episode; -1 is the last (%(default)s)"
    )
    play.add_argument("--robot", metavar="NAME", help="arm (default: the one that was driven)")
    play.add_argument(
        "--speed", type=float, default=1.0, metavar="SCALE", help="speed relative to the recording, 0-1 (%(default)g)"
    )
    add_deadman_options(play)
    play.add_argument("--report", metavar="FILE", help="write the results to a JSON file")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.recording import Dataset
    from hal.recording.checking import check_rows

    check_speed(args)
    check_one_robot(args)
    check_report(args.report)
    episodes = Dataset(args.dataset).episodes
    if not -len(episodes) <= args.episode < len(episodes):
        raise CommandError(f"--episode {args.episode}: {args.dataset} has {len(episodes)}, counted from 0")
    episode = episodes[args.episode]
    check_rows(episode, None)  # before anything is opened
    what = f"episode  {episode.number}: {episode.length} rows at {episode.fps:g} Hz, {episode.task or 'no task'!r}"
    plan = resolve_plan(args, what)
    holds = needs_deadman(plan, args)
    with hal.open(**rig_options(args, pad=holds)) as rig:
        if not rig.robots:
            raise CommandError(f"{rig.plan.source} has no robot", code="no_robot")
        robot = rig.robots[args.robot or _driven(rig, episode)]
        print("\n  ".join([banner(rig), what, *_describe_replay(robot, episode)]) + f"\n{list_links(rig)}", flush=True)
        deadman, _, button = find_deadman(rig) if holds else (None, None, "")
        return ReplayRun(rig, robot, episode, args, deadman, button).run()


def _driven(rig: Rig, episode: Episode) -> str:
    """Return the arm that was driven, else the rig's first one in the recording, else the rig's first one."""
    from hal.learning.replay import list_recorded_arms

    driven = str(episode.info.get("info", {}).get("robot"))
    recorded = list_recorded_arms(episode)
    if driven in rig.robots:
        return driven
    return next((name for name in rig.robots if name in recorded), next(iter(rig.robots)))


def _describe_replay(robot: Robot, episode: Episode) -> Iterator[str]:
    """Yield lines for the banner: the arm, other arms that moved in the recording, and damaged images."""
    from hal.learning.replay import list_other_arms
    from hal.recording.layout import GRIP_FORCE

    yield f"replays  {robot.name}"
    if episode.trouble:
        yield f"ended    the recording ended by itself: {episode.trouble}"
    try:
        episode.check_pictures()
    except DatasetError as error:
        yield f"damaged  {error}; images are not needed here"
    if robot.gripper is not None and GRIP_FORCE not in episode.columns:
        yield "fingers  this recording lacks the gripper's force: grasps of scripts and skills may only touch"
    for name in list_other_arms(episode, robot.name):
        yield f"still    {name} moved in the recording; it is not replayed"


class ReplayRun:
    """One run of the program on an open rig."""

    def __init__(
        self, rig: Rig, robot: Robot, episode: Episode, args: argparse.Namespace, deadman: Deadman | None, button: str
    ) -> None:
        """Check the episode against the arm. ``button`` is the name of the dead-man's control; empty without one."""
        from hal.learning.replay import RecordedTrajectory, TrajectoryPlayer

        self.rig, self.robot, self.episode, self.args, self.button = rig, robot, episode, args, button
        self.line = StatusLine()
        trajectory = RecordedTrajectory.from_episode(episode, robot)
        self.player = TrajectoryPlayer(
            rig, robot, trajectory, speed=args.speed, deadman=deadman, unattended=args.unattended or not button
        )
        self.start = rig.clock.now()
        self.servo = self._servo()

    def _servo(self) -> tuple[int, int]:
        """Return the ticks so far, and how many of them were missed."""
        group = next(group for group in self.rig.statistics().values() if self.robot.name in group["robots"])
        return int(group["ticks"]), int(group.get("missed", 0))

    def run(self) -> int:
        """Move to the first pose, replay, report. Return the exit status."""
        reason = ""
        try:
            self._play()
        except (MotionStopped, RobotFault, ConnectionLost, StaleStateError) as stop:
            reason = getattr(stop, "reason", str(stop))
        except KeyboardInterrupt:
            reason = "Ctrl-C"
        self.line.clear()
        ticks, missed = self._count_missed()
        self._print_results(reason, ticks, missed)
        write_report(self.args.report, self._report(reason) | {"servo": {"ticks": ticks, "missed": missed}})
        return 0 if self.player.finished else NOT_FINISHED

    def _count_missed(self) -> tuple[int, int]:
        """Return the ticks during the replay and the missed ones; zeros if the arm's process is gone."""
        try:
            now = self._servo()
        except (HalError, OSError):
            return 0, 0
        return now[0] - self.servo[0], now[1] - self.servo[1]

    def _announce(self, text: str) -> None:
        self.line.event(f"  {text}")
        self.rig.say(text)

    def _play(self) -> None:
        objects = self.player.trajectory.objects
        if objects and not self.rig.has_world:
            self._announce("place the objects as in the recording, x y z in m:")
            for name, pose in objects.items():
                self._announce(f"  {name:12s} {' '.join(f'{value:.3f}' for value in pose.position)}")
        self._announce(
            "moving to the first pose" + (f": hold {self.button} until the arm is there" if self.button else "")
        )
        self.player.approach()
        if self.button:
            self._announce(f"first pose reached: release {self.button}, then hold it again to replay")
        self.start, self.servo = self.rig.clock.now(), self._servo()
        self.player.play(self._show)

    def _show(self, player: TrajectoryPlayer, plays: bool) -> None:
        def text() -> str:
            does = "replaying" if plays else f"paused: hold {self.button}" if self.button else "starting"
            return f"  {player.progress:6.1f} of {player.trajectory.duration:.1f} s  {does}"

        self.line.update(text)

    def _print_results(self, reason: str, ticks: int, missed: int) -> None:
        from hal.types import Limited

        player, by_speed = self.player, Limited.SPEED | Limited.TCP_SPEED
        if player.finished:
            self._announce(
                f"replayed {player.trajectory.duration:.1f} s at {100 * player.speed:g} % speed; the arm is at rest"
            )
        else:
            self._announce(
                f"ENDED at {player.progress:.1f} of {player.trajectory.duration:.1f} s: {reason}; the arm is at rest"
            )
        if player.limited is not Limited.NONE:
            slower = "; a lower --speed may follow more exactly" if player.limited & by_speed else ""
            self._announce(f"limits were hit ({player.limited}){slower}")
        if missed > MANY_MISSED * ticks:
            self._announce(f"the servo missed {missed} of {ticks} ticks: this computer is overloaded")
        self._announce("deviation of the measured motion from the recorded one:")
        for line in player.deviation.lines():
            self._announce(f"  {line}")

    def _report(self, reason: str) -> dict[str, Any]:
        player = self.player
        return {
            "dataset": str(self.args.dataset),
            "episode": self.episode.number,
            "robot": self.robot.name,
            "backend": self.robot.spec.driver,
            "clock": self.rig.plan.clock,
            "speed": player.speed,
            "finished": player.finished,
            "reason": reason,
            "place_s": player.progress,
            "duration_s": player.trajectory.duration,
            "took_s": self.rig.clock.now() - self.start,
            "pauses": player.pauses,
            "held_back": str(player.limited),
            "deviation": player.deviation.as_json(),
        }


if __name__ == "__main__":
    sys.exit(main())
