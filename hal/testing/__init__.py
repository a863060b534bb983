"""What every driver must do, as checks that you inherit: for people who write drivers, and for this project's own.

    from hal.testing import CameraBench, CameraContract, bench_of, camera_spec

    @contextmanager
    def my_camera():
        driver = MyCamera(camera_spec(streams=("color",)))
        yield CameraBench(driver=driver, lose=..., restore=..., freeze=...)
        driver.close()

    class TestMyCamera(CameraContract):
        bench = bench_of(my_camera)

pytest collects the checks of ``TestMyCamera`` in the file where it stands; ``docs/test-a-driver.md`` has a whole one.
This package needs pytest, and nothing else in ``hal`` imports it.

pytest rewrites the assertions of test files so that they say what they compared. It is told here, before the modules
with the checks are imported, to do the same for those.
"""

from __future__ import annotations

try:
    import pytest
except ImportError as error:
    raise ImportError(
        f"hal.testing needs pytest ({error}); install it with: pip install pytest", name="pytest"
    ) from error

pytest.register_assert_rewrite(
    *(f"{__name__}.{part}" for part in ("camera", "contract", "gamepad", "grasping", "gripper", "robot")),
    *(f"{__name__}.{part}" for part in ("torque", "waiting", "watching")),
)

from .benches import Bench, CameraBench, GripperBench, PadBench, RobotBench  # noqa: E402
from .camera import CameraContract  # noqa: E402
from .contract import Contract, bench_of, needs  # noqa: E402
from .gamepad import GamepadContract  # noqa: E402
from .gripper import GripperContract  # noqa: E402
from .robot import RobotContract  # noqa: E402
from .specs import camera_spec, gripper_spec, pad_spec, robot_spec  # noqa: E402

__all__ = [
    "Bench",
    "CameraBench",
    "CameraContract",
    "Contract",
    "GamepadContract",
    "GripperBench",
    "GripperContract",
    "PadBench",
    "RobotBench",
    "RobotContract",
    "bench_of",
    "camera_spec",
    "gripper_spec",
    "needs",
    "pad_spec",
    "robot_spec",
]
