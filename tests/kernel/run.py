#!/usr/bin/env python3
"""Runs the pads' driver against the kernel's own drivers, in a virtual machine. See README.md beside this file."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from image import image_for
from machine import Machine

from packages import Missing

_HERE = Path(__file__).resolve().parent
_ROOT = _HERE.parents[1]
_SERIES = {"6.12": "", "6.1": "sony"}
"""Series of kernels, and which checks run on it by default: with 6.1, hid-sony drives a DualShock 4."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit status."""
    options = _parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    began = time.monotonic()
    try:
        passed = [
            _run(series, _job(options.k or ("" if options.kernel else usual), options.seconds), options)
            for series, usual in _SERIES.items()
            if series in (options.kernel or _SERIES)
        ]
    except Missing as missing:
        print(f"error: {missing}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    print(f"\n{'all passed' if all(passed) else 'FAILED'}, {time.monotonic() - began:.0f} s")
    return 0 if all(passed) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--kernel", action="append", choices=_SERIES, help="all checks on this series of kernels")
    add("-k", metavar="EXPRESSION", default="", help="only the checks whose names match, as pytest's -k")
    add("--refresh", action="store_true", help="download the newest kernels, though there are some in the cache")
    add("--limit", type=float, default=480.0, help="end a machine after so many seconds (default: %(default)g)")
    add("--seconds", type=float, default=5.0, help="length of the long run of a webcam (default: %(default)g)")
    add("--console", action="store_true", help="show what each machine's kernel and pytest said, too")
    return parser


def _run(series: str, job: str, options: argparse.Namespace) -> bool:
    """All checks on one kernel; True when they passed."""
    image = image_for(series, options.refresh, partial(print, flush=True))
    print(f"\n{image.name}", flush=True)
    machine = Machine(image, job, options.limit + options.seconds)
    passed: list[bool] = []
    status = None
    with closing(machine.lines()) as lines:
        for line in lines:
            try:
                result = json.loads(line)
            except ValueError:
                print(f"  {line}")  # qemu itself has something to say
                continue
            if "finished" in result:
                status = result["finished"]
                continue
            passed.append(result["passed"])
            word = "ok    " if result["passed"] else "FAILED"
            print(f"  {word}  {result['check']:<54}  {result['seconds']:4.1f} s  {result['measured']}", flush=True)
            for why in result["why"].splitlines():
                print(f"          {why}")
    print(f"  {sum(passed)} of {len(passed)} checks passed")
    if status is None:
        print(f"  FAILED  the machine ended before its checks did; it may run for {options.limit:g} s (--limit)")
    if options.console or status is None or not passed:
        print(machine.console)
    return status == 0 and bool(passed) and all(passed)


def _job(expression: str, seconds: float) -> str:
    """What a machine does: pytest, with this interpreter, on this checkout. Raises Missing."""
    guest = _HERE / "guest"
    environment = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": "/run",
        "TMPDIR": "/run",
        "PYTHONPATH": os.pathsep.join([str(guest), os.environ.get("PYTHONPATH", "")]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "HAL_KERNEL_PAD": json.dumps(_pad()),
        "HAL_KERNEL_RESULTS": "/dev/ttyS1",
        "HAL_KERNEL_SECONDS": str(seconds),
    }
    pytest = [sys.executable, "-m", "pytest", "-c", guest / "checks.ini", "--rootdir", guest, "-k", expression, guest]
    exports = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
    return "\n".join((*exports, "cd /run", shlex.join(["exec", *map(str, pytest)]))) + "\n"


def _pad() -> dict[str, object]:
    """A pad of whatever kind, as the configuration of a rig gives it. Read here, for a machine is slow."""
    try:
        import hal
        from hal.config.files import Problems
        from hal.config.models import load_pad_models
        from hal.specs import PadSpec, to_json
    except ImportError as error:
        raise Missing(f"{error}; run: pip install -e '{_ROOT}[test]'") from None
    if Path(hal.__file__).resolve().parents[1] != _ROOT:
        raise Missing(f"{sys.executable} has another robot-hal ({hal.__file__}); run: pip install -e '{_ROOT}[test]'")
    problems = Problems()
    models = load_pad_models(problems)
    problems.raise_any()
    return to_json(PadSpec(name="pad", driver="evdev", model=None, models=tuple(models.values())))


if __name__ == "__main__":
    sys.exit(main())
