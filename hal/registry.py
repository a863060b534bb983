"""Find drivers by name: the built-in ones, and those that other packages announce as entry points of ``hal.drivers``.

This is the only module of ``hal`` that names drivers. A driver is imported when it is first used.

A driver is a folder or module with one class per kind of device (see :mod:`hal.driver`), and one :class:`DriverSpec`
that names these classes. Another package announces its spec in its ``pyproject.toml``; a robot or camera model, or the
device's entry in a rig file, can then use ``drivers: {real: my_arm}``, and a gamepad ``driver: my_pad``::

    [project.entry-points."hal.drivers"]
    my_arm = "my_lab.my_arm:DRIVER"

Without a package, name the spec itself: ``drivers: {real: "my_lab.my_arm:DRIVER"}``.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from .errors import DeviceNotFound, DriverMissing, NotSupported, suggest

PadInput = Literal["plugged", "console", "keys", "recording", "program"]
"""Source of a gamepad's input: a pad that is plugged in, the console's page, the keys of the terminal, a recording, or
the program itself."""

GROUP = "hal.drivers"
"""Group of the entry points."""

BUILT_IN: Mapping[str, str] = MappingProxyType(
    {
        "damiao": "hal.drivers.can:DAMIAO",
        "dynamixel": "hal.drivers.servo_bus:DYNAMIXEL",
        "evdev": "hal.drivers.evdev:DRIVER",
        "feetech": "hal.drivers.servo_bus:FEETECH",
        "franka": "hal.drivers.franka:DRIVER",
        "mock": "hal.drivers.mock:DRIVER",
        "mujoco": "hal.drivers.mujoco:DRIVER",
        "piper": "hal.drivers.can:PIPER",
        "playback": "hal.drivers.playback:DRIVER",
        "pybullet": "hal.drivers.pybullet:DRIVER",
        "realsense": "hal.drivers.realsense:DRIVER",
        "robotiq": "hal.drivers.robotiq:DRIVER",
        "served": "hal.drivers.served:DRIVER",
        "terminal": "hal.drivers.terminal:DRIVER",
        "ur": "hal.drivers.ur:DRIVER",
        "v4l2": "hal.drivers.webcam:V4L2",
        "video": "hal.drivers.webcam:VIDEO",
        "viser": "hal.drivers.viser:DRIVER",
        "web": "hal.drivers.web:DRIVER",
        "xarm": "hal.drivers.xarm:DRIVER",
    }
)
"""Name of a built-in driver -> place of its :class:`DriverSpec`, as "module:ATTRIBUTE"."""

ENGINES = ("pybullet", "mujoco")
"""Built-in engines of the simulation, the first of which that is installed is the engine ``auto``. Any other driver
with a :attr:`~DriverSpec.world` is an engine, too."""

SIMULATION = "simulation"
"""Stands in ``drivers: {sim: simulation}`` for the engine of the rig."""


SERVED = "served"
"""The driver of cameras of another computer."""


@dataclass(frozen=True)
class DriverSpec:
    """Classes and capabilities of one driver. Classes are named as ``"module:Class"`` and imported on first use."""

    name: str
    robot: str | None = None
    """A :class:`~hal.driver.RobotDriver`."""
    gripper: str | None = None
    """A :class:`~hal.driver.GripperDriver`."""
    camera: str | None = None
    """A :class:`~hal.driver.CameraDriver`."""
    gamepad: str | None = None
    """A :class:`~hal.driver.GamepadDriver`."""
    leader: str | None = None
    """A :class:`~hal.leader.LeaderDriver`."""
    world: str | None = None
    """A :class:`~hal.world.WorldDriver`, which makes this driver an engine of the simulation: the world of its arms,
    grippers and cameras."""
    shared_world: str | None = None
    """"module:function" of the record of a world that has only mirrors of emulated arms: it returns the world that
    their emulators share, as a :class:`~hal.world.WorldDriver`, or None."""
    viewer3d: str | None = None
    """A page with the arms in 3D: :class:`~hal.views.Viewer3D`."""
    replay3d: str | None = None
    """"module:function" that returns a page, a text that needs nothing else, which replays a recording in 3D. Its
    arguments are the arms' and the world's records and an iterable of :class:`~hal.views.ReplayFrame`; it raises
    HalError for what cannot be drawn."""
    pictures: str | None = None
    """Renderer of all simulated cameras of a rig: :class:`~hal.views.CameraRenderer`."""
    software_renderer: str | None = None
    """A renderer of simulated cameras that needs no OpenGL."""
    pictures_preflight: str | None = None
    """"module:function" that checks whether :attr:`pictures` can draw; its argument is the rig (see
    :mod:`hal.preflight`)."""
    console: str | None = None
    """A page in a browser that displays a rig and drives it: :class:`~hal.views.Console`."""
    pad_input: PadInput | None = None
    """Source of the input of this driver's gamepads; the rig chooses a gamepad of ``model: auto`` by it."""
    pad_title: str = ""
    """A few words for :attr:`pad_input`, for status messages."""
    checks: Mapping[str, str] = field(default_factory=dict)
    """Kind of device (``robot``, ``gripper``, ``camera``, ``gamepad``, ``leader``) -> "module:function", which checks
    the resolved record of such a device before anything is opened. It yields (key, message, code) for each mistake;
    keys are relative to the device's entry in the rig, for example ``real.host``. It must not import the driver's
    libraries."""
    emulated: str | None = None
    """"module:function" that returns whether the options of a real device name an emulator on this computer."""
    steppable: bool = True
    """Whether ``rig.clock`` may step its emulators in lock-step; those on a bus live in real time."""
    group: str | None = None
    """"module:function" of the unchecked options of a real arm. Arms for which it returns the same key, a text, share
    one process, because only one can open their adapter; None for a process of its own."""
    shared_options: tuple[str, ...] = ()
    """Options of a real arm that apply to its gripper, too, unless the gripper has its own."""
    payload: bool = False
    """Whether a real arm uses the rig's ``payload``. Simulated arms accept one, and need none."""
    preflight: str | None = None
    """"module:function" that checks a real arm before it moves (see :mod:`hal.preflight`)."""
    camera_preflight: str | None = None
    """The same for a real camera."""
    gripper_preflight: str | None = None
    """The same for a real gripper, where the driver of its arm does not check it."""
    motors: str | None = None
    """"module:class" of a real arm's record, which sets up and calibrates its motors (``hal setup-motors``)."""
    buses: str | None = None
    """"module:function" that yields a line for each adapter that this driver's devices can be connected to, without
    arguments; ``hal check --can`` prints them."""
    path_options: frozenset[str] = frozenset()
    """Options that are paths of files; in a rig or a model they are relative to the file that names them."""
    own_process: frozenset[str] = frozenset()
    """Kinds of device that need a process of their own (``gripper``: the vendor's calls block)."""
    stands_in: bool = False
    """Whether ``hal.open(driver=...)`` may put this driver in place of every device, in lock-step."""
    requires: Mapping[str, str] = field(default_factory=dict)
    """Import name of each library that the driver needs -> command that installs it."""
    libraries: str | None = None
    """"module:function" of a real device's record, which returns those of :attr:`requires` that this device needs; None
    if every device needs all."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of device that this driver has."""
        return tuple(kind for kind in _KINDS if getattr(self, kind) is not None)


_VIEWS = ("viewer3d", "replay3d", "pictures", "software_renderer", "console")
_KINDS = ("robot", "gripper", "camera", "gamepad", "leader", "world", *_VIEWS)


def names() -> tuple[str, ...]:
    """Return the names of all drivers, built in and installed, in alphabetical order. Imports none of them."""
    return tuple(sorted({*BUILT_IN, *_entry_points()}))


def driver(name: str) -> DriverSpec:
    """Return the spec of a driver.

    Args:
        name: Name of the driver, or place of its spec as "module:ATTRIBUTE".

    Raises:
        DeviceNotFound: No such driver; lists the known ones (``code`` is ``unknown_driver``).
        DriverMissing: The driver is announced, but its package cannot be imported.
    """
    place = BUILT_IN.get(name)
    if place is None and ":" in name:
        place = name
    if place is None:
        place = _entry_points().get(name)
    if place is None:
        raise DeviceNotFound(f"there is no driver {name!r}{suggest(name, names())}", code="unknown_driver")
    spec = _resolve(place, name, {})
    if not isinstance(spec, DriverSpec):
        raise DriverMissing(
            f"driver {name!r}: {place} is a {type(spec).__name__}, not a hal.registry.DriverSpec", code="bad_driver"
        )
    return spec


def provider(kind: str) -> str:
    """Return the name of the first built-in driver that has a class for ``kind``, for example ``console``.

    Raises:
        NotSupported: No built-in driver has one.
    """
    for name in BUILT_IN:
        if kind in driver(name).kinds:
            return name
    raise NotSupported(f"no driver has a {kind}")


def pad_driver(pad_input: PadInput) -> str:
    """Return the name of the built-in gamepad driver whose input comes from ``pad_input``.

    Raises:
        NotSupported: No built-in driver has this input.
    """
    for name in BUILT_IN:
        if driver(name).pad_input == pad_input:
            return name
    raise NotSupported(f"no gamepad driver for {pad_input} input")


def is_engine(name: str | None) -> bool:
    """Return whether a name under ``drivers`` stands for the rig's engine: ``simulation``, or the name of an engine."""
    if name is None:
        return False
    try:
        return name == SIMULATION or driver(name).world is not None
    except (DeviceNotFound, DriverMissing):
        return False


def explain_engine(choice: str) -> str | None:
    """Return why ``choice`` is neither ``auto`` nor the name of an engine; None if it is."""
    if choice == "auto" or (choice != SIMULATION and is_engine(choice)):
        return None
    there = ("auto", *ENGINES, *(name for name in _entry_points() if is_engine(name)))
    return f"{choice!r} is no engine{suggest(choice, there)}, or a driver with a world"


def choose_engine(choice: str) -> str:
    """Return the name of the engine for the choice of a rig; for ``auto`` the first one if none is installed.

    Imports no engine, and does not check that a named one is installed (see :func:`check_engine`).
    """
    if choice != "auto":
        return choice
    return next((name for name in ENGINES if not find_missing(name)), ENGINES[0])


def check_engine(name: str) -> None:
    """Check, without an import, that the driver ``name`` of a simulated world can be used.

    Raises:
        DriverMissing: A library that it needs is not installed; the message has the command that installs it, and
            those of all engines if none is installed (``code`` is ``missing_engine``).
    """
    lacking = find_missing(name)
    if not lacking:
        return
    there = [other for other in ENGINES if other != name and not find_missing(other)]
    install = " and ".join(lacking.values())
    if there:
        advice = f"install it with: {install}; or use the engine {there[0]!r}"
    else:
        others = [command for other in ENGINES if other != name for command in find_missing(other).values()]
        advice = f"install it with: {install}; or install another engine: {', '.join(others)}"
    message = f"the simulation engine {name!r} is not installed; {advice}"
    raise DriverMissing(message, name=next(iter(lacking)), code="missing_engine")


def versions(name: str) -> dict[str, str]:
    """Return the versions of the libraries that a driver needs, as far as they are installed."""
    from importlib.metadata import PackageNotFoundError, version  # slow to import, so only when it is needed

    found = {}
    for library in driver(name).requires:
        for package in (library, f"{library}-core"):  # a package may install its library by another one
            try:
                found[library] = version(package)
                break
            except PackageNotFoundError:
                continue
    return found


def load(name: str, kind: str) -> Any:
    """Return the class that a driver has for a kind of device.

    Raises:
        DeviceNotFound: No such driver.
        NotSupported: The driver has no such kind; lists what it has.
        DriverMissing: A library that it needs is not installed; the message has the command that installs it.
    """
    spec = driver(name)
    if kind not in _KINDS:
        raise NotSupported(f"there is no kind of driver {kind!r}{suggest(kind, _KINDS)}", code="unknown_kind")
    place = getattr(spec, kind)
    if place is None:
        raise NotSupported(
            f"driver {name!r} has no {kind}; it has: {', '.join(spec.kinds) or 'nothing'}", code="no_such_kind"
        )
    return _resolve(place, name, spec.requires)


def function(name: str, place: str | None) -> Callable[..., Any] | None:
    """Return the function at ``place``, one of a driver's spec such as ``preflight``; None for None.

    Raises:
        DriverMissing: A library that it needs is not installed.
    """
    if place is None:
        return None
    found: Callable[..., Any] = _resolve(place, name, driver(name).requires)
    return found


def check_record(name: str, kind: str, record: object) -> list[tuple[str, str, str]]:
    """Return the mistakes that a driver finds in a device's record.

    Returns:
        (key in the device's entry of the rig, message, code) of each mistake. A check that yields no code has
        ``invalid``.
    """
    check = function(name, driver(name).checks.get(kind))
    return [(key, message, *(code or ("invalid",))) for key, message, *code in check(record)] if check else []


def find_missing(name: str, device: object = None) -> dict[str, str]:
    """Return the libraries that a driver needs and that are not installed -> the command that installs each.

    Imports none of them, so a program can report what is missing before it opens anything.
    """
    spec = driver(name)
    choose = None if device is None else function(name, spec.libraries)
    needed = spec.requires if choose is None else choose(device)
    return {library: spec.requires[library] for library in needed if importlib.util.find_spec(library) is None}


def _resolve(place: str, name: str, requires: Mapping[str, str]) -> Any:
    """Return the attribute at "module:ATTRIBUTE"; errors are reported as those of the driver ``name``."""
    module_name, _, attribute = place.partition(":")
    if not module_name or not attribute:
        raise DriverMissing(f"driver {name!r} is not written as module:CLASS", code="bad_driver")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        library = (error.name or "").partition(".")[0]
        if library == "hal" and error.name != module_name:
            raise  # a mistake in this package: the traceback is more useful
        remedy = requires.get(library)
        hints = [remedy] if remedy else [f"{command} (for {wanted})" for wanted, command in requires.items()]
        advice = f"; install it with: {', '.join(hints)}" if hints else ""
        if library and module_name.partition(".")[0] == library and not advice:
            advice = "; install its package, or name its folder in PYTHONPATH"
        raise DriverMissing(f"driver {name!r} does not import: {error}{advice}", name=error.name) from error
    try:
        return getattr(module, attribute)
    except AttributeError:
        raise DriverMissing(f"driver {name!r}: module {module_name} has no {attribute!r}", code="bad_driver") from None


def _entry_points() -> dict[str, str]:
    """Return the drivers that installed packages announce, name -> "module:ATTRIBUTE"."""
    from importlib.metadata import entry_points  # slow to import, so only when it is needed

    return {point.name: point.value for point in entry_points(group=GROUP)}
