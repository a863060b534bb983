"""Convert an evemu recording (``.events``) of a pad to a file for playback.

    python -m hal.drivers.playback.convert ds4.events --ioctl ds4.ioctl --model dualshock4 --output ds4.jsonl

The ranges of the axes come from the ``A:`` lines of a recording that has the description of its device, or from the
``.ioctl`` file that ``umockdev-record`` writes.
"""

from __future__ import annotations

import argparse
import re
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

from hal.errors import ConfigError, HalError, Problem
from hal.pads.codes import ABS_NAME, EV_ABS, EV_KEY, KEY_NAME
from hal.pads.mapper import AxisRange

from .pad import PadRecording, RecordedEvent, dump_recording

_EVENT = re.compile(r"E: (\d+\.\d+) ([0-9a-fA-F]{4}) ([0-9a-fA-F]{4}) (-?\d+)")
_RANGE = re.compile(r"A: ([0-9a-fA-F]{2}) (-?\d+) (-?\d+) (-?\d+) (-?\d+)")
_IOCTL = re.compile(r"EVIOCGABS(?:\((\d+)\))? 0 ([0-9a-fA-F]{48})")


def convert(events: Path, ioctl: Path | None = None, *, model: str, about: str = "") -> PadRecording:
    """Read a recording of evemu, without the events that no pad model uses (SYN, MSC).

    Args:
        events: The ``.events`` file.
        ioctl: The ``.ioctl`` file of the same device; None where ``events`` has ``A:`` lines.
        model: Name of the pad's model.
        about: Where the recording comes from.

    Raises:
        ConfigError: A line is not an event, or the range of an axis is missing.
    """
    found: list[tuple[float, int, int, int]] = []
    ranges: dict[int, AxisRange] = {}
    problems: list[Problem] = []
    for number, line in enumerate(_lines(events), 1):
        if line.startswith("E: "):
            match = _EVENT.match(line)
            if match:
                found.append((float(match[1]), int(match[2], 16), int(match[3], 16), int(match[4])))
            else:
                problems.append(Problem(str(events), f"line {number}", f"is not an event: {line}", "bad_recording"))
        elif match := _RANGE.match(line):
            ranges[int(match[1], 16)] = AxisRange(int(match[2]), int(match[3]), int(match[5]))
    if ioctl is not None:
        ranges.update(_ioctl_ranges(_lines(ioctl)))
    wanted = [
        (t, kind, code, value)
        for t, kind, code, value in found
        if (kind == EV_KEY and code in KEY_NAME) or (kind == EV_ABS and code in ABS_NAME)
    ]
    for code in sorted({code for _, kind, code, _ in wanted if kind == EV_ABS} - set(ranges)):
        problems.append(Problem(str(events), ABS_NAME[code], "has no range; name the .ioctl file too", "missing_range"))
    if not wanted and not problems:
        problems.append(Problem(str(events), "", "has no event of a pad", "bad_recording"))
    if problems:
        raise ConfigError(problems)
    start = wanted[0][0]
    known = {code: span for code, span in ranges.items() if code in ABS_NAME}
    return PadRecording(model, known, tuple(RecordedEvent(t - start, *rest) for t, *rest in wanted), about)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise ConfigError([Problem(str(path), "", f"cannot be read: {error.strerror}", "unreadable")]) from None


def _ioctl_ranges(lines: Iterable[str]) -> dict[int, AxisRange]:
    """Return the ranges in answers to EVIOCGABS: struct input_absinfo of linux/input.h, six 32-bit numbers."""
    ranges = {}
    for line in lines:
        if match := _IOCTL.match(line):
            _, minimum, maximum, _, flat, _ = struct.unpack("<6i", bytes.fromhex(match[2]))
            ranges[int(match[1] or 0)] = AxisRange(minimum, maximum, flat)
    return ranges


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="hal.drivers.playback.convert", description="evemu -> playback")
    parser.add_argument("events", type=Path, help="the recording")
    parser.add_argument("--ioctl", type=Path, help="umockdev's .ioctl file of the same device")
    parser.add_argument("--model", required=True, help="name of the pad's model, for example dualshock4")
    parser.add_argument("--about", default="", help="where the recording comes from")
    parser.add_argument("--output", type=Path, help="file to write; standard output when left out")
    given = parser.parse_args(arguments)
    try:
        text = dump_recording(convert(given.events, given.ioctl, model=given.model, about=given.about))
    except HalError as error:
        print(error, file=sys.stderr)
        return 2
    if given.output is None:
        print(text, end="")
    else:
        given.output.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
