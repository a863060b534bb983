"""However an app ends, the arm's process ends the motion regularly; errors at opening are reported at once."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_until

import hal
from hal.drivers.franka.arm import create_link
from hal.types import RobotStatus

from .franka_kit import Client, Emulator, free_host
from .rig_kit import Drive, arm_of, rig_of

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")

ROOT = Path(__file__).parents[2]
APP = """
import json, os, sys
sys.path.insert(0, sys.argv[2])
import hal
overrides = ["cameras={}", "robots.arm.real.host=" + sys.argv[1], "robots.arm.model=" + sys.argv[3]]
with hal.open("franka_emulator", pad="none", overrides=[*overrides, "robots.arm.gripper.enabled=false"]) as rig:
    arm = rig.robots["arm"]
    with arm.control(rate_hz=50, unattended=True) as control:
        for turn, tick in enumerate(rig.clock.rate(50)):
            try:
                control.send(hal.JointVelocity([0.2, 0, 0, 0, 0.2, 0, 0.2]))
            except hal.MotionStopped:  # the computer was too busy for this program
                control.rearm()
            if turn == 25:
                children = [host.child.process.pid for host in rig._hosts]
                print(json.dumps({"pid": os.getpid(), "children": children}), flush=True)
"""


@pytest.fixture(params=["fr3", "panda"])
def emulator(request: pytest.FixtureRequest) -> Iterator[Emulator]:
    # It waits for a set-point that is late: a busy machine must not look like a fault of the arm.
    with Emulator("--lockstep", robot=request.param) as started:
        yield started


one = pytest.mark.parametrize("emulator", ["fr3"], indirect=True)
"""For what does not depend on the vendor's library."""


def runs(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


class App:
    """A program that moves the arm."""

    def __init__(self, emulator: Emulator, model: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", APP, emulator.host, str(ROOT), model],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        line = self.process.stdout.readline()
        assert line, self.process.stderr.read()
        self.children: list[int] = json.loads(line)["children"]

    def has_ended(self) -> bool:
        """Whether the app and its children have ended."""
        self.process.poll()
        return not any(map(runs, [self.process.pid, *self.children]))

    def close(self) -> None:
        """Kill the app in any state, and wait until its children have ended, which hold the arm's lock."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(10.0)
        wait_until(self.has_ended, "ended")
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


def model_of(emulator: Emulator) -> str:
    return "panda" if "Panda" in "".join(emulator.lines[:2]) else "fr3"


@pytest.fixture
def app(emulator: Emulator) -> Iterator[App]:
    started = App(emulator, model_of(emulator))
    yield started
    started.close()


@pytest.mark.parametrize(
    ("emulator", "how"),
    [("fr3", signal.SIGKILL), ("panda", signal.SIGKILL), ("fr3", signal.SIGINT)],
    indirect=["emulator"],
)
def test_an_app_that_ends_leaves_an_arm_at_rest(emulator: Emulator, app: App, how: signal.Signals) -> None:
    assert max(map(abs, emulator.control.send("state")["dq"])) > 0.1, "it moves"
    app.process.send_signal(how)
    ended = emulator.wait_event("motion ended")
    assert "success (finished)" in ended["text"], "in order, not cut off"
    wait_until(app.has_ended, "ended")
    assert max(map(abs, emulator.control.send("state")["dq"])) < 1e-9
    assert not emulator.events("reflex")


@one
def test_an_app_that_is_stopped_leaves_an_arm_at_rest(emulator: Emulator, app: App) -> None:
    app.process.send_signal(signal.SIGSTOP)
    wait_until(lambda: max(map(abs, emulator.control.send("state")["dq"])) < 1e-9, "at rest")
    assert not emulator.events("reflex")
    assert emulator.control.send("state")["mode"] == "move", "it holds, and the session may continue"


@one
def test_the_arms_own_process_is_killed(emulator: Emulator, app: App) -> None:
    """Then no program can end the motion in order: the robot does, and the app gets an error."""
    os.kill(app.children[0], signal.SIGKILL)
    emulator.wait_event("motion ended")
    app.process.wait(10.0)
    said = app.process.stderr.read()
    assert "ConnectionLost" in said
    assert "arm process ended" in said
    wait_until(lambda: max(map(abs, emulator.control.send("state")["dq"])) < 1e-9, "at rest")


def opening_error(host: str, robot: str = "fr3", *more: str) -> hal.HalError:
    """Return the error of a rig that cannot be opened."""
    with pytest.raises(hal.HalError) as caught:
        rig_of(host, robot, *more).close()
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("robot", ["fr3", "panda"])
def test_a_robot_that_does_not_answer_is_an_error(robot: str) -> None:
    host = free_host()
    error = opening_error(host, robot)
    assert (type(error), error.code) == (hal.ConnectionLost, "refused")
    assert f"hal emulate franka --host {host}" in str(error)


def test_an_unknown_host_name_is_named() -> None:
    error = opening_error("no-such-robot.invalid")
    assert error.code == "unknown_host"
    assert "no-such-robot.invalid" in str(error)


def test_the_wrong_model_is_named(emulator: Emulator) -> None:
    right = model_of(emulator)
    error = opening_error(emulator.host, "fr3" if right == "panda" else "panda")
    assert error.code == "version"
    assert f"model: {right}" in str(error)


def test_another_version_is_named(emulator: Emulator) -> None:
    emulator.control.send("version 7")
    assert opening_error(emulator.host, model_of(emulator)).code == "version"


@one
def test_the_error_of_a_second_program_names_the_first_one(emulator: Emulator, app: App) -> None:
    error = opening_error(emulator.host, model_of(emulator))
    assert isinstance(error, hal.ControlTaken)
    assert f"process {app.process.pid}" in str(error)


def test_a_client_of_another_program_holds_the_arm(emulator: Emulator) -> None:
    """Another computer's: there is no process here that could be named."""
    model = model_of(emulator)
    with Client(emulator.host, 5 if model == "panda" else 10) as other:
        assert other.reply()[0] == 0
        error = opening_error(emulator.host, model)
    assert isinstance(error, hal.ConnectionLost)


def test_another_tool_at_the_flange_is_refused() -> None:
    with Emulator("--end-effector", "none") as emulator:
        assert "103.4 mm" in str(opening_error(emulator.host))


@pytest.mark.parametrize(("arm", "library", "extra"), [("fr3", "pylibfranka", "franka"), ("fer", "panda_py", "panda")])
def test_a_missing_library_names_the_extra(monkeypatch: pytest.MonkeyPatch, arm: str, library: str, extra: str) -> None:
    for name in list(sys.modules):
        if name.startswith(("hal.drivers.franka.fr3", "hal.drivers.franka.panda")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(hal.DriverMissing, match=extra):
        create_link(arm)


def test_settings_reach_the_robot(emulator: Emulator) -> None:
    more = ["robots.arm.real.load={mass: 0.5, com: [0, 0, 0.05]}"]
    with rig_of(emulator.host, model_of(emulator), *more):
        pass
    settings: dict[str, Any] = emulator.control.send("settings")
    assert "0.5" in json.dumps(settings)


@one
def test_an_arm_is_ready_while_another_thread_works(emulator: Emulator) -> None:
    """A busy thread in the app has nothing to do with the arm's process: no motion is lost."""
    done = threading.Event()

    def busy() -> None:
        value = 0
        while not done.is_set():
            value = (value * 31 + 7) % 1000003

    thread = threading.Thread(target=busy)
    with rig_of(emulator.host, model_of(emulator)) as rig:
        arm = arm_of(rig)
        thread.start()
        try:
            goal = arm.home.copy()
            goal[0] += 0.1
            arm.move_to(goal, unattended=True)
        finally:
            done.set()
            thread.join()
    assert not emulator.events("reflex")
    assert "success" in emulator.events("motion ended")[-1]["text"]


# A robot that ends a motion, and does not answer the library, which then waits for ever.


@pytest.mark.pair  # the app has to be on time until the robot is lost
def test_a_mode_change_without_an_answer_ends_the_motion_and_not_the_process(emulator: Emulator) -> None:
    with rig_of(emulator.host, model_of(emulator)) as rig:
        arm, host = arm_of(rig), rig._hosts[0].child.process.pid
        struck: list[float] = []

        def strike() -> bool:
            if not struck and abs(arm.state(5.0).tcp_twist[1]) > 0.03:
                emulator.control.send("no-move-reply on")
                emulator.control.send("reflex joint_reflex")
                struck.append(time.monotonic())
            return False

        drive = Drive(arm)
        drive.go(rig, 10.0, strike)
        assert isinstance(drive.error, hal.MotionStopped)
        assert drive.error.code == "device_lost"
        assert drive.t_error - struck[0] < 3.0
        with pytest.raises(hal.ConnectionLost) as lost:
            arm.state(5.0)
        assert lost.value.code == "unanswered"
        # The robot is found again, and tells why it ended the motion.
        wait_until(lambda: status_of(arm) is RobotStatus.FAULT, "connected again")
        assert arm.state().fault.code == "joint_reflex"
        emulator.control.send("no-move-reply off")
        arm.recover()
        again = Drive(arm)
        again.go(rig, 0.5)
        assert again.error is None
        assert "success" in emulator.events("motion ended")[-1]["text"]
        assert rig._hosts[0].child.process.pid == host
        assert runs(host)


def test_an_end_without_an_answer_costs_the_connection_and_not_the_process(emulator: Emulator) -> None:
    with rig_of(emulator.host, model_of(emulator)) as rig:
        arm = arm_of(rig)
        Drive(arm).go(rig, 0.3, lambda: bool(emulator.control.send("no-move-reply on")) and False)
        wait_until(lambda: status_of(arm) is None, "lost")
        wait_until(lambda: status_of(arm) is RobotStatus.IDLE, "connected again")
        assert runs(rig._hosts[0].child.process.pid)


def status_of(arm: hal.Robot) -> RobotStatus | None:
    """Return its status; None while the robot does not answer."""
    try:
        return arm.state().status
    except (hal.ConnectionLost, hal.StaleStateError):
        return None


# An app that is gone leaves no process behind, though the robot hangs: the libraries then wait for ever.

LONGEST = 40.0
"""s: what docs/safety.md gives an app that is silent (30), and some."""


@contextlib.contextmanager
def killed(robot: str) -> Iterator[int]:
    """The process of an arm whose robot hangs, and whose app was killed."""
    with Emulator("--lockstep", robot=robot) as emulator:
        app = App(emulator, robot)
        host = app.children[0]
        try:
            emulator.process.send_signal(signal.SIGSTOP)
            time.sleep(0.05)
            app.process.kill()
            yield host
        finally:
            emulator.process.send_signal(signal.SIGCONT)
            if runs(host):
                os.kill(host, signal.SIGKILL)
            app.close()


@pytest.mark.slow
def test_an_app_is_killed_while_the_robot_hangs() -> None:
    """Both arms at once, for both wait for as long."""
    with contextlib.ExitStack() as stack:
        hosts = {robot: stack.enter_context(killed(robot)) for robot in ("fr3", "panda")}
        deadline = time.monotonic() + LONGEST
        while any(map(runs, hosts.values())) and time.monotonic() < deadline:
            time.sleep(0.05)
        left = [robot for robot, host in hosts.items() if runs(host)]
        assert not left, "the arm's process holds the arm for ever"
