"""Time from the silence of a dead-man, a pad or a stream of commands until the arm brakes, in real time.

    python benchmarks/stops.py [--runs 5]

A recorded pad holds the dead-man and a direction; then it freezes, is unplugged or released, or the program stops
sending. The times of the event and of the braking are those of the two processes' common clock. The reference in the
same run is `rig.stop()`, which no limit delays.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import tempfile
import time
import warnings
from pathlib import Path

import hal
from hal.errors import MotionStopped

EVENT = 2.5
"""Time of the event, s after the pad's first poll."""
WAYS = ("rig.stop() (reference)", "dead-man released", "pad frozen", "pad unplugged", "commands stop")


def recording(folder: Path, tour: Path, release: bool) -> Path:
    """Write a recording that presses L2 and the d-pad, in the format of the recorded tour."""
    header = json.loads(tour.read_text().splitlines()[0])
    events = [
        (0.1, "abs", "ABS_X", 128),
        (0.1, "abs", "ABS_Y", 128),
        (0.1, "abs", "ABS_RX", 128),
        (0.1, "abs", "ABS_RY", 128),
        (0.1, "abs", "ABS_Z", 0),
        (0.1, "abs", "ABS_RZ", 0),
        (1.0, "abs", "ABS_Z", 255),
        (1.0, "key", "BTN_TL2", 1),
        (1.1, "abs", "ABS_HAT0Y", -1),
        (EVENT if release else 60.0, "abs", "ABS_Z", 0),
        (EVENT if release else 60.0, "key", "BTN_TL2", 0),
        (60.0, "abs", "ABS_HAT0Y", 0),
    ]
    path = folder / "pad.jsonl"
    lines = [json.dumps(header)]
    lines += [json.dumps({"t": t, "type": kind, "code": code, "value": value}) for t, kind, code, value in events]
    path.write_text("\n".join(lines) + "\n")
    return path


def measure(way: str, folder: Path) -> tuple[float, float]:
    """Return seconds from the event to the start of braking, and to rest."""
    from hal.config.data_files import find_data

    path = recording(folder, find_data("config", "teleop/tour.jsonl"), way == "dead-man released")
    options = {"pad frozen": {"freeze_at": EVENT}, "pad unplugged": {"disconnect_at": EVENT}}.get(way, {})
    pad_config = {"model": "auto", "driver": "playback", "file": str(path), "options": options}
    overrides = ["cameras={}", f"gamepads.pad={json.dumps(pad_config)}"]
    with hal.open("panda_table", sim=True, clock="real_time", overrides=overrides) as rig:
        arm, pad = rig.robots["panda"], rig.gamepads["pad"]
        teleop = hal.Teleop(arm)
        moved = False
        with arm.control(deadman=pad.hold("l2"), rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                state = pad.state()
                event = state.stamp.t - state.stamp.t_device + EVENT  # the recording's start on the clock, then EVENT
                motion, _ = teleop.step(state, tick.dt)
                with contextlib.suppress(MotionStopped):
                    control.send(motion)
                moved = moved or arm.state().tcp_twist[0] > 0.05
                if tick.t >= event:
                    break
            assert moved, "the arm moves before"
            sends_on = way not in ("commands stop", "rig.stop() (reference)")
            if way == "rig.stop() (reference)":
                event = time.monotonic()
                rig.stop()
            elif way == "commands stop":
                event = tick.t  # the time of the last command
            deadline = time.monotonic() + 2.0
            while time.monotonic() < deadline:
                if sends_on:
                    with contextlib.suppress(MotionStopped):
                        control.send(motion)  # a program that continues as if nothing had happened
                braking = [s for s in arm.states(event) if s.status is not hal.RobotStatus.FOLLOWING]
                rest = next((s for s in braking if abs(s.dq_set).max() < 1e-6), None)
                if rest is not None:
                    return braking[0].stamp.t - event, rest.stamp.t - event
                time.sleep(0.002)
    raise RuntimeError(f"{way}: the arm did not stop")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="time from silence to braking")
    parser.add_argument("--runs", type=int, default=5, help="of each way (%(default)s)")
    runs = parser.parse_args().runs
    warnings.simplefilter("ignore", RuntimeWarning)  # that a session was stopped is what is measured
    print(f"{'ms after the event: median (max)':34s}{'braking begins':>20s}{'at rest':>20s}")
    for way in WAYS:
        with tempfile.TemporaryDirectory() as folder:
            found = [measure(way, Path(folder)) for _ in range(runs)]
        cells = [
            f"{1e3 * statistics.median(column):.0f} ({1e3 * max(column):.0f})" for column in zip(*found, strict=True)
        ]
        print(f"{way:34s}" + "".join(f"{cell:>20s}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
