"""A rig in real time: processes that are lost, edits of the world that reach the pictures, faults at run time."""

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from engines_kit import Engine
from waiting import wait_until

import hal
from hal import BodySpec, ConnectionLost, JointVelocity, MotionStopped, Pose, RobotStatus, Trip

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rig(engine: Engine) -> Iterator[hal.Rig]:
    with hal.open("panda_table", sim=True, engine=engine.name, clock="real_time", pad="none") as opened:
        yield opened


def pixels_of(rig: hal.Rig, color: tuple[int, int, int]) -> int:
    image = rig.cameras["scene"].read(timeout=5.0).color.astype(int)
    target = np.array(color)
    hue = image / np.maximum(1, image.max(axis=2, keepdims=True))
    return int((np.abs(hue - target / target.max()).max(axis=2) < 0.15).sum())


def test_edits_of_the_world_are_seen_by_the_cameras(rig: hal.Rig) -> None:
    green = (0.0, 1.0, 0.0, 1.0)
    assert pixels_of(rig, (0, 255, 0)) == 0
    ball = BodySpec("ball", (0.0, 0.0, 0.75), (0, 0, 0, 1), "sphere", radius=0.1, fixed=True, rgba=green)
    rig.world.add(ball)
    assert rig.world.bodies[-1] == "ball" or "ball" in rig.world.bodies
    wait_until(lambda: pixels_of(rig, (0, 255, 0)) > 50)
    rig.world.set_color("ball", (0.0, 0.0, 1.0, 1.0))
    wait_until(lambda: pixels_of(rig, (0, 255, 0)) == 0 and pixels_of(rig, (0, 0, 255)) > 50)
    rig.world.remove("ball")
    wait_until(lambda: pixels_of(rig, (0, 0, 255)) == 0)


def test_a_refused_real_time_priority_is_noted_in_one_line_with_what_allows_it() -> None:
    program = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parents[1] / 'kits')!r})\n"
        "import hal, child_targets\n"
        "child_targets.give_up_right()\n"
        "with hal.open('panda_table', sim=True, pad='none', overrides=['cameras={}']) as rig:\n"
        "    print(*rig.notes, sep='\\n')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    (note,) = (note for note in done.stdout.splitlines() if "SCHED_FIFO" in note)
    assert "/etc/security/limits.d" in note


def test_a_priority_that_it_has_needs_no_note(rig: hal.Rig) -> None:
    has = rig.statistics()["simulation"]["scheduling"].startswith("SCHED_FIFO")
    assert any("SCHED_FIFO" in note for note in rig.notes) is not has


def test_poses_and_reset(rig: hal.Rig) -> None:
    start = rig.world.pose("cube")
    rig.world.set_pose("cube", Pose([0.1, 0.1, 0.9]))
    wait_until(lambda: rig.world.pose("cube").position[2] < 0.7)  # it fell onto the table
    rig.world.reset("cube")
    assert rig.world.pose("cube").distance(start)[0] < 0.15
    with pytest.raises(hal.DeviceNotFound, match="cube"):
        rig.world.pose("cubes")


def test_states_and_frames_go_on_and_their_stamps_increase(rig: hal.Rig) -> None:
    arm, camera = rig.robots["panda"], rig.cameras["wrist"]
    frames = [camera.read(timeout=5.0) for _ in range(5)]
    assert all(b.stamp.t > a.stamp.t and b.stamp.seq > a.stamp.seq for a, b in itertools.pairwise(frames))
    states = []
    while len(states) < 5:
        state = arm.state()
        if not states or state.stamp.seq != states[-1].stamp.seq:
            states.append(state)
    assert all(b.stamp.t > a.stamp.t for a, b in itertools.pairwise(states))


def test_a_fault_in_motion_is_told_and_recovered(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    velocity = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
    with arm.control(rate_hz=5) as control:  # sent ten times as often: a busy computer is no reason for a stop
        for tick in rig.clock.rate(50):
            control.send(velocity)
            if arm.state(max_age=1.0).dq_set[0] > 0.1:
                break
            assert tick.elapsed < 10.0
        arm.inject(fault="collision")
        wait_until(lambda: arm.state().status is RobotStatus.FAULT)
        with pytest.raises(hal.RobotFault, match="collision"):
            control.send(velocity)
        arm.recover()
        wait_until(lambda: control.trip is Trip.FAULT and arm.state().status is RobotStatus.TRIPPED)
        with pytest.raises(MotionStopped):
            control.send(velocity)
        control.rearm()
        wait_until(lambda: control.trip is Trip.NONE)


def test_a_renderer_that_is_killed_takes_only_the_cameras() -> None:
    with hal.open("panda_table", sim=True, clock="real_time", pad="none") as rig:
        arm, camera = rig.robots["panda"], rig.cameras["scene"]
        camera.read(timeout=5.0)
        os.kill(rig._pictures._child.process.pid, signal.SIGKILL)

        def lost() -> bool:
            try:
                camera.read_latest(max_age=10.0)
            except ConnectionLost:
                return True
            return False

        wait_until(lost)
        goal = arm.home.copy()
        goal[0] += 0.05
        arm.move_to(goal, speed=0.5)
        assert arm.state().q[0] == pytest.approx(0.05, abs=2e-3)


def test_a_host_that_is_killed_is_told_by_the_next_call() -> None:
    rig = hal.open("panda_table", sim=True, clock="real_time", pad="none", overrides=["cameras={}"])
    arm = rig.robots["panda"]
    with pytest.raises(ConnectionLost, match="simulation process ended"), arm.control(rate_hz=5) as control:
        for k, _ in enumerate(rig.clock.rate(50)):
            control.send(JointVelocity([0.1] * 7))
            if k == 10:
                os.kill(rig._hosts[0].child.process.pid, signal.SIGKILL)
            assert k < 200
    with pytest.raises(ConnectionLost):
        rig.world.pose("cube")
    rig.close()


def test_a_host_that_is_killed_ends_a_motion() -> None:
    rig = hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=["cameras={}"])
    motion = rig.robots["panda"].start_move_to(rig.robots["panda"].home + 0.2)
    wait_until(lambda: motion.progress > 0.05)
    os.kill(rig._hosts[0].child.process.pid, signal.SIGKILL)
    with pytest.raises(hal.ConnectionLost):
        motion.wait(10.0)
    with pytest.raises(hal.ConnectionLost):
        assert motion.done
    with pytest.raises(hal.ConnectionLost):  # the motion was not over
        rig.close()
