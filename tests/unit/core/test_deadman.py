"""The dead-man switch: when it counts as held, and what its listeners get."""

from __future__ import annotations

import math
import threading

import pytest
from errors_kit import raises_code

from hal.commands import DeadmanRecord
from hal.deadman import Deadman, Threshold
from hal.errors import NotSupported


def test_a_trigger_is_held_from_the_press_threshold_until_below_the_release_threshold() -> None:
    threshold = Threshold(press=0.5, release=0.3)
    travel = [0.0, 0.49, 0.5, 0.4, 0.3, 0.29, 0.4, 1.0, 0.0]
    assert [threshold.update(value) for value in travel] == [False, False, True, True, True, False, False, True, False]


def test_a_trigger_that_is_not_a_number_is_released() -> None:
    threshold = Threshold()
    assert threshold.update(1.0)
    assert not threshold.update(math.nan)


@pytest.mark.parametrize(("press", "release"), [(0.3, 0.5), (1.1, 0.3), (0.5, 0.0)])
def test_invalid_thresholds_are_refused(press: float, release: float) -> None:
    with pytest.raises(ValueError, match="thresholds"):
        Threshold(press, release)


def test_it_counts_only_after_it_was_seen_released() -> None:
    deadman = Deadman("test")
    assert not deadman.update(pressed=True, connected=True, t_alive=0.0).held
    assert not deadman.update(pressed=False, connected=True, t_alive=0.1).held
    record = deadman.update(pressed=True, connected=True, t_alive=0.2)
    assert record == DeadmanRecord(held=True, connected=True, presses=1, t_alive=0.2)


def test_after_an_interruption_it_must_be_released_and_pressed_again() -> None:
    deadman = Deadman("test")
    deadman.update(False, True, 0.0)
    assert deadman.update(True, True, 0.1).held
    assert not deadman.update(True, False, 0.1).held
    back = deadman.update(True, True, 0.5)
    assert not back.held
    assert back.connected
    deadman.update(False, True, 0.6)
    assert deadman.update(True, True, 0.7).presses == 2


def test_a_release_while_it_is_disconnected_does_not_arm_it() -> None:
    deadman = Deadman("test")
    deadman.update(False, False, 0.0)
    assert not deadman.update(True, True, 0.1).held


def test_listeners_get_the_present_state_at_once_and_then_every_update() -> None:
    deadman = Deadman("test")
    deadman.update(False, True, 1.0)
    seen: list[DeadmanRecord] = []
    detach = deadman.attach(seen.append)
    deadman.update(True, True, 2.0)
    deadman.update(True, True, 3.0)  # only the heartbeat changed, which the watchdog needs
    detach()
    detach()
    deadman.update(False, True, 4.0)
    assert [(record.held, record.t_alive) for record in seen] == [(False, 1.0), (True, 2.0), (True, 3.0)]


def test_the_same_listener_may_be_attached_twice_and_detached_once() -> None:
    deadman = Deadman("test")
    seen: list[DeadmanRecord] = []
    first = deadman.attach(seen.append)
    deadman.attach(seen.append)
    first()
    first()
    seen.clear()
    deadman.update(False, True, 1.0)
    assert len(seen) == 1


def test_a_listener_that_fails_is_dropped_and_does_not_disturb_the_others() -> None:
    deadman = Deadman("test")
    seen: list[DeadmanRecord] = []
    calls: list[DeadmanRecord] = []

    def broken(record: DeadmanRecord) -> None:
        calls.append(record)
        if len(calls) == 2:
            raise OSError("the host is gone")

    deadman.attach(broken)
    deadman.attach(seen.append)
    for k in range(3):
        deadman.update(False, True, float(k))
    assert len(calls) == 2
    assert len(seen) == 4
    assert isinstance(deadman.error, OSError)


def test_updates_and_attachments_from_many_threads_lose_no_press() -> None:
    deadman = Deadman("test")
    presses: list[int] = []
    deadman.attach(lambda record: presses.append(record.presses))
    rounds = 300

    def come_and_go() -> None:
        for _ in range(rounds):
            deadman.attach(lambda record: None)()

    threads = [threading.Thread(target=come_and_go) for _ in range(3)]
    for thread in threads:
        thread.start()
    for k in range(rounds):
        deadman.update(False, True, float(k))
        deadman.update(True, True, float(k))
    for thread in threads:
        thread.join()
    assert deadman.record.presses == rounds
    assert presses == sorted(presses)


def test_a_switch_that_may_fall_silent_is_refused_even_when_the_device_changes_later() -> None:
    reasons: list[str | None] = ["it may fall silent"]
    deadman = Deadman("test", lambda: reasons[0])
    with raises_code(NotSupported, "deadman_not_trusted"):
        deadman.check_trust()
    deadman.update(False, True, 0.0)
    assert deadman.update(True, True, 0.1).held  # trust was not required: in simulation it may be used

    reasons[0] = None
    deadman.check_trust()
    assert deadman.update(True, True, 0.2).held
    reasons[0] = "another pad was plugged in"
    assert not deadman.update(True, True, 0.3).held
    reasons[0] = None
    assert not deadman.update(True, True, 0.4).held
    deadman.update(False, True, 0.5)
    assert deadman.update(True, True, 0.6).held
