"""What children run in tests: of test_process.py, and a console that waits for nobody long."""

import os
import threading
import time

from hal.errors import ConfigError, ConnectionLost, Problem
from hal.host.process import serve


def echo(channel, memories, config):
    """Answer every request with its parameters; ``fail`` with an error, ``die`` not at all."""
    if config.get("start") == "fail":
        raise ConfigError([Problem("rig.yaml", "robots.panda", "is missing")])
    if config.get("start") == "never":
        time.sleep(60)
    if memories:
        memories[0].buffer[0:5] = b"hello"
    channel.send({"ready": {"pid": os.getpid(), "path": config.get("x")}})

    def fail():
        raise ConnectionLost("the arm is gone", code="arm_gone")

    def die():
        print("these are my last words")
        os._exit(3)

    def news(count):
        for number in range(count):
            channel.send({"news": number})

    def sleep(seconds):
        time.sleep(seconds)

    serve(channel, {"say": lambda **params: params, "fail": fail, "die": die, "news": news, "sleep": sleep})


def lock_holder(channel, memories, config):
    """Hold the lock on a device, also after the app is gone, until the process is killed."""
    from hal.lock import DeviceLock

    lock = DeviceLock(config["name"], "the arm")
    channel.send({"ready": os.getpid()})
    time.sleep(60.0)
    lock.release()


HURRY = 2.5
"""So many times sooner than any other does an impatient console show out whoever is too slow."""


def impatient_console(channel, memories, config):
    """The console's process, with less patience."""
    from hal.drivers.web import process, server, sockets

    class ConnectionLimit(sockets.ConnectionLimit):
        def __init__(self):  # as the server makes it
            super().__init__(idle_time=sockets._IDLE_TIME / HURRY)

    server.ConnectionLimit = ConnectionLimit
    sockets._SEND_TIME /= HURRY
    process.main(channel, memories, config)


def scheduled(channel, memories, config):
    """Prepare as a servo's host, without the right to real-time priority if so configured; tell how it is scheduled."""
    import resource

    from hal.host.scheduling import describe, is_realtime, note_threads, prepare_process

    if config["refused"]:
        give_up_right()
    ended = threading.Event()
    beside, noted = (threading.Thread(target=ended.wait, daemon=True) for _ in range(2))
    beside.start()
    with note_threads():
        noted.start()
    prepare_process(config["realtime"])
    priorities = [os.sched_getparam(thread.native_id).sched_priority for thread in (noted, beside)]

    def state():
        with open("/proc/self/status") as file:
            locked = next(int(line.split()[1]) for line in file if line.startswith("VmLck"))
        limits = resource.getrlimit(resource.RLIMIT_RTTIME)
        found = {"realtime": is_realtime(), "text": describe(), "limits": limits, "locked_kb": locked}
        return {**found, "threads": priorities}

    channel.send({"ready": state()})
    message = channel.receive(60.0)
    end = time.monotonic() + message["params"]["busy"]
    while time.monotonic() < end:
        pass
    channel.send({"id": message["id"], "result": state()})
    channel.receive(60.0)


def give_up_right():
    """Refuse SCHED_FIFO to this process and its children, as to an ordinary user: no CAP_SYS_NICE, no RLIMIT_RTPRIO."""
    import ctypes
    import resource

    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    libc = ctypes.CDLL(None)
    libc.prctl(24, 23, 0, 0, 0)  # PR_CAPBSET_DROP: children of root do not regain it; fails for others, who lack it
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    sets = (ctypes.c_uint32 * 6)()
    assert libc.capget(header, sets) == 0
    for k in range(3):
        sets[k] &= ~(1 << 23)
    assert libc.capset(header, sets) == 0
