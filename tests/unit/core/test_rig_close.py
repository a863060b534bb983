"""The end of a rig with several hosts."""

from __future__ import annotations

from typing import Any

import pytest

import hal


class NotedHost:
    """A host that notes how it is closed."""

    def __init__(self, name: str, calls: list[str], error: Exception | None = None) -> None:
        self.name, self.calls, self.error = name, calls, error

    def request_close(self) -> None:
        self.calls.append(f"request {self.name}")
        if self.error is not None:
            raise self.error

    def close(self) -> None:
        self.calls.append(f"close {self.name}")


def test_every_host_begins_to_close_before_one_is_waited_for() -> None:
    calls: list[str] = []
    with hal.open("panda_table", driver="mock", pad="none", overrides=["cameras={}"], clock="lock_step") as rig:
        hosts: list[Any] = [NotedHost("left", calls, OSError("gone")), NotedHost("right", calls)]
        rig._hosts += hosts
        with pytest.raises(OSError, match="gone"):
            rig.close()
    assert calls == ["request left", "request right", "close left", "close right"]
