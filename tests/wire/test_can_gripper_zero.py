"""``hal calibrate gripper`` on an emulated YAM, from the command line to the entry for the rig file."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from app_kit import Done, run_here, write_pad
from can_kit import EmulatorProcess

import hal
from hal.apps import _gripper_zero
from hal.apps._common import ACTION_NEEDED
from hal.apps.calibrate import main

pytestmark = pytest.mark.pair

OFFSET = 0.8
"""Error of the rig's offset, rad: where it takes the fingers for closed they are not."""
GEAR = 0.095 / 6.5
"""m/rad"""


class Bench:
    """An emulated YAM, the program, and what the fingers do meanwhile."""

    def __init__(self, emulator: EmulatorProcess, folder: Path) -> None:
        self.emulator, self.folder = emulator, folder
        self.samples: list[tuple[float, float, float]] = []
        """Time, s, angle of the gripper's motor, rad, and its torque, Nm."""

    def run(self, held: tuple[float, float] | None, then: str = "") -> Done:
        """Run the program with a pad whose dead-man is held; execute ``then`` when the fingers move."""
        motor = f"{{id: 7, type: DM4310, kp: 20, kd: 0.5, offset: {OFFSET}}}"
        slow = "robots.arm.rate_hz=100"  # for a busy computer
        overrides = [*self.emulator.overrides, f"robots.arm.gripper.real.motor={motor}", slow]
        options = [word for value in overrides for word in ("--set", value)]
        pad = write_pad(self.folder, until=60.0, held=held)
        ended = threading.Event()
        watcher = threading.Thread(target=self._watch, args=(ended, then))
        watcher.start()
        try:
            return run_here(main, "gripper", "--real", "--config", "yam", *options, "--pad", pad)
        finally:
            ended.set()
            watcher.join()

    def _watch(self, ended: threading.Event, then: str) -> None:
        while not ended.wait(0.01):
            fingers = self.emulator.execute("state")["gripper"]
            self.samples.append((time.monotonic(), fingers["q"], fingers["tau"]))
            if then and self.way > 0.005:
                self.emulator.execute(then)
                then = ""

    @property
    def way(self) -> float:
        """Way by which the fingers have closed, m."""
        return GEAR * (self.samples[0][1] - self.samples[-1][1])

    def motors(self) -> dict[str, Any]:
        """Return the state of every motor."""
        return dict(self.emulator.execute("state")["motors"])


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with EmulatorProcess("yam") as emulator:
        yield Bench(emulator, tmp_path)


def entry(done: Done) -> dict[str, Any]:
    """Return the motor in the entry that was printed."""
    assert done.returncode == 0, done.stdout + done.stderr
    rig = yaml.safe_load(done.stdout[done.stdout.index("robots:\n") :])
    return dict(rig["robots"]["arm"]["gripper"]["real"]["motor"])


@pytest.mark.parametrize("thing", [0.0, 0.02])
def test_the_closed_position_is_found_gently_and_the_arm_stays_off(bench: Bench, thing: float) -> None:
    """An object between the fingers gives another number, and the text says so."""
    if thing:
        bench.emulator.execute(f"object {thing}")
    done = bench.run(held=(0.3, 50.0))
    motor = entry(done)
    overrides = [*bench.emulator.overrides, f"robots.arm.gripper.real.motor={json.dumps(motor)}"]
    with hal.open("yam", sim=False, pad="none", overrides=overrides) as rig:
        assert rig.robots["arm"].gripper.state().width == pytest.approx(0.0, abs=5e-4), "with the entry in the rig"
    assert motor.pop("offset") == pytest.approx(-thing / GEAR, abs=0.02)
    assert motor == {"id": 7, "type": "DM4310", "kp": 20, "kd": 0.5}
    assert "nothing is between them" in done.stdout
    assert all(state["commands"] == 0 for number, state in bench.motors().items() if number != "7")
    assert 0.5 < max(abs(tau) for _, _, tau in bench.samples) / (10.0 * GEAR) < 1.1
    assert bench.way == pytest.approx(0.5 * 0.095 - thing, abs=1e-3)
    spans = zip(bench.samples, bench.samples[50:], strict=False)
    assert 0.01 < max((q0 - q1) * GEAR / (t1 - t0) for (t0, q0, _), (t1, q1, _) in spans) < 0.022


def test_a_released_dead_man_stops_the_fingers_at_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_gripper_zero, "LONGEST", 4.0)
    done = bench.run(held=(0.5, 1.2))
    assert done.returncode == 2
    assert "MotionStopped: nothing stopped the fingers within 4 s" in done.stderr
    assert 0.005 < bench.way < (0.7 + 0.15) * 0.021, "closed at 20 mm/s for as long as it was held, and 150 ms"
    t_end = bench.samples[-1][0]
    late = [q for t, q, _ in bench.samples if t > t_end - 1.0]
    assert (max(late) - min(late)) * GEAR < 1e-4


def test_a_motor_that_is_missing_is_named(bench: Bench) -> None:
    bench.emulator.execute("silent 7 on")
    done = bench.run(held=(0.3, 50.0))
    assert done.returncode == ACTION_NEEDED
    assert "gripper (motor 7) does not answer" in done.stdout


def test_a_motor_that_falls_silent_ends_the_search(bench: Bench) -> None:
    done = bench.run(held=(0.3, 50.0), then="silent 7 on")
    assert done.returncode == 2
    assert "motor 7" in done.stderr
