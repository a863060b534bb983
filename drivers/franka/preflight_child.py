"""The short-lived process that asks a robot who it is and how it is, through the vendor's library.

A process of its own, because the libraries keep Python's lock while they wait, give the calling thread the highest
priority that it may have, and wait for ever for a greeting that nobody answers. Here that costs only this process.
"""

from __future__ import annotations

import resource
from collections.abc import Sequence
from typing import Any

from hal.host.process import Channel, SharedMemory

from .faults import fault_of_exception
from .flags import FLAGS
from .links import link_to

__all__ = ["main"]

_SAMPLES = 50
"""States, a millisecond apart, in which the noise of an arm at rest is looked for."""


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point; ``config`` has the settings' ``host`` and ``arm``. Nothing moves."""
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))  # a look needs no priority
    channel.send({"ready": _look(config["host"], config["arm"])})


def _look(host: str, arm: str) -> dict[str, Any]:
    """``protocol``, ``mode``, ``flags``, ``noise``; or ``missing``, a library; or ``fault``: code, cause and remedy.

    ``noise`` is by how much the commanded positions differ that an arm at rest reports, rad.
    """
    try:
        link = link_to(arm)
    except ImportError as error:
        return {"missing": error.name or str(error)}
    try:
        link.connect(host)
        sample = link.read()
        found = {"protocol": link.protocol, "mode": sample.mode.name.lower(), "flags": link.errors(FLAGS)}
        reports = [list(link.read().q_d) for _ in range(_SAMPLES)]
        found["noise"] = max(max(values) - min(values) for values in zip(*reports, strict=True))
        link.disconnect()
    except link.troubles as error:
        fault = fault_of_exception(error, host=host)
        return {"fault": [fault.code, fault.cause, fault.remedy]}
    return found
