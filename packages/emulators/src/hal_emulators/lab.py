"""Everything that a rig names as real, emulated by one command with one prompt: ``hal emulate --config RIG``."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import NamedTuple

from hal.specs import RobotSpec
from hal_emulators.control import note_signals
from hal_emulators.shared_world import find_address, has_world, load_real
from hal_emulators.ur.motion import ROBOTS
from hal_emulators.xarm.controller import ROBOTS as XARMS

_END = 10.0
"""Longest time that the emulators take to end, s."""
_PR_SET_PDEATHSIG = 1
_FRANKA = {"fr3": "fr3", "fer": "panda"}
"""Arm of a Franka's settings -> robot of its emulator."""


class Emulator(NamedTuple):
    name: str
    """At the prompt: that of the arm, or of the program that plays several."""
    arguments: list[str]
    """Of ``hal emulate``."""


def list_emulators(config: str, overrides: Sequence[str] = ()) -> list[Emulator]:
    """Return the emulators of a rig (a name in ``config/``, or a path), with changes ``KEY=VALUE``.

    Raises ConfigError, and ValueError if a device is not at an address of this computer, a UR's model has no emulator,
    or nothing is real.
    """
    rig = load_real(config, overrides)
    words = ["--config", config, *(word for value in overrides for word in ("--set", value))]
    foreign = [arm.name for arm in rig.robots if arm.attended and not arm.emulated]
    if foreign:
        raise ValueError(f"{', '.join(foreign)}: not at an address of an emulator: change real: there, or --set it")
    in_world = has_world(config, overrides)
    emulators = {}
    for arm in rig.robots:
        for device in (arm, arm.gripper):
            if device is not None:
                made = _emulator_of(device.driver, arm, words, in_world)
                if made is not None:
                    emulators[made.name] = made
    if any(pad.leader is not None and pad.driver in ("feetech", "dynamixel") for pad in rig.pads):
        emulators["servo_bus"] = Emulator("servo_bus", ["servo_bus", *words])
    if not emulators:
        raise ValueError(f"{config} names no real arm, gripper or leader that has an emulator")
    return list(emulators.values())


def _emulator_of(driver: str, arm: RobotSpec, words: list[str], in_world: bool) -> Emulator | None:
    if driver in ("damiao", "piper"):
        return Emulator("can", ["can", *words])
    if driver in ("feetech", "dynamixel"):
        return Emulator("servo_bus", ["servo_bus", *words])
    if driver == "robotiq":
        return Emulator(driver, [driver, *words])
    if arm.driver != driver or driver not in ("franka", "ur", "xarm"):
        return None
    options = ["--host", find_address(arm), *(words if in_world else [])]
    if driver == "ur":
        if arm.model not in ROBOTS:
            known = ", ".join(sorted(ROBOTS))
            raise ValueError(f"{arm.name}: its model {arm.model} has no emulator, only {known}")
        return Emulator(arm.name, ["ur", "--robot", arm.model, *options])
    if driver == "xarm":
        robot = arm.model if arm.model in XARMS else f"xarm{len(arm.joints)}"  # a model of one's own
        return Emulator(arm.name, ["xarm", "--robot", robot, *options])
    bare = arm.gripper is None or arm.gripper.driver != driver
    hand = ["--end-effector", "none", "--no-hand"] if bare else []
    return Emulator(arm.name, ["franka", "--robot", _FRANKA[arm.options["arm"]], *hand, *options])


def run_lab(config: str, overrides: Sequence[str] = ()) -> int:
    """Run the emulators of a rig until one ends or the program is asked to end; return the exit status.

    A line of standard input goes to the emulator whose name it begins with, or to the only one. Raises as
    :func:`list_emulators`.
    """
    ends = note_signals()
    emulators = list_emulators(config, overrides)
    failed = False
    with contextlib.ExitStack() as stack:
        running = {emulator.name: stack.enter_context(_start(emulator)) for emulator in emulators}
        stack.callback(_end_all, list(running.values()))
        print(f"starting {', '.join(running)}; NAME help lists the commands of one, Ctrl-C ends all", flush=True)
        for name, process in running.items():
            threading.Thread(target=_print_lines, args=(name, process), name=name, daemon=True).start()
        threading.Thread(target=_serve_prompt, args=(running,), name="prompt", daemon=True).start()
        while not ends:
            time.sleep(0.1)
            ended = [name for name, process in running.items() if process.poll() is not None]
            if ended:
                print(f"error: {', '.join(ended)} ended, so all do", file=sys.stderr, flush=True)
                failed = True
                break
    return int(failed)


def _start(emulator: Emulator) -> subprocess.Popen[str]:
    """Start an emulator, which ends with this program however this ends, and not at its terminal's Ctrl-C."""
    libc = ctypes.CDLL(None)
    return subprocess.Popen(
        [sys.executable, "-m", f"hal_emulators.{emulator.arguments[0]}", *emulator.arguments[1:]],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM),
    )


def _end_all(processes: Sequence[subprocess.Popen[str]]) -> None:
    for process in processes:
        process.terminate()
    limit = time.monotonic() + _END
    for process in processes:
        try:
            process.wait(max(0.0, limit - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()


def _print_lines(name: str, process: subprocess.Popen[str]) -> None:
    for line in process.stdout or ():
        print(f"{name}: {line.rstrip()}\n", end="", flush=True)  # in one piece: others print, too


def _serve_prompt(running: dict[str, subprocess.Popen[str]]) -> None:
    for line in sys.stdin:
        name, _, command = line.strip().partition(" ")
        if len(running) == 1 and name not in running:
            (name,), command = running, line.strip()
        if name not in running:
            print(f"begin with the name of an emulator: {', '.join(running)}", flush=True)
            continue
        stdin = running[name].stdin
        assert stdin is not None
        with contextlib.suppress(OSError):
            print(command or "help", file=stdin, flush=True)
