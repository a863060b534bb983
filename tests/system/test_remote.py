"""A rig over two computers: a program drives an arm that ``hal serve`` has; whatever happens in between stops it."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from app_kit import run_here
from errors_kit import raises_code
from link_kit import Bench, serve_rig, served_arm, start_server
from operator_kit import Operator
from policy_server import CONFIG, SPEED, serving
from recording_kit import small
from waiting import wait_until

import hal
from hal.apps import check, collect, replay, rollout
from hal.deadman import Deadman
from hal.errors import CommandError, ConnectionLost, ControlTaken, DeviceNotFound, NotSupported
from hal.host import records
from hal.host.scheduling import LINK_PRIORITY
from hal.lock import APP_MARK
from hal.preflight import check_machine
from hal.recording import Dataset, Recorder
from hal.remote.client import connect
from hal.servo.watchdog import SILENCE
from hal.types import RobotStatus, Trip

pytestmark = pytest.mark.slow
LATE = 0.02
"""Of a process that a busy computer lets wait, s."""


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A served mock arm, and a proxy before it."""
    with served_arm() as found:
        yield found


def drive(rig: hal.Rig) -> dict[str, Any]:
    """A program as on one computer: a motion, a stream to a goal, a grip, a stop."""
    arm = rig.robots["panda"]
    arm.move_to(arm.home + [0.3, 0, 0, 0, 0, 0, 0], speed=0.5)
    moved = arm.state().q_set
    goal = arm.home + [0.25, 0.05, 0, 0, 0, 0, 0]
    with arm.control(rate_hz=10) as control:
        for tick in rig.clock.rate(50):
            control.send(hal.JointTarget(goal), grip=1.0)
            if np.abs(arm.state().q_set - goal).max() < 1e-12 and arm.gripper.state().outcome.name == "DONE":
                break
            assert tick.elapsed < 20.0
        streamed = arm.state().q_set
        rig.stop()
        with pytest.raises(hal.MotionStopped) as stop:
            while True:
                control.send(hal.JointTarget(goal))
                rig.clock.sleep(0.01)
        control.rearm()
        wait_until(lambda: control.trip is Trip.NONE, "acknowledged")
    return {"moved": moved, "streamed": streamed, "width": arm.gripper.state().width, "stop": stop.value.code}


def may_raise() -> bool:
    return next(verdict for verdict in check_machine() if verdict.name == "scheduling").level == "ok"


def find_priority(process: int) -> int:
    """Return the real-time priority of the one thread of a process that copies records; 0 for none."""
    found = [os.sched_getparam(int(thread)).sched_priority for thread in os.listdir(f"/proc/{process}/task")]
    assert found.count(0) >= len(found) - 1, found
    return max(found)


def roll_out(arm_at: str, folder: Path) -> None:
    """Run ``hal rollout`` with an arm, a camera and a policy of three other computers, as if all were of one."""
    view = {"model": "realsense_d435", "output": {"width": 160, "height": 120}}
    view["look_at"] = {"target": [0, 0, 0.7], "distance": 1.5}
    seen = {"observation": {**CONFIG["observation"], "picture": {"camera": "scene", "size": [120, 160]}}}
    (folder / "policy.yaml").write_text(json.dumps({**CONFIG, **seen}))
    cameras, camera_at = start_server("robots={}", f"cameras={json.dumps({'scene': view})}")
    try:
        devices = {"robots": {"panda": {"at": arm_at}}, "cameras": {"scene": {"at": camera_at}}}
        (folder / "rig.yaml").write_text(json.dumps(devices))
        checked = run_here(check.main, "--config", folder / "rig.yaml", "--duration", 0.1)
        assert f"hal check --at {arm_at};" in checked.stdout, checked.stdout + checked.stderr
        with serving(0.05, 0.04) as (_, url):
            words = ["--config", folder / "rig.yaml", "--policy", url, "--policy-config", folder / "policy.yaml"]
            words += ["--task", "left", "--seconds", 1.5, "--rate", 50, "--report", folder / "report.json"]
            done = run_here(rollout.main, *words, "--out", folder / "runs")
    finally:
        cameras.kill()
    assert done.returncode == 0, done.stdout + done.stderr
    (outcome,) = json.loads((folder / "report.json").read_text())["episodes"]
    assert (outcome["ended"], outcome["code"]) == ("time", "")
    (episode,) = Dataset(folder / "runs").episodes
    q = episode.columns["observation.state"][:, 0]
    assert 0.1 < q[-1] - q[0] < 1.2 * SPEED * 1.5
    assert [np.ptp(frame) > 50 for frame in episode.frames("scene")] == [True] * episode.length


def test_the_same_programs_drive_an_arm_of_another_computer(tmp_path: Path) -> None:
    """``hal serve --sim`` as a program; set-points at rest are the same as on one computer."""
    server, at = start_server()
    try:
        with hal.open({"robots": {"panda": {"at": at}}}, pad="none") as rig:
            state = rig.robots["panda"].state()
            assert 0.0 <= rig.clock.now() - state.stamp.t < 0.1
            there = drive(rig)
            for end in (rig._hosts[0].child.process.pid, server.pid):
                assert find_priority(end) == (LINK_PRIORITY if may_raise() else 0)
            link = rig.statistics()[at]["link"]
            assert abs(link["offset_s"]) <= link["round_trip_s"] / 2.0, "one computer has one clock"
        with hal.open("panda_table", sim=True, clock="real_time", pad="none", overrides={"cameras": {}}) as rig:
            here = drive(rig)
        assert np.abs(there["moved"] - here["moved"]).max() < 1e-9
        assert np.abs(there["streamed"] - here["streamed"]).max() < 1e-9
        assert there["stop"] == here["stop"] == Trip.STOP.code
        assert abs(there["width"] - here["width"]) < 1e-3
        roll_out(at, tmp_path)
        server.send_signal(signal.SIGINT)
        assert server.wait(20.0) == 130
    finally:
        server.kill()


@pytest.mark.alone
def test_an_episode_with_pictures_is_collected_over_the_link_and_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``hal serve``, ``hal collect`` and ``hal replay``, with a camera and an arm of the other computer."""
    server, at = start_server(*small(160, 120))
    person = Operator()
    try:
        devices = {"robots": {"panda": {"at": at}}, "cameras": {"scene": {"at": at}}}
        (tmp_path / "rig.yaml").write_text(json.dumps({**devices, "gamepads": {"pad": {"driver": "mock"}}}))
        rig, data, report = ["--config", str(tmp_path / "rig.yaml")], str(tmp_path / "data"), tmp_path / "report.json"
        with person.operate(monkeypatch):
            words = ["--out", data, "--episodes", "1", "--speed", "0.3"]  # 30 rows a second are enough for 2 mm
            assert collect.main([*rig, *words]) == 0, person.getvalue()
        (episode,) = Dataset(data).episodes
        frames = list(episode.frames("scene"))
        assert len(frames) == len(list(episode.depth("scene"))) == episode.length
        assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50, "the arm moved in the pictures"
        assert (episode.stamps["grid"] >= episode.stamps["camera.scene"]).all(), "times are those of this computer"
        tcp = episode.columns["observation.tcp"][:, :3]
        assert np.linalg.norm(tcp[-1] - tcp[0]) > 0.05
        assert replay.main([data, *rig, "--report", str(report)]) == 0
        assert json.loads(report.read_text())["deviation"]["tcp_mm"]["max"] < 2.0
    finally:
        server.terminate()
        server.wait()


@contextlib.contextmanager
def stream(rig: hal.Rig) -> Iterator[None]:
    """Let the arm turn for as long as the pad's trigger is held, at the speed 0.2 rad/s."""
    arm, over = rig.robots["panda"], threading.Event()

    def send(control: hal.Control) -> None:
        while not over.wait(0.01):
            with contextlib.suppress(hal.MotionStopped):
                control.send(hal.JointVelocity([0.2, 0, 0, 0, 0, 0, 0]))

    with arm.control(rate_hz=5, deadman=rig.gamepads["pad"].hold("l2")) as control:
        thread = threading.Thread(target=send, args=(control,))
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def test_a_pad_of_a_third_computer_holds_the_dead_man_and_a_new_press_is_needed_when_it_was_lost(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Arm at one computer, pad and leader at another one, program at a third one."""
    monkeypatch.setattr("hal.remote.server.MOST_READERS", 2)
    devices = {"gamepads": {"pad": {"driver": "mock"}}, "leaders": {"left": {"model": "so101_leader", "sim": True}}}
    with hal.open(devices, clock="real_time") as there, serve_rig(there) as (_, proxy):
        pad: Any = there.driver("pad")
        leader: Any = there.driver("left")
        at = {"robots": {"panda": {"at": bench.proxy.at}}, "gamepads": {"pad": {"at": proxy.at}}}
        with hal.open({**at, "leaders": {"left": {"at": proxy.at}}}) as rig, stream(rig):
            found = rig.gamepads["pad"]
            with raises_code(ControlTaken, "too_many_readers"):
                connect(proxy.at, {"want": "pad", "pad": "pad"})
            for harm in (proxy.stalled.set, proxy.cut):
                pad.release("l2")
                wait_until(lambda: found.state().connected and not found.waiting_for, "the pad counts")
                pad.press("l2")
                wait_until(lambda: bench.speed() > 0.15, "the arm moves")
                began = time.monotonic()
                harm()
                wait_until(lambda: bench.speed() == 0.0 and not found.state().connected, "stopped")
                assert bench.servo().trip in (Trip.DEADMAN_SILENT, Trip.DEADMAN_LOST)
                assert bench.servo().t_stop - began <= SILENCE + LATE
                proxy.stalled.clear()
                wait_until(lambda: found.state().connected, "back")
                rest = bench.servo().q_set
                time.sleep(0.3)
                assert bench.servo().q_set == rest, "what is still held moves nothing"
            assert pad.rumbles, "the stop was felt"
            leader.move([0.1] * 5)
            wait_until(lambda: rig.gamepads["left"].state().joints == (0.1,) * 5, "the leader's joints arrive")
            proxy.delay = 0.09
            proxy.cut()
            wait_until(lambda: any("round trip" in note for note in found.notes), "a link that is too slow")
            assert not found.state().connected


def find_hosts(server: int) -> list[str]:
    """Return the processes that own the devices of a server."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            found += [path.parent.name] * (f"{APP_MARK}{server}" in path.read_text().split("\0"))
    return found


def test_a_server_whose_host_is_killed_ends_and_the_next_call_says_so() -> None:
    server, at = start_server()
    try:
        with hal.open({"robots": {"panda": {"at": at}}}, pad="none") as rig:
            (host,) = find_hosts(server.pid)
            os.kill(int(host), signal.SIGKILL)
            with raises_code(ConnectionLost, "process_ended"):
                while True:
                    rig.robots["panda"].check()
                    time.sleep(0.01)
            server.wait(20.0)
    finally:
        server.kill()


def test_a_server_that_freezes_or_is_killed_moves_the_arm_only_after_a_new_press_or_session() -> None:
    """It freezes for less than the link may be silent, which is a trip, then for longer; then it is killed."""
    server, at = start_server()
    deadman, rig_file = Deadman("test"), {"robots": {"panda": {"at": at}}}
    codes: set[str | None] = set()

    def drive_until(control: hal.Control, condition: Callable[[], bool], held: bool = True) -> None:
        """Let the arm turn until ``condition``; note the codes of all stops."""
        for tick in control.robot.clock.rate(100):
            deadman.update(held, True, time.monotonic())
            try:
                control.send(hal.JointVelocity([0.2, 0, 0, 0, 0, 0, 0]))
            except hal.MotionStopped as stop:
                codes.add(stop.code)
            if condition():
                return
            assert tick.elapsed < 20.0

    def freeze() -> float:
        """Stop the server; return when."""
        server.send_signal(signal.SIGSTOP)
        return time.monotonic()

    try:
        deadman.update(False, True, time.monotonic())
        with contextlib.suppress(ConnectionLost), hal.open(rig_file, pad="none") as rig:
            arm = rig.robots["panda"]
            with arm.control(rate_hz=5, deadman=deadman) as control:
                drive_until(control, lambda: arm._mail.peek().dq_set[0] > 0.15)
                began = freeze()
                drive_until(control, lambda: time.monotonic() > began + 2.0 * SILENCE)
                server.send_signal(signal.SIGCONT)
                drive_until(control, lambda: control.trip is not Trip.NONE and not any(arm._mail.peek().dq_set))
                rest, stopped = arm._mail.peek().q_set, arm._mail.peek().t_stop
                assert stopped - began <= SILENCE + LATE
                for held in (True, False):
                    end = time.monotonic() + 0.3
                    drive_until(control, lambda end=end: time.monotonic() > end, held)
                    assert arm._mail.peek().q_set == rest, "a dead-man that is still held moves nothing, nor a release"
                assert codes
                assert codes <= {"app_silent", "pad_silent"}
                drive_until(control, lambda: arm._mail.peek().dq_set[0] > 0.15)
                began = freeze()
                with pytest.raises(ConnectionLost) as lost:
                    drive_until(control, lambda: False)
        assert lost.value.code in ("link_silent", "process_silent")
        server.send_signal(signal.SIGCONT)
        with hal.open(rig_file, pad="none") as rig:
            arm = rig.robots["panda"]
            state = arm.state()
            assert arm._mail.peek().t_stop - began <= SILENCE + LATE
            rig.clock.sleep(0.3)
            assert arm.state().status is RobotStatus.IDLE
            assert (arm.state().q_set == state.q_set).all()
            assert max(rig.statistics()[at]["robots"]["panda"]["peak"].values()) <= 1.0 + 1e-6, "within every limit"
            deadman.update(False, True, time.monotonic())
            with raises_code(ConnectionLost, "link_closed"), arm.control(rate_hz=5, deadman=deadman) as control:
                drive_until(control, lambda: arm._mail.peek().dq_set[0] > 0.15)
                server.kill()
                drive_until(control, lambda: False)
        wait_until(lambda: not find_hosts(server.pid), "nothing is left")
    finally:
        server.kill()


@pytest.mark.parametrize("deadman", [True, False], ids=["dead-man", "no dead-man"])
def test_a_link_that_stalls_stops_the_arm_until_it_is_acknowledged(bench: Bench, deadman: bool) -> None:
    program = bench.drive(deadman)
    began = time.monotonic()
    bench.proxy.stalled.set()
    wait_until(lambda: bench.servo().trip is not Trip.NONE, "stopped")
    assert bench.servo().trip in (Trip.DEADMAN_SILENT, Trip.APP_SILENT)
    assert bench.servo().t_stop - began <= SILENCE + LATE
    wait_until(lambda: bench.speed() == 0.0, "at rest")
    bench.proxy.stalled.clear()  # and everything that waited comes at once
    program.wait_for("stopped", bench.servo().trip.code)
    rest = bench.servo().q_set
    time.sleep(0.3)
    assert bench.servo().q_set == rest, "commands and the dead-man that is still held move nothing"
    for word in ("release", "press") if deadman else ("rearm",):
        program.tell(word)
        assert word != "release" or bench.servo().q_set == rest
    wait_until(lambda: bench.speed() > 0.15, "the arm moves again")


@pytest.mark.parametrize("what", ["the program", "its process for the link"])
@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL])
def test_a_program_that_freezes_or_is_killed(bench: Bench, what: str, how: signal.Signals) -> None:
    program = bench.drive()
    mail, pid = bench.mail, program.process.pid if what == "the program" else program.link
    began = time.monotonic()
    os.kill(pid, how)
    try:
        wait_until(lambda: mail.peek().status is not RobotStatus.FOLLOWING, "stopped")
        assert mail.peek().t_stop - began <= SILENCE + LATE
        if how is signal.SIGKILL or what != "the program":  # the link is silent for 2 s, or gone
            wait_until(lambda: not bench.server.served, "free for the next client")
            assert mail.peek().status is RobotStatus.IDLE
        wait_until(lambda: bench.speed() == 0.0, "at rest")
        rest = mail.peek().q_set
    finally:
        if how is signal.SIGSTOP:
            os.kill(pid, signal.SIGCONT)
    if what != "the program":
        assert program.wait_for("lost") in ("process_ended", "process_silent")
    elif how is signal.SIGSTOP:
        assert program.wait_for("stopped")
    assert mail.peek().q_set == rest, "nothing moves by itself"


@pytest.mark.parametrize("how", ["closed", "cable"])
def test_a_link_that_is_lost_ends_the_program_and_a_new_one_moves_nothing_by_itself(bench: Bench, how: str) -> None:
    """The connection is closed, or the cable is pulled, of which neither end hears."""
    program = bench.drive()
    mail, began = bench.mail, time.monotonic()
    if how == "closed":
        bench.proxy.cut()
    else:
        bench.proxy.stalled.set()
    wait_until(lambda: mail.peek().status is not RobotStatus.FOLLOWING, "stopped")
    assert mail.peek().t_stop - began <= SILENCE + LATE
    assert program.wait_for("lost") in ("link_closed", "link_silent", "process_silent")
    wait_until(lambda: not bench.server.served, "free for the next client")
    bench.proxy.stalled.clear()
    with hal.open({"robots": {"panda": {"at": bench.proxy.at}}}, pad="none") as rig:
        rest = rig.robots["panda"].state().q_set
        rig.clock.sleep(0.3)
        assert (rig.robots["panda"].state().q_set == rest).all()
        assert rig.robots["panda"].state().status is RobotStatus.IDLE


def test_a_gripper_stops_when_its_program_is_gone_and_the_next_program_moves_it(bench: Bench) -> None:
    rig_file = {"robots": {"panda": {"at": bench.proxy.at}}}
    mail = bench.rig.robots["panda"].gripper._mail

    def width() -> float:
        return float(mail.get().state.width)

    with hal.open(rig_file, pad="none") as rig:
        start = width()
        rig.robots["panda"].gripper.start(0.0, speed=0.02)
        wait_until(lambda: width() < start - 0.005, "it moves")
        bench.proxy.cut()
        wait_until(lambda: not bench.server.served, "free for the next client")
    rest = width()
    assert rest > 0.005, "it has not come to its goal"
    with hal.open(rig_file, pad="none") as rig:
        assert width() == rest
        assert rig.robots["panda"].gripper.move(0.5 * rest, timeout=10.0).width == pytest.approx(0.5 * rest, abs=1e-3)


def test_frames_lost_repeated_or_out_of_order_and_a_wall_clock_that_steps_change_nothing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.proxy.delay = 0.01
    bench.drive()
    steps = itertools.cycle((0.0, 3600.0))
    monkeypatch.setattr(time, "time", lambda: next(steps))
    bench.proxy.trouble = 0.1
    q = bench.servo().q_set[0]
    wait_until(lambda: abs(bench.servo().q_set[0] - q) > 0.3, "the arm moves on")
    assert bench.servo().trip is Trip.NONE
    assert bench.servo().q_set[0] > q


def test_a_link_with_a_long_round_trip_opens_no_session(bench: Bench) -> None:
    bench.proxy.delay = 0.09
    with hal.open({"robots": {"panda": {"at": bench.proxy.at}}}, pad="none") as rig:
        assert rig.robots["panda"].state(1.0).status is RobotStatus.IDLE
        with raises_code(ConnectionLost, "link_too_slow"), rig.robots["panda"].control():
            pass


def test_the_time_on_the_way_does_not_count_against_a_commands_deadline(bench: Bench) -> None:
    bench.proxy.delay = 0.06
    turn = hal.JointVelocity([0.1, 0, 0, 0, 0, 0, 0])
    with (
        hal.open({"robots": {"panda": {"at": bench.proxy.at}}}, pad="none") as rig,
        rig.robots["panda"].control(rate_hz=50) as control,  # the next command within 100 ms
    ):
        for tick in rig.clock.rate(20):
            control.send(turn)
            if tick.elapsed > 0.5:
                break
        assert control.trip is Trip.NONE
        with pytest.raises(hal.MotionStopped, match="commands stopped coming"):
            rig.clock.sleep(0.5)
            control.send(turn)


@pytest.mark.alone
def test_recordings_at_the_arm_and_at_the_program_agree_within_1_ms(bench: Bench, tmp_path: Path) -> None:
    bench.proxy.delay = 0.005
    with (
        hal.open({"robots": {"panda": {"at": bench.proxy.at}}}, pad="none") as rig,
        Recorder(rig, tmp_path / "program", fps=30) as here,
        Recorder(bench.rig, tmp_path / "arm", fps=60) as there,
        rig.robots["panda"].control(rate_hz=5) as control,
    ):
        there.start()
        here.start()
        for tick in rig.clock.rate(50):
            control.send(hal.JointVelocity([0.3, 0, 0, 0, 0, 0, 0]))
            if tick.elapsed > 1.5:
                break
        here.save(True, wait=True)
        there.save(True, wait=True)
    (own,), (theirs,) = Dataset(tmp_path / "program").episodes, Dataset(tmp_path / "arm").episodes
    t, their_t = own.stamps["robot.panda"], theirs.stamps["robot.panda"]
    q, their_q = (episode.columns["observation.state"][:, 0] for episode in (own, theirs))
    cruise = (t > t[0] + 0.7) & (t < their_t[-1])
    assert cruise.sum() > 5
    assert q[cruise][-1] - q[cruise][0] > 0.1, "the arm moved"
    assert np.abs(q - np.interp(t, their_t, their_q))[cruise].max() <= 0.3 * 0.001


def test_who_may_connect_and_ask_for_what(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = {"robots": {"panda": {"at": bench.proxy.at}}}
    with hal.open(rig, pad="none") as first:
        with raises_code(ControlTaken, "in_use"):
            hal.open(rig, pad="none")
        for terms in ([1, 0.9, 0.25, False], [1, 0.3, 5.0, False], [1, float("nan"), 0.25, False]):
            with raises_code(CommandError, "too_fast"):  # whatever the program's own checks let pass
                first._hosts[0].request("begin", {"robot": "panda", "session": terms})
    for want, kind in (("pad", "gamepad"), ("frames", "camera")):  # as of a rig that was opened before a restart
        with pytest.raises(DeviceNotFound, match=f"^{bench.proxy.at}: this rig has no {kind} 'left'"):
            connect(bench.proxy.at, {"want": want, "pad": "left", "camera": "left"})
    monkeypatch.setattr("hal.remote.link.LAYOUT", records.LAYOUT + 1)
    monkeypatch.setattr("hal.remote.server.describe_version", lambda: {"version": "0.0", "layout": records.LAYOUT})
    with raises_code(NotSupported, "version_mismatch"):
        hal.open(rig, pad="none")
    bench.server.close()
    bench.proxy.close()
    with raises_code(ConnectionLost, "no_server"):
        hal.open(rig, pad="none")
