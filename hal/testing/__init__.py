"""The contract that every driver fulfils, as pytest checks to inherit: for driver authors, and for this project's own.

    from hal.testing import CameraBench, CameraContract, bench_of, camera_spec

    @contextmanager
    def my_camera():
        driver = MyCamera(camera_spec(streams=("color",)))
        yield CameraBench(driver=driver, lose=..., restore=..., freeze=...)
        driver.close()

    class TestMyCamera(CameraContract):
        bench = bench_of(my_camera)

pytest collects the checks of ``TestMyCamera`` in the file where the class is defined; ``docs/test-a-driver.md`` has a
complete example. This package needs pytest, and nothing else in ``hal`` imports it.

The modules with the checks are registered for pytest's assertion rewriting before they are imported, so that a failed
check shows the compared values as in a test file.
"""

from __future__ import annotations

try:
    import pytest
except ImportError as error:
    raise ImportError(
        f"hal.testing needs pytest ({error}); install it with: pip install pytest", name="pytest"
    ) from error

pytest.register_assert_rewrite(
    *(
        f"{__name__}.{part}"
        for part in ("benches", "camera", "gamepad", "gripper", "hosting", "leader", "robot", "world")
    )
)

from .benches import (  # noqa: E402
    Bench,
    CameraBench,
    Contract,
    GripperBench,
    PadBench,
    RobotBench,
    bench_of,
    camera_spec,
    gripper_spec,
    needs,
    pad_spec,
    robot_spec,
)
from .camera import CameraContract  # noqa: E402
from .gamepad import GamepadContract  # noqa: E402
from .gripper import GripperContract  # noqa: E402
from .holding import HoldResult, hold_object  # noqa: E402
from .leader import LeaderContract  # noqa: E402
from .robot import RobotContract  # noqa: E402
from .world import WorldContract  # noqa: E402
from .world_bench import WorldBench  # noqa: E402

__all__ = [
    "Bench",
    "CameraBench",
    "CameraContract",
    "Contract",
    "GamepadContract",
    "GripperBench",
    "GripperContract",
    "HoldResult",
    "LeaderContract",
    "PadBench",
    "RobotBench",
    "RobotContract",
    "WorldBench",
    "WorldContract",
    "bench_of",
    "camera_spec",
    "gripper_spec",
    "hold_object",
    "needs",
    "pad_spec",
    "robot_spec",
]
