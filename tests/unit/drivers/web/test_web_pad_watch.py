"""A pad over a network: messages that are late, follow a gap, or have an old stamp move nothing."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.web.messages import CLOCK_AHEAD, MESSAGES_LATE, PAGE_SILENT, MalformedMessage, PadMessage
from hal.drivers.web.session import PadVerdict, PadWatch
from hal.servo.watchdog import PAD_SILENCE

T = 100.0


def message(seen: float, since: float) -> PadMessage:
    return PadMessage(seen, since, (0.0,) * 8, 0)


def watch(granted: float = T) -> PadWatch:
    return PadWatch(granted)


def connected(now: float = T) -> PadWatch:
    """A watch over a pad that spoke just now."""
    found = watch()
    assert found.judge(message(T, now - T), now) == PadVerdict(None, now)
    return found


def test_a_message_counts_from_the_time_that_it_proves() -> None:
    pad = watch()
    assert not pad.connected
    assert pad.judge(message(T, 0.010), T + 0.030) == PadVerdict(None, T + 0.010)
    assert pad.connected
    pad.stamp(T + 0.030)
    assert pad.judge(message(T + 0.030, 0.005), T + 0.050) == PadVerdict(None, T + 0.035)


def test_a_clock_that_runs_a_little_ahead_proves_no_more_than_now() -> None:
    assert watch().judge(message(T, 0.050), T + 0.020) == PadVerdict(None, T + 0.020)


def test_a_late_message_loses_the_pad() -> None:
    pad = connected()
    assert pad.judge(message(T, 0.020), T + 0.020 + PAD_SILENCE + 1e-6) == PadVerdict(MESSAGES_LATE)
    assert not pad.connected
    assert pad.judge(message(T, 0.040), T + 1.0) == PadVerdict(), "lost once"
    assert pad.judge(message(T, 1.0), T + 1.0) == PadVerdict(None, T + 1.0), "and comes back with one that is not late"
    assert pad.connected


def test_no_gap_no_loss() -> None:
    pad = connected()
    for k in range(1, 50):
        assert pad.judge(message(T, 0.119 * k), T + 0.119 * k) == PadVerdict(None, T + 0.119 * k)


def test_silence_is_noticed_without_a_message() -> None:
    pad = watch()
    assert pad.check_silence(T + 10.0) is None, "there was no pad yet"
    pad = connected()
    assert pad.check_silence(T + PAD_SILENCE - 0.001) is None
    assert pad.check_silence(T + PAD_SILENCE + 0.001) == PAGE_SILENT
    assert pad.check_silence(T + PAD_SILENCE + 0.002) is None
    assert pad.judge(message(T, 0.200), T + 0.200) == PadVerdict(None, T + 0.200)


def test_a_stamp_that_was_never_sent_is_malformed() -> None:
    pad = connected()
    with pytest.raises(MalformedMessage):
        pad.judge(message(T + 0.001, 0.0), T + 0.002)
    assert pad.connected
    pad.stamp(T + 0.001)
    assert pad.judge(message(T + 0.001, 0.0), T + 0.002).t_alive == T + 0.001


def test_a_stamp_from_before_the_lease_does_not_count() -> None:
    assert watch().judge(message(T - 0.01, 0.02), T + 0.01) == PadVerdict(None, None)


def test_a_page_whose_clock_jumped_ahead_does_not_count() -> None:
    """A computer that slept: its browser's clock went on, ours did not."""
    pad = connected()
    assert pad.judge(message(T, 3600.0), T + 0.02) == PadVerdict(CLOCK_AHEAD)
    assert not pad.connected


def test_a_backlog_after_a_stall_counts_only_from_where_it_is_fresh_and_after_a_loss() -> None:
    """One second without a network, then everything at once."""
    pad = connected()
    now = T + 1.0
    verdicts = [pad.judge(message(T, 0.02 * k), now) for k in range(1, 51)]
    fresh = [k for k, verdict in enumerate(verdicts, 1) if verdict.t_alive is not None]
    assert verdicts[0] == PadVerdict(MESSAGES_LATE)
    assert fresh == list(range(45, 51)), "those of the last 120 ms"
    assert all(verdict.lost is None for verdict in verdicts[1:])


@settings(deadline=None)
@given(st.randoms(use_true_random=False), st.floats(0.0, 0.4), st.floats(0.0, 0.4))
def test_over_any_network_only_recent_messages_count(chance: random.Random, up: float, down: float) -> None:
    """Messages and beats arrive in order, each after some time; sometimes the page freezes. What counts is young, and
    between two that count without a loss there is no silence."""
    pad, page, now = watch(), T, T
    seen, seen_at, arriving = T, T + down * chance.random(), T
    last_alive = last_said = -1.0
    beats: list[tuple[float, float]] = []
    page = seen_at
    for _ in range(60):
        page += 0.02 if chance.random() < 0.9 else chance.random()
        while beats and beats[0][1] <= page:
            seen, seen_at = beats.pop(0)
        arriving = max(arriving, page + up * chance.random() ** 4)
        now = arriving
        before = pad.connected
        verdict = pad.judge(message(seen, page - seen_at), now)
        beat = pad.stamp(now)
        beats.append((beat, max([now + down * chance.random() ** 4, *(at for _, at in beats)])))
        if verdict.t_alive is None:
            continue
        assert now - PAD_SILENCE <= verdict.t_alive <= now
        assert verdict.t_alive <= page + 1e-9, "never later than it was said"
        assert verdict.t_alive >= last_alive, "time does not go back"
        if before and verdict.lost is None:
            assert verdict.t_alive - last_alive <= PAD_SILENCE
            assert page - last_said <= 2 * PAD_SILENCE
        last_alive, last_said = verdict.t_alive, page
