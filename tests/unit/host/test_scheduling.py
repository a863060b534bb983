"""How a servo's host is scheduled, with and without the right to real-time priority."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import hal
from hal.host.process import Child
from hal.host.scheduling import PRIORITY, describe, is_realtime
from hal.preflight import check_machine, may_lock_memory

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs Linux")

KERNEL = tuple(int(part) for part in os.uname().release.split(".")[:2])
START = Callable[..., Child]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[START]:
    """Start a child that prepares itself as a host does."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "kits"))
    children: list[Child] = []

    def started(realtime: bool = True, refused: bool = False) -> Child:
        child = Child("scheduled", "child_targets:scheduled", {"realtime": realtime, "refused": refused})
        children.append(child)
        child.wait_ready(20.0)
        return child

    yield started
    for child in children:
        child.close()


def allowed() -> bool:
    return next(verdict for verdict in check_machine() if verdict.name == "scheduling").level == "ok"


def test_a_host_gets_real_time_priority_where_the_user_has_the_right(start: START) -> None:
    ready = start().ready
    assert ready["realtime"] is allowed()
    assert ready["text"].startswith("SCHED_FIFO" if allowed() else "default")
    assert (ready["locked_kb"] > 1000) is may_lock_memory()
    assert ready["threads"] == ([PRIORITY - 1, 0] if allowed() else [0, 0])  # noted, and another one


def test_without_the_right_it_gets_a_short_slice_where_the_kernel_has_them(start: START) -> None:
    ready = start(refused=True).ready
    assert not ready["realtime"]
    if KERNEL >= (6, 12):
        assert ready["text"] == "default, slice of 0.1 ms"


def test_a_host_that_does_not_ask_stays_as_it_is(start: START) -> None:
    ready = start(realtime=False).ready
    assert not ready["realtime"]
    assert ready["text"] == describe()
    assert ready["threads"] == [0, 0]
    assert ready["locked_kb"] == 0


@pytest.mark.slow
@pytest.mark.pair  # of its processes none is to begin at idle priority
def test_a_host_that_never_pauses_loses_its_priority_and_then_its_life(start: START) -> None:
    child = start()
    soft, hard = (limit / 1e6 for limit in child.ready["limits"])
    assert 0.0 < soft < hard <= 10.0
    busy: Any = child.request("busy", {"busy": soft + 1.0})
    assert not busy["realtime"]
    assert KERNEL < (6, 12) or busy["text"] == "default, slice of 0.1 ms"


def test_lock_step_never_changes_the_scheduling_of_the_program() -> None:
    before = describe()
    with hal.open("panda_table", driver="mock", clock="lock_step") as rig:
        rig.clock.sleep(0.1)
        assert describe() == before
        assert not any("real-time priority" in note for note in rig.notes)
    assert not is_realtime()
