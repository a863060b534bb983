"""A rig: the named devices of one setup behind one clock. :func:`open_rig` is ``hal.open``."""

from __future__ import annotations

import atexit
import contextlib
import importlib
import logging
import os
import threading
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TypeVar

from . import registry
from .arguments import choice
from .camera import Camera, find_place
from .clock import Clock, LockStepClock, RealClock
from .commands import StopLatch
from .errors import ConfigError, ConnectionLost, DeviceNotFound, HalError, NotSupported, Problem, suggest
from .gamepad import Gamepad
from .gripper import Gripper
from .host.hosts import Host, LocalHost, RemoteHost, SteppedHost, make_groups, start_processes
from .host.process import SharedMemory
from .leader import explain_unguarded, make_leader
from .observation import Observation, Observer
from .pads.choice import Chosen, choose_pad
from .robot import Robot
from .specs import GroupSpec, RobotSpec
from .views import Console, Listen
from .world import NoWorld, World

if TYPE_CHECKING:
    from .specs import Plan
    from .views import CameraRenderer, Viewer3D

T = TypeVar("T")
_FIRST_FRAME = 5.0
"""Longest wait for a camera's first frame, s."""


def open_rig(
    config: str | Path | Mapping[str, Any] = "panda_table",
    *,
    sim: bool | None = None,
    driver: str | None = None,
    clock: str | None = None,
    engine: str | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    pad: str | None = None,
    viewer: str = "none",
    console: bool = False,
    listen: str | None = None,
    realtime: bool = True,
) -> Rig:
    """Open a rig. Nothing moves.

    Args:
        config: Path of a rig file, name of a built-in rig, or a dict of the same structure.
        sim: True simulates every device, False makes every device real; None keeps the flags of the rig file.
        driver: Driver that replaces those of all devices; ``"mock"`` needs no devices and no simulation.
        clock: ``"real_time"`` or ``"lock_step"``; None keeps that of the rig file.
        engine: Engine of the simulated world: ``"pybullet"``, ``"mujoco"``, or ``"auto"`` for the first of them that is
            installed; None keeps that of the rig file. :attr:`~hal.specs.Plan.engine` of :attr:`Rig.plan` names it.
        overrides: Values for keys of the rig file, as ``KEY=VALUE`` strings or a mapping.
        pad: Device behind a pad of ``model: auto``: ``auto``, ``evdev``, ``web`` (the console), ``terminal``, ``demo``
            (a recorded tour), the path of a recording, or ``none`` for no pad.
        viewer: ``"3d"`` serves a page with the arms in 3D, ``"none"`` none.
        console: Serve the console, even if another pad drives.
        listen: Address and port of the console, ``ADDRESS[:PORT]``; this computer only by default.
        realtime: Request real-time scheduling (SCHED_FIFO) and locked memory for the servos in real time; if they are
            refused, :attr:`Rig.notes` has the remedy.

    Returns:
        The rig; close it, or use it in a ``with`` statement.

    Raises:
        ConfigError: The rig file is wrong; lists every problem.
        CommandError: An argument is wrong.
        DriverMissing: A library is not installed; the message has the command that installs it.
        DeviceNotFound: No such device.
        ConnectionLost: A device does not answer.
        NotSupported: A viewer or a console that this rig cannot have.
    """
    from .config import load

    where = Listen.parse(listen)
    plan = load(config, sim=sim, driver=driver, clock=clock, engine=engine, overrides=overrides).resolve()
    rig = Rig(plan)
    try:
        rig._open(pad=pad, viewer=viewer, console=console, listen=where, realtime=realtime)
    except BaseException:
        with contextlib.suppress(Exception):
            rig.close()
        raise
    return rig


class Rig:
    """Robots, cameras and gamepads by name, one clock, and the simulated world if there is one.

    Created by :func:`hal.open`. Close it, or use it in a ``with`` statement; it is also closed when the program ends.

    Args:
        plan: The resolved rig.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.robots: Devices[Robot] = Devices("robot")
        self.cameras: Devices[Camera] = Devices("camera")
        self.gamepads: Devices[Gamepad] = Devices("gamepad")
        """Gamepads, then leader arms."""
        self.world: World = NoWorld()  # type: ignore[assignment]  # every use of it raises NotSupported
        self.clock: Clock = RealClock()
        self.notes: list[str] = list(plan.warnings)
        """Messages for the user about what was not found or refused, each with the remedy."""
        self._hosts: list[Host] = []
        self._latch = StopLatch()
        self.console: Console | None = None
        """The page in a browser; None if it is not served."""
        self.viewer3d: Viewer3D | None = None
        """The view of the arms in 3D on the console's page; None if there is none."""
        self._pictures: CameraRenderer | None = None
        self._devices: dict[str, Any] = {}
        self._observer = Observer(self)
        self._closed = False
        self._pid = os.getpid()
        atexit.register(self._close_at_exit)

    # Opening.

    @property
    def lock_step(self) -> bool:
        """Whether time stands still until the program waits."""
        return self.plan.clock == "lock_step"

    def _open(self, *, pad: str | None, viewer: str, console: bool, listen: Listen, realtime: bool) -> None:
        plan = self.plan
        pads = check_opening(plan, pad, viewer, console)
        groups = make_groups(plan)
        world_host = self._start_hosts(groups, realtime)
        if viewer == "3d":
            self.viewer3d = registry.load(registry.provider("viewer3d"), "viewer3d")(self)
        if console or viewer == "3d" or any(chosen.input == "console" for chosen in pads):
            self._start_console(listen, pads)
        if world_host is not None:
            self._open_renderer(world_host)
        self._wait_for_hosts(realtime)
        if world_host is not None:
            request, edited = partial(self._request_world, world_host), partial(self._pass_on_edit, world_host)
            self.world = World(request, edited, self.plan.world)
        for host in self._hosts:
            self.notes.extend(host.request("warnings"))
            for spec in host.spec.robots:
                gripper, collisions = self._make_gripper(spec), plan.collisions
                robot = Robot(spec, host, self.clock, gripper, collisions, self.robots)
                self.robots[spec.name] = robot
        for opened in (self.viewer3d, self.console):
            if opened is not None:
                opened.wait_ready()
                self.notes.extend(opened.notes)
        self._open_cameras()
        if self.console is not None:
            for camera in self.cameras.values():
                self.console.show_camera(camera)
        self._open_pads(pads)
        for host in self._hosts:
            host.request("reset_statistics")  # leave out the start

    def _wait_for_hosts(self, realtime: bool) -> None:
        """Wait until every process is ready, and note if an arm's did not get the real-time priority it asked for.

        Meanwhile a thread imports what the first control session needs: a signal in the middle of the import of a
        compiled library ends Python, and no thread but the main one gets any.
        """
        remote = [host for host in self._hosts if isinstance(host, RemoteHost)]
        preparing = threading.Thread(target=importlib.import_module, args=["hal.servo.controllers"])
        if remote:
            preparing.start()
        ready = [(host.wait_ready(), host.spec.robots) for host in remote]
        if remote:
            preparing.join()
        if not realtime or self.lock_step or all(answer["realtime"] or not robots for answer, robots in ready):
            return
        from .preflight import REALTIME_RIGHT

        checked = self.attended and not self.emulated  # the check before a real arm has printed the command
        remedy = "hal check prints what allows it" if checked else f"to allow it: {REALTIME_RIGHT}"
        self.notes.append(f"real-time priority (SCHED_FIFO) is refused: a busy computer delays the servos; {remedy}")

    def _start_hosts(self, groups: Sequence[GroupSpec], realtime: bool) -> Host | None:
        """Start the processes of the groups; return the one with the simulated world."""
        if not self.lock_step:
            for host in start_processes(groups, realtime, self._latch):
                self._hosts.append(host)
            return next((host for host in self._hosts if host.spec.world is not None), None)
        single = len(groups) == 1  # needs no memory that another process can read
        memories = [] if single else [(group, RemoteHost.allocate(group)) for group in groups]
        stepped = [
            SteppedHost(group, shared=shared, others=[] if group.robots else memories, latch=self._latch)
            for group, shared in memories[1:]
        ]
        self._hosts.extend(stepped)
        local = LocalHost(groups[0], stepped, self._latch, None if single else memories[0][1])
        self._hosts.insert(0, local)
        self.clock = LockStepClock(local.now, local.advance_to)
        return local if local.spec.world is not None else None

    def _make_gripper(self, robot: RobotSpec) -> Gripper | None:
        spec = robot.gripper
        if spec is None:
            return None
        host = next(host for host in self._hosts if spec in host.spec.grippers)
        return Gripper(spec, robot.name, host, self.clock)

    def _open_renderer(self, host: Host) -> None:
        """Open the renderer of the simulated cameras, if there are any."""
        world = host.spec.world
        assert world is not None
        cameras = [camera for camera in self.plan.cameras if camera.driver == world.driver]
        if cameras:
            self._pictures = registry.load(world.driver, "pictures")(host, cameras, self.plan.renderer)
            self._pictures.wait_ready()
            self.notes.extend(self._pictures.notes)

    def _open_cameras(self) -> None:
        for spec in self.plan.cameras:
            drawn = self._pictures is not None and spec.name in self._pictures
            source: object = self._pictures.source(spec.name) if self._pictures and drawn else self.clock
            driver = registry.load(spec.driver, "camera")(spec, source)
            place = find_place(spec, self.robots) if not driver.simulated else None
            camera = Camera(driver, self.clock, threaded=not self.lock_step, place=place)
            self._devices[spec.name] = driver
            self.cameras[spec.name] = camera
            camera.on_connection(partial(self._announce_camera, spec.name))
            camera.open()
        for camera in self.cameras.values():
            if not camera.wait_for_first(_FIRST_FRAME):
                self.notes.append(f"camera {camera.name} sent no frame in its first {_FIRST_FRAME:g} s")

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
            driver = registry.load(spec.driver, spec.kind)(spec, self._pad_source(chosen))
            gamepad = Gamepad(driver) if spec.leader is None else make_leader(driver, self.gamepads)
            self._devices[spec.name] = driver
            self.gamepads[spec.name] = gamepad
            gamepad.open(self.clock.now())
            self.notes.extend(gamepad.notes)
            if self.lock_step:
                self._local.pollers.append(gamepad.poll_once)
            else:
                gamepad.start_thread(self.clock.now)
        if self.console is not None and any(chosen.input == "console" for chosen in pads):
            # A program that waits for a dead-man would seem to hang. Apps print a banner instead.
            logging.getLogger("hal.console").warning("drive from a browser: %s", self.console.link)

    def _pad_source(self, chosen: Chosen) -> object | None:
        """Return the second argument of a gamepad driver: the console, this rig's stop, or the world's time."""
        if chosen.input == "console":
            return self.console
        if chosen.input == "keys":
            return self.stop
        return self._world_time() if chosen.input == "recording" else None

    def _world_time(self) -> Callable[[], float] | None:
        """Return a function for the time of a simulated world with arms, s, if it differs from the clock's."""
        host = next((host for host in self._hosts if host.spec.world is not None and host.spec.robots), None)
        if host is None or self.lock_step:
            return None
        memory, rate_hz = host.memory, host.spec.rate_hz
        return lambda: memory.get_host().ticks / rate_hz

    # The rig itself.

    @property
    def attended(self) -> bool:
        """Whether anything real moves on this rig, so that someone must be present."""
        return self.plan.attended

    @property
    def emulated(self) -> bool:
        """Whether everything that counts as real here is emulated, so that no one can be hurt."""
        return self.plan.emulated

    @property
    def has_world(self) -> bool:
        """Whether there is a simulated world, ``rig.world``."""
        return isinstance(self.world, World)

    @property
    def _local(self) -> LocalHost:
        host = self._hosts[0]
        if not isinstance(host, LocalHost):
            raise NotSupported(
                "drivers run in their own processes in real time; open the rig with clock='lock_step'",
                code="needs_lock_step",
            )
        return host

    def driver(self, name: str) -> Any:
        """Return the driver object of a device; for tests that press a mock pad or read its log.

        In real time only those of pads and cameras are in this process.

        Args:
            name: Name of a robot, a camera or a pad, or ``NAME.gripper`` for a robot's gripper.

        Raises:
            DeviceNotFound: No such device.
            NotSupported: In real time, for a robot or a gripper, whose drivers are in processes of their own.
        """
        if name in self._devices:
            return self._devices[name]
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
        """Description of the renderer of the simulated cameras; None if there are none."""
        return self._pictures.describe() if self._pictures is not None else None

    def statistics(self) -> dict[str, Any]:
        """Return ticks, missed ticks and periods (s) per group, peaks of set-points and latencies per robot."""
        return {host.spec.name: host.request("statistics") for host in self._hosts}

    def shared_states(self) -> list[SharedStates]:
        """Return the memory into which each group of devices publishes its states, for reading in another process.

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
        return self._latch.stops

    # Observing and stopping.

    def observe(
        self,
        after: float | None = None,
        *,
        timeout: float = 1.0,
        history: int = 1,
        cameras: Collection[str] | None = None,
    ) -> Observation:
        """Return every camera's newest frame with the states of all arms and grippers interpolated to its time.

        Args:
            after: Earliest time of everything in it, s on ``rig.clock``: after a motion,
                ``rig.observe(after=rig.clock.now())`` shows its end. None for any.
            timeout: Longest time to wait, s.
            history: Number of observations, this one included, in :attr:`~hal.observation.Observation.history`.
            cameras: Names of the cameras to use; all by default.

        Raises:
            StaleStateError: A frame or a state did not come within ``timeout``.
            ConnectionLost: A device does not answer.
            CommandError: An invalid argument.
            DeviceNotFound: No such camera.
        """
        return self._observer.observe(after, timeout, history, cameras)

    def forget_observations(self) -> None:
        """Start a new history of observations, for a new episode."""
        self._observer.forget()

    def stop(self) -> None:
        """Stop every arm, within its limits, and latch the stop. May be called from any thread at any time.

        A session continues after it reported the stop and ``control.rearm()`` was called, or when its dead-man is
        released and pressed again; a new session without a dead-man needs :meth:`rearm` first.
        """
        self._latch.stop()
        for host in self._hosts:
            host.beat()

    def say(self, text: str) -> None:
        """Display a line on the console's pages, if there are any."""
        if self.console is not None:
            self.console.say(text)

    def _announce_camera(self, name: str, lost: ConnectionLost | None) -> None:
        self.say(f"camera {name} is back" if lost is None else str(lost))

    def rearm(self) -> None:
        """Acknowledge every :meth:`stop` so far, so that sessions without a dead-man can be opened again.

        A session that is open stays stopped: it is continued by ``control.rearm()``, or by its dead-man.
        """
        self._latch.rearm()

    def _request_world(self, host: Host, method: str, params: dict[str, Any]) -> Any:
        answer = host.request(method, params)
        if method in ("world.reset", "world.restore"):
            for robot in host.spec.robots:
                if (gripper := self.robots[robot.name].gripper) is not None:
                    gripper._forget_grip()
        return answer

    def _pass_on_edit(self, host: Host, method: str, params: dict[str, Any], revision: int) -> None:
        if method == "add":
            self.notes.extend(text for text in host.request("warnings") if text not in self.notes)
        for shown in (self._pictures, self.viewer3d):
            if shown is not None:
                with contextlib.suppress(ConnectionLost):  # its own next use raises the error
                    shown.note_edit(method, params, revision)
        if method == "randomize" and self._pictures is not None:
            for name in self._pictures.cameras:
                self._devices[name].vary(params["values"])
                self.cameras[name].refresh_info()

    def close(self) -> None:
        """Bring the arms to rest and release every device. Idempotent; the first error is raised at the end."""
        if self._closed or self._pid != os.getpid():  # what a forked process has copies of is not its own
            return
        errors: list[BaseException] = []
        sessions = [robot._open for robot in self.robots.values() if robot._open is not None]
        shown = [item for item in (self.viewer3d, self.console, self._pictures) if item is not None]
        ends = [device.close for device in (*sessions, *self.gamepads.values(), *self.cameras.values(), *shown)]
        ends.insert(len(ends) - len(shown), self._warn_of_devices)
        ends += [host.request_close for host in self._hosts]  # all at the same time: lowering an arm takes seconds
        ends += [host.close for host in self._hosts]
        for end in ends:
            try:
                end()
            except BaseException as error:  # a second Ctrl-C must not leave the rest open
                errors.append(error)
        self._closed = True
        atexit.unregister(self._close_at_exit)
        if errors:
            raise errors[0]

    def _warn_of_devices(self) -> None:
        """Display the ``warnings`` in the statistics of real arms' drivers, for example of lost frames."""
        for host in self._hosts if self.attended else ():
            with contextlib.suppress(HalError):  # a lost process has nothing to say
                host.check()
                for arm in host.request("statistics")["robots"].values():
                    for text in arm["driver"].get("warnings", ()):
                        self.say(text)
                        warnings.warn(text, RuntimeWarning, stacklevel=3)

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


def check_opening(plan: Plan, pad: str | None, viewer: str, console: bool) -> list[Chosen]:
    """Choose the pads, and check what can be checked before a device or a process is opened.

    Returns:
        The pads to open.

    Raises:
        DriverMissing: The engine of the simulated world, or the libraries of a page, are not installed.
        DeviceNotFound: No such pad.
        NotSupported: A viewer or a console that this rig cannot have, or a recording, or a leader without a dead-man,
            for a real arm.
        ConfigError: A recording that cannot be played.
    """
    if plan.engine is not None:
        registry.check_engine(plan.engine)
    lock_step = plan.clock == "lock_step"
    known = {"attended": plan.attended, "emulated": plan.emulated, "lock_step": lock_step}
    pads = [] if pad == "none" else [choose_pad(spec, pad, **known) for spec in plan.pads]
    _check_leaders(plan, pads)
    wrong = _check_pages(plan.source, pads) + [
        Problem("--pad", "", message, code)
        for chosen in pads
        for _, message, code in registry.check_record(chosen.spec.driver, chosen.spec.kind, chosen.spec)
    ]
    if wrong:
        raise ConfigError(wrong)
    choice("viewer", viewer, ("none", "3d"), "unknown_viewer")
    if viewer == "3d":
        registry.load(registry.provider("viewer3d"), "viewer3d")
    if console or viewer == "3d" or any(chosen.input == "console" for chosen in pads):
        if lock_step:
            raise NotSupported(
                "the console needs real time; in lock-step, time runs as fast as the program", code="needs_real_time"
            )
        registry.load(registry.provider("console"), "console")
    return pads


def _check_pages(source: str, pads: list[Chosen]) -> list[Problem]:
    """Add a note to each further pad of the console's page; return the mistake of each further pad of the same hand."""
    first: dict[str, str] = {}
    problems = []
    for place, chosen in enumerate(pads):
        hand, name = chosen.spec.hand, chosen.spec.name
        if chosen.input != "console" or first.setdefault(hand, name) == name:
            continue
        if hand:
            message = f"is {hand}, as that of gamepads.{first[hand]}: one hand drives one arm; use the other hand"
            problems.append(Problem(source, f"gamepads.{name}.options.hand", message, "same_hand"))
            continue
        note = "the page is one pad, and drives one arm at a time; for the other, plug in a gamepad, or use a headset"
        pads[place] = chosen._replace(notes=(*chosen.notes, f"{name}: {note}"))
    return problems


def _check_leaders(plan: Plan, pads: Sequence[Chosen]) -> None:
    """Refuse a leader without a dead-man where something real moves. Raises NotSupported."""
    for chosen in pads:
        leader = chosen.spec.leader
        if leader is not None and not leader.may_drive_real and plan.attended and not plan.emulated:
            raise NotSupported(explain_unguarded(chosen.spec.name), code="deadman_not_trusted")


class Devices(dict[str, T]):
    """Devices by name. An unknown name raises DeviceNotFound, which lists the known ones."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self._kind = kind

    def __missing__(self, name: str) -> T:
        raise DeviceNotFound(f"this rig has no {self._kind} {name!r}{suggest(name, self)}", code=f"no_{self._kind}")

    if not TYPE_CHECKING:  # so that type checkers still report unknown attributes

        def __getattr__(self, name: str) -> NoReturn:
            hint = f"; use rig.{self.__dict__.get('_kind')}s[{name!r}]" if name in self else ""
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}{hint}", name=name, obj=self)


class SharedStates(NamedTuple):
    """States of one group of devices, in memory that another process may read; see :meth:`Rig.shared_states`."""

    spec: GroupSpec
    """The group: its robots, grippers and, where it has one, its simulated world."""
    memory: SharedMemory
    """Laid out as :class:`~hal.host.records.GroupMemory` of :attr:`spec`, then the bodies of a simulated world."""
