"""Every driver on a bench: a way to let its time pass, and to break its link.

A new driver joins the suite by one function here and one line in the table of its kind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from hal.camera import CameraDriver
from hal.drivers.mock.camera import MockCamera
from hal.drivers.mock.gamepad import MockPad
from hal.drivers.mock.gripper import MockGripper
from hal.drivers.mock.robot import MockRobot
from hal.gamepad import GamepadDriver
from hal.gripper import GripperDriver
from hal.robot import RobotDriver
from hal.specs import BodySpec, CameraSpec, GripperSpec, PadSpec, RobotSpec, ViewSpec, WorldSpec

from ..unit.specs import panda

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


@dataclass
class Bench:
    """What surrounds a driver: its time."""

    dt: float
    advance: Callable[[], None] = lambda: None
    """What happens in the device while ``dt`` passes."""
    now: float = 1000.0
    """The host's clock, which never starts at zero."""

    def pass_time(self) -> float:
        """Let one cycle pass; the time after it."""
        self.now += self.dt
        self.advance()
        return self.now


@dataclass
class RobotBench(Bench):
    driver: RobotDriver = None  # type: ignore[assignment]
    lose: Callable[[], None] = lambda: None
    """Break the link to the device."""


@dataclass
class GripperBench(Bench):
    driver: GripperDriver = None  # type: ignore[assignment]
    put_object: Callable[[float], None] = lambda width: None
    """Hold something rigid of this width (m) between the open fingers."""


@dataclass
class CameraBench:
    driver: CameraDriver
    lose: Callable[[], None]


@dataclass
class PadBench(Bench):
    driver: GamepadDriver = None  # type: ignore[assignment]
    press_south: Callable[[], None] = lambda: None
    unplug: Callable[[], None] | None = None
    replug: Callable[[], None] | None = None


def _panda(driver: str) -> RobotSpec:
    return panda(driver=driver)


def _hand(driver: str) -> GripperSpec:
    hand = panda().gripper
    assert hand is not None
    return hand


@contextmanager
def mock_robot() -> Iterator[RobotBench]:
    driver = MockRobot(_panda("mock"))
    yield RobotBench(dt=1 / 240, driver=driver, lose=lambda: driver.inject(disconnect=True))
    driver.close()


@contextmanager
def pybullet_robot() -> Iterator[RobotBench]:
    from hal.drivers.pybullet.robot import PyBulletRobot
    from hal.drivers.pybullet.world import World

    spec = _panda("pybullet")
    world = World(WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (), (spec,)))
    driver = PyBulletRobot(spec, world)
    yield RobotBench(dt=1 / 240, advance=world.step, driver=driver, lose=lambda: driver.inject(disconnect=True))
    driver.close()
    world.close()


@contextmanager
def mock_gripper() -> Iterator[GripperBench]:
    driver = MockGripper(_hand("mock"))
    yield GripperBench(dt=1 / 240, driver=driver, put_object=lambda width: driver.inject(object_width=width))
    driver.close()


@contextmanager
def pybullet_gripper() -> Iterator[GripperBench]:
    from hal.drivers.pybullet.gripper import PyBulletGripper
    from hal.drivers.pybullet.robot import PyBulletRobot
    from hal.drivers.pybullet.world import World

    spec = _panda("pybullet")
    assert spec.gripper is not None
    world = World(WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (), (spec,)))
    arm = PyBulletRobot(spec, world)
    arm.open()
    driver = PyBulletGripper(spec.gripper, world)
    x, y, z = world.pose("panda", "panda_hand")["position"]

    def put_object(width: float) -> None:
        place = (x, y, z - 0.1034)  # its fingers point down
        world.add(BodySpec("thing", place, NO_ROTATION, "sphere", radius=width / 2, fixed=True))

    yield GripperBench(dt=1 / 240, advance=world.step, driver=driver, put_object=put_object)
    driver.close()
    arm.close()
    world.close()


@contextmanager
def mock_camera() -> Iterator[CameraBench]:
    driver = MockCamera(
        CameraSpec(
            name="scene",
            model="test",
            driver="mock",
            capture_width=128,
            capture_height=96,
            width=64,
            height=48,
            rate_hz=30.0,
            K=((60.0, 0.0, 31.5), (0.0, 60.0, 23.5), (0.0, 0.0, 1.0)),
            distortion=(0.0,) * 5,
            depth_min=0.1,
            depth_max=3.0,
            streams=("color", "depth", "infrared"),
            view=ViewSpec((0.0, 0.0, 1.0), NO_ROTATION),
        )
    )
    yield CameraBench(driver, lambda: driver.inject(disconnect=True))
    driver.close()


@contextmanager
def mock_pad() -> Iterator[PadBench]:
    driver = MockPad(PadSpec(name="pad", driver="mock", model=None))
    yield PadBench(
        dt=0.01,
        driver=driver,
        press_south=lambda: driver.press("south"),
        unplug=lambda: driver.inject(disconnect=True),
        replug=lambda: driver.inject(disconnect=False),
    )
    driver.close()


RECORDED_PAD = """\
{"format": "hal-pad-events", "version": 1, "ranges": {"ABS_X": [0, 255]}, "model": {"name": "test", "title": "a test", \
"axes": {"ABS_X": "left_x"}, "buttons": {"BTN_SOUTH": "south"}}}
{"t": 0.5, "type": "abs", "code": "ABS_X", "value": 255}
{"t": 1.0, "type": "key", "code": "BTN_SOUTH", "value": 1}
{"t": 60.0, "type": "key", "code": "BTN_SOUTH", "value": 0}
"""


@contextmanager
def playback_pad() -> Iterator[PadBench]:
    from hal.drivers.playback.pad import PlaybackPad

    with TemporaryDirectory() as folder:
        file = Path(folder) / "pad.jsonl"
        file.write_text(RECORDED_PAD)
        options = {"file": str(file), "disconnect_at": 2.0, "reconnect_at": 4.0}
        driver = PlaybackPad(PadSpec(name="pad", driver="playback", model=None, options=options))
        bench = PadBench(dt=0.01, driver=driver)
        start = bench.now
        bench.unplug = lambda: setattr(bench, "now", start + 2.5)
        bench.replug = lambda: setattr(bench, "now", start + 4.5)
        yield bench
        driver.close()


@contextmanager
def web_pad() -> Iterator[PadBench]:
    """The page of the console; every 10 ms it says how its pad stands."""
    from hal.drivers.web.pad import PadMail, WebPad, reading
    from hal.types import AXES

    class Page:
        mail = PadMail()
        driver = "page 1"
        stops = 0
        there, mask = True, 0

        def subscribe(self) -> PadMail:
            return self.mail

        def show_playing(self, on: bool) -> None:
            """No recording is played here."""

    page = Page()
    driver = WebPad(PadSpec(name="pad", driver="web", model=None), page)
    bench = PadBench(dt=0.01, driver=driver)

    def speak() -> None:
        now, axes = bench.now, [0.0] * len(AXES)
        message = {"connected": page.there, "t": now, "t_alive": now, "axes": axes, "buttons": page.mask}
        page.mail.put(reading(message, 0))

    bench.advance = speak
    bench.press_south = lambda: setattr(page, "mask", 1)
    bench.unplug = lambda: setattr(page, "there", False)
    bench.replug = lambda: setattr(page, "there", True)
    yield bench
    driver.close()


@contextmanager
def terminal_pad() -> Iterator[PadBench]:
    """The keys of a terminal, which a test plays."""
    from terminal_kit import FarEnd

    from hal.drivers.terminal.pad import TerminalPad

    with FarEnd() as far:
        options = {"tty": far.path, "mode": "step"}
        driver = TerminalPad(PadSpec(name="pad", driver="terminal", model=None, options=options))
        yield PadBench(dt=0.01, driver=driver, press_south=lambda: far.put("1"))
        driver.close()


ROBOTS = {"mock": mock_robot, "pybullet": pybullet_robot}
GRIPPERS = {"mock": mock_gripper, "pybullet": pybullet_gripper}
CAMERAS = {"mock": mock_camera}
PADS = {"mock": mock_pad, "playback": playback_pad, "terminal": terminal_pad, "web": web_pad}
