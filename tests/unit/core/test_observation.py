"""Observations: frames and states of one time, and their history."""

from __future__ import annotations

import pytest

import hal
from hal.drivers.mock.camera import read_picture
from hal.errors import CommandError, DeviceNotFound, StaleStateError
from hal.types import GripperState


def test_pictures_and_states_of_the_same_time_in_real_time() -> None:
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        arm = rig.robots["panda"]
        seen = []
        with arm.control(rate_hz=5) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist([0.1, 0.0, 0.0]), grip=min(1.0, tick.elapsed))
                if tick.elapsed > 0.5:
                    seen.append(rig.observe(timeout=10.0))
                if tick.elapsed > 1.0 and len(seen) > 10:
                    break
        for observation in seen:
            assert set(observation.cameras) == {"scene", "wrist"}
            assert observation.t == max(moment.frame.stamp.t for moment in observation.cameras.values())
            for moment in observation.cameras.values():
                state = moment.robots["panda"]
                assert state.stamp.t == pytest.approx(moment.frame.stamp.t, abs=1e-9)
                assert moment.grippers["panda"].stamp.t == pytest.approx(moment.frame.stamp.t, abs=1e-9)
                assert read_picture(moment.frame.color).t == pytest.approx(state.stamp.t, abs=1e-5)
            assert observation.robots["panda"].stamp.t == pytest.approx(observation.t, abs=1e-9)
        first, last = (observation.robots["panda"].tcp.position for observation in (seen[0], seen[-1]))
        assert last[0] - first[0] > 0.02, "it moved"
        after = rig.clock.now()
        assert all(m.frame.stamp.t >= after for m in rig.observe(after=after, timeout=10.0).cameras.values())


def test_history_has_the_requested_length_and_starts_again() -> None:
    with hal.open("panda_table", driver="mock") as rig:

        def stamps() -> list[float]:
            rig.clock.sleep(0.1)
            return [round(past.t, 3) for past in rig.observe(history=3).history]

        start = rig.clock.now()
        first = round(start + 0.1, 3)
        assert stamps() == [first] * 3, "padded with the oldest"
        assert stamps() == pytest.approx([first, first, first + 0.1])
        stamps()
        assert stamps() == pytest.approx([first + 0.1, first + 0.2, first + 0.3])
        rig.forget_observations()
        assert len(set(stamps())) == 1
        assert len(rig.observe().history) == 1
        with pytest.raises(CommandError):
            rig.observe(history=0)


def test_some_cameras_or_none() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        assert set(rig.observe(cameras=["wrist"]).cameras) == {"wrist"}
        bare = rig.observe(cameras=[])
        assert bare.t == rig.robots["panda"].state().stamp.t
        with pytest.raises(DeviceNotFound):
            rig.observe(cameras=["wirst"])


def test_an_old_frame_is_not_returned() -> None:
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        wrist = rig.cameras["wrist"]
        old = rig.observe(timeout=10.0).cameras["wrist"].frame
        wrist.inject(freeze=True)
        rig.clock.sleep(0.5)
        with pytest.raises(StaleStateError):
            rig.observe(timeout=0.2)
        wrist.inject(freeze=False)
        assert rig.observe(timeout=10.0).cameras["wrist"].frame.stamp.t > old.stamp.t + 0.3


def test_a_frame_from_before_the_first_state_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera is there before an arm when a rig opens."""
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        rig.observe(timeout=10.0)
        begin = rig.clock.now() + 0.1
        monkeypatch.setattr(rig.robots["panda"]._mail.history, "begin", lambda: begin)
        assert all(moment.frame.stamp.t >= begin for moment in rig.observe(timeout=10.0).cameras.values())


def test_a_camera_without_new_frames_is_an_error() -> None:
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        rig.observe(timeout=10.0)
        rig.cameras["wrist"].inject(freeze=True)
        with pytest.raises(StaleStateError):
            rig.observe(after=rig.clock.now(), timeout=0.3)


def test_without_cameras_it_waits_for_a_new_state(monkeypatch: pytest.MonkeyPatch) -> None:
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=["cameras={}"]) as rig:
        for _ in range(20):
            now = rig.clock.now()
            assert rig.observe(after=now).robots["panda"].stamp.t >= now
        gripper = rig.robots["panda"].gripper
        calls: list[float] = []
        assert gripper is not None
        state_at = gripper.state_at

        def late(t: float) -> GripperState:
            calls.append(t)
            if len(calls) == 1:
                raise StaleStateError("late")
            return state_at(rig.clock.now())

        monkeypatch.setattr(type(gripper), "peek", lambda _: None)
        monkeypatch.setattr(type(gripper), "state_at", lambda _, t: late(t))
        assert rig.observe().grippers["panda"].width > 0.0
        assert len(calls) > 1, "a late gripper is waited for, too"
