"""The view of a recording, and the message that pages get of it."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hal.drivers.web.console import recording_message
from hal.errors import CommandError
from hal.views import ACTIONS, PHASES, RecordingView

VIEW = RecordingView(
    phase="recording",
    prompt="put the cube on the plate, then save",
    task="the cube on the plate",
    episode=22,
    saved=2,
    wanted=10,
    succeeded=1,
    failed=1,
    discarded=3,
    seconds=12.345,
    frames=370,
    dropped=0,
    free_bytes=41_200_000_000,
    trouble="",
    actions=("finish", "fail", "discard"),
)


def test_a_view_reaches_the_pages_whole() -> None:
    message = recording_message(VIEW)
    assert message.keys() == set(RecordingView.__slots__)
    assert message | {"seconds": 12.345, "actions": VIEW.actions} == {
        name: getattr(VIEW, name) for name in RecordingView.__slots__
    }
    assert (message["seconds"], message["actions"]) == (12.35, ["finish", "fail", "discard"])


def test_numbers_may_be_numpy_scalars() -> None:
    view = replace(VIEW, frames=np.int64(3), free_bytes=np.uint64(1 << 40), seconds=np.float32(0.5))
    message = json.loads(json.dumps(recording_message(view)))
    assert (message["frames"], message["free_bytes"], message["seconds"]) == (3, 1 << 40, 0.5)


def test_texts_become_one_line_of_limited_length() -> None:
    message = recording_message(replace(VIEW, prompt="two\nlines  of it", trouble="no space left " * 1000))
    assert message["prompt"] == "two lines of it"
    assert len(message["trouble"]) == 300


@pytest.mark.parametrize("phase", PHASES)
def test_every_phase(phase: str) -> None:
    assert replace(VIEW, phase=phase, actions=ACTIONS).phase == phase


@pytest.mark.parametrize(
    "wrong",
    [
        {"phase": "paused"},
        {"actions": ("record", "erase")},
        {"actions": "record"},
        {"seconds": float("nan")},
        {"seconds": float("inf")},
        {"seconds": -0.1},
    ],
)
def test_invalid_views(wrong: dict[str, Any]) -> None:
    with pytest.raises(CommandError):
        replace(VIEW, **wrong)
