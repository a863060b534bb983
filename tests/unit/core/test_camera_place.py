"""Where a real camera is, worked out from the rig and the arm: the same as the simulator says of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hal
from hal.camera import Camera, CameraDriver, RawFrame, place_of
from hal.driver import CameraInfo, nominal_info


def difference(a: hal.Pose, b: hal.Pose) -> tuple[float, float]:
    apart = a.inverse() @ b
    return float(np.linalg.norm(apart.position)), 2.0 * float(np.linalg.norm(apart.orientation[:3]))


@pytest.mark.parametrize("name", ["scene", "wrist"])
def test_it_is_where_the_simulator_says(name: str) -> None:
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        arm, camera = rig.robots["panda"], rig.cameras[name]
        place = place_of(camera.spec, rig.robots)
        assert place is not None
        poses = []
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist(linear=[0.1, 0.05, 0.05], angular=[0.0, 0.3, 0.4]))
                if tick.elapsed >= 0.2 * (len(poses) + 1):
                    frame = camera.read()
                    found = place(frame.stamp.t)
                    assert found is not None
                    assert frame.T_world_camera is not None
                    assert difference(found, frame.T_world_camera) == pytest.approx((0.0, 0.0), abs=1e-5)
                    poses.append(found)
                if tick.elapsed > 1.0:
                    break
        moved, turned = difference(poses[0], poses[-1])
        assert (moved > 0.03 and turned > 0.1) == (name == "wrist"), "only a camera on the arm moves"


def test_a_picture_of_a_little_while_ago_was_taken_where_the_arm_was_then() -> None:
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        arm, camera = rig.robots["panda"], rig.cameras["wrist"]
        place = place_of(camera.spec, rig.robots)
        assert place is not None
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist(linear=[0.0, 0.1, 0.0]))
                if tick.elapsed > 0.6:
                    break
            frame = camera.read()
            rig.clock.sleep(0.03)
            control.send(hal.Twist(linear=[0.0, 0.1, 0.0]))
            then, now = place(frame.stamp.t), place(rig.clock.now())
            assert then is not None
            assert now is not None
            assert frame.T_world_camera is not None
            assert difference(now, frame.T_world_camera)[0] > 2e-3, "the arm went on"
            assert difference(then, frame.T_world_camera)[0] < 1e-5
            assert place(rig.clock.now() - 60.0) is None, "nobody knows any more"
            assert place(rig.clock.now() + 1.0) is None


def test_a_camera_that_stands_nowhere_has_no_place() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        spec = replace(rig.cameras["scene"].spec, view=None)
        assert place_of(spec, rig.robots) is None


class Still(CameraDriver):
    """A camera that does not know where it is, and whose depth sensor is not where its model says."""

    @property
    def info(self) -> CameraInfo:
        info = nominal_info(self.spec, "hardware")
        depth = replace(info.streams["depth"], T_color_stream=hal.Pose([0.016, 0.0, 0.0]))
        return replace(info, streams={**info.streams, "depth": depth})

    def open(self) -> None: ...

    def grab(self, timeout: float) -> RawFrame:
        return RawFrame(0.0, 0.0, 1, None, None, None, None, None)

    def close(self) -> None: ...


@pytest.mark.parametrize("align", ["color", "depth"])
def test_the_view_handed_out_is_that_of_the_sensor_that_others_are_aligned_to(align: str) -> None:
    with hal.open("panda_table", driver="mock", overrides=[f"cameras.scene.align={align}"]) as rig:
        spec = rig.cameras["scene"].spec
        camera = Camera(Still(spec), rig.clock, threaded=False, place=place_of(spec, rig.robots))
        camera.open()
        pose = camera.read().T_world_camera
        assert pose is not None
        assert spec.view is not None
        apart = hal.Pose(spec.view.position, spec.view.orientation).inverse() @ pose
        assert apart.position == pytest.approx([0.016 if align == "depth" else 0.0, 0.0, 0.0], abs=1e-9)
