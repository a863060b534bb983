"""The driver of the Franka Hand, through Franka's own client library, against the emulated hand."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import wait_until

pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")

from hal.drivers.franka import hand, hand_motions, hand_process
from hal.drivers.franka.hand import FrankaHand
from hal.errors import CommandError, ConnectionLost, NotSupported
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .franka_kit import Emulator
from .hand_kit import LIMIT, HandBench
from .rig_kit import arm_of, rig_of

pytestmark = pytest.mark.pair

DONE, MISSED, STOPPED, FAILED = (GripperOutcome[name] for name in ("DONE", "MISSED", "STOPPED", "FAILED"))


@pytest.fixture
def bench() -> Iterator[HandBench]:
    """A homed hand, half open."""
    with HandBench() as bench:
        yield bench


@pytest.fixture
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter times than a real hand needs."""
    monkeypatch.setattr(hand_motions, "_CALL_MARGIN", 0.3)
    monkeypatch.setattr(hand_motions, "_STOP_TIMEOUT", 0.3)
    monkeypatch.setattr(hand_motions, "_SETTLE_TIME", 0.3)
    monkeypatch.setattr(hand_process, "_RESTART_PAUSE", 0.1)


def client_of(bench: HandBench) -> int:
    """Number of the process in which the client library lives."""
    child = bench.hand._link._child
    return child.process.pid


def test_opening_reads_and_moves_nothing(bench):
    reading = bench.read()
    assert (reading.width, reading.width_target, reading.moving, reading.grasped) == (0.04, 0.04, False, False)
    assert (reading.outcome, reading.fault) == (GripperOutcome.NONE, None)
    assert 0.0 <= time.monotonic() - reading.t < 1.0
    later = bench.wait(lambda r: r.seq > reading.seq + 2)
    assert later.t_device > reading.t_device
    assert later.t > reading.t
    bench.hand.open()
    assert bench.requests == {"connect": 1, "homing": 0, "grasp": 0, "move": 0, "stop": 0}


def test_a_hand_that_is_not_homed_reports_it_and_is_homed():
    with HandBench(homed=False) as bench:
        bench.server.fingers.width = 0.01
        fault = bench.read().fault
        assert fault.code == "not_homed"
        assert "home" in fault.remedy
        assert (bench.do("move", 0.08, 0.1, 40.0).outcome, bench.read().fault) == (FAILED, fault)
        assert bench.requests["move"] == 0
        reading = bench.do("home")
        assert (reading.outcome, reading.fault, reading.width) == (DONE, None, 0.08)
        assert bench.slowest < 0.3  # the library's own call takes more than a second


def test_a_motion_that_is_never_answered_is_given_up(bench, brisk):
    client = client_of(bench)
    bench.command("slow-reply 1000")
    reading = bench.do("move", 0.045, 0.1, 40.0)
    assert reading.outcome is FAILED
    assert reading.fault.code == "no_answer"
    bench.wait_server(lambda state: not state["client"])
    bench.command("slow-reply 0")
    bench.wait_back(2)
    assert client_of(bench) != client
    assert bench.do("move", 0.05, 0.1, 40.0).outcome is DONE


def test_silence_is_a_lost_hand_and_nothing_waits_for_it(bench):
    bench.command("silence 1.3")
    assert bench.wait_lost().code == "silent"
    with pytest.raises(ConnectionLost):
        bench.hand.move(0.08, 0.1, 40.0)
    bench.wait_back(1)
    assert bench.slowest < 0.5  # the library waits for a second
    assert bench.do("move", 0.05, 0.1, 40.0).outcome is DONE


@pytest.mark.parametrize("how", ["the hand hangs up", "the client library dies", "the hand restarts"])
def test_a_connection_comes_back_but_not_the_command_that_it_cost(bench, brisk, monkeypatch, how):
    """The library itself would wait for ever here, and take a whole core."""
    monkeypatch.setattr(hand_process, "_STATE_TIMEOUT", 0.5)
    client = client_of(bench)
    bench.hand.move(0.08, 0.01, 40.0)
    bench.wait(lambda r: r.width > 0.041)
    if how == "the hand hangs up":
        bench.command("drop")
    elif how == "the client library dies":
        os.kill(client, signal.SIGKILL)
    else:
        bench.command("restart 0.2")
    reading = bench.wait_back(2)
    assert reading.outcome is FAILED
    assert reading.fault.code == "lost"
    assert bench.requests["move"] == 1
    with pytest.raises(ProcessLookupError):
        os.kill(client, 0)
    if how == "the hand restarts":
        fault = bench.do("move", 0.05, 0.1, 40.0).fault
        assert fault.code == "not_homed"


@pytest.mark.slow
def test_fingers_hear_a_stop_that_came_while_the_connection_was_lost():
    """And what they have grasped meanwhile stays held. An emulated hand continues without a client."""
    with (
        Emulator("--lockstep", hand=True) as emulator,
        rig_of(emulator.host, "fr3", "robots.arm.gripper.enabled=true") as rig,
    ):
        gripper = arm_of(rig).gripper

        def hand(words: str = "state") -> dict:
            return emulator.control.send(f"hand {words}")

        def stop_unheard(connections: int) -> None:
            wait_until(lambda: hand()["motion"], "moving")
            hand("drop")
            rig.stop()
            wait_until(lambda: gripper.trouble, "lost")
            wait_until(lambda: hand()["requests"]["connect"] == connections and not gripper._mail.get().lost, "back")
            rig.rearm()
            width = -1.0
            while width != (width := gripper.state().width):
                rig.clock.sleep(0.5)

        hand("object 0.036")
        gripper.start_grasp(0.036, speed=0.005)
        stop_unheard(2)
        assert hand()["is_grasped"]
        assert hand()["requests"]["stop"] == 0
        assert hand("object none")["width"] <= 0.036
        wait_until(lambda: hand()["width"] == 0.0, "pressing")
        gripper.start(0.08, speed=0.004)
        stop_unheard(3)
        assert hand()["motion"] is None
        assert hand()["width"] == gripper.state().width < 0.075
        assert gripper.move(0.06).width == pytest.approx(0.06, abs=2e-3)


def test_closing_leaves_alone_what_is_held(bench):
    bench.command("object 0.03")
    bench.do("move", 0.0, 0.1, 40.0)
    client = client_of(bench)
    before = bench.requests
    bench.hand.close()
    bench.hand.close()
    state = bench.command("state")
    assert (state["is_grasped"], state["force"], state["requests"]) == (True, 40.0, before)
    with pytest.raises(ProcessLookupError):
        os.kill(client, 0)
    with pytest.raises(ConnectionLost):
        bench.read()


def test_closing_stops_fingers_that_are_on_their_way(bench):
    bench.hand.move(0.08, 0.01, 40.0)
    bench.wait(lambda r: r.width > 0.041)
    bench.hand.close()
    state = bench.command("state")
    assert (state["motion"], state["requests"]["stop"]) == (None, 1)
    assert state["width"] < 0.06


def test_a_missing_hand_is_reported_in_one_line():
    spec = GripperSpec("panda.gripper", "franka", 0.08, 0.1, 40.0, options={"host": "127.0.2.255"})
    with pytest.raises(ConnectionLost, match="panda.gripper: .*127.0.2.255") as caught:
        FrankaHand(spec).open()
    assert "\n" not in str(caught.value)


def test_another_protocol_is_reported():
    with HandBench(connect=False, version=4) as bench, pytest.raises(NotSupported, match="protocol 4, .* 3"):
        bench.hand.open()


def test_a_hand_in_use_by_another_program_is_reported(bench):
    other = FrankaHand(bench.hand.spec)
    with pytest.raises(ConnectionLost, match=bench.host):
        other.open()
    assert bench.do("move", 0.05, 0.1, 40.0).outcome is DONE


def test_a_hand_that_accepts_and_stays_silent_is_reported(monkeypatch):
    monkeypatch.setattr(hand_process, "_OPEN_TIMEOUT", 1.0)
    with HandBench(connect=False) as bench:
        bench.command("slow-reply 1000")
        with pytest.raises(ConnectionLost) as caught:
            bench.hand.open()
    assert caught.value.code == "silent"


def test_numbers_that_cannot_be_are_never_sent(bench):
    for numbers in ((math.nan, 0.1, 40.0), (0.04, 0.0, 40.0), (0.04, 0.1, -1.0), (0.04, math.inf, 40.0)):
        with pytest.raises(CommandError):
            bench.hand.move(*numbers)
        with pytest.raises(CommandError):
            bench.hand.grasp(*numbers, 0.005, 0.005)
    assert bench.requests["move"] == bench.requests["grasp"] == 0


def test_numbers_beyond_the_hand_are_brought_into_its_range(bench):
    assert bench.do("move", 0.2, 5.0, 40.0).outcome is DONE
    assert bench.command("state")["newest"]["move"] == [0.08, 0.1]


def test_a_hand_without_states_is_reported(monkeypatch):
    monkeypatch.setattr(hand, "_FIRST_STATE_TIMEOUT", 0.3)
    with HandBench(connect=False) as bench:
        bench.command("silence 1000")
        with pytest.raises(ConnectionLost) as caught:
            bench.hand.open()
    assert caught.value.code == "silent"


def test_the_client_library_ends_with_its_driver(bench):
    """Also when that is killed."""
    bench.hand.close()
    program = (
        "import sys, time; from hal.drivers.franka.hand import FrankaHand; from hal.specs import GripperSpec; "
        "hand = FrankaHand(GripperSpec('hand', 'franka', 0.08, 0.1, 40.0, options={'host': sys.argv[1]})); "
        "hand.open(); print(hand._link._child.process.pid, flush=True); time.sleep(100)"
    )
    driver = subprocess.Popen([sys.executable, "-c", program, bench.host], stdout=subprocess.PIPE, text=True)
    client = int(driver.stdout.readline())
    driver.kill()
    driver.communicate()
    deadline = time.monotonic() + LIMIT
    while Path(f"/proc/{client}").exists():
        assert time.monotonic() < deadline, "it lives on"
        time.sleep(0.01)
    assert not bench.command("state")["client"]


def test_invalid_options_of_the_emulated_hand_are_refused(bench):
    for words in ("", "help"):
        assert "object W|none" in bench.command(words)["text"]
    for words in ("dance", "object", "object wide", "stop-ignored maybe", "silence -1", "drop it"):
        with pytest.raises(ValueError, match=words.split()[0]):
            bench.command(words)


class LateWorld:
    """A simulated world that is late."""

    LAG = 0.5
    object_width = None
    fingers = None

    @property
    def now(self) -> float:
        return time.monotonic()

    @property
    def now_of_fingers(self) -> float:
        return time.monotonic() - self.LAG


def test_fingers_wait_until_a_late_world_has_reached_their_command():
    with HandBench(world=LateWorld()) as bench:
        began = time.monotonic()
        bench.do("move", 0.08, 0.1, 40.0)
        assert time.monotonic() - began > 0.4 + LateWorld.LAG, "the way of 40 mm takes 0.4 s"
