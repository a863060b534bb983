"""Which process runs first: a servo's host before everything else; drawing and encoding after it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import platform
import signal
import struct
import sys
from collections.abc import Iterator

from ..preflight import may_lock_memory

PRIORITY = 50
"""Priority of a host among SCHED_FIFO processes, 1 to 99."""
LINK_PRIORITY = PRIORITY - 2
"""Priority of the ends of a link between computers: whatever comes over it delays no host."""
SLICE = 1e-4
"""Slice of a host that may not use SCHED_FIFO, s: the shorter, the sooner it runs after it wakes."""
RUNAWAY = 2, 10
"""After so many s on a processor without a pause a host loses its priority, and is killed (a library that hangs)."""
_SYSCALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""Machine -> numbers of sched_setattr and sched_getattr, for which Python has no function."""
_ATTRIBUTES = struct.Struct("=IIQiIQQQII")
"""sched_attr(2): size, policy, flags, nice, priority, runtime in ns, deadline, period, two clamps."""
_noted: set[int] = set()
"""Threads without which the host's is late as well."""
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_TIMERSLACK = 29


def prepare_process(realtime: bool, priority: int = PRIORITY) -> None:
    """Make this process wake up on time.

    Needs no right: a timer slack of 1 ns and no garbage collection.

    Args:
        realtime: Also ask for SCHED_FIFO, or a slice of :data:`SLICE` where it is refused, and lock the memory where
            that is allowed. Other threads, and children, do not inherit the priority.
        priority: Priority for SCHED_FIFO.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    if not sys.platform.startswith("linux"):
        return
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if not realtime:
        return
    _limit_runaway()
    try:
        raise_thread(priority)
        for thread in _noted & _list_threads():
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(PRIORITY - 1))
    except OSError:
        _shorten_slice()
    if may_lock_memory():
        libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)  # without the last, a new thread takes ms


def raise_thread(priority: int) -> None:
    """Give SCHED_FIFO to this thread, and not to those that it starts. Raises OSError if that is refused."""
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def is_realtime() -> bool:
    """Whether this thread has a real-time priority."""
    if not sys.platform.startswith("linux"):
        return False
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR)


@contextlib.contextmanager
def note_threads() -> Iterator[None]:
    """Note the threads that a library starts meanwhile: :func:`prepare_process` puts them just below this one."""
    before = _list_threads()
    yield
    _noted.update(_list_threads() - before)


def _list_threads() -> set[int]:
    try:
        return set(map(int, os.listdir("/proc/self/task")))
    except OSError:  # Linux only
        return set()


def describe() -> str:
    """Return a description of how this thread is scheduled."""
    if is_realtime():
        return f"SCHED_FIFO, priority {os.sched_getparam(0).sched_priority}"
    slice_s = _slice()
    return f"default, slice of {1e3 * slice_s:g} ms" if slice_s else "default"


def yield_to_others(nice: int) -> None:
    """Give this process a lower priority, no claim to run at once, and all processors but the first.

    The last of these matters most for a servo at 1 kHz beside cameras (``python -m benchmarks real_time``).
    """
    os.nice(nice)
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        processors = sorted(os.sched_getaffinity(0))
        if len(processors) > 1:
            os.sched_setaffinity(0, processors[1:])


def _limit_runaway() -> None:
    """Keep a host that never pauses, because its work is too much or a library hangs, from occupying a processor.

    The kernel counts the time since the last pause, and sends SIGXCPU and then SIGKILL.
    """
    import resource

    def lose_priority(signum: int, frame: object) -> None:
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
        _shorten_slice()

    signal.signal(signal.SIGXCPU, lose_priority)
    allowed = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
    first, last = (1_000_000 * seconds for seconds in RUNAWAY)
    if allowed != resource.RLIM_INFINITY:
        last = min(last, allowed)
        first = min(first, last // 2)  # the signal must come before the end
    resource.setrlimit(resource.RLIMIT_RTTIME, (first, last))


def _shorten_slice() -> None:
    """Set the slice of this thread; Linux before 6.12 ignores it."""
    attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, os.nice(0), 0, int(1e9 * SLICE), 0, 0, 0, 0)
    numbers = _SYSCALLS.get(platform.machine())
    if numbers is not None:
        ctypes.CDLL(None).syscall(numbers[0], 0, ctypes.create_string_buffer(attributes), 0)


def _slice() -> float:
    """Slice of this thread, s; 0.0 where the kernel does not report one."""
    numbers = _SYSCALLS.get(platform.machine())
    if not sys.platform.startswith("linux") or numbers is None:
        return 0.0
    buffer = ctypes.create_string_buffer(_ATTRIBUTES.size)
    if ctypes.CDLL(None).syscall(numbers[1], 0, buffer, _ATTRIBUTES.size, 0) != 0:
        return 0.0
    return float(1e-9 * _ATTRIBUTES.unpack(buffer.raw)[5])
