"""Play a recorded episode back through the servo: in simulation and on the real arm, the same program.

python apps/replay.py data/demo --episode 0 --sim
python apps/replay.py data/demo --episode 0 --speed 0.5 --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.apps._common import ACTION_NEEDED, add_rig_options, rig_options, run_app

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hal.deadman import Deadman
    from hal.learning.replay import Player
    from hal.recording import Episode
    from hal.rig import Rig
    from hal.robot import Robot

NOT_FINISHED = 1
MANY_MISSED = 0.01
"""Share of the servo's ticks: who misses more is behind what it should follow."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="replay",
        description="Play a recorded episode back through the servo, and say how far the arm was from the recording.",
        epilog="Ctrl-C stops the arm. The exit status is 1 when the episode was not played to its end.",
    )
    made.add_argument("dataset", metavar="DATASET", help="the folder of a recording")
    add_rig_options(made)
    play = made.add_argument_group("replaying")
    play.add_argument("--episode", type=int, default=0, metavar="N", help="which one; -1 is the last (%(default)s)")
    play.add_argument("--robot", metavar="NAME", help="which arm (the one that was driven)")
    play.add_argument(
        "--speed", type=float, default=1.0, metavar="SHARE", help="of the recording's, above 0, at most 1 (%(default)s)"
    )
    who = play.add_mutually_exclusive_group()
    who.add_argument("--deadman", action="store_true", help="a simulated arm, too, moves only while it is held")
    who.add_argument("--unattended", action="store_true", help="a real arm moves without one: nobody is near it")
    play.add_argument("--report", metavar="FILE", help="write how it went, as JSON")
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    import hal
    from hal.apps._common import banner, check_writable, held_by, invitation, needs_holding, planned
    from hal.apps.check import may_open
    from hal.errors import CommandError
    from hal.recording import Dataset
    from hal.recording.checking import check_rows

    if not 0.0 < args.speed <= 1.0:
        raise CommandError(f"--speed must be above 0 and at most 1, not {args.speed:g}")
    if args.report:
        check_writable(args.report)
    episodes = Dataset(args.dataset).episodes
    if not -len(episodes) <= args.episode < len(episodes):
        raise CommandError(f"--episode {args.episode}: {args.dataset} has {len(episodes)}, counted from 0")
    episode = episodes[args.episode]
    check_rows(episode, None)  # before anything is opened
    what = f"episode  {episode.number}: {episode.length} rows at {episode.fps:g} Hz, {episode.task or 'no task'!r}"
    plan = planned(args, what)
    if plan is None:
        return 0
    if not may_open(plan):
        return ACTION_NEEDED
    holds = needs_holding(plan, args)
    with hal.open(**{**rig_options(args), "pad": args.pad if holds else "none"}) as rig:
        if not rig.robots:
            raise CommandError(f"{rig.plan.source} has no robot")
        robot = rig.robots[args.robot or _driven(rig, episode)]
        print("\n  ".join([banner(rig), what, *_replayed(robot, episode)]) + f"\n{invitation(rig)}", flush=True)
        deadman, mapping = held_by(rig) if holds else (None, None)
        return Replay(rig, robot, episode, args, deadman, mapping.deadman if mapping is not None else "").run()


def _driven(rig: Rig, episode: Episode) -> str:
    """The arm that the recording says was driven, else the first of the rig that is in it, else the first."""
    from hal.learning.replay import arms_of

    driven = str(episode.info.get("info", {}).get("robot"))
    recorded = arms_of(episode)
    if driven in rig.robots:
        return driven
    return next((name for name in rig.robots if name in recorded), next(iter(rig.robots)))


def _replayed(robot: Robot, episode: Episode) -> Iterator[str]:
    """Which arm moves, which others of the recording do not, and what is damaged but not needed."""
    from hal.errors import DatasetError
    from hal.learning.replay import moved_besides

    yield f"replays  {robot.name}"
    try:
        episode.check_pictures()
    except DatasetError as error:
        yield f"damaged  {error}; pictures are not replayed"
    for name in moved_besides(episode, robot.name):
        yield f"still    {name} moved in the recording, too; it is not replayed"


class Replay:
    """One run of the app."""

    def __init__(
        self, rig: Rig, robot: Robot, episode: Episode, args: argparse.Namespace, deadman: Deadman | None, button: str
    ) -> None:
        from hal.apps._common import StatusLine
        from hal.learning.replay import Player, RecordedTrajectory

        self.rig, self.robot, self.episode, self.args, self.button = rig, robot, episode, args, button
        self.line = StatusLine()
        course = RecordedTrajectory.of(episode, robot)
        self.player = Player(
            rig, robot, course, speed=args.speed, deadman=deadman, unattended=args.unattended or not button
        )
        self.start = rig.clock.now()
        self.servo = self._servo()

    def _servo(self) -> tuple[int, int]:
        """Ticks so far, and how many of them came too late."""
        group = next(group for group in self.rig.statistics().values() if self.robot.name in group["robots"])
        return int(group["ticks"]), int(group.get("missed", 0))

    def run(self) -> int:
        """Approach, play, report."""
        from hal.errors import ConnectionLost, MotionStopped, RobotFault, StaleStateError

        reason = ""
        try:
            self._play()
        except (MotionStopped, RobotFault, ConnectionLost, StaleStateError) as stop:
            reason = getattr(stop, "reason", str(stop))
        except KeyboardInterrupt:
            reason = "Ctrl-C"
        self.line.clear()
        ticks, missed = self._missed()
        self._tell(reason, ticks, missed)
        if self.args.report:
            report = self._report(reason) | {"servo": {"ticks": ticks, "missed": missed}}
            Path(self.args.report).write_text(json.dumps(report, indent=2) + "\n")
        return 0 if self.player.finished else NOT_FINISHED

    def _missed(self) -> tuple[int, int]:
        """Ticks while it played, and missed ones; none where there is nobody left to be asked."""
        from hal.errors import HalError

        try:
            now = self._servo()
        except (HalError, OSError):
            return 0, 0
        return now[0] - self.servo[0], now[1] - self.servo[1]

    def _say(self, text: str) -> None:
        self.line.event(f"  {text}")
        self.rig.say(text)

    def _play(self) -> None:
        things = self.player.course.objects
        if things and not self.rig.has_world:
            self._say("where things lay when it was recorded, x y z in m:")
            for name, pose in things.items():
                self._say(f"  {name:12s} {' '.join(f'{value:.3f}' for value in pose.position)}")
        self._say("to the first pose" + (f": hold {self.button} until the arm is there" if self.button else ""))
        self.player.approach()
        if self.button:
            self._say(f"there; let go of {self.button} and hold it again to play")
        self.start, self.servo = self.rig.clock.now(), self._servo()
        self.player.play(self._show)

    def _show(self, player: Player, plays: bool) -> None:
        def text() -> str:
            does = "playing" if plays else f"paused: hold {self.button}" if self.button else "about to play"
            return f"  {player.place:6.1f} of {player.course.duration:.1f} s  {does}"

        self.line.update(text)

    def _tell(self, reason: str, ticks: int, missed: int) -> None:
        from hal.types import Limited

        player = self.player
        if player.finished:
            self._say(f"played {player.course.duration:.1f} s at {player.speed:g} of its speed; the arm is at rest")
        else:
            self._say(f"ENDED at {player.place:.1f} of {player.course.duration:.1f} s: {reason}; the arm is at rest")
        if player.limited is not Limited.NONE:
            self._say(f"the servo held it back at times ({player.limited}); a lower --speed may be more exact")
        if missed > MANY_MISSED * ticks:
            self._say(f"the servo missed {missed} of {ticks} ticks: this computer had too much else to do")
        self._say("measured, from what was measured in the recording:")
        for line in player.deviation.lines():
            self._say(f"  {line}")

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
            "place_s": player.place,
            "duration_s": player.course.duration,
            "took_s": self.rig.clock.now() - self.start,
            "pauses": player.pauses,
            "held_back": str(player.limited),
            "deviation": player.deviation.as_json(),
        }


if __name__ == "__main__":
    sys.exit(main())
