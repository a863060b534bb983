"""However an app ends, its arm is brought to rest by the arm's own process, and nothing is left behind."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import observer
import pytest

from hal.types import RobotStatus, Trip

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")]


MOTION = "hal.JointVelocity(velocity)"
TORQUE = "hal.JointTorque([5.0] + [0.0] * 6)"


@pytest.fixture
def watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """Start an app whose arm moves, by velocities or by torques; it is ended after the test."""
    watched: list[observer.Watched] = []

    def start(ending: str = "", command: str = MOTION) -> observer.Watched:
        monkeypatch.setattr(observer, "APP", observer.APP.replace(MOTION, command))
        watched.append(observer.Watched(tmp_path, ending, rate_hz=5))  # a busy computer may be late
        return watched[-1]

    yield start
    for app in watched:
        app.close()


@pytest.mark.parametrize(
    ("how", "command"),
    [("kill -9", MOTION), ("SIGTERM", MOTION), ("Ctrl-C", MOTION), ("closed terminal", MOTION), ("kill -9", TORQUE)],
)
def test_an_app_that_ends(watch, how: str, command: str) -> None:
    app = watch(command=command)
    assert app.speed() > 0.1, "the arm moves before"
    app.end(how)
    app.wait_for(app.at_rest)
    app.wait_for(app.fingers_stopped)
    app.wait_for(app.nobody_left)


@pytest.mark.parametrize(("how", "command"), [("SIGSTOP", MOTION), ("Ctrl-Z", MOTION), ("SIGSTOP", TORQUE)])
def test_an_app_that_is_stopped_but_still_there(watch, how: str, command: str) -> None:
    app = watch(command=command)
    assert app.speed() > 0.1
    app.end(how)
    app.wait_for(app.at_rest)
    app.wait_for(app.fingers_stopped)
    servo = app.servo()
    assert servo.status is RobotStatus.TRIPPED
    assert servo.trip in (Trip.APP_SILENT, Trip.COMMAND_LATE)
    assert not app.nobody_left(), "the host keeps holding: the app may come back"


FORK = """
import os, sys
import hal

turn = hal.JointVelocity([0.1] + [0.0] * 6)
with hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=["cameras={}"]) as rig:
    with rig.robots["panda"].control(rate_hz=5) as control:
        control.send(turn)
        if not (child := os.fork()):
            for use in (lambda: control.send(turn), control.rearm, rig.stop, rig.robots["panda"].state):
                try:
                    use()
                    os._exit(1)
                except hal.HalError as error:
                    assert error.code == "forked", error
            sys.exit(7)
        ended, status, turns = 0, 0, 0
        for tick in rig.clock.rate(50):
            control.send(turn)
            if not ended:
                ended, status = os.waitpid(child, os.WNOHANG)
            turns += ended > 0
            if turns > 20 or tick.elapsed > 20.0:
                break
        assert os.waitstatus_to_exitcode(status) == 7, tick
        assert control.status is hal.RobotStatus.FOLLOWING
print("done")
"""


def test_a_fork_of_the_program_ends_nothing() -> None:
    run = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, timeout=60)
    assert run.stdout == "done\n", run.stderr


@pytest.mark.parametrize(
    ("ending", "trip"),
    [("commands stop", Trip.COMMAND_LATE), ("interpreter blocked", Trip.COMMAND_LATE), ("exception", Trip.NONE)],
)
def test_user_code_that_goes_wrong(watch, ending: str, trip: Trip) -> None:
    app = watch(ending)
    assert app.speed() > 0.1
    app.wait_for(app.at_rest)
    if trip is Trip.NONE:
        app.wait_for(app.nobody_left)
        assert app.process.wait(5) == 1, "the user's own exception ends the program"
    else:
        app.wait_for(lambda: app.servo().trip is trip)  # a busy computer may show the arm at rest before its deadline


def test_an_app_that_is_killed_while_a_motion_runs(watch, monkeypatch: pytest.MonkeyPatch) -> None:
    session = "with rig, arm.control(rate_hz={rate_hz}) as control:"
    assert session in observer.APP
    motion = "motion = arm.start_move_to([2.0, *arm.home[1:]], speed=0.2)\nwith rig:"
    send = f"control.send({MOTION}, grip=1.0)"
    monkeypatch.setattr(observer, "APP", observer.APP.replace(session, motion).replace(send, "motion.progress"))
    app = watch()
    assert app.speed() > 0.1, "the arm moves before"
    app.end("kill -9")
    app.wait_for(app.at_rest)
    app.wait_for(app.nobody_left)
    assert app.servo().progress < 0.9
