"""A RealSense: received frames, cost, rate, latency, and the effect of an unplugged camera on an arm.

    python benchmarks/realsense.py [--seconds 20] [--only live recording latency unplug]

The camera is emulated (librealsense's software device, its pictures known exactly) and lives in the process that the
driver has for librealsense. References in the same run: that camera fed to nobody, the library's own loop on the
same recording, and the arm while nothing is unplugged.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal.drivers.realsense.emulator import SoftwareCamera, write_recording

PHASES = 8
"""Number of images after which all but the drawn number repeats; aligned depth does not show the number."""
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


def cpu(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


def children() -> list[int]:
    """Return the processes that this one has started."""
    found = []
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            found += [int(pid) for pid in (task / "children").read_text().split()]
    return found


def percentiles(values: list[float]) -> str:
    """Format p50 and p99, ms."""
    return f"p50 {1e3 * np.percentile(values, 50):.1f}  p99 {1e3 * np.percentile(values, 99):.1f} ms"


# Live.


def live(seconds: float) -> None:
    """Print whether every image is exact, and the cost of reading."""
    alone = fed_to_nobody(seconds)
    with hal.open(rig_file()) as rig:
        camera = rig.cameras["cam"]
        pids = children()
        camera.read(5.0)
        before, app, began = sum(map(cpu, pids)), time.process_time(), time.monotonic()
        while time.monotonic() - began < seconds:
            camera.read(5.0)
        span = time.monotonic() - began
        theirs, ours = (sum(map(cpu, pids)) - before) / span, (time.process_time() - app) / span
    print(f"  {'camera and librealsense, fed to nobody (reference)':58s} {100 * alone:5.1f} % of a processor")
    print(f"  {'camera, librealsense and driver':58s} {100 * theirs:5.1f} %")
    print(f"  {'the app, which reads every frame':58s} {100 * ours:5.1f} %")
    print(f"  {'so the reader, without what feeds it':58s} {100 * (theirs + ours - alone):5.1f} %")
    exactness(seconds)


def fed_to_nobody(seconds: float) -> float:
    """Return the share of a processor that the emulated camera uses in a process of its own."""
    command = [sys.executable, __file__, "--feed", str(seconds)]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def feed(seconds: float) -> float:
    """Run the emulated camera in this process for so many seconds."""
    import pyrealsense2 as rs

    from hal.drivers.realsense.emulator import emulated_context

    context, camera = emulated_context(), SoftwareCamera(spec())
    camera.attach(context)
    queues = []
    for sensor in context.query_devices()[0].query_sensors():
        wanted = [p for p in sensor.get_stream_profiles() if p.is_default() and p.stream_index() < 2]
        queues.append((sensor, rs.frame_queue(1)))
        sensor.open(wanted)
        sensor.start(queues[-1][1])
    time.sleep(1.0)  # the pictures are made
    before, began = time.process_time(), time.monotonic()
    time.sleep(seconds)
    share = (time.process_time() - before) / (time.monotonic() - began)
    assert camera.sent[-1].number > 25 * seconds, "it was not fed"
    for sensor, _ in queues:
        sensor.stop()
        sensor.close()
    camera.close()
    return share


def spec() -> Any:
    """Return the camera's record, as the rig resolves it."""
    with hal.open(rig_file()) as rig:
        return rig.cameras["cam"].spec


def exactness(seconds: float) -> None:
    """Compare every pixel with what was sent, and aligned depth with the library's own alignment."""
    with hal.open(rig_file()) as rig:
        camera = rig.cameras["cam"]
        reference = SoftwareCamera(camera.spec)
        aligned = aligned_by_the_library(camera.spec)
        reference.expected(1)  # what is to be compared with is made once
        sets, exact = 0, dict.fromkeys(STREAMS, 0)
        first = number = camera.read(5.0).stamp.seq
        start, began = camera.counts(), time.monotonic()
        while time.monotonic() - began < seconds:
            frame = camera.read(5.0)
            number = frame.stamp.seq
            meant = reference.expected(number)
            sets += 1
            exact["color"] += np.array_equal(frame.color, meant["color"])
            exact["infrared"] += np.array_equal(frame.infrared, meant["infrared"])
            exact["depth"] += np.array_equal(np.rint(frame.depth * 1000.0), aligned[number % PHASES])
        counts = camera.counts()
        reference.close()
    same = "  ".join(f"{name} {100.0 * found / sets:.1f} %" for name, found in exact.items())
    print(f"  sets read {sets} of {number - first} sent meanwhile; exact to the last bit: {same}")
    print(
        f"  dropped {counts.dropped - start.dropped}, mismatched {counts.mismatched - start.mismatched}, "
        f"repeated {counts.repeated - start.repeated}"
    )


def aligned_by_the_library(camera: Any) -> dict[int, np.ndarray]:
    """Return phase -> depth in the view of colour, mm, by a bare loop over a recording; 0 beyond the camera's range."""
    found: dict[int, np.ndarray] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "phases.db3"
        write_recording(path, camera, 2 * PHASES + 2)
        for number, _, depth in bare_loop(path):
            depth[(depth < 1000.0 * camera.depth_min) | (depth > 1000.0 * camera.depth_max)] = 0
            found[number % PHASES] = depth
    assert len(found) == PHASES
    return found


def bare_loop(path: Path) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Play with the library alone (wait, align, copy); yield number, colour and depth of each set."""
    import pyrealsense2 as rs

    context = rs.context()
    device = context.load_device(str(path))
    pipeline, align = rs.pipeline(context), rs.align(rs.stream.color)
    pipeline.set_device(device)
    device.set_real_time(False)
    pipeline.start(rs.config())
    try:
        while True:
            arrived, frames = pipeline.try_wait_for_frames(1000)
            if not arrived:
                return
            aligned = align.process(frames)
            color, depth = aligned.get_color_frame(), aligned.get_depth_frame()
            yield (
                depth.get_frame_number(),
                np.asanyarray(color.get_data()).copy(),
                np.asanyarray(depth.get_data()).copy(),
            )
    finally:
        pipeline.stop()


# A recording.


def recording(seconds: float) -> None:
    """Print aligned frames per second, as fast as possible."""
    frames = max(150, round(30 * seconds))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.db3"
        resolved = spec()
        began = time.monotonic()
        write_recording(path, resolved, frames)
        wrote = time.monotonic() - began
        size = path.stat().st_size / 1e6
        print(f"  {frames} sets of three VGA pictures written in {wrote:.1f} s, {size:.1f} MB")
        print(f"  {'':34s} {'frames/s':>10s} {'processor time for each':>26s}")
        for _ in range(3):
            rate, each = bare_rate(path)
            print(f"  {'library: wait, align, copy (ref.)':34s} {rate:10.0f} {1e3 * each:23.1f} ms")
            rate, each, got, counts = read_rate(path)
            print(
                f"  {'Camera.read':34s} {rate:10.0f} {1e3 * each:23.1f} ms"
                f"   {got} of {frames} read, dropped {counts.dropped}, mismatched {counts.mismatched}"
            )


def bare_rate(path: Path) -> tuple[float, float]:
    """Return frames per second, and processor time for each, s."""
    before = time.process_time()
    times = [time.monotonic() for _ in bare_loop(path)]
    return (len(times) - 1) / (times[-1] - times[0]), (time.process_time() - before) / len(times)


def read_rate(path: Path) -> tuple[float, float, int, Any]:
    """Return the same through `hal`, both processes, with the number of frames and the camera's counts."""
    real = {"emulated": False, "play": str(path), "paced": False, "repeat": False}
    times = []
    with hal.open(rig_file(**real)) as rig:
        camera = rig.cameras["cam"]
        spans = []
        with contextlib.suppress(hal.ConnectionLost, hal.StaleStateError):
            while True:
                camera.read(2.0)
                times.append(time.monotonic())
                if len(times) % 50 == 0:
                    spans.append(time.process_time() + sum(map(cpu, children())))
        counts = camera.counts()
    each = (spans[-1] - spans[0]) / (50 * (len(spans) - 1))
    return (len(times) - 1) / (times[-1] - times[0]), each, len(times), counts


# Latency.


def latency(seconds: float) -> None:
    """Print the time from pushing the last image of a set to the frame in the app.

    The stamps are the host's time at each push (``clock: system``), the last one is colour's.
    """
    with hal.open(rig_file(emulated={"clock": "system"})) as rig:
        camera = rig.cameras["cam"]
        camera.read(5.0)
        found, began = [], time.monotonic()
        while time.monotonic() - began < seconds:
            frame = camera.read(5.0)
            found.append(rig.clock.now() - frame.stamp.t - frame.skew)
    print(f"  {'last picture pushed -> Camera.read returns':48s} {percentiles(found)}   ({len(found)} frames)")
    print(f"  {'the library alone: pushed -> its set (reference)':48s} {percentiles(bare_latency(seconds))}")
    print(f"  new memory in the app for a frame: {new_memory():.2f} times its pictures")


def bare_latency(seconds: float) -> list[float]:
    """Return the same for the library alone in this process, aligned and copied."""
    import pyrealsense2 as rs

    from hal.drivers.realsense.emulator import emulated_context

    context, camera = emulated_context(), SoftwareCamera(spec())
    camera.attach(context)
    pipeline, config, align = rs.pipeline(context), rs.config(), rs.align(rs.stream.color)
    config.enable_device(camera.serial)
    pipeline.start(config)
    found, began = [], time.monotonic()
    while time.monotonic() - began < seconds:
        arrived, frames = pipeline.try_wait_for_frames(1000)
        if not arrived or frames.size() < 3:
            continue
        for frame in align.process(frames):
            np.asanyarray(frame.get_data()).copy()
        now = time.monotonic()
        number = frames.get_depth_frame().get_frame_number()
        found += [now - sent.t for sent in camera.sent if sent.number == number]
    pipeline.stop()
    camera.close()
    return found


def new_memory() -> float:
    """Return the memory that a driver's ``grab`` allocates per byte of the images that it returns."""
    from hal import registry

    driver = registry.load("realsense", "camera")(spec())
    driver.open()
    shares = []
    try:
        while driver.grab(1.0) is None:
            pass
        tracemalloc.start()
        for _ in range(10):
            time.sleep(0.05)  # one is there
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            frame = driver.grab(1.0)
            pictures = [getattr(frame, name) for name in STREAMS] if frame is not None else []
            peak = tracemalloc.get_traced_memory()[1]
            if pictures:
                shares.append((peak - before) / sum(picture.nbytes for picture in pictures))
            del frame, pictures
    finally:
        tracemalloc.stop()
        driver.close()
    return float(np.median(shares))


# Unplugged beside an arm.


def unplug(seconds: float) -> None:
    """Drive a simulated Panda at 50 Hz, undisturbed and while the camera is unplugged for 3 s."""
    camera = rig_file()["cameras"]["cam"] | {"sim": False}
    overrides = [f"cameras={json.dumps({'cam': camera})}"]
    with hal.open("panda_table", sim=None, pad="none", overrides=overrides) as rig:
        arm, cam = rig.robots["panda"], rig.cameras["cam"]
        arm.move_to(arm.home, unattended=True, speed=0.3)
        cam.read(5.0)
        for name, gone in (("nothing happens (reference)", 0.0), ("unplugged for 3 s", 3.0)):
            missed, late, trips, back = drive(rig, arm, cam, max(seconds, 8.0), gone)
            print(
                f"  {name:30s} ticks of the servo missed {missed:.2f} %   the app's loop: longest period "
                f"{1e3 * late:.0f} ms, stops {trips}"
            )
        print(f"  replugged -> first good frame: {back:.2f} s; reconnects {cam.counts().reconnects}")


def drive(rig: hal.Rig, arm: Any, cam: Any, seconds: float, gone: float) -> tuple[float, float, int, float]:
    """Return missed ticks in %, longest loop period in s, number of stops, and the camera's time to reconnect in s."""
    import threading

    took: list[float] = []

    def pull() -> None:
        time.sleep(2.0)
        cam.inject(disconnect=True)
        time.sleep(gone)
        since = time.monotonic()
        cam.inject(disconnect=False)
        while time.monotonic() - since < 30.0:
            with contextlib.suppress(hal.ConnectionLost, hal.StaleStateError):
                cam.read(1.0, after=since)
                took.append(time.monotonic() - since)
                return
            time.sleep(0.005)

    trips, periods = 0, []
    puller = threading.Thread(target=pull) if gone else None
    with arm.control(rate_hz=50, unattended=True) as control:
        before, start = rig.statistics()["simulation"], rig.clock.now()
        if puller:
            puller.start()
        last = time.monotonic()
        for tick in rig.clock.rate(50):
            now, turn = time.monotonic(), tick.t - start
            periods.append(now - last)
            last = now
            try:
                control.send(hal.Twist([0.0, 0.05 * np.cos(turn), 0.0], [0.0, 0.0, 0.0]))
            except hal.MotionStopped:
                trips += 1
                control.rearm()
            if turn > seconds:
                break
        after = rig.statistics()["simulation"]
    if puller:
        puller.join()
        assert took, "the camera did not come back within 30 s"
    ticks, missed = after["ticks"] - before["ticks"], after["missed"] - before["missed"]
    return 100.0 * missed / (ticks + missed), max(periods), trips, took[0] if took else 0.0


def main() -> None:
    """Print everything."""
    parts = {"live": live, "recording": recording, "latency": latency, "unplug": unplug}
    parser = argparse.ArgumentParser(description="an emulated RealSense through its driver")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=list(parts), default=list(parts), help="parts to run")
    parser.add_argument("--feed", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.feed:
        print(feed(args.feed))
        return
    for name in args.only:
        print(f"\n{name}")
        parts[name](args.seconds)


if __name__ == "__main__":
    main()
