"""Times until the arm brakes and rests: after a silence of a dead-man or a pad, and after each end of an app."""

from __future__ import annotations

import contextlib
import json
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from observer import Watched

import hal
from hal.config.data_files import find_data
from hal.errors import MotionStopped

from .kit import Table, ms

PATHS = ("hal/servo/watchdog.py", "hal/deadman.py", "hal/control.py", "hal/host")
EVENT = 2.5
"""Time of the event, s after the pad's first poll."""
WAYS = ("rig.stop() (reference)", "dead-man released", "pad frozen", "pad unplugged", "commands stop")
ENDS = ("exception", "kill -9", "SIGTERM", "Ctrl-C", "closed terminal", "SIGSTOP", "Ctrl-Z")


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


def measure_end(how: str) -> tuple[float, float, float | None]:
    """Return seconds to the start of braking, to rest, and until no process is left (None: they are meant to stay)."""
    with tempfile.TemporaryDirectory() as folder:
        app = Watched(Path(folder), ending="exception" if how == "exception" else "")
        try:
            full = app.speed()
            if how == "exception":
                began = when = app.wait_for(lambda: app.speed() < 0.999 * full)
            else:
                when = app.end(how)
                began = app.wait_for(lambda: app.speed() < 0.999 * full)
            rest = app.wait_for(app.at_rest)
            gone = None if how in ("SIGSTOP", "Ctrl-Z") else app.wait_for(app.nobody_left)
        finally:
            app.close()
    return began - when, rest - when, None if gone is None else gone - when


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    warnings.simplefilter("ignore", RuntimeWarning)  # that a session was stopped is what is measured
    runs, columns = 1 if quick else 5, ("ms after the event, median (max)", "braking begins", "at rest")
    table = Table(f"silence, {runs} times each", columns)
    for way in WAYS[:2] if quick else WAYS:
        with tempfile.TemporaryDirectory() as folder:
            found = [measure(way, Path(folder)) for _ in range(runs)]
        table.add(way, *(ms(column) for column in zip(*found, strict=True)))
    yield table
    table = Table(f"ends of an app at 0.4 rad/s, {runs} times each", (*columns, "processes gone"))
    for how in ENDS[:2] if quick else ENDS:
        ends = [measure_end(how) for _ in range(runs)]
        cells = [[value for value in column if value is not None] for column in zip(*ends, strict=True)]
        name = "exception, from braking (reference)" if how == "exception" else how
        table.add(name, *(ms(values) if values else "stay" for values in cells))
    yield table
