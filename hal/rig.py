"""A rig: the named devices of one bench, behind one clock. ``hal.open`` makes it."""

from __future__ import annotations

import atexit
import contextlib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from . import registry
from .camera import Camera
from .clock import Clock, LockStepClock, RealClock
from .errors import ConnectionLost, DeviceNotFound, HalError, NotSupported
from .gamepad import Gamepad
from .host.hosts import Host, LocalHost, RemoteHost
from .pads.choice import choose_pad
from .robot import Robot
from .specs import GroupSpec
from .stops import StopLatch
from .world import NoWorld, World

if TYPE_CHECKING:
    from .config.plan import Plan
    from .pictures import Pictures, Viewer

__all__ = ["Devices", "Rig", "open_rig"]

T = TypeVar("T")
_FIRST_FRAME = 5.0


class Devices(dict[str, T]):
    """Devices by name. A name that is not there raises DeviceNotFound, which lists those that are."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self._kind = kind

    def __missing__(self, name: str) -> T:
        close = get_close_matches(name, self, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        there = ", ".join(self) if self else "none"
        raise DeviceNotFound(f"this rig has no {self._kind} {name!r}{hint}; it has: {there}")


def open_rig(
    config: str | Path | Mapping[str, Any] = "panda_table",
    *,
    sim: bool | None = None,
    driver: str | None = None,
    clock: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    pad: str | None = None,
    viewer: str = "none",
    realtime: bool = False,
) -> Rig:
    """Open a rig: a file, the name of a built-in one, or a dict of the same shape.

    ``sim=True`` makes everything simulated, ``sim=False`` sets the rig's flag to real, None leaves the file's flags.
    ``driver="mock"`` puts a mock in the place of every device. ``clock`` is ``real_time`` or ``lock_step``.
    ``overrides`` are ``KEY=VALUE`` for any key of the rig. ``pad`` says what a pad of ``model: auto`` is: ``auto``,
    ``evdev``, ``keyboard``, the path of a recording, or ``none`` to open no pad. ``viewer="gui"`` opens a window onto
    the simulated world. ``realtime`` asks for SCHED_FIFO and locked memory in the processes that run servos, where the
    user may.

    Nothing moves. Raises ConfigError (every problem at once), DriverMissing, DeviceNotFound, ConnectionLost.
    """
    from .config import load

    plan = load(config, sim=sim, driver=driver, clock=clock, overrides=overrides).resolve()
    rig = Rig(plan)
    try:
        rig._open(pad=pad, viewer=viewer, realtime=realtime)
    except BaseException:
        with contextlib.suppress(Exception):
            rig.close()
        raise
    return rig


class Rig:
    """Robots, cameras and gamepads by name, one clock, and the simulated world if there is one.

    Close it, or use it in a ``with`` statement; the end of the program closes it too.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.robots: Devices[Robot] = Devices("robot")
        self.cameras: Devices[Camera] = Devices("camera")
        self.gamepads: Devices[Gamepad] = Devices("gamepad")
        self.world: World = NoWorld()  # type: ignore[assignment]  # every use of it raises NotSupported
        self.clock: Clock = RealClock()
        self.notes: list[str] = list(plan.warnings)
        """What a person should know: what was not found, and the command that mends it."""
        self._hosts: list[Host] = []
        self._latch = StopLatch()
        self._pictures: Pictures | None = None
        self._viewer: Viewer | None = None
        self._devices: dict[str, Any] = {}
        self._closed = False
        atexit.register(self._close_at_exit)

    # Opening.

    @property
    def lock_step(self) -> bool:
        """Does this rig's time stand still until somebody waits?"""
        return self.plan.clock == "lock_step"

    def _open(self, *, pad: str | None, viewer: str, realtime: bool) -> None:
        plan = self.plan
        groups = _groups(plan)
        world_host: Host | None = None
        if self.lock_step:
            (group,) = groups
            local = LocalHost(group)
            self._hosts.append(local)
            self.clock = LockStepClock(local.now, local.advance_to)
            world_host = local if group.world is not None else None
        else:
            for group in groups:
                remote = RemoteHost(group, realtime=realtime)
                self._hosts.append(remote)
                if group.world is not None:
                    world_host = remote
        if world_host is not None:
            self._open_pictures(world_host, viewer)
        elif viewer != "none":
            raise NotSupported("there is no simulated world to look at; leave the viewer out")
        for host in self._hosts:
            if isinstance(host, RemoteHost):
                scheduling = host.wait_ready()["scheduling"]
                if realtime:
                    self.notes.append(f"servo process {host.spec.name}: {scheduling}")
        if world_host is not None:
            self.world = World(world_host.request, self._world_edited)
        for host in self._hosts:
            for spec in host.spec.robots:
                self.robots[spec.name] = Robot(spec, host, self.clock, self._latch)
        self._open_cameras()
        self._open_pads(pad)
        for host in self._hosts:
            host.request("reset_statistics")  # starting up is not what anybody wants to measure

    def _open_pictures(self, host: Host, viewer: str) -> None:
        """Whatever shows the world: the renderer of its cameras, a window."""
        world = host.spec.world
        assert world is not None
        cameras = [camera for camera in self.plan.cameras if camera.driver == world.driver]
        if cameras:
            self._pictures = registry.load(world.driver, "pictures")(host, cameras, self.plan.renderer)
        if viewer != "none":
            self._viewer = registry.load(world.driver, "viewer")(host)
        for shown in (self._pictures, self._viewer):
            if shown is not None:
                shown.wait_ready()
                self.notes.extend(shown.notes)

    def _open_cameras(self) -> None:
        for spec in self.plan.cameras:
            drawn = self._pictures is not None and spec.name in self._pictures
            source: object = self._pictures.source(spec.name) if self._pictures and drawn else self.clock
            driver = registry.load(spec.driver, "camera")(spec, source)
            camera = Camera(driver, self.clock, threaded=not self.lock_step)
            self._devices[spec.name] = driver
            self.cameras[spec.name] = camera
            camera.open()
        for camera in self.cameras.values():
            if not camera.wait_for_first(_FIRST_FRAME):
                self.notes.append(f"camera {camera.name} has sent no frame in its first {_FIRST_FRAME:g} s")

    def _open_pads(self, pad: str | None) -> None:
        window = self.plan.world.driver if self.plan.world is not None else None
        for spec in self.plan.pads if pad != "none" else ():
            chosen, source, notes = choose_pad(spec, pad, self._viewer, window=window, attended=self.attended)
            self.notes.extend(notes)
            driver = registry.load(chosen.driver, "gamepad")(chosen, source)
            gamepad = Gamepad(driver)
            self._devices[spec.name] = driver
            self.gamepads[spec.name] = gamepad
            gamepad.open(self.clock.now())
            if self.lock_step:
                self._local.pollers.append(gamepad.poll_once)
            else:
                gamepad.start_thread(self.clock.now)

    # What it is.

    @property
    def attended(self) -> bool:
        """Does something real move on this rig, so that a person must be there?"""
        return any(robot.attended for robot in self.plan.robots)

    @property
    def _local(self) -> LocalHost:
        host = self._hosts[0]
        if not isinstance(host, LocalHost):
            raise NotSupported(
                "drivers live in processes of their own in real time; open the rig with clock='lock_step'"
            )
        return host

    def driver(self, name: str) -> Any:
        """The driver object behind a device, in lock-step: for unit tests that set a mock's pad or read its log.

        ``name`` is a robot's, a camera's or a pad's, or ``robot.gripper``.
        """
        arms = self._local.cycle.arms
        if name in arms:
            return arms[name].driver
        robot, _, part = name.partition(".")
        if part == "gripper" and robot in arms and arms[robot].gripper is not None:
            return arms[robot].gripper
        if name in self._devices:
            return self._devices[name]
        there = ", ".join([*arms, *self._devices])
        raise DeviceNotFound(f"this rig has no device {name!r}; it has: {there}")

    @property
    def renderer(self) -> str | None:
        """What draws the pictures of simulated cameras, in words; None where nothing does."""
        return self._pictures.describe() if self._pictures is not None else None

    def statistics(self) -> dict[str, Any]:
        """Per group: ticks, missed ticks, periods (s), and per robot the peaks of its set-points and latencies."""
        return {host.spec.name: host.request("statistics") for host in self._hosts}

    # What it does.

    def stop(self) -> None:
        """Stop every arm, within its limits, and latch it. Any thread may call it, at any time.

        A session goes on after ``control.rearm()``, or when its dead-man was let go of and pressed again; a new one
        without a dead-man needs :meth:`rearm` first.
        """
        self._latch.stopped = True
        for host in self._hosts:
            host.stop()

    def rearm(self) -> None:
        """Acknowledge :meth:`stop`, so that sessions without a dead-man can be opened again."""
        self._latch.stopped = False

    def _world_edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        for shown in (self._pictures, self._viewer):
            if shown is not None:
                with contextlib.suppress(ConnectionLost):  # its own next use says that it is gone
                    shown.edited(method, params, revision)

    def close(self) -> None:
        """Bring the arms to rest and let go of every device. Idempotent; the first error is raised at the end."""
        if self._closed:
            return
        errors: list[BaseException] = []
        sessions = [robot._open for robot in self.robots.values() if robot._open is not None]
        shown = [item for item in (self._viewer, self._pictures) if item is not None]
        for device in (*sessions, *self.gamepads.values(), *self.cameras.values(), *shown, *self._hosts):
            try:
                device.close()
            except BaseException as error:  # a second Ctrl-C must not leave the rest open
                errors.append(error)
        self._closed = True
        atexit.unregister(self._close_at_exit)
        if errors:
            raise errors[0]

    def _close_at_exit(self) -> None:
        with contextlib.suppress(Exception):
            self.close()

    def __enter__(self) -> Rig:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except (HalError, OSError):
            if error is None:
                raise

    def __repr__(self) -> str:
        devices = ", ".join([*self.robots, *self.cameras, *self.gamepads])
        return f"<Rig {self.plan.source}: {devices}; {self.plan.clock}>"


def _groups(plan: Plan) -> list[GroupSpec]:
    """Which devices share a clock and a process: the simulated world's, and each other arm alone."""
    world = plan.world
    inside = tuple(r for r in plan.robots if world is not None and r.driver == world.driver)
    outside = tuple(r for r in plan.robots if r not in inside)
    if plan.clock == "lock_step":
        rate = world.physics_hz if world else max((r.rate_hz for r in outside), default=240.0)
        return [GroupSpec("simulation", plan.clock, rate, inside + outside, world)]
    groups = [GroupSpec("simulation", plan.clock, world.physics_hz, inside, world)] if world else []
    return groups + [GroupSpec(r.name, plan.clock, r.rate_hz, (r,)) for r in outside]
