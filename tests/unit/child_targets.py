"""What children run in tests: of test_process.py, and a console that waits for nobody long."""

import os
import time

from hal.errors import ConfigError, ConnectionLost, Problem
from hal.host.process import pack_error


def echo(channel, memories, config):
    """Answer every request with its parameters; ``fail`` with an error, ``die`` not at all."""
    if config.get("start") == "fail":
        raise ConfigError([Problem("rig.yaml", "robots.panda", "is missing")])
    if config.get("start") == "never":
        time.sleep(60)
    if memories:
        memories[0].buffer[0:5] = b"hello"
    channel.send({"ready": {"pid": os.getpid(), "path": config.get("x")}})
    while True:
        message = channel.receive(1.0)
        if message is None:
            if os.getppid() == 1:
                return
            continue
        if message["method"] == "close":
            return
        if message["method"] == "die":
            print("these are my last words")
            os._exit(3)
        if message["method"] == "fail":
            channel.send({"id": message["id"], "error": pack_error(ConnectionLost("the arm is gone"))})
        else:
            channel.send({"id": message["id"], "result": message["params"]})


HURRY = 2.5
"""So many times sooner than any other does an impatient console show out whoever is too slow."""


def impatient_console(channel, memories, config):
    """The console's process, with less patience."""
    from hal.drivers.web import process, service, sockets, visitors

    class Visitors(visitors.Visitors):
        def __init__(self):  # the service's way to make them
            super().__init__(patience=visitors._PATIENCE / HURRY)

    service.Visitors = Visitors
    sockets._PATIENCE /= HURRY
    process.main(channel, memories, config)
