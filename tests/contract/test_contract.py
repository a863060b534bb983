"""The contracts themselves: a wrong driver fails them, and they need nothing but pytest."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hal.testing import CameraContract, Contract, GamepadContract, GripperContract, RobotContract, WorldContract

HERE = Path(__file__).parent

NOTICED = {
    "TestShortPictures": "test_frames_have_the_streams_size_and_units_of_the_spec",
    "TestMillimetres": "test_frames_have_the_streams_size_and_units_of_the_spec",
    "TestOneBuffer": "test_a_returned_frame_is_never_written_to_again",
    "TestOldFrames": "test_without_a_frame_grab_returns_in_time",
    "TestOwnErrors": "test_a_lost_link_raises_except_at_close",
    "TestWallClock": "test_frames_are_new_and_stamped",
    "TestWideLens": "test_info_describes_the_camera",
    "TestDegrees": "test_open_does_not_move_the_arm",
    "TestNewStamps": "test_a_frozen_device_repeats_its_stamps",
    "TestSlowRead": "test_read_and_write_do_not_block",
    "TestLimp": "test_halt_holds_and_may_be_repeated",
    "TestSinks": "test_without_a_host_the_arm_holds",
    "TestJumpsWhenEngaged": "test_engage_moves_nothing_and_halt_keeps_it",
    "TestFaultWithoutRemedy": "test_a_fault_has_cause_code_and_remedy_until_recover",
    "TestOpensAtStop": "test_stop_holds_the_width",
    "TestFullSpeed": "test_moves_reach_their_width_at_their_speed[0.25]",
    "TestOpensAtClose": "test_close_does_not_move_the_fingers_and_may_be_repeated",
    "TestAlwaysAlive": "test_t_alive_stops_when_the_pad_is_silent",
    "TestStuckButtons": "test_an_unplugged_pad_is_released",
    "TestCounts": "test_names_and_ranges",
    "TestWaits": "test_a_poll_without_time_out_does_not_wait",
    "TestStalePoses": "test_bodies_stand_where_their_records_place_them",
    "TestMoreThanPoses": "test_edits_are_counted_and_announced",
    "TestNoBench": "test_info_describes_the_camera",
    "TestForgotten": "test_info_describes_the_camera",
    "TestBoth": "test_describe_names_the_device",
}
"""Class of ``wrong_drivers.py`` -> a check that must fail."""


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The output of pytest for the wrong drivers, in a folder outside this repository."""
    folder = tmp_path_factory.mktemp("elsewhere")
    shutil.copy(HERE / "wrong_drivers.py", folder / "test_wrong.py")
    wanted = " or ".join(f"({name} and {check.partition('[')[0]})" for name, check in NOTICED.items())
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--tb=short", "-k", wanted, "test_wrong.py"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=100)
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("name", NOTICED)
def test_a_wrong_driver_fails_its_check(output: str, name: str) -> None:
    title = rf"^_+ (?:ERROR at setup of )?{name}\.{re.escape(NOTICED[name])} _+$"
    assert re.search(title, output, re.M), f"{name}.{NOTICED[name]} did not fail:\n{output[-3000:]}"


def test_a_failed_check_shows_the_compared_values_and_what_to_do(output: str) -> None:
    assert "E   assert ((47, 64, 3), dtype('uint8')) == ((48, 64, 3), dtype('uint8'))" in output
    assert "color: must be (48, 64, 3) of uint8" in output
    assert "neither bench nor driver has 'lose': add it" in output


def test_a_check_that_is_left_out_is_not_collected() -> None:
    class Without(CameraContract, left_out={"freeze": "it cannot be stopped"}):
        pass

    assert Without.test_without_a_frame_grab_returns_in_time is None
    assert Without.test_a_lost_link_raises_except_at_close is not None
    assert CameraContract.test_without_a_frame_grab_returns_in_time is not None


@pytest.mark.parametrize("left_out", [{"looze": "no link"}, {"lose": " "}])
def test_what_is_left_out_must_be_known_and_have_a_reason(left_out: dict[str, str]) -> None:
    with pytest.raises(TypeError):
        type("Wrong", (CameraContract,), {}, left_out=left_out)


@pytest.mark.parametrize("contract", [RobotContract, GripperContract, CameraContract, GamepadContract, WorldContract])
def test_every_ability_is_needed_by_a_check(contract: type[Contract]) -> None:
    needed = {ability for name in dir(contract) for ability in getattr(getattr(contract, name), "needs", ())}
    assert needed == set(contract.abilities)


def test_importing_hal_imports_no_pytest() -> None:
    code = "import sys, hal, hal.registry; assert 'pytest' not in sys.modules and 'hal.testing' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_without_pytest_the_error_names_it() -> None:
    code = "import sys; sys.modules['pytest'] = None; import hal.testing"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "hal.testing needs pytest" in done.stderr
    assert "pip install pytest" in done.stderr
