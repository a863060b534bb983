"""The checks before a motion: of arms and cameras by their drivers, and of this computer on made-up system files."""

from __future__ import annotations

import itertools
import os
import resource
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from hal.config import load
from hal.driver import CameraDriver, RawFrame
from hal.errors import DriverMissing
from hal.preflight import CheckResult, check_frames, check_machine, has_realtime_kernel, list_real_arms, preflight
from hal.registry import DriverSpec
from hal.specs import CameraSpec, Plan, RobotSpec
from hal.testing import camera_spec

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs Linux")


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    yield CheckResult("link", "ok", f"{spec.name} for {duration:g} s")
    if spec.options.get("broken"):
        raise DriverMissing("no library; pip install it")


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch) -> Plan:
    """A rig with one arm that counts as real."""
    module = ModuleType("checked_driver")
    vars(module).update(check=check, DRIVER=DriverSpec("checked_driver", preflight="checked_driver:check"))
    monkeypatch.setitem(sys.modules, "checked_driver", module)
    plan = load("panda_table", sim=True).resolve()
    return replace(plan, robots=tuple(replace(r, driver="checked_driver:DRIVER", attended=True) for r in plan.robots))


def of_arms(plan: Plan) -> list[CheckResult]:
    return [v for v in preflight(plan, 0.25) if ":" in v.name]


def test_a_simulated_rig_has_only_the_machine_and_its_engine_to_check() -> None:
    plan = load("panda_table", sim=True).resolve()
    assert list_real_arms(plan) == ()
    bare = replace(plan, cameras=())
    assert [v.name for v in preflight(bare)] == ["kernel", "processor", "scheduling", "memory", "simulation"]


def test_simulated_cameras_need_a_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = load("panda_table", sim=True).resolve()
    *_, drawn = preflight(plan, machine=False)
    assert (drawn.name, drawn.level) == ("renderer", "ok")
    assert [camera.name in drawn.found for camera in plan.cameras] == [True, True]
    missing = DriverMissing("no EGL; apt install it")
    monkeypatch.setattr("hal.drivers.scene.camera.choose_renderer", lambda *_: (_ for _ in ()).throw(missing))
    *_, failed = preflight(plan, machine=False)
    assert (failed.name, failed.level) == ("renderer", "fail")
    assert [v.name for v in preflight(plan, machine=False, cameras=False)] == ["simulation"]


def test_an_arm_is_checked_by_its_driver_under_its_own_name(plan: Plan) -> None:
    assert of_arms(plan) == [CheckResult("panda: link", "ok", "panda for 0.25 s")]


def test_an_emulated_arm_is_checked_too(plan: Plan) -> None:
    emulated = replace(plan, robots=(replace(plan.robots[0], attended=False, emulated=True),))
    assert of_arms(emulated) == of_arms(plan)


def test_a_check_that_raises_is_a_failure_after_its_first_results(plan: Plan) -> None:
    broken = replace(plan, robots=(replace(plan.robots[0], options={"broken": True}),))
    first, last = of_arms(broken)
    assert first.level == "ok"
    assert last.level == "fail"
    assert "pip install it" in last.found


def test_a_driver_without_a_check_is_unknown(plan: Plan) -> None:
    (found,) = of_arms(replace(plan, robots=(replace(plan.robots[0], driver="mock"),)))
    assert found.level == "unknown"
    assert "'mock'" in found.found


def test_an_unknown_driver_is_a_failure(plan: Plan) -> None:
    (found,) = of_arms(replace(plan, robots=(replace(plan.robots[0], driver="nothing:DRIVER"),)))
    assert found.level == "fail"


def test_a_camera_is_checked_by_its_driver_unless_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def look(spec: CameraSpec, duration: float) -> Iterator[CheckResult]:
        yield CheckResult("rate", "ok", f"{spec.rate_hz:g} Hz over {duration:g} s")

    module = ModuleType("checked_camera")
    vars(module).update(look=look, DRIVER=DriverSpec("checked_camera", camera_preflight="checked_camera:look"))
    monkeypatch.setitem(sys.modules, "checked_camera", module)
    plan = load("panda_table", sim=True).resolve()
    first, *others = plan.cameras
    plan = replace(plan, cameras=(replace(first, driver="checked_camera:DRIVER"), *others))
    assert of_arms(plan) == [CheckResult(f"{first.name}: rate", "ok", "30 Hz over 0.25 s")]
    assert [v for v in preflight(plan, 0.25, cameras=False) if ":" in v.name] == []


class CountingCamera(CameraDriver):
    """Takes frames at a rate, of which every n-th arrives."""

    def __init__(self, rate_hz: float, nth: int) -> None:
        super().__init__(camera_spec())
        self.rate_hz, self.numbers = rate_hz, itertools.count(7, nth)

    def open(self) -> None: ...

    def close(self) -> None: ...

    def grab(self, timeout: float) -> RawFrame | None:
        number = next(self.numbers)
        return RawFrame(number / self.rate_hz, 0.0, number) if self.rate_hz else None


@pytest.mark.parametrize(
    ("rate_hz", "nth", "level", "remedy"),
    [
        (30.0, 1, "ok", ""),
        (29.0, 1, "ok", ""),
        (15.0, 1, "warn", "slow"),
        (30.0, 2, "warn", "lossy"),
        (15.0, 2, "warn", "slow"),
        (0.0, 1, "fail", "silent"),
    ],
)
def test_slow_cameras_and_lost_frames_have_remedies_of_their_own(
    rate_hz: float, nth: int, level: str, remedy: str
) -> None:
    found = check_frames(CountingCamera(rate_hz, nth), 0.01, "slow", "lossy", "silent")
    assert (found.level, found.remedy) == (level, remedy), found.found


# This computer

ORDINARY = "Linux version 6.8.0-45-generic (buildd@x) #45-Ubuntu SMP PREEMPT_DYNAMIC Fri Aug 30 12:02:04 UTC 2024"
CAPABLE, INCAPABLE = "CapEff:\t000001ffffffffff", "CapEff:\t0000000000000000"


def write(root: Path, **files: str) -> Path:
    """Write files, named by their paths with ``__`` for a slash."""
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return root


def machine_check(root: Path, name: str) -> CheckResult:
    return next(v for v in check_machine(root) if v.name == name)


@linux
@pytest.mark.parametrize(
    "version",
    [
        "Linux version 6.12.38-rt-amd64 (x) #1 SMP PREEMPT_RT Debian 6.12.38-1",
        "Linux version 5.9.1-rt20 (x) #1 SMP PREEMPT_RT Thu Mar 4",
        "Linux version 4.14.12-rt10 (x) #1 SMP PREEMPT RT Wed Apr 24",
    ],
)
def test_a_real_time_kernel_is_recognised_by_its_name(tmp_path: Path, version: str) -> None:
    write(tmp_path, proc__version=version)
    assert has_realtime_kernel(tmp_path) is True
    assert machine_check(tmp_path, "kernel").level == "ok"


@linux
def test_a_real_time_kernel_is_recognised_by_its_file(tmp_path: Path) -> None:
    write(tmp_path, proc__version=ORDINARY, sys__kernel__realtime="1")
    assert has_realtime_kernel(tmp_path) is True


@linux
@pytest.mark.parametrize(
    ("release", "remedy"),
    [
        ("ID=ubuntu", "sudo pro enable realtime-kernel"),
        ('NAME="Debian"\nID="debian"', "sudo apt install linux-image-rt-amd64"),
        ("ID=arch", "PREEMPT_RT"),
    ],
)
def test_an_ordinary_kernel_is_a_warning_with_the_command_for_this_system(
    tmp_path: Path, release: str, remedy: str
) -> None:
    write(tmp_path, proc__version=ORDINARY, etc__os_release="")
    (tmp_path / "etc/os-release").write_text(release)
    found = machine_check(tmp_path, "kernel")
    assert has_realtime_kernel(tmp_path) is False
    assert found.level == "warn"
    assert remedy in found.remedy


@linux
def test_what_cannot_be_checked_is_unknown(tmp_path: Path) -> None:
    assert has_realtime_kernel(tmp_path) is None
    assert machine_check(tmp_path, "kernel").level == "unknown"
    assert machine_check(tmp_path, "processor").level == "unknown"


@linux
@pytest.mark.parametrize(
    ("governors", "level"),
    [(["performance", "performance"], "ok"), (["performance", "powersave"], "warn"), (["schedutil"] * 2, "warn")],
)
def test_processors_that_save_power_are_a_warning(tmp_path: Path, governors: list[str], level: str) -> None:
    for k, governor in enumerate(governors):
        write(tmp_path, **{f"sys__devices__system__cpu__cpu{k}__cpufreq__scaling_governor": governor})
    found = machine_check(tmp_path, "processor")
    assert found.level == level
    if level == "warn":
        assert set(governors) - {"performance"} == {found.found.split("governor ")[1].strip(")")}
        assert "tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor" in found.remedy


@linux
@pytest.mark.parametrize(
    ("capabilities", "limit", "level"),
    [
        (CAPABLE, 2**16, "ok"),
        (INCAPABLE, resource.RLIM_INFINITY, "ok"),
        (INCAPABLE, 2**26, "warn"),
        ("", 2**26, "unknown"),
    ],
)
def test_memory_may_be_locked_by_capability_or_by_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capabilities: str, limit: int, level: str
) -> None:
    write(tmp_path, proc__self__status=f"Name:\tpython\n{capabilities}")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    found = machine_check(tmp_path, "memory")
    assert found.level == level
    if level == "warn":
        assert "64 MiB" in found.found
        assert "memlock" in found.remedy


@linux
def test_this_computer_gets_every_result_and_keeps_its_scheduling() -> None:
    before = os.sched_getscheduler(0)
    found = list(check_machine())
    assert [v.name for v in found] == ["kernel", "processor", "scheduling", "memory"]
    assert all(v.remedy for v in found if v.level in ("warn", "fail"))
    assert os.sched_getscheduler(0) == before


@linux
def test_no_right_to_real_time_scheduling_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    found = machine_check(Path("/"), "scheduling")
    assert found.level == "warn"
    assert "rtprio 99" in found.remedy
