"""Run a policy, and record what it does: in simulation and on the real arm, the same program.

python apps/rollout.py --policy my_policy:act --sim
python apps/rollout.py --policy my_policy:Act --episodes 10 --out data/eval --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.apps._common import ACTION_NEEDED, add_rig_options, rig_options, run_app
from hal.apps.collecting import called

if TYPE_CHECKING:
    from hal.config.mapping import TeleopMapping
    from hal.deadman import Deadman
    from hal.geometry import Pose
    from hal.learning.policy import Outcome
    from hal.recording import Recorder
    from hal.rig import Rig
    from hal.robot import Robot

ENDED_EARLY = 1
MARKS = {"finish": True, "fail": False}
"""What ends an episode, of the actions of a pad's mapping, and how it is marked then: as in ``apps/collect.py``."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="rollout",
        description="Run a policy under the limits and the dead-man that a person has, and record what it does.",
        epilog="Ctrl-C stops the arm. The exit status is 1 when an episode was stopped or the policy raised something.",
    )
    add_rig_options(made)
    run = made.add_argument_group("running")
    run.add_argument("--policy", required=True, metavar="MODULE:NAME", help="a function, or a class that is called")
    run.add_argument("--robot", metavar="NAME", help="which arm, where the rig has several (the first)")
    run.add_argument("--rate", type=float, default=20.0, metavar="HZ", help="how often it is asked (%(default)g)")
    run.add_argument("--history", type=int, default=1, metavar="N", help="observations in each one (%(default)s)")
    run.add_argument("--episodes", type=int, default=1, metavar="N", help="how many (%(default)s)")
    run.add_argument("--seconds", type=float, default=30.0, metavar="S", help="an episode's length (%(default)g)")
    run.add_argument("--seed", type=int, default=0, metavar="N", help="of the first episode; the next has one more (0)")
    run.add_argument(
        "--reset", metavar="MODULE:NAME", help="called with the rig and a random generator once all is back in place"
    )
    run.add_argument(
        "--success", metavar="MODULE:NAME", help="called with the rig and an observation; True ends an episode"
    )
    who = run.add_mutually_exclusive_group()
    who.add_argument("--deadman", action="store_true", help="a simulated arm, too, moves only while it is held")
    who.add_argument("--unattended", action="store_true", help="a real arm moves without one: nobody is near it")
    run.add_argument("--out", metavar="DIR", help="record into this dataset")
    run.add_argument("--fps", type=int, default=30, metavar="N", help="rows a second of that (%(default)s)")
    run.add_argument("--task", default="", metavar="TEXT", help="what is to be done, for the recording")
    run.add_argument("--report", metavar="FILE", help="write how it went, as JSON")
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    import hal
    from hal.apps._common import banner, check_writable, held_by, invitation, needs_holding, planned
    from hal.apps.check import may_open
    from hal.errors import CommandError
    from hal.learning.policy import found

    for name in ("rate", "episodes", "seconds", "history"):
        if not getattr(args, name) > 0:
            raise CommandError(f"--{name} must be positive, not {getattr(args, name):g}")
    if args.seed < 0:
        raise CommandError(f"--seed must be 0 or more, not {args.seed}")
    if args.report:
        check_writable(args.report)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    for what in ("policy", "reset", "success"):
        if getattr(args, what):
            found(getattr(args, what), f"--{what}")
    plan = planned(args, f"policy   {args.policy}")
    if plan is None:
        return 0
    if not may_open(plan):
        return ACTION_NEEDED
    holds = needs_holding(plan, args)
    with hal.open(**{**rig_options(args), "pad": args.pad if holds else "none"}) as rig:
        if not rig.robots:
            raise CommandError(f"{rig.plan.source} has no robot")
        robot = rig.robots[args.robot or next(iter(rig.robots))]
        print(f"{banner(rig)}\n  policy   {args.policy}\n{invitation(rig)}", flush=True)
        deadman, mapping = held_by(rig) if holds else (None, None)
        recorder = _recorder(rig, args)
        try:
            return Run(rig, robot, args, recorder, deadman, mapping).run()
        finally:
            if recorder is not None:
                recorder.close()


def _recorder(rig: Rig, args: argparse.Namespace) -> Recorder | None:
    if not args.out:
        return None
    from hal.recording import Recorder

    return Recorder(rig, out=args.out, fps=args.fps, task=args.task)


class Run:
    """One run of the app."""

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        args: argparse.Namespace,
        recorder: Recorder | None,
        deadman: Deadman | None,
        mapping: TeleopMapping | None,
    ) -> None:
        """``mapping`` says what the pad's controls are, where somebody holds one."""
        from hal.apps._common import StatusLine
        from hal.learning.policy import PolicyRunner, found, load_policy

        self.rig, self.robot, self.args, self.recorder = rig, robot, args, recorder
        self.deadman = deadman
        self.button = mapping.deadman if mapping is not None else ""
        """That must be held."""
        actions = mapping.actions if mapping is not None else {}
        self.marks = {actions[action]: mark for action, mark in MARKS.items() if action in actions}
        """Of the pad's buttons: what they say of an episode."""
        self.line = StatusLine()
        self.put_back: Any = found(args.reset, "--reset") if args.reset else None
        self.runner = PolicyRunner(
            rig,
            load_policy(args.policy, rig),
            robot=robot,
            rate_hz=args.rate,
            seconds=args.seconds,
            deadman=deadman,
            unattended=args.unattended or mapping is None,
            history=args.history,
            success=found(args.success, "--success") if args.success else None,
            mark=self._mark,
        )
        self.pressed: set[str] = set()
        """Of the buttons that mark: what is pressed. Who goes on pressing marks nothing more."""
        self.outcomes: list[Outcome] = []

    def run(self) -> int:
        """All episodes, or as far as one is stopped."""
        from hal.errors import MotionStopped, RobotFault

        self.runner.rehearse()
        ended = ""
        try:
            for number in range(self.args.episodes):
                outcome = self._episode(self.args.seed + number)
                if outcome.ended in ("stopped", "error"):
                    ended = outcome.reason
                    break
        except (MotionStopped, RobotFault) as stop:  # on the way to the beginning of an episode
            ended = getattr(stop, "reason", str(stop))
        except KeyboardInterrupt:
            ended = "Ctrl-C"
        self.line.clear()
        self._tell(ended)
        if self.args.report:
            Path(self.args.report).write_text(json.dumps(self._report(ended), indent=2) + "\n")
        return ENDED_EARLY if ended else 0

    def _say(self, text: str) -> None:
        self.line.event(f"  {text}")
        self.rig.say(text)

    def _mark(self) -> bool | None:
        """What a person says with the pad, with the dead-man held or not."""
        before, pads = self.pressed, self.rig.gamepads.values()
        self.pressed = {name for name in self.marks if any(pad.state().pressed(name) for pad in pads)}
        return next((self.marks[name] for name in self.pressed - before), None)

    def _episode(self, seed: int) -> Outcome:
        number = len(self.outcomes)
        self._begin(number, seed)
        self.pressed = set(self.marks)
        if self.recorder is not None:
            self.recorder.start(seed=seed, info=self._about())
        outcome: Outcome | None = None
        try:
            outcome = self.runner.run(seed, lambda seconds: self._show(number, seconds))
        finally:
            if self.recorder is not None:
                self.recorder.save(outcome.success if outcome is not None else None, wait=True)
        self.outcomes.append(outcome)
        self._say(f"episode {number}: {_told(outcome)}")
        if self.recorder is not None and (trouble := self.recorder.status().trouble):
            self._say(f"RECORDING: {trouble}")
        if outcome.error is not None:
            self.line.clear()
            traceback.print_exception(outcome.error)
        return outcome

    def _about(self) -> dict[str, Any]:
        return {"policy": self.args.policy, "robot": self.robot.name, "rate_hz": self.args.rate}

    def _begin(self, number: int, seed: int) -> None:
        """Everything back to where it starts: a real arm drives home, things with random ranges as the seed says."""
        import numpy as np

        from hal.learning.episode import reset_scene, stands_in_world

        rig, robot = self.rig, self.robot
        if not stands_in_world(rig, robot):
            held = f"; let go of {self.button}, then hold it until the arm is there" if self.button else ""
            self._say(f"episode {number}: home, and the gripper opens{held}")
        random = np.random.default_rng(seed)
        put = reset_scene(rig, robot, random=random, deadman=self.deadman, unattended=self.args.unattended)
        if self.put_back is not None:
            self.put_back(rig, random)
        elif put:
            self._say(f"episode {number}: {', '.join(_placed(name, pose) for name, pose in put.items())}")
        if self.button:
            words = {True: "a success", False: "a failure"}
            marks = "".join(f"; {called(name)} marks {words[mark]}" for name, mark in self.marks.items())
            self._say(f"episode {number}: let go of {self.button} and hold it, and the policy drives{marks}")

    def _show(self, number: int, seconds: float) -> None:
        self.line.update(lambda: f"  episode {number}: {seconds:6.1f} of {self.args.seconds:g} s")

    def _tell(self, ended: str) -> None:
        done = [outcome.success for outcome in self.outcomes]
        marked = [mark for mark in done if mark is not None]
        rate = f", {sum(marked)} of {len(marked)} that were marked succeeded" if marked else ""
        self._say(f"{len(done)} episode(s){rate}; the arm is at rest")
        if ended:
            self._say(f"ENDED: {ended}")

    def _report(self, ended: str) -> dict[str, Any]:
        return {
            "policy": self.args.policy,
            "robot": self.robot.name,
            "backend": self.robot.spec.driver,
            "clock": self.rig.plan.clock,
            "rate_hz": self.args.rate,
            "recorded": self.args.out,
            "ended": ended,
            "episodes": [
                {
                    "seed": self.args.seed + number,
                    "success": outcome.success,
                    "ended": outcome.ended,
                    "reason": outcome.reason,
                    "seconds": outcome.seconds,
                    "turns": outcome.turns,
                    "missed": outcome.missed,
                    "repeated": outcome.repeated,
                    "pauses": outcome.pauses,
                    "inference_ms": {name: _ms(value) for name, value in outcome.inference.items()},
                }
                for number, outcome in enumerate(self.outcomes)
            ],
        }


def _placed(name: str, pose: Pose) -> str:
    x, y, z = pose.position
    return f"{name} at x {x:.3f}, y {y:.3f}, z {z:.3f} m"


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


def _told(outcome: Outcome) -> str:
    """How an episode went, in a line."""
    p50, p99 = (_ms(outcome.inference[name]) or 0.0 for name in ("p50", "p99"))
    how = {"time": "time is over", "stopped": "STOPPED", "error": "the policy raised an error"}
    mark = {True: ", a success", False: ", a failure", None: ""}[outcome.success if outcome.ended == "time" else None]
    told = f"{how.get(outcome.ended, outcome.ended)}{mark} after {outcome.seconds:.1f} s, {outcome.turns} turn(s)"
    missed = f", {outcome.missed} MISSED" if outcome.missed else ""
    return f"{told}{missed}; inference p50 {p50:.1f}, p99 {p99:.1f} ms"


if __name__ == "__main__":
    sys.exit(main())
