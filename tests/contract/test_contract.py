"""The contracts themselves: they notice what is wrong, say what to do, and ask for nothing but pytest."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hal.testing import CameraContract, Contract, GamepadContract, GripperContract, RobotContract

HERE = Path(__file__).parent

NOTICED = {
    "TestShortPictures": ("test_a_frame_has_the_streams_the_size_and_the_units_of_its_spec", "wants (48, 64"),
    "TestMillimetres": ("test_a_frame_has_the_streams_the_size_and_the_units_of_its_spec", "depth is in metres"),
    "TestOneBuffer": ("test_a_frame_that_was_handed_out_is_never_written_to_again", "hand out copies"),
    "TestOldFrames": ("test_without_a_frame_grab_ends_in_time", "never an old one again"),
    "TestOwnErrors": ("test_a_lost_link_is_an_error_and_never_at_close", "must raise hal.errors.ConnectionLost"),
    "TestWallClock": ("test_frames_are_new_and_stamped", "on the host's clock"),
    "TestWideLens": ("test_it_says_what_it_is", "principal point"),
    "TestDegrees": ("test_open_moves_nothing_and_reads", "rad, base to tip"),
    "TestNewStamps": ("test_a_device_that_freezes_shows_by_its_old_stamps", "return the last reading again"),
    "TestSlowRead": ("test_reading_and_writing_do_not_block", "never block"),
    "TestLimp": ("test_halt_holds_and_may_be_repeated", "halt holds where the arm is"),
    "TestFaultWithoutRemedy": ("test_a_fault_has_a_cause_and_a_remedy_and_ends_with_recover", "what a person can do"),
    "TestOpensAtStop": ("test_stop_stays_where_it_is", "stop stays where it is"),
    "TestFullSpeed": ("test_it_moves_to_a_width_at_the_speed_asked_for[0.25]", "asked for 0.05 m/s"),
    "TestOpensAtClose": ("test_close_does_not_move_the_fingers_and_may_be_repeated", "close leaves the fingers"),
    "TestAlwaysAlive": ("test_the_silence_of_a_pad_ages_its_proof_of_life", "t_alive stands still"),
    "TestStuckButtons": ("test_nothing_is_pressed_on_a_pad_that_is_unplugged", "nothing is pressed on a pad"),
    "TestCounts": ("test_names_and_ranges", "left_x goes from -1 to 1"),
    "TestWaits": ("test_a_poll_that_was_told_not_to_wait_does_not", "it must not wait"),
    "TestNoBench": ("test_it_says_what_it_is", "give it a fixture `bench`"),
    "TestForgotten": ("test_it_says_what_it_is", "the bench has no 'lose'"),
    "TestBoth": ("test_it_says_what_it_is", "leaves out 'lose', but its bench has one"),
}
"""Class of ``wrong_drivers.py`` -> a check that fails, and words of what it says."""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What pytest says of the drivers that are wrong, as somebody's own tests, in a folder far from here."""
    folder = tmp_path_factory.mktemp("elsewhere")
    shutil.copy(HERE / "wrong_drivers.py", folder / "test_wrong.py")
    wanted = " or ".join(f"({name} and {check.partition('[')[0]})" for name, (check, _) in NOTICED.items())
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--tb=short", "-k", wanted, "test_wrong.py"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=100)
    assert "passed" not in done.stdout.splitlines()[-1] or done.returncode == 1, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("name", NOTICED)
def test_what_is_wrong_is_noticed_and_told(said: str, name: str) -> None:
    check, words = NOTICED[name]
    report = re.search(
        rf"^_+ (?:ERROR at setup of )?{name}\.{re.escape(check)} _+$(.*?)^(?:___|===)", said, re.M | re.S
    )
    assert report is not None, f"{name}.{check} did not fail:\n{said[-3000:]}"
    assert words in report[1], report[1]


def test_assertions_say_what_they_compared_in_other_peoples_tests_too(said: str) -> None:
    assert "E   assert ((47, 64, 3), dtype('uint8')) == ((48, 64, 3), dtype('uint8'))" in said


def test_a_check_that_is_left_out_is_not_collected_and_not_skipped() -> None:
    class Without(CameraContract, left_out={"freeze": "it cannot be stopped"}):
        pass

    assert Without.test_without_a_frame_grab_ends_in_time is None
    assert Without.test_a_lost_link_is_an_error_and_never_at_close is not None
    assert CameraContract.test_without_a_frame_grab_ends_in_time is not None


@pytest.mark.parametrize(
    ("left_out", "says"),
    [({"looze": "no link"}, "there is no 'looze'; there are: lose, restore"), ({"lose": " "}, "say why")],
)
def test_what_is_left_out_must_be_known_and_have_a_reason(left_out: dict[str, str], says: str) -> None:
    with pytest.raises(TypeError, match=says):
        type("Wrong", (CameraContract,), {}, left_out=left_out)


@pytest.mark.parametrize("contract", [RobotContract, GripperContract, CameraContract, GamepadContract])
def test_every_ability_is_asked_for_by_some_check(contract: type[Contract]) -> None:
    asked = {ability for name in dir(contract) for ability in getattr(getattr(contract, name), "needs", ())}
    assert asked == set(contract.abilities)


def test_importing_the_hal_imports_no_pytest() -> None:
    code = "import sys, hal, hal.registry; assert 'pytest' not in sys.modules and 'hal.testing' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_without_pytest_it_says_what_to_install() -> None:
    code = "import sys; sys.modules['pytest'] = None; import hal.testing"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "hal.testing needs pytest" in done.stderr
    assert "pip install pytest" in done.stderr


def test_the_driver_of_the_docs_and_its_test_are_less_than_a_hundred_lines() -> None:
    text = (HERE.parents[1] / "docs" / "test-a-driver.md").read_text()
    files = dict(re.findall(r"<!-- file: (\S+) -->\n```python\n(.*?)^```", text, re.S | re.M))
    assert sum(files[name].count("\n") for name in ("net_camera.py", "test_net_camera.py")) < 100
