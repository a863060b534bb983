"""The console: start-up, cost, latency from page to set-point, and time from the end of a browser to the arm's braking.

    python benchmarks/console.py [--seconds 20] [--runs 30] [--only start cost latency stops]

Needs chromium and chromedriver, like the browser tests. References in the same run: the app without the console (cost,
missed ticks), and a pad whose driver lives in the app (latency).
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from browser.kit import Bench, Browser, wait_for  # noqa: E402

import hal  # noqa: E402

TICKS = os.sysconf("SC_CLK_TCK")


def cpu(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def percentiles(values: list[float]) -> str:
    """Format p50, p99 and the maximum, ms."""
    ordered = sorted(values)
    at = ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]
    return f"p50 {1e3 * statistics.median(ordered):.1f}  p99 {1e3 * at:.1f}  max {1e3 * ordered[-1]:.1f} ms"


def start(runs: int) -> None:
    """Print the time from the command to a link that answers, in a fresh process, and the share of imports."""
    imports = "import hal, hal.rig, hal.config, hal.kinematics.arm, pinocchio, ruckig, pydantic, pybullet"
    begun = time.monotonic()
    subprocess.run([sys.executable, "-c", imports], check=True, stdout=subprocess.DEVNULL)
    print(f"imports alone: {time.monotonic() - begun:.2f} s")
    for _ in range(runs):
        command = [sys.executable, str(ROOT / "apps" / "teleop.py"), "--sim", "--pad", "web", "--listen", ":0"]
        begun = time.monotonic()
        app = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert app.stdout is not None
        link = next(line.strip() for line in app.stdout if "http://" in line)
        printed = time.monotonic() - begun
        parts = urlsplit(link)
        with socket.create_connection((parts.hostname, parts.port or 80), 5.0) as connection:
            connection.sendall(f"GET / HTTP/1.1\r\nHost: {parts.netloc}\r\nConnection: close\r\n\r\n".encode())
            assert b"200" in connection.recv(100)
        print(f"link printed after {printed:.2f} s, page served after {time.monotonic() - begun:.2f} s")
        app.terminate()
        app.wait(20.0)


def cost(seconds: float) -> None:
    """Print the console's processor time and the servo's missed ticks, with a page that drives."""
    with hal.open("panda_table", sim=True, pad="none") as rig:
        print(f"{'without the console':34s}{'':26s} missed {_missed(rig, seconds):.2f} %")
    bench = Bench(cameras=True)
    try:
        pid = bench.console._child.process.pid  # type: ignore[attr-defined]
        _console(bench, pid, "console, no page", seconds)
        page = subprocess.Popen([sys.executable, __file__, "--page", bench.link])
        try:
            wait_for(lambda: bench.status == "following", "the page without a browser to drive")
            _console(bench, pid, "console, a page without a browser", seconds)
        finally:
            page.terminate()
            page.wait()
        browser = Browser()
        try:
            browser.open(bench.link)
            browser.wait_driving()
            browser.hold()
            _console(bench, pid, "console, Chromium drives, two cameras", seconds)
            state = browser.facts["lastState"]["cameras"]
            print(
                "    "
                + ", ".join(f"{name} {at['fps']:.1f}/s, {1e3 * at['age']:.0f} ms old" for name, at in state.items())
            )
            print(f"    trips: {bench.session.report.trips or 'none'}")
            browser.let_go()
        finally:
            browser.close()
    finally:
        bench.close()


def _missed(rig: hal.Rig, seconds: float) -> float:
    group = next(iter(rig.statistics()))
    before = rig.statistics()[group]
    time.sleep(seconds)
    after = rig.statistics()[group]
    ticks, missed = after["ticks"] - before["ticks"], after["missed"] - before["missed"]
    return 100.0 * missed / (ticks + missed)


def _console(bench: Bench, pid: int, name: str, seconds: float) -> None:
    before = cpu(pid)
    missed = _missed(bench.rig, seconds)
    share = 100.0 * (cpu(pid) - before) / seconds
    print(f"{name:34s} {share:5.1f} % of a processor   missed {missed:.2f} %")


async def be_a_page(link: str) -> None:
    """Act as the page without the load of a browser: hold the dead-man, receive every picture."""
    import asyncio

    import aiohttp

    parts = urlsplit(link)
    origin = f"http://{parts.netloc}"
    options: dict[str, Any] = {"protocols": ("hal.v1", parts.fragment), "origin": origin}
    seen, arrived = 0.0, time.monotonic()
    async with aiohttp.ClientSession() as session:
        live = await session.ws_connect(f"{origin}/live", **options)
        pictures = await session.ws_connect(f"{origin}/pictures", **options)
        await live.send_json({"type": "lease", "take": True})
        names: list[str] = []

        async def hear() -> None:
            nonlocal seen, arrived, names
            async for message in live:
                said = message.json()
                if said["type"] in ("beat", "lease"):
                    seen, arrived = said["t"], time.monotonic()
                elif said["type"] == "hello":
                    names = [camera["name"] for camera in said["rig"]["cameras"]]
                    await pictures.send_json({"type": "watch", "cameras": names})

        async def draw() -> None:
            async for message in pictures:
                await pictures.send_json({"type": "drawn", "camera": names[message.data[0]]})

        async def beat() -> None:
            turn = 0
            while True:
                await asyncio.sleep(0.02)
                turn += 1
                held = turn > 50
                since = 1e3 * (time.monotonic() - arrived)
                axes = [0.0, 0.0, 0.0, 0.0, float(held), 0.0, 0.0, 0.0]
                buttons = (1 << 6) * held
                await live.send_json({"type": "pad", "seen": seen, "since": since, "axes": axes, "buttons": buttons})

        await asyncio.gather(hear(), draw(), beat())


def latency(runs: int) -> None:
    """Print the time from a key event in the page to the first set-point that moves."""
    bench, browser = Bench(), Browser()
    found = []
    try:
        browser.open(bench.link)
        browser.wait_driving()
        # The event's own time stamp, by the wall clock that all processes of this machine share.
        browser.run(
            """const note = (event) => { if (!event.repeat) window.t0 = performance.timeOrigin + event.timeStamp };
               window.addEventListener('keydown', note, true)"""
        )
        for turn in range(runs):
            browser.hold()
            wait_for(lambda: bench.status == "following", "the arm to follow")
            time.sleep(0.1 + 0.0137 * (turn % 7))  # not in step with the app's loop
            key = ("ArrowLeft", "ArrowRight")[turn % 2]
            shift = time.time() - time.monotonic()
            watch = _Watch(bench)
            browser.key(key, key, True)
            moved = watch.result()
            pressed = browser.run("return window.t0") / 1e3 - shift
            found.append(moved - pressed)
            browser.key(key, key, False)
            browser.let_go()
            wait_for(lambda: bench.speed() == 0.0, "the arm to rest")
        print(f"key in the page to the first moving set-point, {runs} presses: {percentiles(found)}")
        own = bench.rig.statistics()["simulation"]["robots"]["panda"]["latency_s"]
        text = f"p50 {1e3 * own['p50']:.1f}  p99 {1e3 * own['p99']:.1f} ms"
        print(f"of these, from the page's message to the set-point written:  {text}")
    finally:
        browser.close()
        bench.close()


class _Watch:
    """Waits for the first set-point that moves, in a thread because the call that presses the key returns late."""

    def __init__(self, bench: Bench) -> None:
        import threading

        self._bench = bench
        self._moved = 0.0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            servo = self._bench.servo
            if any(servo.dq_set):
                self._moved = servo.t_written
                return
            time.sleep(0.0005)

    def result(self) -> float:
        self._thread.join()
        assert self._moved, "nothing moved"
        return self._moved


def stops(runs: int) -> None:
    """Print the time from an event in the browser to the start of braking, at full speed."""
    ways: dict[str, Callable[[Browser], float]] = {
        "key let go (reference)": lambda browser: _timed(lambda: browser.let_go()),
        "stop button": lambda browser: _timed(lambda: browser.key("Escape", "Escape", True)),
        "page reloaded": lambda browser: _timed(lambda: browser.run("location.reload()")),
        "browser frozen (SIGSTOP)": lambda browser: browser.freeze(),
        "browser killed (SIGKILL)": _kill,
    }
    for name, way in ways.items():
        print(f"{name:28s} braking begins after {percentiles([_stop(way) for _ in range(runs)])}")


def _stop(way: Callable[[Browser], float]) -> float:
    bench, browser = Bench(), Browser()
    try:
        browser.open(bench.link)
        browser.wait_driving()
        wait_for(lambda: bench.session.pad.state().connected, "the pad")
        browser.hold()
        browser.key("ArrowLeft", "ArrowLeft", True)
        wait_for(lambda: bench.tcp_speed[1] > 0.15, "full speed")
        event = way(browser)
        wait_for(lambda: bench.speed() == 0.0, "the arm to rest")
        return bench.servo.t_stop - event
    finally:
        browser.close()
        bench.close()


def _timed(action: Callable[[], Any]) -> float:
    now = time.monotonic()
    action()
    return now


def _kill(browser: Browser) -> float:
    import signal

    now = time.monotonic()
    for pid in browser.processes():
        os.kill(pid, signal.SIGKILL)
    return now


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description="start-up, cost, latency and stops of the console")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement of cost (%(default)s)")
    parser.add_argument("--runs", type=int, default=30, help="presses for the latency (%(default)s); a tenth for stops")
    parser.add_argument("--only", nargs="+", default=["start", "cost", "latency", "stops"], help="parts to run")
    parser.add_argument("--page", metavar="LINK", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.page:
        import asyncio

        asyncio.run(be_a_page(args.page))
    few = max(3, args.runs // 10)
    parts = {
        "start": lambda: start(few),
        "cost": lambda: cost(args.seconds),
        "latency": lambda: latency(args.runs),
        "stops": lambda: stops(few),
    }
    for name in args.only:
        print(f"\n{name}")
        parts[name]()


if __name__ == "__main__":
    main()
