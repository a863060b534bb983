"""The hands of emulated arms meet the objects of the world that the rig's cameras show: pick, place, record, replay."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from app_kit import run_here
from benchmark_kit import load_benchmark
from can_kit import EmulatorProcess
from waiting import wait_until

import hal
from hal.apps.replay import main as replay
from hal.recording import Recorder
from hal.skills import SkillProgress, grasp, grasp_pose, locate_by_truth

from .franka_kit import Emulator, free_host

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
for library in ("pyarrow", "av", "zstandard"):
    pytest.importorskip(library, reason="pip install 'robot-hal[record]'")

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.timeout(300)]

tries = load_benchmark("emulated_skills")
OPTIONS: dict[str, Any] = {"approach": 0.06, "lift": 0.06, "speed": 0.3, "unattended": True}
AREA = tries.BENCHES["YAM"]
"""What every arm here reaches."""


class Bench:
    """An emulator that runs, and how its rig is opened."""

    def __init__(self, rig: str, overrides: list[str]) -> None:
        self.rig, self.overrides = rig, overrides

    def open(self, *more: str) -> hal.Rig:
        """Open the rig as a user does."""
        return hal.open(self.rig, sim=False, pad="none", overrides=[*self.overrides, *more])

    @property
    def words(self) -> list[str]:
        """The same for a command line."""
        return ["--real", "--config", self.rig, *(word for value in self.overrides for word in ("--set", value))]


@pytest.fixture(scope="module")
def fr3() -> Iterator[Bench]:
    sets = [f"objects=[floor, table, {tries.flow(AREA.cube)}]", f"cameras={tries.flow({'scene': tries.CAMERA})}"]
    host = free_host()
    sets += [f"robots.arm.real.host={host}", "robots.arm.gripper.enabled=true"]
    words = [word for value in sets for word in ("--set", value)]
    # It waits for a set-point that is late: a busy machine must not look like a fault of the arm.
    with Emulator("--lockstep", "--config", "franka_emulator", *words, host=host, hand=True):
        yield Bench("franka_emulator", sets)


@pytest.fixture(scope="module", params=["yam_emulator", "piper_emulator"])
def can(request: pytest.FixtureRequest) -> Iterator[Bench]:
    sets = [f"objects=[floor, table, {tries.flow(AREA.cube)}]", f"cameras={tries.flow({'scene': tries.CAMERA})}"]
    with EmulatorProcess(request.param, *sets) as emulator:
        yield Bench(request.param, emulator.overrides)


def height_of_cube(frame: hal.Frame) -> float:
    """Return the height in the world of the pink points that a frame shows, m."""
    red, green, blue = (frame.color[..., k].astype(int) for k in range(3))
    depth = np.asarray(frame.depth, float)
    rows, columns = np.nonzero((red > green + 60) & (red > 120) & (blue > green) & (depth > 0.0))
    assert len(rows) > 20, "the camera sees the cube"
    rays = np.linalg.inv(frame.K) @ [columns + 0.5, rows + 0.5, np.ones(len(rows))]
    return float(np.median(frame.T_world_camera.transform((rays * depth[rows, columns]).T)[:, 2]))


def prepare(rig: hal.Rig, x: float = -0.08, y: float = 0.03) -> hal.Pose:
    """Bring the arm home, open its fingers and put the cube before it; return how to grasp it."""
    arm = rig.robots["arm"]
    arm.move_to(arm.home, speed=0.3, unattended=True)
    assert arm.gripper is not None
    arm.gripper.open()
    rig.world.reset("cube", pose=hal.Pose([x, y, AREA.cube["position"][2]]))
    rig.clock.sleep(0.3)
    found = locate_by_truth(rig, arm, "cube")
    assert found is not None
    return grasp_pose(found, arm.gripper)


def test_an_episode_of_pick_and_place_is_recorded_and_replayed(fr3: Bench, tmp_path: Path) -> None:
    with fr3.open() as rig:
        arm = rig.robots["arm"]
        pose = prepare(rig)
        low = height_of_cube(rig.cameras["scene"].read(after=rig.clock.now()))
        with Recorder(rig, tmp_path / "data", fps=15, task="move the cube") as recorder:
            recorder.start()
            done = grasp(arm, pose, width=0.03, hold=0.3, **OPTIONS)
            assert done, done.message
            assert arm.gripper is not None
            assert arm.gripper.state().grasped
            high = height_of_cube(rig.cameras["scene"].read(after=rig.clock.now()))
            assert high - low == pytest.approx(OPTIONS["lift"], abs=0.01), "the camera sees it lifted"
            for shift in ([0.0, -0.08, 0.0], [0.0, -0.08, -OPTIONS["lift"]]):
                there = hal.Pose(done.tcp.position + shift, done.tcp.orientation)
                arm.move_to(there, straight=True, speed=0.3, unattended=True)
            arm.gripper.open()
            arm.move_to(arm.home, speed=0.3, unattended=True)
            recorder.save(success=True, wait=True)
        put = rig.world.pose("cube").position
        assert put == pytest.approx([-0.08, -0.05, AREA.cube["position"][2]], abs=5e-3)
    shown = run_here(replay, str(tmp_path / "data"), "--unattended", *fr3.words)
    assert shown.returncode == 0, shown.stdout + shown.stderr
    with fr3.open() as rig:  # the emulator's world goes on between programs
        assert rig.world.pose("cube").position == pytest.approx(put, abs=2e-3)


def miss_and_lose(rig: hal.Rig) -> None:
    """Grasp where the cube is not, and lose one that is taken away."""
    arm = rig.robots["arm"]
    gripper = arm.gripper
    assert gripper is not None
    pose = prepare(rig)
    far = hal.Pose([0.3, 0.4, AREA.cube["position"][2]])
    rig.world.reset("cube", pose=far)
    assert grasp(arm, pose, width=0.03, **OPTIONS).reason == "missed"

    pose = prepare(rig)

    def steal(now: SkillProgress) -> None:
        if now.phase == "hold":
            assert gripper.state().grasped is not False
            rig.world.reset("cube", pose=far)

    result = grasp(arm, pose, width=0.03, hold=1.5, **OPTIONS, progress=steal)
    assert result.reason == "dropped", result.message
    wait_until(lambda: not gripper.state().grasped and gripper.state().width < 0.005, "the fingers closed")


def test_a_hand_misses_and_loses_what_is_not_there(fr3: Bench) -> None:
    with fr3.open() as rig:
        miss_and_lose(rig)


def test_fingers_on_a_bus_hold_miss_and_lose(can: Bench) -> None:
    with can.open() as rig:
        arm = rig.robots["arm"]
        done = grasp(arm, prepare(rig), width=0.03, hold=0.3, **OPTIONS)
        assert done, done.message
        assert done.width == pytest.approx(0.03, abs=1e-3)
        bottom = AREA.cube["position"][2]
        wait_until(lambda: rig.world.pose("cube").position[2] - bottom > 0.05, "lifted")  # the world may be late
        assert arm.gripper is not None
        assert arm.gripper.state().force == pytest.approx(arm.gripper.spec.force, rel=0.2)
        miss_and_lose(rig)


def test_a_world_that_is_gone_shows_no_new_pictures() -> None:
    sets = ["objects=[floor]", f"cameras={tries.flow({'scene': tries.CAMERA})}"]
    rig_name = "yam_emulator"
    with EmulatorProcess(rig_name, *sets) as emulator, Bench(rig_name, emulator.overrides).open() as rig:
        camera = rig.cameras["scene"]
        camera.read(timeout=10.0)
        emulator.execute("kill")
        with pytest.raises(hal.StaleStateError):
            camera.read(after=rig.clock.now() + 0.5)
        with pytest.raises(hal.ConnectionLost, match="start the emulators"):
            rig.world.pose("floor")


def test_a_rig_with_another_scene_is_refused(fr3: Bench) -> None:
    with pytest.raises(hal.ConfigError, match="another scene") as found:
        fr3.open("objects=[floor, table]")
    assert [problem.code for problem in found.value.problems] == ["other_scene"]


def test_edits_of_the_world_are_drawn_and_undone_for_the_next_program(fr3: Bench) -> None:
    ball = hal.BodySpec("ball", (0.1, 0.3, 0.64), (0.0, 0.0, 0.0, 1.0), "sphere", radius=0.03, mass=0.1)
    with fr3.open() as rig:
        rig.world.add(ball)
        assert "ball" in rig.world.bodies
        frame = rig.cameras["scene"].read(after=rig.clock.now())
        assert frame.color is not None
        with pytest.raises(hal.DeviceNotFound):
            rig.world.pose("bell")
    with fr3.open() as rig:
        assert "ball" not in rig.world.bodies
