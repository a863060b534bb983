"""A RealSense: received frames, cost, rate, latency, and the effect of an unplugged camera on an arm.

The camera is emulated (librealsense's software device) and lives in the process that the driver has for librealsense.
References in the same run: the library alone, and the arm while nothing is unplugged.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal.config import load
from hal_emulators.realsense import SoftwareCamera, emulated_context

from .kit import Table, cpu, ms, ticks_missed

PATHS = ("drivers/realsense", "hal/camera.py", "hal/images.py")
STREAMS = ("color", "depth", "infrared")


def rig_file(**real: Any) -> dict[str, Any]:
    """Return the rig: one camera at 30 Hz with three VGA streams."""
    camera = {
        "model": "realsense_d435",
        "capture": {"width": 640, "height": 480, "rate_hz": 30},
        "streams": {name: {} for name in STREAMS},
        "real": {"emulated": True, **real},
    }
    return {"sim": False, "robots": {}, "gamepads": {}, "cameras": {"cam": camera}}


def children() -> list[int]:
    """Return the processes that this one has started."""
    found = []
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            found += [int(pid) for pid in (task / "children").read_text().split()]
    return found


def live(seconds: float, table: Table) -> None:
    """Read every frame for some seconds."""
    with hal.open(rig_file()) as rig:
        camera = rig.cameras["cam"]
        pids = children()
        first = camera.read(5.0).stamp.seq
        start, before, app, began = camera.counts(), sum(map(cpu, pids)), time.process_time(), time.monotonic()
        sets = 0
        while time.monotonic() - began < seconds:
            number = camera.read(5.0).stamp.seq
            sets += 1
        span, counts = time.monotonic() - began, camera.counts()
        theirs, ours = (sum(map(cpu, pids)) - before) / span, (time.process_time() - app) / span
    table.add(f"sets of {len(STREAMS)} streams read, of {number - first} sent", sets)
    table.add("mismatched, dropped", f"{counts.mismatched - start.mismatched}, {counts.dropped - start.dropped}")
    table.add(
        "processor of the camera, librealsense and the driver; of the app, %", f"{100 * theirs:.1f}, {100 * ours:.1f}"
    )


# Latency: from pushing a set to the frame in the app.


def latencies(seconds: float) -> list[float]:
    """Return those of ``Camera.read``, s; the stamp of a frame is the host's time at the push of its first image."""
    with hal.open(rig_file(emulated={"clock": "system"})) as rig:
        camera = rig.cameras["cam"]
        camera.read(5.0)
        found, began = [], time.monotonic()
        while time.monotonic() - began < seconds:
            frame = camera.read(5.0)
            found.append(rig.clock.now() - frame.stamp.t)
    return found


def bare_latencies(seconds: float) -> list[float]:
    """Return those of the library alone in this process, aligned and copied, s."""
    import pyrealsense2 as rs

    context, camera = emulated_context(), SoftwareCamera(load(rig_file()).resolve().cameras[0])
    camera.attach(context)
    pipeline, config, align = rs.pipeline(context), rs.config(), rs.align(rs.stream.color)
    config.enable_device(camera.serial)
    pipeline.start(config)
    found, began = [], time.monotonic()
    while time.monotonic() - began < seconds or not found:
        arrived, frames = pipeline.try_wait_for_frames(1000)
        if not arrived or frames.size() < 3:
            continue
        for frame in align.process(frames):
            np.asanyarray(frame.get_data()).copy()
        now, number = time.monotonic(), frames.get_depth_frame().get_frame_number()
        found += [now - sent.t for sent in camera.sent if sent.number == number]
    pipeline.stop()
    camera.close()
    return found


# Unplugged beside an arm.


def unplug(seconds: float, gone: float, table: Table) -> None:
    """Drive a simulated Panda at 50 Hz while the camera is unplugged for some seconds."""
    overrides = [f"cameras={json.dumps({'cam': rig_file()['cameras']['cam'] | {'sim': False}})}"]
    took: list[float] = []
    with hal.open("panda_table", sim=None, pad="none", overrides=overrides) as rig:
        arm, camera = rig.robots["panda"], rig.cameras["cam"]

        def pull() -> None:
            time.sleep(0.2 * seconds)
            camera.inject(disconnect=True)
            time.sleep(gone)
            since = time.monotonic()
            camera.inject(disconnect=False)
            while not took and time.monotonic() - since < 30.0:
                with contextlib.suppress(hal.ConnectionLost, hal.StaleStateError):
                    camera.read(1.0, after=since)
                    took.append(time.monotonic() - since)

        camera.read(5.0)
        stops, times = 0, []
        puller = threading.Thread(target=pull)
        with arm.control(rate_hz=50, unattended=True) as control, ticks_missed(rig) as host:
            if gone:
                puller.start()
            for tick in rig.clock.rate(50):
                times.append(time.monotonic())
                try:
                    control.send(hal.Twist([0.0, 0.05 * np.cos(tick.elapsed), 0.0]))
                except hal.MotionStopped:
                    stops += 1
                    control.rearm()
                if tick.elapsed > seconds:
                    break
        if gone:
            puller.join()
    back = f"; first frame {took[0]:.2f} s after replugging" if took else ""
    text = f"{host['missed']:.2f} %; {1e3 * np.diff(times).max():.0f} ms; {stops}{back}"
    name = f"unplugged for {gone:g} s" if gone else "not unplugged (reference)"
    table.add(f"{name}: the arm's ticks missed; longest turn of the app; stops", text)


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    seconds = 0.5 if quick else 10.0
    table = Table("an emulated D435, three VGA streams at 30 Hz", ("", ""))
    live(seconds, table)
    table.add("set pushed to frame in the app, ms", ms(latencies(seconds), 0.5, 0.99))
    table.add("the library alone (reference)", ms(bare_latencies(seconds), 0.5, 0.99))
    unplug(1.0 if quick else 10.0, 0.0, table)
    unplug(1.0 if quick else 10.0, 0.5 if quick else 3.0, table)
    yield table
