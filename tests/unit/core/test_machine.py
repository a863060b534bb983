"""What is said of this computer, on made-up files of the system: never ok where nobody could look."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import pytest

from hal.preflight import CheckResult, check_machine, has_realtime_kernel

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs Linux")

ORDINARY = "Linux version 6.8.0-45-generic (buildd@x) #45-Ubuntu SMP PREEMPT_DYNAMIC Fri Aug 30 12:02:04 UTC 2024"
CAPABLE, INCAPABLE = "CapEff:\t000001ffffffffff", "CapEff:\t0000000000000000"


def write(root: Path, **files: str) -> Path:
    """Files by their paths, with ``__`` for a slash."""
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return root


def verdict(root: Path, name: str) -> CheckResult:
    return next(v for v in check_machine(root) if v.name == name)


@pytest.mark.parametrize(
    "version",
    [
        "Linux version 6.12.38-rt-amd64 (x) #1 SMP PREEMPT_RT Debian 6.12.38-1",
        "Linux version 5.9.1-rt20 (x) #1 SMP PREEMPT_RT Thu Mar 4",
        "Linux version 4.14.12-rt10 (x) #1 SMP PREEMPT RT Wed Apr 24",
    ],
)
def test_a_real_time_kernel_is_known_by_its_name(tmp_path: Path, version: str) -> None:
    write(tmp_path, proc__version=version)
    assert has_realtime_kernel(tmp_path) is True
    assert verdict(tmp_path, "kernel").level == "ok"


def test_a_real_time_kernel_is_known_by_its_file(tmp_path: Path) -> None:
    write(tmp_path, proc__version=ORDINARY, sys__kernel__realtime="1")
    assert has_realtime_kernel(tmp_path) is True


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
    found = verdict(tmp_path, "kernel")
    assert has_realtime_kernel(tmp_path) is False
    assert found.level == "warn"
    assert remedy in found.remedy


def test_what_cannot_be_looked_at_is_unknown(tmp_path: Path) -> None:
    assert has_realtime_kernel(tmp_path) is None
    assert verdict(tmp_path, "kernel").level == "unknown"
    assert verdict(tmp_path, "processor").level == "unknown"


@pytest.mark.parametrize(
    ("governors", "level"),
    [(["performance", "performance"], "ok"), (["performance", "powersave"], "warn"), (["schedutil"] * 2, "warn")],
)
def test_processors_that_save_power_are_a_warning(tmp_path: Path, governors: list[str], level: str) -> None:
    for k, governor in enumerate(governors):
        write(tmp_path, **{f"sys__devices__system__cpu__cpu{k}__cpufreq__scaling_governor": governor})
    found = verdict(tmp_path, "processor")
    assert found.level == level
    if level == "warn":
        assert set(governors) - {"performance"} == {found.found.split("governor ")[1].strip(")")}
        assert "tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor" in found.remedy


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
    found = verdict(tmp_path, "memory")
    assert found.level == level
    if level == "warn":
        assert "64 MiB" in found.found
        assert "memlock" in found.remedy


def test_this_computer_gets_a_verdict_of_each_kind_and_keeps_its_scheduling() -> None:
    import os

    before = os.sched_getscheduler(0)
    found = list(check_machine())
    assert [v.name for v in found] == ["kernel", "processor", "scheduling", "memory"]
    assert all(v.remedy for v in found if v.level in ("warn", "fail"))
    assert os.sched_getscheduler(0) == before


def test_without_the_right_real_time_scheduling_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    found = verdict(Path("/"), "scheduling")
    assert found.level == "warn"
    assert "rtprio 99" in found.remedy
