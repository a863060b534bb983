"""A whole laboratory with one command: every arm of a rig emulated, driven by ``hal.open``, with faults by name."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from waiting import wait_until

import hal
from hal.config.data_files import find_data
from hal.skills import grasp, grasp_pose, locate_by_truth
from hal_emulators.lab import list_emulators
from hal_emulators.robotiq.server import RobotiqEmulator, find_grippers
from hal_emulators.shared_world import has_world

from .franka_kit import free_host
from .network_kit import UR_PORTS

START = 60.0


class Lab:
    """The running command, and what it prints."""

    def __init__(self, config: Path) -> None:
        words = [sys.executable, "-m", "hal_emulators", "--config", str(config)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        self.process = subprocess.Popen(words, text=True, **pipes)  # type: ignore[call-overload]
        self.lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            print(line, end="")
            self.lines.put(line)

    def wait_line(self, wanted: Callable[[str], bool]) -> str:
        """Return the first line of the next ones that is wanted."""
        limit = time.monotonic() + START
        while True:
            line = self.lines.get(timeout=max(0.01, limit - time.monotonic()))
            if wanted(line):
                return line

    @property
    def children(self) -> list[Path]:
        """Its emulators' processes, until it has ended."""
        found = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return [Path("/proc", number) for number in found.read_text().split()] if self.process.poll() is None else []

    def type(self, line: str) -> None:
        """Type a line at the prompt."""
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()


@pytest.fixture
def config(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A UR5e with a Robotiq 2F-85 and a cube, and on request a YAM behind it, at addresses of this test's own."""
    channel = f"239.74.{128 + os.getpid() // 250 % 100}.{1 + os.getpid() % 250}"
    path = find_data("config", "ur5e_robotiq.yaml")
    text = path.read_text(encoding="utf-8").replace("127.0.0.2", free_host((*UR_PORTS, 63352)))
    rig = yaml.safe_load(text)
    rig["cameras"]["scene"]["capture"]["rate_hz"] = 6
    if getattr(request, "param", None) == "yam":  # all of it in motion in real time is too much for two processors
        rig["robots"]["right"] = {
            "model": "yam",
            "base": {"position": [-0.55, 1.5, 0.6]},
            "real": {"interface": "udp_multicast", "channel": channel},
        }
    path = tmp_path / "lab.yaml"
    path.write_text(yaml.safe_dump(rig), encoding="utf-8")
    return path


def check_ended(lab: Lab, children: list[Path]) -> None:
    """Check that it ends, and that its emulators end with it."""
    lab.process.wait(15.0)
    wait_until(lambda: not any(child.exists() for child in children), "emulators ended", timeout=15.0)


@pytest.fixture
def lab(config: Path) -> Iterator[Lab]:
    """The laboratory, ready."""
    lab = Lab(config)
    try:
        missing = {"arm", "robotiq"} | ({"can"} if "right" in yaml.safe_load(config.read_text())["robots"] else set())
        while missing:
            missing.discard(lab.wait_line(lambda line: "ready:" in line).partition(":")[0])
        yield lab
    finally:
        children = lab.children
        lab.process.kill()
        check_ended(lab, children)


def grasp_cube(config: Path, sim: bool) -> tuple[bool, float, float]:
    """Grasp the cube; return whether it is held, the width of the fingers and how far it is lifted, m."""
    with hal.open(config, sim=sim, pad="none", clock="lock_step" if sim else "real_time") as rig:
        arm = rig.robots["arm"]
        rig.cameras["scene"].read(timeout=10.0)  # meshes that are new take the renderer long beside five processes
        assert arm.gripper is not None
        if not sim:
            arm.gripper.home()
        arm.move_to(arm.home, speed=0.3, unattended=True)
        found = locate_by_truth(rig, arm, "cube")
        assert found is not None
        low = rig.world.pose("cube").position[2]
        done = grasp(arm, grasp_pose(found, arm.gripper), unattended=True)
        if done:  # the emulators' world may be late
            wait_until(lambda: rig.world.pose("cube").position[2] - low > 0.095, "the cube is lifted")
        return bool(done), done.width, rig.world.pose("cube").position[2] - low


@pytest.mark.alone
@pytest.mark.timeout(300)
def test_one_program_grasps_in_simulation_and_in_the_laboratory_and_a_typed_fault_stops_it(
    lab: Lab, config: Path
) -> None:
    for sim in (True, False):
        held, width, lifted = grasp_cube(config, sim)
        assert held
        assert width == pytest.approx(0.03, abs=2e-3)
        assert lifted == pytest.approx(0.1, abs=5e-3)
    lab.type("middle help")
    assert "arm, robotiq" in lab.wait_line(lambda line: "begin with the name" in line)
    with hal.open(config, sim=False, pad="none") as rig:
        arm = rig.robots["arm"]
        lab.type("arm protective")
        wait_until(lambda: arm.state().fault is not None, "the stop is known")
        with pytest.raises(hal.RobotFault, match="protective stop"):
            arm.move_to(arm.home, unattended=True)


@pytest.mark.parametrize("config", ["yam"], indirect=True)
def test_no_emulator_outlives_it(lab: Lab, config: Path) -> None:
    """Nor when it is killed, as every other test here does at its end."""
    children = lab.children
    assert len(children) == 3
    for _ in range(3):  # as impatient people do
        lab.process.send_signal(signal.SIGINT)
    check_ended(lab, children)


def test_it_names_a_model_that_has_no_emulator_and_knows_the_address_of_localhost(tmp_path: Path) -> None:
    arm, _ = list_emulators("ur5e_robotiq", ["robots.arm.real.host=localhost"])
    assert arm.arguments[1:5] == ["--robot", "ur5e", "--host", "127.0.0.1"]
    (arm,) = list_emulators("xarm7")
    assert arm.arguments == ["xarm", "--robot", "xarm7", "--host", "127.0.0.3", "--config", "xarm7"]
    (arm,) = list_emulators("xarm7", ["robots.arm.model=lite6"])
    assert arm.arguments[:3] == ["xarm", "--robot", "lite6"]
    model = tmp_path / "my_ur16e.yaml"
    model.write_bytes(find_data("robots", "ur5e.yaml").read_bytes())
    with pytest.raises(ValueError, match=r"arm: .*my_ur16e.* has no emulator, only ur10, ur10e, ur16e"):
        list_emulators("ur5e_robotiq", [f"robots.arm.model={model}"])


def test_a_simulated_arm_has_an_emulated_gripper(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    gripper = {"model": "robotiq_2f85", "sim": False, "real": {"port": str(tmp_path / "grip.emulated")}}
    path.write_text(yaml.safe_dump({"robots": {"arm": {"model": "panda", "gripper": gripper}}}), encoding="utf-8")
    assert [emulator.name for emulator in list_emulators(str(path))] == ["robotiq"]
    assert not has_world(str(path)), "the world is that of the program"
    with RobotiqEmulator(find_grippers(path)), hal.open(path, pad="none") as rig:
        rig.robots["arm"].gripper.home()
        assert rig.robots["arm"].gripper.move(0.04).width == pytest.approx(0.04, abs=1e-3)
