"""Writes demonstrations.jsonl: a DualShock 4 that collects two demonstrations, made event by event, not recorded.

    python tests/data/pads/make_demonstrations.py

It is for

    hal collect --sim --pad demo --episodes 2 --task "lift the cube" --out DIR

A made-up person sits before the simulated arm, sees where the cube lies in the episodes of that command, and does what
anybody would do with the default mapping: Cross, squeeze L2, drive over the cube, turn the hand as the cube is turned,
go down, close the hand with R2, lift, PS, let go. The person looks while the arm is at rest, presses as long as the way
is far, and looks again. What the fingers do reaches the arm as it does from a real pad: reports of hid-sony every 4 ms,
the pad's model, its dead zone, ``hal.Teleop``, the dead-man. Seeds are fixed, so the file is the same every time.
"""

from __future__ import annotations

import json
import math
import random
import sys
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import numpy as np
import yaml

import hal
from hal.apps._collecting import episode_seed
from hal.config.data_files import find_data
from hal.driver import GamepadDriver, PadReading
from hal.gamepad import Gamepad
from hal.geometry import quaternion_to_matrix
from hal.learning.episode import reset_scene
from hal.pads.codes import ABS, EV_ABS, EV_KEY, KEY
from hal.pads.mapper import AxisRange, PadMapper
from hal.pads.model import pad_model
from hal.specs import PadSpec

FILE = Path(__file__).resolve().parents[3] / "config" / "teleop" / "demonstrations.jsonl"

EPISODES = 2
FIRST_CROSS = 5.0  # s from the beginning: a program needs some time to start
PAUSE = 3.0  # s from PS to the next Cross: the arm is put back, the episode is saved
RATE_HZ = 50.0  # of the program's loop

REPORT = 0.004  # s between two reports of the pad by cable
RISE = 0.12  # s that a finger needs from one end of a trigger or a stick to the other
TRIGGER_BUTTON = {"ABS_Z": "BTN_TL2", "ABS_RZ": "BTN_TR2"}
TRIGGER_BUTTON_FROM = 10  # of 255; where the pad itself starts to call a trigger pressed, a guess
REST = {"ABS_X": 128, "ABS_Y": 128, "ABS_RX": 128, "ABS_RY": 127, "ABS_Z": 0, "ABS_RZ": 0}
STICKS = ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY")
HATS = ("ABS_HAT0X", "ABS_HAT0Y")
RANGES = {code: [0, 255, 15] for code in REST} | {code: [-1, 1, 0] for code in HATS}
ABOUT = "Synthesised event by event by make_demonstrations.py after what hid-sony reports; no hand moved a pad for it."

SPEED, TURN = 0.2, 0.8  # m/s and rad/s of the default mapping
SETTLE = 0.3  # s until the arm is at rest after a control was let go of
ABOVE = 0.12  # m over the table: where the cube passes below the fingers
GRASP = 0.022  # m over the table: a little below the middle of the cube
LIFT = 0.16  # m
NEAR, ALIGNED = 0.006, 0.05  # m and rad that are good enough
TRIES = 5


class HeldPad(GamepadDriver):
    """A DualShock 4 in somebody's hands. ``wanted`` is what the fingers are doing; what changes becomes an event."""

    def __init__(self, spec: PadSpec) -> None:
        super().__init__(spec)
        text = find_data("sensors", "gamepads/dualshock4.yaml").read_text(encoding="utf-8")
        self._mapper = PadMapper(pad_model(yaml.safe_load(text)), {ABS[c]: AxisRange(*r) for c, r in RANGES.items()})
        self.flat = self._mapper.flat
        self.wanted: dict[str, int] = dict(REST)
        self.lines: list[str] = []
        self._fingers: dict[str, float] = dict(REST)
        self._said = {code: 0 for code in (*RANGES, *KEY) if code not in STICKS}
        self._hand = random.Random(7)
        self._reports = 0
        self._t = 0.0

    def open(self) -> None:
        """It is there."""

    def poll(self, now: float, timeout: float) -> PadReading:
        while (t := self._reports * REPORT) <= now + 1e-9:
            self._reports += 1
            for code, value in self._values().items():
                if self._said.get(code) != value:
                    self._say(t, code, value)
        axes = MappingProxyType(dict(self._mapper.axes))
        return PadReading(self._t, now, self._t, len(self.lines), axes, self._mapper.buttons, connected=True)

    def _values(self) -> dict[str, int]:
        """The next report. Fingers move with ramps, a pushed thumb trembles, a stick at rest flickers by one step."""
        values = {code: value for code, value in self.wanted.items() if code not in REST}
        for code, rest in REST.items():
            step = 255.0 * REPORT / RISE
            away = self.wanted[code] - self._fingers[code]
            self._fingers[code] += min(step, max(-step, away))
            pushed = self._fingers[code] != rest
            tremble = self._hand.gauss(0.0, 1.2) if pushed and code in STICKS else 0.0
            flicker = int(self._hand.random() < 0.02) if not pushed and code in STICKS else 0
            values[code] = min(255, max(0, round(self._fingers[code] + tremble) + flicker))
        for axis, button in TRIGGER_BUTTON.items():
            values[button] = int(values[axis] >= TRIGGER_BUTTON_FROM)
        return values

    def _say(self, t: float, code: str, value: int) -> None:
        kind = "abs" if code in ABS else "key"
        self._mapper.feed(*((EV_ABS, ABS[code]) if code in ABS else (EV_KEY, KEY[code])), value)
        self.lines.append(json.dumps({"t": round(t, 3), "type": kind, "code": code, "value": value}))
        self._said[code], self._t = value, t

    def close(self) -> None:
        """It stays."""


class Person:
    """Who holds the pad. Every method that drives is an iterator: one step per turn of the program's loop."""

    def __init__(self, rig: hal.Rig, pad: HeldPad) -> None:
        self.rig, self.arm, self.pad = rig, rig.robots["panda"], pad

    # Seeing, in the arm's base frame.

    def gap(self) -> np.ndarray:
        """From the fingertips to the middle of the cube, (3,) m."""
        cube = self.arm.base.inverse() @ self.rig.world.pose("cube")
        return np.asarray(cube.position - self.arm.state().tcp.position)

    def height(self) -> float:
        """Of the fingertips over the table, m."""
        return float(self.arm.state().tcp.position[2])

    def twisted(self) -> float:
        """How far the hand must turn to the left until it closes over the thin side of the cube, rad: -pi/2 to pi/2."""
        cube = self.arm.base.inverse() @ self.rig.world.pose("cube")
        thin, closes = (quaternion_to_matrix(q)[:, 1] for q in (cube.orientation, self.arm.state().tcp.orientation))
        angle = math.atan2(thin[1], thin[0]) - math.atan2(closes[1], closes[0])
        return (angle + math.pi / 2) % math.pi - math.pi / 2

    # Doing.

    def wait(self, seconds: float) -> Iterator[None]:
        for _ in range(round(seconds * RATE_HZ)):
            yield

    def press(self, code: str, value: int, seconds: float) -> Iterator[None]:
        """Press, hold, and let go."""
        self.pad.wanted[code] = value
        yield from self.wait(seconds)
        self.pad.wanted[code] = REST.get(code, 0)

    def forwards(self, distance: float) -> Iterator[None]:
        yield from self.press("ABS_HAT0Y", -1 if distance > 0 else 1, abs(distance) / SPEED)

    def to_the_left(self, distance: float) -> Iterator[None]:
        yield from self.press("ABS_HAT0X", -1 if distance > 0 else 1, abs(distance) / SPEED)

    def up(self, distance: float) -> Iterator[None]:
        yield from self.press("BTN_TL" if distance > 0 else "BTN_TR", 1, abs(distance) / SPEED)

    def turn_left(self, angle: float) -> Iterator[None]:
        yield from self.press("ABS_X", 0 if angle > 0 else 255, abs(angle) / TURN)

    def aim(self) -> Iterator[None]:
        """The open hand over the cube, fingers along its thin side."""
        for _ in range(TRIES):
            x, y, _z = self.gap()
            yield from together(self.forwards(x), self.to_the_left(y), self.up(ABOVE - self.height()))
            yield from self.wait(SETTLE)
            if abs(self.twisted()) > ALIGNED:
                yield from self.turn_left(self.twisted())
                yield from self.wait(SETTLE)
            if np.abs(self.gap()[:2]).max() < NEAR and abs(self.twisted()) < ALIGNED:
                return
        raise SystemExit("the hand did not find the cube")

    def demonstrate(self) -> Iterator[None]:
        """From Cross to PS."""
        yield from self.press("BTN_SOUTH", 1, 0.15)
        yield from self.wait(0.5)
        self.pad.wanted["ABS_Z"] = 255
        yield from self.wait(0.4)
        yield from self.aim()
        yield from self.up(GRASP - self.height())
        yield from self.wait(SETTLE)
        self.pad.wanted["ABS_RZ"] = 255
        yield from self.wait(1.2)
        yield from self.up(LIFT)
        yield from self.wait(0.5)
        yield from self.press("BTN_MODE", 1, 0.15)

    def let_go(self) -> Iterator[None]:
        """Hands off, and a rest."""
        yield from self.wait(0.3)
        self.pad.wanted["ABS_Z"] = self.pad.wanted["ABS_RZ"] = 0
        yield from self.wait(0.5)


def together(*doings: Iterator[None]) -> Iterator[None]:
    """All of them at the same time."""
    running = list(doings)
    while running := [doing for doing in running if next(doing, doing) is None]:
        yield


def place_of(number: int) -> np.random.Generator:
    """Draws where things start in that episode, as apps/collect.py does with its default seed."""
    return np.random.default_rng(episode_seed(0, number))


def lines() -> list[str]:
    """The file, line by line."""
    quiet = ["cameras={}"]
    with hal.open("panda_table", sim=True, clock="lock_step", engine="pybullet", pad="none", overrides=quiet) as rig:
        held = HeldPad(rig.plan.pads[0])
        pad, arm, person = Gamepad(held), rig.robots["panda"], Person(rig, held)
        pad.open(rig.clock.now())
        teleop = hal.Teleop(arm)

        def drive(doing: Iterator[None], until: float = 0.0) -> None:
            """Let the arm follow the pad for as long as the person does something, and at least until then."""
            with arm.control(deadman=pad.hold("l2"), rate_hz=RATE_HZ) as control:
                teleop.reset()
                for tick in rig.clock.rate(RATE_HZ):
                    pad.poll_once(tick.t)
                    motion, grip = teleop.step(pad.state(), tick.dt)
                    control.send(motion, grip=grip)
                    if next(doing, doing) is doing and tick.t >= until:
                        return

        start = FIRST_CROSS
        for number in range(EPISODES):
            reset_scene(rig, arm, random=place_of(number))
            drive(person.let_go(), until=start)
            drive(person.demonstrate())
            print(
                f"episode {number}: {rig.clock.now() - start:.1f} s, the cube at "
                f"{rig.world.pose('cube').position[2]:.3f} m",
                file=sys.stderr,
            )
            start = rig.clock.now() + PAUSE
        drive(person.let_go())
        pad.poll_once(rig.clock.now())
    header = {"format": "hal-pad-events", "version": 1, "model": "dualshock4", "ranges": RANGES, "about": ABOUT}
    return [json.dumps(header), *held.lines]


if __name__ == "__main__":
    FILE.write_text("\n".join(lines()) + "\n", encoding="utf-8")
