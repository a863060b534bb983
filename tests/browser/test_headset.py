"""Driving with the hand controllers of a headset, which Meta's emulator of WebXR (IWER, MIT) plays in the browser."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from .kit import Bench, Browser, need_browser, wait_for
from .moves import BRIEF, clear_trip, undisturbed
from .test_settings import TWO_ARMS
from .test_taps import LISTEN

TWO_HANDS = TWO_ARMS | {
    "gamepads": {
        "page": {"driver": "web", "drives": "left"},
        "hand": {"driver": "web", "drives": "right", "options": {"hand": "right"}},
    },
}

IWER, DIGEST = "iwer@2.5.0", "23d8640949f19db4b1e70398b30e084e4aa555f3a81e4329da3fac1a70b39542"
WEAR = """
if (self === top) {
  window.device = new IWER.XRDevice(IWER.metaQuest3);
  device.installRuntime({ forceInstall: true }); // in place of the browser's own, which has no device
  window.hands = device.controllers;
  window.hand = hands.right;
  Object.assign(window, { blind: false, steady: false, speed: [0, 0, 0] }); // speed in m per picture
  Object.defineProperty(XRPose.prototype, 'emulatedPosition', { get: () => blind });
  window.rest = () => {
    Object.assign(window, { blind: false, steady: false, speed: [0, 0, 0] });
    hand.connected = true;
    device.updateVisibilityState('visible');
    for (const one of Object.values(hands)) {
      for (const name of ['squeeze', 'trigger']) one.updateButtonValue(name, 0);
    }
    hand.updateButtonValue('a-button', 0);
    hand.quaternion.set(0, 0, 0, 1);
  };
  let tremble = 1e-5;
  const live = () => {
    requestAnimationFrame(live);
    hands.left.position.y += tremble;
    if (steady) return;
    hand.position.x += speed[0] + (tremble = -tremble);
    hand.position.y += speed[1];
    hand.position.z += speed[2];
  };
  live();
}
"""


@pytest.fixture(scope="session")
def iwer(pytestconfig: pytest.Config) -> str:
    """The emulator's script."""
    return load_iwer(Path(pytestconfig.cache.mkdir("iwer")))


def load_iwer(folder: Path) -> str:
    """Return the emulator's script, from npm; it is kept in the folder for the next run."""
    folder.mkdir(parents=True, exist_ok=True)
    found = folder / f"{IWER.replace('@', '-')}.tgz"
    for _ in range(3):
        if found.exists() or not shutil.which("npm"):
            break
        subprocess.run(["npm", "pack", "--silent", IWER], cwd=folder, timeout=60, check=False, capture_output=True)
    if not found.exists():
        pytest.skip(f"needs {IWER} from npm")
    with tarfile.open(found) as package:
        script = package.extractfile("package/build/iwer.min.js").read()
    assert hashlib.sha256(script).hexdigest() == DIGEST
    return script.decode()


@contextmanager
def emulated(bench: Bench, page: Browser, iwer: str) -> Iterator[Browser]:
    """Open the page in a browser that has a headset."""
    script = page.cdp("Page.addScriptToEvaluateOnNewDocument", source=iwer + WEAR)["identifier"]
    page.open(bench.link)
    page.wait_driving()
    yield page
    page.cdp("Page.removeScriptToEvaluateOnNewDocument", identifier=script)


@pytest.fixture
def worn(bench: Bench, page: Browser, iwer: str) -> Iterator[Browser]:
    """The page in control, in a headset that shows it."""
    with emulated(bench, page, iwer):
        clear_trip(bench, page)
        yield page
    bench.rig.world.reset("panda")


@pytest.fixture
def two() -> Iterator[Bench]:
    """Two arms, one for each hand."""
    need_browser()
    bench = Bench(rig=TWO_HANDS, robots=("left", "right"))
    yield bench
    bench.close()


def wear(page: Browser) -> None:
    wait_for(lambda: page.text("#headset") == "Headset", "the button")
    page.click("#headset")
    wait_for(lambda: page.text("#headset") == "Leave headset", "the session")


def squeeze(bench: Bench, page: Browser) -> None:
    """Squeeze the right controller until the arm knows."""
    wait_for(lambda: bench.session.pad.state().connected and not bench.session.pad.waiting_for, "the pad", BRIEF)
    squeeze_anew(page, "right", lambda: bench.deadman.held)


def squeeze_anew(page: Browser, side: str, held: Callable[[], bool]) -> None:
    """Squeeze, and as a person does once more where a busy computer let go of it, until that counts."""
    for _ in range(5):
        page.run(f"hands.{side}.updateButtonValue('squeeze', 1)")
        with suppress(pytest.fail.Exception):
            wait_for(held, "the squeeze", 2.0)
            return
        page.run(f"hands.{side}.updateButtonValue('squeeze', 0)")
        page.run(LATER, 400)
    pytest.fail(f"no squeeze of the {side} hand counts")


def rest(bench: Bench, page: Browser) -> None:
    """Release, for as long as a person does between two squeezes."""
    page.run("rest()")
    wait_for(lambda: not bench.deadman.held and bench.rests(), "the arm to rest", BRIEF)
    two = "requestAnimationFrame(() => requestAnimationFrame(done))"  # pictures that show it released
    page.run(f"return new Promise((done) => setTimeout(() => {two}, 250))")


HUNG = ("the headset hangs", "the controller does not answer", "the tracking leapt")
"""What the page says when it shows a picture later than every 0.12 s: it lets go then, and a person squeezes anew."""
GLIDE = """const steps = { left: arguments[0], right: arguments[1] };
    return new Promise((done) => {
      let rest = 10;
      const next = () => {
        if (rest-- === 0) return done();
        for (const [side, [x, y, z]] of Object.entries(steps)) {
          hands[side].position.x += x;
          hands[side].position.y += y;
          hands[side].position.z += z;
        }
        requestAnimationFrame(next);
      };
      next();
    })"""
SHOWN = """
    const next = XRSession.prototype.requestAnimationFrame;
    window.pictures = [];
    XRSession.prototype.requestAnimationFrame = function (call) {
      return next.call(this, (...now) => {
        const start = performance.now();
        call(...now);
        if (sent.at(-1)?.hands.any) pictures.push({ start, sent: sent.at(-1).t >= start });
      });
    };
"""
"""Notes of each picture in which the hand holds whether a message was sent in it."""
LATER = "return new Promise((done) => setTimeout(done, arguments[0]))"


def test_two_hands_drive_two_arms(two: Bench, browser: Browser, iwer: str, caplog: pytest.LogCaptureFixture) -> None:
    """Each with a dead-man, a clutch and a gripper of its own.

    This test comes first: the module's own rig, which would run beside it, is not open yet.
    """
    assert [record.name for record in caplog.get_records("setup")].count("hal.console") == 1, "the link, once"
    arms = {arm.robot.name: arm for arm in two.session.arms}

    def tcps() -> np.ndarray:
        return np.array([arm.robot.state(max_age=2.0).tcp.position for arm in arms.values()])

    def move(left: tuple[float, float, float], right: tuple[float, float, float], *ways: tuple[float, ...]) -> None:
        """Move both hands by ten steps, and wait until the arms went these ways."""
        to = tcps() + ways
        browser.run(GLIDE, list(left), list(right))
        wait_for(lambda: abs(tcps() - to).max() < 2e-3, f"the ways {ways}", BRIEF)

    def hold() -> np.ndarray:
        """Rest, then squeeze with both hands; return where the arms are."""
        browser.run("rest()")
        pads = [arm.pad for arm in arms.values()]
        wait_for(lambda: all(pad.state().connected and not pad.waiting_for for pad in pads), "the pads", BRIEF)
        wait_for(lambda: not two.session.held, "both hands to be released", BRIEF)
        browser.run(LATER, 400)
        start = tcps()
        for side, arm in arms.items():
            squeeze_anew(browser, side, lambda deadman=arm.deadman: deadman.held)
        return start

    def move_both() -> None:
        start = hold()
        browser.run(LATER, 250)
        assert abs(tcps() - start).max() < 1e-4, "a squeeze moves nothing"
        move((0, 0, -0.01), (0, 0.01, 0), (0.1, 0, 0), (0, 0, 0.1))

    def release_one() -> None:
        hold()
        browser.run("hands.left.updateButtonValue('squeeze', 0)")
        wait_for(lambda: not arms["left"].deadman.held, "the left hand to let go", BRIEF)
        assert arms["right"].deadman.held, "the other hand holds on"
        move((-0.02, 0.01, 0), (0, 0, -0.01), (0, 0, 0), (0.1, 0, 0))
        browser.run(LATER, 250)
        squeeze_anew(browser, "left", lambda: arms["left"].deadman.held)
        move((-0.01, 0, 0), (0, 0, 0), (0, 0.1, 0), (0, 0, 0))

    def grip() -> None:
        hold()
        browser.run("hands.left.updateButtonValue('trigger', 1)")
        wait_for(lambda: arms["left"].robot.gripper.state(max_age=2.0).width < 0.01, "the left fingers to close", BRIEF)
        assert arms["right"].robot.gripper.state(max_age=2.0).width > 0.07

    def lose() -> None:
        hold()
        browser.run("hands.right.connected = false")
        wait_for(lambda: not arms["right"].deadman.held, "the lost hand to let go", BRIEF)
        move((0, -0.01, 0), (0, 0, -0.01), (0, 0, -0.1), (0, 0, 0))
        browser.run("device.updateVisibilityState('visible-blurred')")
        wait_for(lambda: not two.session.held, "both to let go", BRIEF)

    with emulated(two, browser, iwer):
        browser.size(640, 480)  # less to draw
        wear(browser)
        for attempt in (move_both, release_one, grip, lose):
            undisturbed(two, browser, attempt, HUNG)
        browser.chrome.get("about:blank")


def test_the_arm_follows_the_hand_while_it_is_squeezed_and_never_jumps(bench: Bench, worn: Browser) -> None:
    def follow(step: tuple[float, float, float], way: tuple[float, float, float]) -> None:
        rest(bench, worn)
        squeeze(bench, worn)
        to = bench.tcp + way
        glide(worn, step)
        wait_for(lambda: abs(bench.tcp - to).max() < 2e-3, f"the way {way}", BRIEF)

    def squeeze_elsewhere() -> None:
        rest(bench, worn)
        before = bench.tcp.copy()
        glide(worn, (0, 0, 0.01))
        squeeze(bench, worn)
        worn.run(LATER, 250)
        assert abs(bench.tcp - before).max() < 1e-4, "a squeeze moves nothing, wherever the hand is"

    def turn_and_grip() -> None:
        rest(bench, worn)
        squeeze(bench, worn)
        turned = bench.arm.state(max_age=2.0).tcp
        worn.run("hand.quaternion.set(0, Math.sin(0.15), 0, Math.cos(0.15))")
        wait_for(lambda: abs(bench.arm.state(max_age=2.0).tcp.distance(turned)[1] - 0.3) < 0.02, "a turn", BRIEF)
        worn.run("hand.updateButtonValue('trigger', 1)")
        wait_for(lambda: bench.arm.gripper.state(max_age=2.0).width < 0.01, "the fingers to close", BRIEF)

    def send_with_every_picture() -> None:
        """A pose that waits for the next beat is up to 20 ms old."""
        rest(bench, worn)
        squeeze(bench, worn)
        worn.run("pictures.length = 0")
        wait_for(lambda: worn.run("return pictures.length") > 30, "pictures", BRIEF)
        pictures = worn.run("return pictures")
        apart = [now for last, now in pairwise(pictures) if now["start"] - last["start"] > 8.0]
        assert apart
        assert [now for now in apart if not now["sent"]] == []

    worn.size(390, 844, touch=True)
    wait_for(lambda: worn.text("#headset"), "the button")
    assert worn.run("return document.documentElement.scrollWidth") <= 390, "it fits on a phone"
    worn.size(640, 480)  # less to draw
    worn.run(LISTEN + SHOWN)
    wear(worn)
    bench.arm.gripper.open()
    ways = (((0, 0, -0.01), (0.1, 0, 0)), ((-0.01, 0, 0), (0, 0.1, 0)), ((0, 0.01, 0), (0, 0, 0.1)))
    follows = [partial(follow, step, way) for step, way in ways]
    for attempt in (*follows, squeeze_elsewhere, turn_and_grip, send_with_every_picture):
        undisturbed(bench, worn, attempt, HUNG)
    worn.run("hand.updateButtonValue('a-button', 1)")
    wait_for(lambda: bench.trip == "stop", "STOP by the controller")


def glide(page: Browser, step: tuple[float, float, float]) -> None:
    """Move the hand by ten steps, m, one with each picture."""
    page.run("speed = [0, 0, 0];" + GLIDE, [0, 0, 0], list(step))


LOSSES = {
    "lost tracking": ("blind = true", "blind = false"),
    "a controller that is gone": ("hand.connected = false", "hand.connected = true"),
    "a controller that keeps its last state": ("steady = true", "steady = false"),
    "a leap of the tracking": ("hand.position.x -= 0.5", ""),
    "the system's menu": (
        "device.updateVisibilityState('visible-blurred')",
        "device.updateVisibilityState('visible')",
    ),
    "a session that ends": ("document.querySelector('#headset').click()", ""),
}


def test_every_loss_of_the_hand_lets_go(bench: Bench, worn: Browser) -> None:
    """And what comes back while it is still squeezed moves nothing."""

    def lose(what: str, happens: str, ends: str) -> None:
        if worn.text("#headset") == "Headset":
            wear(worn)
        rest(bench, worn)
        squeeze(bench, worn)
        worn.run("speed = [-0.003, 0, 0]")
        wait_for(lambda: bench.tcp_speed[1] > 0.05, f"motion before {what}", BRIEF)
        worn.run(happens)
        wait_for(lambda: not bench.deadman.held, f"{what} to let go", BRIEF)
        wait_for(bench.rests, "the arm to rest", BRIEF)
        worn.run(ends)
        before = bench.tcp.copy()
        worn.run("return new Promise((done) => setTimeout(done, 300))")
        assert abs(bench.tcp - before).max() < 1e-3, f"{what} is over, and the arm moves by itself"

    for what, (happens, ends) in LOSSES.items():
        undisturbed(bench, worn, partial(lose, what, happens, ends))
