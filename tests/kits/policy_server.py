"""A policy's server as a program, also to be killed or frozen: the first joint moves at a constant speed.

python policy_server.py LATENCY JITTER: s from a request to its answer, and the greatest difference from that.
"""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from hal.learning.remote import PolicyServer

STEPS, RATE, SPEED = 60, 15, 0.15
EXECUTE = 15
CONFIG: dict[str, Any] = {
    "rate_hz": RATE,
    "execute": EXECUTE,
    "observation": {"state": {"state": "q"}, "way": {"text": "task"}},
    "action": {"kind": "joint_position"},
}


@contextmanager
def serving(latency: float, jitter: float = 0.0) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the server; yields its process and its address."""
    command = [sys.executable, __file__, str(latency), str(jitter)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            yield server, server.stdout.readline().strip()
        finally:
            server.kill()


def main() -> None:
    latency, jitter = map(float, sys.argv[1:])
    chance = random.Random(1)

    def infer(request: dict[str, Any]) -> dict[str, Any]:
        time.sleep(latency + jitter * chance.uniform(-1.0, 1.0))
        if "picture" in request and np.ptp(request["picture"]) < 50:
            raise ValueError("nothing in the picture")
        speed = SPEED if request["way"] == "left" else -SPEED
        return {"actions": request["state"] + speed * np.arange(STEPS)[:, None] / RATE * np.eye(7)[0]}

    with PolicyServer(infer) as server:
        print(server.url, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
