"""Emulated CAN arms under gravity: at rest, on a recorded drive, and after the end of their program."""

from __future__ import annotations

from pathlib import Path

import pytest
from can_proofs import end, rest, tour

from .calm_tour import Held, write_pad

pytestmark = pytest.mark.pair

DRIVE: tuple[Held, ...] = (
    (0.6, 1.6, "ABS_HAT0Y", -1, 0),  # forwards
    (1.0, 2.2, "ABS_HAT0X", -1, 0),  # to the left
    (1.8, 2.8, "BTN_TR", 1, 0),  # down
    (2.4, 3.2, "ABS_RX", 190, 128),
    (0.3, 3.6, "ABS_Z", 255, 0),  # L2, the dead-man
    (0.3, 3.6, "BTN_TL2", 1, 0),
)


def test_an_arm_rests_where_it_was_sent() -> None:
    """With a payload that the rig gives; then also 20 % heavier than its model, and with friction."""
    payload = "robots.arm.payload={mass: 0.3, position: [0, 0, 0.02]}"
    (right,), (heavier,) = rest("yam", 1, [(1.0, 0.0), (1.2, 1.0)], payload)
    assert right.distance <= 1e-3
    assert heavier.distance <= 15e-3
    assert heavier.distance > right.distance
    assert max(right.speed, heavier.speed) <= 0.02


def test_a_recorded_drive_ends_where_it_does_in_simulation(tmp_path: Path) -> None:
    for _ in range(3):  # a computer that is too busy stops the arm
        drive = tour("yam", write_pad(tmp_path / "drive.jsonl", DRIVE, 4.2), tmp_path)
        if not drive.trips:
            break
    assert drive.travel > 0.1
    assert drive.trips == []
    assert drive.apart <= 3e-3
    assert drive.turned <= 0.01


@pytest.mark.parametrize(("way", "fastest"), [("app killed", 0.5), ("host killed", 0.7)])
def test_an_arm_without_its_program_sinks_slowly(way: str, fastest: float) -> None:
    """The program's own end lowers the arm; else only the motors damp, by as much as the emulator assumes."""
    found = end("yam", way, seconds=2.5)
    assert found.before > 0.3
    assert found.sunk > 0.1
    assert found.after <= fastest
