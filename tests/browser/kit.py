"""A rig with its console, an app's control loop, and headless Chromium in front of it."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

import hal
from hal.apps.teleop import TeleopRun, parser
from hal.commands import DeadmanRecord
from hal.deadman import Deadman
from hal.host.records import ServoRecord
from hal.robot import Robot
from hal.servo.watchdog import PAD_SILENCE

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
CHROMEDRIVER = shutil.which("chromedriver") or ""
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--mute-audio",
)
MAX_AGE = 0.1
"""s after which the console shows no state any more."""
PATIENCE = 20.0
"""s until a test gives up on a browser that shares two processors with a simulation."""
TRIES = 3
"""How often a test is tried whose machine was too busy for the pad, the arm or the app to be heard in time."""
DISTURBANCES: list[float] = []
"""When that was so, s, monotonic."""
_BUSY = ("app_silent", "command_late", "host_late", "deadman_silent")
"""Trips for which a busy machine suffices."""


class Bench:
    """A simulated rig that its console drives, with the teleoperation app's own loop in a thread."""

    def __init__(
        self,
        cameras: bool = False,
        rig: Any = "panda_table",
        listen: str = ":0",
        robots: Sequence[str] = (),
        **options: Any,
    ) -> None:
        self.args = parser().parse_args(["--sim"])
        overrides = [] if cameras else ["cameras={}"]
        self.rig = hal.open(rig, sim=True, pad="web", listen=listen, overrides=overrides, **options)
        self.arm: Robot = next(iter(self.rig.robots.values()))
        assert self.rig.console is not None
        self.console = self.rig.console
        self.link = self.console.link
        self.app = TeleopRun(self.rig, [self.rig.robots[name] for name in robots] or [self.arm], self.args)
        self.session = self.app.session
        self._alive = math.inf
        self.deadman.attach(self._heard)
        self._thread = threading.Thread(target=self.app.run, name="the app's loop")
        self._thread.start()

    @property
    def servo(self) -> ServoRecord:
        """What the servo says now."""
        found = self.arm._mail.peek()
        assert found is not None
        return found

    @property
    def deadman(self) -> Deadman:
        """What must be held for the arm to move."""
        return self.session.deadman

    @property
    def status(self) -> str:
        """What the arm does, for example ``following``."""
        return str(self.servo.status)

    @property
    def trip(self) -> str:
        """Why a stop is latched, for example ``deadman_silent``; ``none``."""
        return str(self.servo.trip)

    @property
    def tcp(self) -> Any:
        """Where the tool centre point is, (3,) m."""
        return self.arm.state(max_age=2.0).tcp.position

    @property
    def tcp_speed(self) -> Any:
        """How fast it goes, (3,) m/s."""
        return self.arm.state(max_age=2.0).tcp_twist[:3]

    def speed(self) -> float:
        """Greatest joint speed of the set-point, rad/s."""
        return max(abs(value) for value in self.servo.dq_set)

    def _heard(self, record: DeadmanRecord) -> None:
        """Called whenever the pad was looked at: notes when that, the arm or the app was silent for too long."""
        now = time.monotonic()
        servo = self.arm._mail.peek()
        if now - self._alive > PAD_SILENCE or (servo is not None and now - servo.t_written > MAX_AGE):
            DISTURBANCES.append(now)
        if servo is not None and str(servo.trip) in _BUSY:
            DISTURBANCES.append(servo.t_stop)
        self._alive = record.t_alive if record.connected else math.inf

    def rests(self) -> bool:
        """Does the arm stand still? A goal that is held may leave its set-point a last bit of speed."""
        return self.speed() < 1e-3

    def close(self) -> None:
        self.args.duration = self.app.end_time = self.rig.clock.now()
        self._thread.join(PATIENCE)
        self.rig.close()
        assert not self._thread.is_alive()


class Browser:
    """Headless Chromium with one profile of its own."""

    def __init__(self, width: int = 1280, height: int = 800, flags: Sequence[str] = FLAGS) -> None:
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        self._profile = tempfile.mkdtemp(prefix="hal-browser-")
        for flag in (*flags, f"--user-data-dir={self._profile}", f"--window-size={width},{height}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        service = webdriver.ChromeService(executable_path=CHROMEDRIVER)
        self.chrome = webdriver.Chrome(options=options, service=service)
        self.size(width, height)

    def size(self, width: int, height: int, touch: bool = False) -> None:
        """Show a page of so many CSS pixels."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": touch}
        self.cdp("Emulation.setDeviceMetricsOverride", **metrics)
        self.cdp("Emulation.setTouchEmulationEnabled", enabled=touch, maxTouchPoints=5 if touch else 1)

    def cdp(self, method: str, **params: Any) -> Any:
        """Ask Chromium itself, by its devtools protocol."""
        return self.chrome.execute_cdp_cmd(method, params)

    def run(self, script: str, *arguments: Any) -> Any:
        """Run JavaScript in the page."""
        return self.chrome.execute_script(script, *arguments)

    def open(self, link: str) -> None:
        """Open the console."""
        self.chrome.get("about:blank")  # a link that differs in its fragment only would not load anything
        self.chrome.get(link)
        self.cdp("Page.bringToFront")  # a window that was opened or closed meanwhile may have the focus

    @property
    def facts(self) -> dict[str, Any]:
        """What the page says of itself."""
        return self.run("return window.halConsole ? JSON.parse(JSON.stringify(window.halConsole)) : {}")

    def wait_driving(self) -> None:
        """Until the page drives, and hears about the arm."""
        wait_for(lambda: self.facts.get("driving") and self.facts.get("lastState"), "the page to drive")

    def text(self, selector: str) -> str:
        """The text of an element as it is shown; "" where it is not."""
        script = "const e = document.querySelector(arguments[0]); return e && e.checkVisibility() ? e.innerText : ''"
        return str(self.run(script, selector))

    def place(self, selector: str) -> dict[str, float]:
        """Its rectangle in CSS pixels: left, top, width, height, x and y of its centre."""
        script = """const r = document.querySelector(arguments[0]).getBoundingClientRect();
            return {left: r.left, top: r.top, right: r.right, bottom: r.bottom, width: r.width, height: r.height,
                    x: r.left + r.width / 2, y: r.top + r.height / 2}"""
        return dict(self.run(script, selector))

    # A person's hands: real input events, not calls into the page.

    def key(self, code: str, key: str, down: bool) -> None:
        """Press a key, or let it go; ``code`` as in KeyboardEvent.code."""
        virtual = {"Space": 32, "Escape": 27, "ArrowUp": 38, "ArrowDown": 40, "ArrowLeft": 37, "ArrowRight": 39}
        number = virtual.get(code, ord(key.upper()) if len(key) == 1 else 0)
        kind = "rawKeyDown" if down else "keyUp"
        self.cdp("Input.dispatchKeyEvent", type=kind, code=code, key=key, windowsVirtualKeyCode=number)

    def tap(self, code: str, key: str) -> None:
        """Press a key and release it."""
        self.key(code, key, True)
        self.key(code, key, False)

    def hold(self) -> None:
        """Hold the dead-man with the space bar."""
        self.key("Space", " ", True)

    def let_go(self) -> None:
        """And let it go."""
        self.key("Space", " ", False)

    def mouse(self, kind: str, x: float, y: float) -> None:
        """``mousePressed``, ``mouseMoved`` or ``mouseReleased`` at a place, with the left button."""
        self.cdp("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def click(self, selector: str) -> None:
        """Click where an element is."""
        at = self.place(selector)
        self.mouse("mousePressed", at["x"], at["y"])
        self.mouse("mouseReleased", at["x"], at["y"])

    @contextlib.contextmanager
    def drag(self, disc: str, right: float, up: float) -> Iterator[None]:
        """Take a disc with the mouse and push it so far (shares of its way, -1..1) for as long as the block lasts."""
        at = self.place(f'[data-disc="{disc}"]')
        radius = 0.4 * at["width"]  # where the rim counts as reached
        self.mouse("mousePressed", at["x"], at["y"])
        x, y = at["x"] + right * radius, at["y"] - up * radius
        self.mouse("mouseMoved", x, y)
        try:
            yield
        finally:
            self.mouse("mouseReleased", x, y)

    # What may happen to a browser.

    def processes(self) -> list[int]:
        """Every process of this browser; not that of chromedriver."""
        found, wanted = [], {self.chrome.service.process.pid}
        parents = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with contextlib.suppress(OSError, ValueError, IndexError):
                    parents[int(entry.name)] = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
        grown = True
        while grown:
            children = [pid for pid, parent in parents.items() if parent in wanted and pid not in wanted]
            wanted.update(children)
            found.extend(children)
            grown = bool(children)
        return found

    def freeze(self) -> float:
        """Stop all of its processes; returns when the last one was."""
        for pid in self.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
        return time.monotonic()

    def thaw(self) -> None:
        """Let them go on."""
        for pid in self.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def complaints(self) -> list[str]:
        """Errors that the page met: exceptions, refused scripts."""
        return [entry["message"] for entry in self.chrome.get_log("browser") if entry["level"] == "SEVERE"]

    def close(self) -> None:
        self.thaw()
        self.chrome.quit()
        shutil.rmtree(self._profile, ignore_errors=True)


def disturbed(since: float) -> bool:
    """Return whether the pad, the arm or the app's loop was silent for longer than they may be, since s, monotonic.

    On a machine with too much else to do that happens, and the arm must not move then, nor a press count.
    """
    return any(t >= since for t in DISTURBANCES)


def wait_for(condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> float:
    """When the condition first held; fails when it did not in time."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"waited {timeout:g} s for {what}")
        time.sleep(0.002)
    return time.monotonic()


def need_browser() -> None:
    """Skip where there is no browser."""
    pytest.importorskip("selenium")
    if not (CHROMIUM and CHROMEDRIVER):
        pytest.skip("needs chromium and chromium-driver (Debian's packages)")
