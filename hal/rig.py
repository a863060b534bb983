"""A rig: the named devices of one bench, behind one clock. ``hal.open`` makes it."""

from __future__ import annotations

import atexit
import contextlib
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from . import registry
from .camera import Camera, place_of
from .clock import Clock, LockStepClock, RealClock
from .control import StopLatch
from .errors import ConfigError, ConnectionLost, DeviceNotFound, HalError, NotSupported, Problem
from .gamepad import Gamepad
from .gripper import Gripper
from .host.hosts import Host, LocalHost, RemoteHost, SteppedHost, groups_of
from .host.process import SharedMemory
from .observation import Observation, Observer
from .pads.choice import Chosen, choose_pad
from .robot import Robot
from .specs import GroupSpec, RobotSpec
from .views import Console, Listen
from .world import NoWorld, World

if TYPE_CHECKING:
    from .specs import Plan
    from .views import Pictures, Viewer, Viewer3D

__all__ = [
    "Devices",
    "Rig",
    "SharedStates",
    "open_rig",
]

# [devices.py] Devices by name.

T = TypeVar("T")


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


_FIRST_FRAME = 5.0


def open_rig(
    config: str | Path | Mapping[str, Any] = "panda_table",
    *,
    sim: bool | None = None,
    driver: str | None = None,
    clock: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    pad: str | None = None,
    viewer: str = "none",
    console: bool = False,
    listen: str | None = None,
    realtime: bool = True,
) -> Rig:
    """Open a rig: a file, the name of a built-in one, or a dict of the same shape.

    ``sim=True`` makes everything simulated, ``sim=False`` sets the rig's flag to real, None leaves the file's flags.
    ``driver="mock"`` puts a mock in the place of every device. ``clock`` is ``real_time`` or ``lock_step``.
    ``overrides`` are ``KEY=VALUE`` for any key of the rig. ``pad`` says what a pad of ``model: auto`` is: ``auto``,
    ``evdev``, ``web`` (the console), ``terminal``, ``demo`` (the recorded tour), the path of a recording,
    or ``none`` to open no pad. ``viewer="gui"`` opens a window onto the simulated world, ``viewer="3d"`` a page with
    the arms in three dimensions. ``console=True`` serves the console also where another pad drives; ``listen`` is the
    address, and the port, at which it listens: loopback unless told otherwise. ``realtime=False``
    leaves the processes that run servos at the default scheduling; otherwise, in real time, they ask for SCHED_FIFO and
    locked memory, and :attr:`Rig.notes` says how to allow it where it is refused.

    Nothing moves. Raises ConfigError (every problem at once), DriverMissing, DeviceNotFound, ConnectionLost.
    """
    from .config import load

    where = Listen.parse(listen)
    plan = load(config, sim=sim, driver=driver, clock=clock, overrides=overrides).resolve()
    rig = Rig(plan)
    try:
        rig._open(pad=pad, viewer=viewer, console=console, listen=where, realtime=realtime)
    except BaseException:
        with contextlib.suppress(Exception):
            rig.close()
        raise
    return rig


def check_opening(plan: Plan, pad: str | None, viewer: str, console: bool) -> list[Chosen]:
    """Choose the pads, and check what can be checked before a device or a process is opened.

    Args:
        plan: What is to be opened.
        pad: As :func:`open_rig` takes it; ``viewer`` and ``console`` likewise.

    Raises:
        DriverMissing: The libraries of a page are not installed.
        DeviceNotFound: No such pad.
        NotSupported: A viewer or a console that this rig cannot have, or a recording for a real arm.
        ConfigError: A recording that cannot be played.
    """
    lock_step = plan.clock == "lock_step"
    known = {"attended": plan.attended, "emulated": plan.emulated, "lock_step": lock_step}
    pads = [] if pad == "none" else [choose_pad(spec, pad, **known) for spec in plan.pads]
    wrong = [
        Problem("--pad", "", message)
        for chosen in pads
        for _, message in registry.checked(chosen.spec.driver, "gamepad", chosen.spec)
    ]
    if wrong:
        raise ConfigError(wrong)
    if viewer == "gui" and plan.world is None:
        raise NotSupported("there is no simulated world to look at; leave the viewer out")
    if viewer == "3d":
        registry.load(registry.provider("viewer3d"), "viewer3d")
    if console or any(chosen.input == "console" for chosen in pads):
        if lock_step:
            raise NotSupported("the console is for real time; in lock-step, time runs as fast as the program lets it")
        registry.load(registry.provider("console"), "console")
    return pads


class SharedStates(NamedTuple):
    """The states of one group of devices, in memory that another process may read; see :meth:`Rig.shared_states`."""

    spec: GroupSpec
    """The group: its robots, grippers and, where it has one, its simulated world."""
    memory: SharedMemory
    """Laid out as :class:`~hal.host.records.GroupMemory` of :attr:`spec`, then the bodies of a simulated world."""


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
        self.console: Console | None = None
        """The page in a browser, where there is one."""
        self.viewer3d: Viewer3D | None = None
        """The page with the arms in three dimensions, where there is one."""
        self._pictures: Pictures | None = None
        self._viewer: Viewer | None = None
        self._devices: dict[str, Any] = {}
        self._observer = Observer(self)
        self._closed = False
        atexit.register(self._close_at_exit)

    # Opening.

    @property
    def lock_step(self) -> bool:
        """Does this rig's time stand still until somebody waits?"""
        return self.plan.clock == "lock_step"

    def _open(self, *, pad: str | None, viewer: str, console: bool, listen: Listen, realtime: bool) -> None:
        plan = self.plan
        pads = check_opening(plan, pad, viewer, console)
        groups = groups_of(plan)
        world_host = self._start_hosts(groups, realtime)
        if console or any(chosen.input == "console" for chosen in pads):
            self._start_console(listen, pads)
        if world_host is not None:
            self._open_pictures(world_host, viewer)
        if viewer == "3d":
            self.viewer3d = registry.load(registry.provider("viewer3d"), "viewer3d")(self)
        refused = False
        for host in self._hosts:
            if isinstance(host, RemoteHost):
                ready = host.wait_ready()
                refused |= realtime and bool(host.spec.robots) and not self.lock_step and not ready["realtime"]
        if refused:
            self._note_refused_priority()
        if world_host is not None:
            self.world = World(world_host.request, self._world_edited)
            self.notes.extend(world_host.request("warnings"))
        for host in self._hosts:
            for spec in host.spec.robots:
                self.robots[spec.name] = Robot(spec, host, self.clock, self._latch, self._gripper_of(spec))
        for opened in (self.console, self.viewer3d):
            if opened is not None:
                opened.wait_ready()
                self.notes.extend(opened.notes)
        self._open_cameras()
        if self.console is not None:
            for camera in self.cameras.values():
                self.console.show(camera)
        self._open_pads(pads)
        for host in self._hosts:
            host.request("reset_statistics")  # starting up is not what anybody wants to measure

    def _note_refused_priority(self) -> None:
        from .preflight import REALTIME_RIGHT

        checked = self.attended and not self.emulated  # the check before a real arm has printed the command
        remedy = "hal-check prints what allows it" if checked else f"to allow it: {REALTIME_RIGHT}"
        self.notes.append(f"real-time priority (SCHED_FIFO) is refused: a busy computer delays the servos; {remedy}")

    def _start_hosts(self, groups: Sequence[GroupSpec], realtime: bool) -> Host | None:
        """The processes of the groups; returns the one with the simulated world. Its copies of arms follow the rest."""
        world_host: Host | None = None
        if self.lock_step:
            group, *others = groups
            stepped = [SteppedHost(other) for other in others]
            self._hosts.extend(stepped)
            local = LocalHost(group, stepped)
            self._hosts.insert(0, local)
            self.clock = LockStepClock(local.now, local.advance_to)
            return local if group.world is not None else None
        remotes: list[RemoteHost] = []
        for group in sorted(groups, key=lambda group: group.world is not None):
            others_ = remotes if group.world is not None else ()
            remotes.append(RemoteHost(group, realtime=realtime and bool(group.robots), others=others_))
            self._hosts.append(remotes[-1])
            if group.world is not None:
                world_host = remotes[-1]
        return world_host

    def _gripper_of(self, robot: RobotSpec) -> Gripper | None:
        spec = robot.gripper
        if spec is None:
            return None
        host = next(host for host in self._hosts if spec in host.spec.grippers)
        return Gripper(spec, robot.name, host, self.clock, self._latch)

    def _open_pictures(self, host: Host, viewer: str) -> None:
        """Whatever shows the world: the renderer of its cameras, a window."""
        world = host.spec.world
        assert world is not None
        cameras = [camera for camera in self.plan.cameras if camera.driver == world.driver]
        if cameras:
            self._pictures = registry.load(world.driver, "pictures")(host, cameras, self.plan.renderer)
        if viewer == "gui":
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
            place = place_of(spec, self.robots) if not driver.simulated else None
            camera = Camera(driver, self.clock, threaded=not self.lock_step, place=place)
            self._devices[spec.name] = driver
            self.cameras[spec.name] = camera
            camera.on_connection(partial(self._camera_news, spec.name))
            camera.open()
        for camera in self.cameras.values():
            if not camera.wait_for_first(_FIRST_FRAME):
                self.notes.append(f"camera {camera.name} has sent no frame in its first {_FIRST_FRAME:g} s")

    def _start_console(self, listen: Listen, pads: Sequence[Chosen]) -> None:
        drives = any(chosen.input == "console" for chosen in pads)
        others = ", ".join(chosen.title for chosen in pads) or "the program itself"
        self.console = registry.load(registry.provider("console"), "console")(
            self, listen, driven_by=None if drives else others
        )

    def _open_pads(self, pads: Sequence[Chosen]) -> None:
        for chosen in pads:
            self.notes.extend(chosen.notes)
            spec = chosen.spec
            driver = registry.load(spec.driver, "gamepad")(spec, self._pad_source(chosen))
            gamepad = Gamepad(driver)
            self._devices[spec.name] = driver
            self.gamepads[spec.name] = gamepad
            gamepad.open(self.clock.now())
            self.notes.extend(gamepad.notes)
            if self.lock_step:
                self._local.pollers.append(gamepad.poll_once)
            else:
                gamepad.start_thread(self.clock.now)
            if chosen.input == "console" and self.console is not None:
                # Without a word a program that waits for a dead-man would just hang. Apps print a banner instead.
                logging.getLogger("hal.console").warning("drive from a browser: %s", self.console.link)

    def _pad_source(self, chosen: Chosen) -> object | None:
        """Return the second argument of a gamepad driver: the console, this rig's stop, or the world's time."""
        if chosen.input == "console":
            return self.console
        if chosen.input == "keys":
            return self.stop
        return self._world_time() if chosen.input == "recording" else None

    def _world_time(self) -> Callable[[], float] | None:
        """How far a simulated world with arms has come, s, where that is not what the clock shows: in real time."""
        host = next((host for host in self._hosts if host.spec.world is not None and host.spec.robots), None)
        if host is None or self.lock_step:
            return None
        memory, rate_hz = host.memory, host.spec.rate_hz
        return lambda: memory.get_host().ticks / rate_hz

    # What it is.

    @property
    def attended(self) -> bool:
        """Does something real move on this rig, so that a person must be there?"""
        return self.plan.attended

    @property
    def emulated(self) -> bool:
        """Does a program stand in for everything that counts as real here, so that nothing can be hurt?"""
        return self.plan.emulated

    @property
    def has_world(self) -> bool:
        """Is there a simulated world, ``rig.world``?"""
        return isinstance(self.world, World)

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
        cycle = self._local.cycle
        drivers: dict[str, Any] = {unit_name: unit.driver for unit_name, unit in cycle.arms.items()}
        drivers |= {unit_name: unit.driver for unit_name, unit in cycle.grippers.items()}
        drivers |= self._devices
        if name in drivers:
            return drivers[name]
        there = ", ".join(drivers)
        raise DeviceNotFound(f"this rig has no device {name!r}; it has: {there}")

    @property
    def renderer(self) -> str | None:
        """What draws the pictures of simulated cameras, in words; None where nothing does."""
        return self._pictures.describe() if self._pictures is not None else None

    def statistics(self) -> dict[str, Any]:
        """Per group: ticks, missed ticks, periods (s), and per robot the peaks of its set-points and latencies."""
        return {host.spec.name: host.request("statistics") for host in self._hosts}

    def shared_states(self) -> list[SharedStates]:
        """Return the memory into which each group of devices publishes its states.

        A program that shows the rig, such as the console, hands it to a process of its own, which reads it there. It is
        for reading only.

        Returns:
            One record for each group, in the order in which the groups were started.

        Raises:
            NotSupported: In lock-step, where states are not shared (``code`` is ``needs_real_time``).
        """
        if self.lock_step:
            raise NotSupported("in lock-step no other process can read the states of a rig", code="needs_real_time")
        return [SharedStates(host.spec, host.shared) for host in self._hosts if isinstance(host, RemoteHost)]

    @property
    def stop_count(self) -> int:
        """Number that grows with every call of :meth:`stop`."""
        return sum(host.stops for host in self._hosts)

    # What it sees and does.

    def observe(
        self,
        after: float | None = None,
        *,
        timeout: float = 1.0,
        history: int = 1,
        cameras: Collection[str] | None = None,
    ) -> Observation:
        """Every camera's newest picture with the arms and grippers interpolated to its stamp, in one record.

        With ``after`` (s on ``rig.clock``) everything is from that time or later: after a motion,
        ``rig.observe(after=rig.clock.now())`` shows its end. ``history`` says how many observations, this one included,
        are in :attr:`~hal.observation.Observation.history`. ``cameras`` are the names of those that count, else all.

        Raises StaleStateError when a picture or a state did not come within ``timeout`` s, ConnectionLost.
        """
        return self._observer.observe(after, timeout, history, cameras)

    def forget_observations(self) -> None:
        """A new episode begins: what was observed before is no part of its history."""
        self._observer.forget()

    def stop(self) -> None:
        """Stop every arm, within its limits, and latch it. Any thread may call it, at any time.

        A session goes on after ``control.rearm()``, or when its dead-man was let go of and pressed again; a new one
        without a dead-man needs :meth:`rearm` first.
        """
        self._latch.stopped = True
        for host in self._hosts:
            host.stop()

    def say(self, text: str) -> None:
        """Show a line to whoever watches: on the console's pages, where there are some."""
        if self.console is not None:
            self.console.say(text)

    def _camera_news(self, name: str, lost: ConnectionLost | None) -> None:
        self.say(f"camera {name} is back" if lost is None else str(lost))

    def rearm(self) -> None:
        """Acknowledge :meth:`stop`, so that sessions without a dead-man can be opened again."""
        self._latch.stopped = False

    def _world_edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        for shown in (self._pictures, self._viewer, self.viewer3d):
            if shown is not None:
                with contextlib.suppress(ConnectionLost):  # its own next use says that it is gone
                    shown.edited(method, params, revision)

    def close(self) -> None:
        """Bring the arms to rest and let go of every device. Idempotent; the first error is raised at the end."""
        if self._closed:
            return
        errors: list[BaseException] = []
        sessions = [robot._open for robot in self.robots.values() if robot._open is not None]
        shown = [item for item in (self.viewer3d, self.console, self._viewer, self._pictures) if item is not None]
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
