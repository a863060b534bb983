"""``rig.world.poses``: where many things were at one moment, and which moment that was."""

from __future__ import annotations

import pytest
from engines_kit import Engine

import hal
from hal import DeviceNotFound, Pose

PLAIN = ["cameras={}"]
SECONDS = 1.5


def test_they_are_those_of_one_moment_and_of_the_bodies_that_were_asked_for(engine: Engine) -> None:
    with hal.open("panda_table", sim=True, engine=engine.name, clock="lock_step", pad="none", overrides=PLAIN) as rig:
        assert rig.world.poses().t == rig.clock.now() == 0.0
        rig.clock.sleep(0.2)
        seen = rig.world.poses()
        assert seen.t == rig.clock.now() == pytest.approx(0.2)
        assert tuple(seen.poses) == rig.world.bodies
        assert all(pose == rig.world.pose(name) for name, pose in seen.poses.items())
        assert list(rig.world.poses(["duck", "panda"]).poses) == ["duck", "panda"]
        assert rig.world.poses([]).poses == {}
        with pytest.raises(DeviceNotFound, match="did you mean 'cube'"):
            rig.world.poses(["duck", "cub"])


@pytest.mark.parametrize("clock", ["lock_step", pytest.param("real_time", marks=pytest.mark.slow)])
def test_their_time_is_that_of_the_world_that_they_show(engine: Engine, clock: str) -> None:
    """What the arm carries is where the arm's state of that very time says: within 0.1 mm, at 0.2 m/s."""
    options = {"clock": clock, "pad": "none", "overrides": PLAIN}
    with hal.open("panda_calibration_held", sim=True, engine=engine.name, **options) as rig:
        arm = rig.robots["panda"]
        (board,) = set(rig.world.bodies) - {"floor", "table", "panda"}
        base = rig.world.pose("panda")
        held = (base @ arm.state().tcp).inverse() @ rig.world.pose(board)
        before, fastest, off, waited = 0.0, 0.0, [], 0
        with arm.control(rate_hz=20) as control:
            for tick in rig.clock.rate(50):
                if tick.elapsed > SECONDS:
                    break
                try:
                    control.send(hal.Twist([0.0, 0.2, 0.0]))
                except hal.MotionStopped:  # a busy machine
                    control.rearm()
                asked = rig.clock.now()
                seen = rig.world.poses([board])
                assert before <= seen.t <= rig.clock.now()
                assert asked - seen.t < 0.5, "it is of the present"
                before = seen.t
                while arm.state().stamp.t < seen.t:
                    waited += 1
                    assert waited < 1000
                    rig.clock.sleep(0.001)
                state = arm.state_at(seen.t)
                fastest = max(fastest, float(abs(state.tcp_twist[1])))
                off.append(_distance(base @ state.tcp @ held, seen.poses[board]))
        assert fastest > 0.15, "it moved"
        assert len(off) > 30
        assert max(off) < 1e-4


def _distance(a: Pose, b: Pose) -> float:
    return a.distance(b)[0]
