"""A program that records one episode after the other until it is killed, and says what it is at in lines of JSON."""

from __future__ import annotations

import json
import random
import sys
import time

from recording_kit import mock_rig

from hal.recording import Recorder


def say(what: str, **more: object) -> None:
    print(json.dumps({"what": what, "t": time.monotonic(), **more}), flush=True)


def main(out: str, seed: int) -> None:
    chance = random.Random(seed)
    with mock_rig("real_time") as rig, Recorder(rig, out, task="to be killed") as recorder:
        say("ready", writer=recorder._child.process.pid)
        while True:
            recorder.start(seed=seed)
            say("begun", episode=recorder.status().episode)
            time.sleep(chance.uniform(0.2, 1.5))
            say("ending")
            recorder.save(True, wait=True)
            say("saved", rows=recorder.status().frames)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
