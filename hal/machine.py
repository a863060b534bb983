"""Is this computer fit for set-points at a fixed rate? What every real arm wants of it, whatever its make."""

from __future__ import annotations

import os
import resource
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from .verdict import Verdict

__all__ = ["REALTIME_RIGHT", "check_machine", "has_realtime_kernel", "may_lock_memory"]

_ROOT = Path("/")
_GOVERNORS = "sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"
_IPC_LOCK = 14
"""Number of the capability to lock memory without a limit (capabilities(7))."""
REALTIME_RIGHT = (
    'printf \'%s - rtprio 99\\n%s - memlock unlimited\\n\' "$USER" "$USER" | '
    "sudo tee /etc/security/limits.d/99-realtime.conf; then log out and in"
)
"""Command that gives this user the right to real-time scheduling and to locked memory."""
_FULL_SPEED = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor (until the next start)"
_KERNELS = {
    "debian": "sudo apt install linux-image-rt-amd64, then start the computer with it",
    "ubuntu": "sudo pro enable realtime-kernel, then start the computer with it",
}
"""Distribution -> how a real-time kernel gets there."""


def check_machine(root: Path = _ROOT) -> Iterator[Verdict]:
    """One verdict each: kernel, processor's frequency, right to real-time scheduling, right to lock memory.

    ``root`` is where the files of the system are looked for.
    """
    if not sys.platform.startswith("linux"):
        yield Verdict("machine", "unknown", f"nothing is known of {sys.platform}", "use Linux for a real arm")
        return
    yield _kernel(root)
    yield _frequency(root)
    yield _scheduling()
    yield _memory(root)


def has_realtime_kernel(root: Path = _ROOT) -> bool | None:
    """Does this computer run a kernel with PREEMPT_RT? None where that cannot be found out."""
    version = _text(root / "proc/version")
    if version is None:
        return None
    # The file came with the patches for older kernels; the name of a newer kernel says it.
    return _text(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version or "PREEMPT RT" in version


def _kernel(root: Path) -> Verdict:
    realtime = has_realtime_kernel(root)
    if realtime is None:
        return Verdict("kernel", "unknown", "cannot read /proc/version")
    release = os.uname().release
    if realtime:
        return Verdict("kernel", "ok", f"{release}, a real-time kernel (PREEMPT_RT)")
    found = f"{release}, no real-time kernel: a set-point now and then will be late"
    return Verdict("kernel", "warn", found, _KERNELS.get(_distribution(root), "install a kernel with PREEMPT_RT"))


def _frequency(root: Path) -> Verdict:
    """Processors that slow down to save power wake up late."""
    governors = {text for path in root.glob(_GOVERNORS) if (text := _text(path))}
    if not governors:
        return Verdict("processor", "unknown", "Linux does not say how the processor's frequency is governed")
    saving = ", ".join(sorted(governors - {"performance"}))
    if not saving:
        return Verdict("processor", "ok", "full speed (governor performance)")
    return Verdict("processor", "warn", f"saves power and then wakes up late (governor {saving})", _FULL_SPEED)


def _scheduling() -> Verdict:
    priority = os.sched_get_priority_max(os.SCHED_FIFO)
    if _may_be_fifo(priority):
        return Verdict("scheduling", "ok", f"SCHED_FIFO is allowed, up to priority {priority}")
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    found = f"SCHED_FIFO is not allowed up to priority {priority} ('ulimit -r' says {limit})"
    return Verdict("scheduling", "warn", found, REALTIME_RIGHT)


def _may_be_fifo(priority: int) -> bool:
    """Try it, in a thread of its own, for limits, capabilities and containers all have a say."""
    allowed = False

    def attempt() -> None:
        nonlocal allowed
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError:
            return
        allowed = True

    thread = threading.Thread(target=attempt, name="hal-check-scheduling")
    thread.start()
    thread.join()
    return allowed


def may_lock_memory(root: Path = _ROOT) -> bool:
    """Whether this process may lock all of its memory."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return limit == resource.RLIM_INFINITY or bool((_capabilities(root) or 0) >> _IPC_LOCK & 1)


def _memory(root: Path) -> Verdict:
    if may_lock_memory(root):
        return Verdict("memory", "ok", "all of a process's memory may be locked")
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    found = f"only {limit / 2**20:.0f} MiB may be locked ('ulimit -l'); a servo's process needs more"
    return Verdict("memory", "unknown" if _capabilities(root) is None else "warn", found, REALTIME_RIGHT)


def _capabilities(root: Path) -> int | None:
    """Capabilities of this process, as bits."""
    lines = (_text(root / "proc/self/status") or "").splitlines()
    return next((int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")), None)


def _distribution(root: Path) -> str:
    """``debian``, ``ubuntu``, ...: ID of os-release(5)."""
    lines = (_text(root / "etc/os-release") or "").splitlines()
    return next((line[3:].strip("\"'") for line in lines if line.startswith("ID=")), "")


def _text(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None
