"""Run a policy, and record what it does: in simulation and on the real arm, the same program.

hal rollout --policy my_policy:act --sim
hal rollout --policy my_policy:Act --episodes 10 --out data/eval --real --config my_rig.yaml
hal rollout --policy ws://gpu:8000 --policy-config droid --task "put the cube on the plate" --sim
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
import traceback
from collections import Counter
from typing import TYPE_CHECKING, Any, Literal

import hal
from hal.apps._common import (
    ACTION_NEEDED,
    add_deadman_options,
    add_episode_options,
    add_rig_options,
    check_episode_options,
    find_deadman,
    find_pad,
    load_named,
    needs_deadman,
    program,
    resolve_plan,
    rig_options,
    write_report,
)
from hal.apps._display import StatusLine, banner, list_links, to_ms
from hal.errors import CommandError, HalError, MotionStopped, PolicyError, RobotFault

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from hal.config.mapping import TeleopMapping
    from hal.deadman import Deadman
    from hal.gamepad import Gamepad
    from hal.geometry import Pose
    from hal.learning.policy import Policy, PolicyOutcome
    from hal.learning.policy_config import PolicyConfig
    from hal.learning.takeover import Takeover
    from hal.recording import Recorder
    from hal.rig import Rig
    from hal.robot import Robot

ENDED_EARLY = 1
LEROBOT = "lerobot:"
"""Begins a policy that is the checkpoint of one that LeRobot trained."""
LOAD_TIMEOUT = 300.0
"""Longest time that such a policy may take to load, s."""
RECONNECT_TIMEOUT = 60.0
"""Longest wait between two episodes for a policy's server that was lost, s."""
RECONNECT_PERIOD = 0.5
"""Time between two attempts, s."""
AWAY = ("policy_unreachable", "policy_lost", "policy_timeout")
"""Codes of a server that is not there, or not yet."""
NOTE_PERIOD = 0.5
"""Time between two notes to the console on who drives, while that does not change, s."""
MARKS = {"finish": True, "fail": False}
"""Action of the pad's mapping that ends an episode -> whether it is marked a success, as in ``apps/collect.py``."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal rollout",
        description="Run a policy under the limits and the dead-man of manual driving; count successes and record.",
        epilog="Ctrl-C stops the arm. An episode that the policy ends by an error is a failure, and the next follows; "
        "a real arm waits for a new press of the dead-man. The exit status is 1 if any episode ended so.",
    )
    add_rig_options(made)
    run = made.add_argument_group("running")
    run.add_argument(
        "--policy",
        required=True,
        metavar="MODULE:NAME|URL|CHECKPOINT",
        help="policy: a function, or a class whose instances are called; ws://HOST:PORT of a policy's server; or "
        "lerobot:CHECKPOINT, where LeRobot is installed beside this package",
    )
    run.add_argument(
        "--policy-config",
        metavar="NAME|FILE",
        help="what a policy on a server sees, and what its actions mean: droid, roboarena, aloha, libero, lerobot, or "
        "a YAML file (default: as the server describes itself)",
    )
    run.add_argument(
        "--latency",
        type=float,
        default=0.0,
        metavar="S",
        help="simulated time that a policy on a server takes to answer, in lock-step (0)",
    )
    run.add_argument(
        "--takeover",
        action="store_true",
        help="moving a stick takes the arm from the policy, with the dead-man held; letting go gives it back",
    )
    run.add_argument(
        "--controller",
        nargs="+",
        metavar=("NAME", "GAIN=VALUE"),
        help="what makes the arms follow: Position (default), JointImpedance or OperationalSpace, with gains, for "
        "example --controller OperationalSpace stiffness=[500,500,200] rotation_stiffness=30",
    )
    add_episode_options(run)
    add_deadman_options(run)
    run.add_argument("--out", metavar="DIR", help="dataset to record into")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.learning.policy_config import load_policy_config

    remote = is_remote(args.policy)
    check_episode_options(args, *([] if remote else ["policy"]), "reset", "success")
    if args.policy_config and not remote:
        raise CommandError("--policy-config is for a policy on a server: --policy ws://HOST:PORT")
    if args.takeover and args.unattended:
        raise CommandError("--takeover needs a pad and its dead-man; leave --unattended out")
    config = load_policy_config(args.policy_config) if args.policy_config else None
    make_controller(args.controller)  # so that a mistake shows before anything is opened
    plan = resolve_plan(args, f"policy   {args.policy}")
    holds = args.takeover or needs_deadman(plan, args)
    with hal.open(**rig_options(args, pad=holds)) as rig:
        if not rig.robots:
            raise CommandError(f"{rig.plan.source} has no robot", code="no_robot")
        robot = rig.robots[args.robot or next(iter(rig.robots))]
        print(f"{banner(rig)}\n  policy   {args.policy}\n{list_links(rig)}", flush=True)
        held = find_deadman(rig, robot if args.takeover else None) if holds else (None, None, "")
        recorder = _recorder(rig, args)
        try:
            with _policy(rig, robot, args, config) as policy:
                return RolloutRun(rig, robot, args, policy, recorder, *held).run()
        finally:
            if recorder is not None:
                recorder.close()


def make_controller(words: list[str] | None) -> hal.Position | hal.JointImpedance | hal.OperationalSpace | None:
    """Return the controller of ``--controller``: the name of its class, then arguments of that as NAME=VALUE.

    Raises:
        CommandError: There is no such controller, or it does not take these arguments (code ``bad_controller``).
    """
    import yaml

    if words is None:
        return None
    kinds = {kind.__name__: kind for kind in (hal.Position, hal.JointImpedance, hal.OperationalSpace)}
    name, *pairs = words
    try:
        gains = {key: yaml.safe_load(value) for key, _, value in (pair.partition("=") for pair in pairs)}
        gains = {key: tuple(gain) if isinstance(gain, list) else gain for key, gain in gains.items()}
        return kinds[name](**gains)
    except KeyError:
        text = f"there is no controller {name!r}, only {', '.join(kinds)}"
    except (TypeError, ValueError, yaml.YAMLError) as error:
        text = f"{name} with {', '.join(pairs)}: {error}"
    raise CommandError(f"--controller: {text}", code="bad_controller")


def is_remote(policy: str) -> bool:
    """Return whether a policy runs in another process."""
    return "://" in policy or policy.startswith(LEROBOT)


@contextlib.contextmanager
def _policy(rig: Rig, robot: Robot, args: argparse.Namespace, config: PolicyConfig | None) -> Iterator[Policy]:
    """Yield the policy of ``--policy``."""
    from hal.host.process import Child
    from hal.learning.asynchronous import RemotePolicy
    from hal.learning.policy import load_policy
    from hal.learning.remote import PolicyClient

    if not is_remote(args.policy):
        yield load_policy(args.policy, rig)
        return
    with contextlib.ExitStack() as stack:
        url = args.policy
        if url.startswith(LEROBOT):
            given = {"checkpoint": url.removeprefix(LEROBOT)}
            child = Child("policy", "hal.apps.serve_lerobot:serve_checkpoint", given)
            stack.callback(child.close)
            url = child.wait_ready(LOAD_TIMEOUT)
        client = PolicyClient(url, api_key=os.environ.get("HAL_POLICY_KEY", ""))
        stack.callback(client.close)
        yield RemotePolicy(rig, client, config, robot=robot, task=args.task, latency=args.latency)


def _recorder(rig: Rig, args: argparse.Namespace) -> Recorder | None:
    if not args.out:
        return None
    from hal.recording import Recorder

    return Recorder(rig, out=args.out, fps=args.fps, task=args.task)


class RolloutRun:
    """One run of the program on an open rig."""

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        args: argparse.Namespace,
        policy: Policy,
        recorder: Recorder | None,
        deadman: Deadman | None,
        mapping: TeleopMapping | None,
        button: str,
    ) -> None:
        """Prepare to run a policy; the last three arguments are those of the pad; None, and "", without a dead-man."""
        from hal.leading import make_teleop
        from hal.learning.asynchronous import RemotePolicy
        from hal.learning.policy import PolicyRunner
        from hal.learning.takeover import Takeover

        self.rig, self.args, self.recorder, self.deadman = rig, args, recorder, deadman
        self.remote = policy if isinstance(policy, RemotePolicy) else None
        """The policy, if it is on a server."""
        self.figures: Callable[[], dict[str, Any]] = dict if self.remote is None else self.remote.statistics
        """Returns the figures of a policy on a server."""
        self.robots = {robot.name: robot} if self.remote is None else self.remote.robots
        """The arms that the policy moves, by name."""
        self.robot = self.robots.get(robot.name) or next(iter(self.robots.values()))
        """The arm that a person drives in a takeover."""
        self.pad: Gamepad | None = None
        self.button = button
        """Name of the dead-man's control, if it must be held."""
        self.marks: dict[str, bool] = {}
        """Button -> how it marks an episode."""
        self.takeover: Takeover | None = None
        if mapping is not None:
            self.pad = find_pad(rig, robot if args.takeover else None)
            assert self.pad is not None
            self.marks = {mapping.actions[name]: mark for name, mark in MARKS.items() if name in mapping.actions}
            if args.takeover:
                self.takeover = Takeover(make_teleop(self.robot, self.pad, mapping), self.pad)
        self.line, self._noted, self._next_note = StatusLine(), "", 0.0
        if recorder is not None:
            recorder.source = self._driver
        self.reset_function = load_named(args, "reset")
        self.runner = PolicyRunner(
            rig,
            policy,
            robots=self.robots.values(),
            rate_hz=args.rate,
            seconds=args.seconds,
            deadman=deadman,
            unattended=args.unattended or mapping is None,
            controller=make_controller(args.controller),
            cameras=None if self.remote is None else self.remote.config.cameras(),
            history=args.history,
            success=load_named(args, "success"),
            mark=self._mark,
            takeover=self.takeover,
        )
        self.pressed: set[str] = set()
        """Marking buttons that are pressed. Each press marks once."""
        self.outcomes: list[PolicyOutcome] = []

    def run(self) -> int:
        """Run all episodes, or until a device or a person ends the run. Return the exit status."""
        self.runner.rehearse()
        ended, failed = "", False
        try:
            for number in range(self.args.episodes):
                self._reconnect()
                outcome = self._episode(self.args.seed + number)
                if not self._continues_after(outcome):
                    ended = outcome.reason
                    break
        except (MotionStopped, RobotFault) as stop:  # during a reset
            ended = getattr(stop, "reason", str(stop))
        except KeyboardInterrupt:
            ended = "Ctrl-C"
        except (HalError, OSError) as error:  # such as the end of the arm's process
            if not self.outcomes:
                raise
            ended, failed = f"{type(error).__name__}: {error}", True
        self.line.clear()
        self._print_results(ended)
        write_report(self.args.report, self._report(ended))
        return ACTION_NEEDED if failed else ENDED_EARLY if ended or self._reasons() else 0

    def _continues_after(self, outcome: PolicyOutcome) -> bool:
        """Return whether the next episode may begin: after errors of the policy, if a person starts each real arm.

        A reset also ends the fault of a simulated arm that something held away from its set-point.
        """
        from hal.learning.episode import stands_in_world
        from hal.learning.policy import POLICY_STOPS

        if outcome.ended not in ("stopped", "error"):
            return True
        placed = all(stands_in_world(self.rig, arm) for arm in self.robots.values())
        if placed and isinstance(outcome.error, RobotFault):
            return True
        return (placed or self.deadman is not None) and (outcome.ended == "error" or outcome.code in POLICY_STOPS)

    def _reconnect(self) -> None:
        """Wait until a policy's server that was lost answers again.

        Raises:
            PolicyError: It does not in time.
        """
        if self.remote is None or self.remote.client.connected:
            return None
        client, end = self.remote.client, time.monotonic() + RECONNECT_TIMEOUT
        self._announce(f"waiting for {client.url}, at most {RECONNECT_TIMEOUT:g} s")
        while True:
            try:
                return self.runner.rehearse()
            except PolicyError as error:
                if error.code not in AWAY:
                    return None  # it is there; the next episode names what is wrong
                if time.monotonic() > end:
                    raise
            time.sleep(RECONNECT_PERIOD)

    def _reasons(self) -> dict[str, int]:
        """Return how many episodes ended by each error or stop."""
        return dict(Counter(outcome.code for outcome in self.outcomes if outcome.code))

    def _announce(self, text: str) -> None:
        self.line.event(f"  {text}")
        self.rig.say(text)

    def _mark(self) -> bool | None:
        """Return how a newly pressed button marks the episode; None if there is none."""
        before, pads = self.pressed, self.rig.gamepads.values()
        self.pressed = {name for name in self.marks if any(pad.state().pressed(name) for pad in pads)}
        return next((self.marks[name] for name in self.pressed - before), None)

    def _episode(self, seed: int) -> PolicyOutcome:
        number = len(self.outcomes)
        self._reset(number, seed)
        self.pressed = set(self.marks)
        if self.recorder is not None:
            self.recorder.start(seed=seed, info=self._info())
        outcome: PolicyOutcome | None = None
        try:
            outcome = self.runner.run(seed, lambda seconds: self._show(number, seconds))
        finally:
            if self.recorder is not None:
                mark = outcome.success if outcome is not None else None
                self.recorder.save(mark, wait=True, result=self._result(outcome))
        self._noted = ""
        self._note_driver("")
        is_new = outcome.reason not in [earlier.reason for earlier in self.outcomes]
        self.outcomes.append(outcome)
        self._announce(f"episode {number}: {_describe(outcome)}")
        if self.recorder is not None and (trouble := self.recorder.status().trouble):
            self._announce(f"RECORDING: {trouble}")
        if outcome.ended == "error" and is_new and not isinstance(outcome.error, PolicyError):  # its text is enough
            assert outcome.error is not None
            self.line.clear()
            traceback.print_exception(outcome.error)
        return outcome

    def _result(self, outcome: PolicyOutcome | None) -> dict[str, Any]:
        """Return what an episode's metadata says about its end; without an ``outcome`` the run ended in it."""
        return {
            "interventions": [] if self.takeover is None else self.takeover.intervals,
            "policy": self.figures() if outcome is None else dict(outcome.statistics),
            "ended": "stopped" if outcome is None else outcome.ended,
            "code": "" if outcome is None else outcome.code,
        }

    def _following(self) -> dict[str, str]:
        return {"controller": " ".join(self.args.controller)} if self.args.controller else {}

    def _info(self) -> dict[str, Any]:
        return {
            "policy": self.args.policy,
            "robot": ",".join(self.robots),
            "rate_hz": self.args.rate,
            **self._following(),
        }

    def _reset(self, number: int, seed: int) -> None:
        """Reset the scene: real arms drive home, and the seed places objects with random ranges."""
        import numpy as np

        from hal.learning.episode import reset_scene, stands_in_world

        rig, random, put = self.rig, np.random.default_rng(seed), {}
        for count, robot in enumerate(self.robots.values(), start=1):
            if not stands_in_world(rig, robot):
                held = f"; release {self.button}, then hold it until the arm is there" if self.button else ""
                self._announce(f"episode {number}: {robot.name} drives home, then its gripper opens{held}")
            objects = random if count == len(self.robots) else None  # every reset of an arm puts the objects back
            varied = None if objects is None else seed
            free = self.args.unattended
            put = reset_scene(rig, robot, random=objects, seed=varied, deadman=self.deadman, unattended=free)
        if self.reset_function is not None:
            self.reset_function(rig, random)
        elif put:
            self._announce(f"episode {number}: {', '.join(_describe_place(name, pose) for name, pose in put.items())}")
        if self.button:
            words = {True: "success", False: "failure"}
            names = self.pad.control_name if self.pad is not None else str
            marks = "".join(f"; {names(name)}: {words[mark]}" for name, mark in self.marks.items())
            self._announce(f"episode {number}: release {self.button}, then hold it to run the policy{marks}")

    def _show(self, number: int, seconds: float) -> None:
        if self.pad is not None and self.pad.finished and self.deadman is not None and not self.deadman.held:
            raise CommandError("the recorded pad has ended, and nothing holds the dead-man", code="pad_finished")
        self.line.update(lambda: f"  episode {number}: {seconds:6.1f} of {self.args.seconds:g} s")
        driver, now = self._driver(), self.rig.clock.now()
        if driver != self._noted or now >= self._next_note:
            self._noted, self._next_note = driver, now + NOTE_PERIOD
            figures = self.figures()
            self._note_driver(driver + (f": {_describe_chunks(figures)}" if figures.get("chunks") else ""))

    def _driver(self) -> Literal["person", "policy"]:
        return "person" if self.takeover is not None and self.takeover.active else "policy"

    def _note_driver(self, note: str) -> None:
        from hal.views import DrivingView

        if self.rig.console is not None:
            self.rig.console.show_driving(DrivingView(self.robot.name, note=note))

    def _print_results(self, ended: str) -> None:
        done = [outcome.success for outcome in self.outcomes]
        marked = [mark for mark in done if mark is not None]
        rate = f", {sum(marked)} of {len(marked)} marked episodes succeeded" if marked else ""
        self._announce(f"{len(done)} episode(s){rate}; the arm is at rest")
        if reasons := self._reasons():
            self._announce("ended early: " + ", ".join(f"{count} {code}" for code, count in reasons.items()))
        if ended:
            self._announce(f"ENDED: {ended}")

    def _report(self, ended: str) -> dict[str, Any]:
        return {
            "policy": self.args.policy,
            "robot": ",".join(self.robots),
            "backend": self.robot.spec.driver,
            "clock": self.rig.plan.clock,
            "rate_hz": self.args.rate,
            **self._following(),
            "recorded": self.args.out,
            "ended": ended,
            "reasons": self._reasons(),
            "episodes": [
                {
                    "seed": self.args.seed + number,
                    "success": outcome.success,
                    "ended": outcome.ended,
                    "code": outcome.code,
                    "reason": outcome.reason,
                    "seconds": outcome.seconds,
                    "turns": outcome.turns,
                    "missed": outcome.missed,
                    "repeated": outcome.repeated,
                    "pauses": outcome.pauses,
                    "interventions": outcome.interventions,
                    "inference_ms": {name: to_ms(value) for name, value in outcome.inference.items()},
                    "policy": dict(outcome.statistics),
                }
                for number, outcome in enumerate(self.outcomes)
            ],
        }


def _describe_place(name: str, pose: Pose) -> str:
    x, y, z = pose.position
    return f"{name} at x {x:.3f}, y {y:.3f}, z {z:.3f} m"


def _describe(outcome: PolicyOutcome) -> str:
    """Return the result of an episode in one line."""
    p50, p99 = (to_ms(outcome.inference[name]) or 0.0 for name in ("p50", "p99"))
    how = {"time": "time limit reached", "stopped": "STOPPED", "error": "the policy raised an error"}
    mark = {True: ", success", False: ", failure", None: ""}[outcome.success if outcome.ended == "time" else None]
    why = f" ({outcome.code}: {outcome.reason})" if outcome.code else ""
    text = f"{how.get(outcome.ended, outcome.ended)}{mark}{why} after {outcome.seconds:.1f} s, {outcome.turns} step(s)"
    missed = f", {outcome.missed} MISSED" if outcome.missed else ""
    if taken := outcome.interventions:
        missed += f", {len(taken)} takeover(s) of {sum(end - begin for begin, end in taken):.1f} s"
    if "latency" in outcome.statistics:
        return f"{text}{missed}; {_describe_chunks(outcome.statistics)}"
    return f"{text}{missed}; inference p50 {p50:.1f}, p99 {p99:.1f} ms"


def _describe_chunks(figures: Mapping[str, Any]) -> str:
    """Return the figures of a policy on a server in one line."""
    p50, p99 = (to_ms(figures["latency"][name]) or 0.0 for name in ("p50", "p99"))
    counts = f"{figures['chunks']} chunk(s), {figures['late']} late, {figures['steep']} steep"
    return f"{counts}, latency p50 {p50:.0f}, p99 {p99:.0f} ms"


if __name__ == "__main__":
    sys.exit(main())
