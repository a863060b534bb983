"""The engines of the simulated world as each other's referee: one recorded drive has the same course on each."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from engines_kit import has_engine
from referee_kit import TourRun, draw_state, drive_tour

from hal import registry

APART, TURNED = 0.002, 0.01
"""How far the ends of a drive may be apart, m and rad."""


@pytest.fixture(scope="module")
def tours() -> dict[str, TourRun]:
    """Return the recorded tour on each engine that is installed."""
    return {name: drive_tour(name) for name in registry.ENGINES if has_engine(name)}


def test_the_tour_turns_the_wrist_moves_the_gripper_and_releases_in_motion(tours: dict[str, TourRun]) -> None:
    for name, tour in tours.items():
        assert np.ptp(tour.q[:, 6]) > 0.3, f"{name}: the hand turned"
        assert tour.width.min() < 0.2 * tour.width.max(), f"{name}: the fingers closed"
        assert tour.width[-1] > 0.9 * tour.width.max(), f"{name}: and opened again"
        assert tour.touched is None, f"{name}: the tour touches nothing"
        assert len(tour.releases) >= 2, name
        assert max(tour.releases) > 0.05, f"{name}: the dead-man was released in mid-motion"


def test_the_servo_sends_the_same_set_points_to_every_engine(tours: dict[str, TourRun]) -> None:
    """To the bit, as long as the arm touches nothing: what the engine reports back moves no set-point."""
    for (one, a), (other, b) in itertools.combinations(tours.items(), 2):
        assert a.q_set.shape == b.q_set.shape, (one, other)
        assert np.array_equal(a.q_set, b.q_set), (one, other)


def test_the_arm_ends_where_it_does_on_every_engine(tours: dict[str, TourRun]) -> None:
    for (one, a), (other, b) in itertools.combinations(tours.items(), 2):
        distance, angle = a.end.distance(b.end)
        assert distance < APART, (one, other)
        assert angle < TURNED, (one, other)


def test_one_state_gives_one_picture_on_every_engine() -> None:
    """To the pixel, in colour and depth: what draws has no physics engine."""
    first, *others = [name for name in registry.ENGINES if has_engine(name)]
    frames, state = draw_state(first)
    for other in others:
        again, _ = draw_state(other, state)
        for camera, frame in frames.items():
            assert frame.color is not None
            assert frame.color.std() > 10.0, f"{camera} shows something"
            assert np.array_equal(frame.color, again[camera].color), (camera, other)
            assert np.array_equal(frame.depth, again[camera].depth), (camera, other)
