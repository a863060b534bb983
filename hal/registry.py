"""Find drivers by name: a table of the built-in drivers, and the entry-point group ``hal.drivers`` for all others.

This is the only module of ``hal`` that names drivers. It imports a driver when it is first used.

A driver is a folder with one class for each kind of device (see :mod:`hal.driver`), and one :class:`DriverSpec` that
names these classes. Another package announces its spec in its ``pyproject.toml``; a robot or camera model, or the
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
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, Literal

from .errors import DeviceNotFound, DriverMissing, NotSupported

__all__ = [
    "BUILT_IN",
    "GROUP",
    "DriverSpec",
    "PadInput",
    "checked",
    "driver",
    "function",
    "load",
    "missing",
    "names",
    "pad_driver",
    "provider",
]

PadInput = Literal["plugged", "console", "keys", "recording"]
"""A gamepad that is plugged in, the page of the console, the keys of the program's terminal, or a recording."""

GROUP = "hal.drivers"
"""The entry-point group."""

BUILT_IN: Mapping[str, str] = MappingProxyType(
    {
        "evdev": "hal.drivers.evdev:DRIVER",
        "franka": "hal.drivers.franka:DRIVER",
        "mock": "hal.drivers.mock:DRIVER",
        "playback": "hal.drivers.playback:DRIVER",
        "pybullet": "hal.drivers.pybullet:DRIVER",
        "realsense": "hal.drivers.realsense:DRIVER",
        "terminal": "hal.drivers.terminal:DRIVER",
        "viser": "hal.drivers.viser:DRIVER",
        "web": "hal.drivers.web:DRIVER",
    }
)
"""Name of a built-in driver -> where its :class:`DriverSpec` is, as "module:ATTRIBUTE"."""


@dataclass(frozen=True)
class DriverSpec:
    """The classes and capabilities of one driver. Classes are named as ``"module:Class"`` and imported on first use."""

    name: str
    robot: str | None = None
    """A :class:`~hal.driver.RobotDriver`."""
    gripper: str | None = None
    """A :class:`~hal.driver.GripperDriver`."""
    camera: str | None = None
    """A :class:`~hal.driver.CameraDriver`."""
    gamepad: str | None = None
    """A :class:`~hal.driver.GamepadDriver`."""
    world: str | None = None
    """The simulated world that this driver's arms, grippers and cameras stand in."""
    viewer: str | None = None
    """A window onto a mirror."""
    viewer3d: str | None = None
    """A page with the arms in three dimensions."""
    pictures: str | None = None
    """What draws the pictures of all simulated cameras of a rig."""
    console: str | None = None
    """A page in a browser that shows a rig and drives it."""
    pad_input: PadInput | None = None
    """Where the input of this driver's gamepads comes from; the rig chooses a gamepad of ``model: auto`` by it."""
    pad_title: str = ""
    """A few words for :attr:`pad_input`, for status messages."""
    checks: Mapping[str, str] = field(default_factory=dict)
    """Kind of device (``robot``, ``gripper``, ``camera``, ``gamepad``) -> "module:function", which looks at the
    resolved record of such a device before anything is opened, and yields (key, message) for each thing that is wrong
    in it; keys are relative to the device's entry in the rig, for example ``real.host``. It must not import the
    driver's libraries."""
    emulated: str | None = None
    """"module:function" that says of the options of a real device whether a program stands in for it, which may be
    stepped by ``rig.clock`` (an address on this computer)."""
    preflight: str | None = None
    """"module:function" that looks at a real arm before it moves (see :mod:`hal.preflight`)."""
    camera_preflight: str | None = None
    """The same for a real camera."""
    path_options: frozenset[str] = frozenset()
    """Options that are paths of files: in a rig or a model they are relative to the file that names them."""
    own_process: frozenset[str] = frozenset()
    """Kinds of device that need a process of their own (``gripper``: the vendor's calls block)."""
    stands_in: bool = False
    """Whether ``hal.open(driver=...)`` may put this driver in place of every device, in lock-step."""
    requires: Mapping[str, str] = field(default_factory=dict)
    """Import name of each library that the driver needs -> the command that installs it."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of device that this driver has."""
        return tuple(kind for kind in _KINDS if getattr(self, kind) is not None)


_KINDS = ("robot", "gripper", "camera", "gamepad", "world", "viewer", "viewer3d", "pictures", "console")


def names() -> tuple[str, ...]:
    """Names of all drivers, built in and installed, in alphabetical order. Imports none of them."""
    return tuple(sorted({*BUILT_IN, *_entry_points()}))


def driver(name: str) -> DriverSpec:
    """The spec of the driver called ``name``, or named as "module:ATTRIBUTE".

    Raises DeviceNotFound (lists the drivers that there are) and DriverMissing (it is announced, but its package does
    not import).
    """
    place = BUILT_IN.get(name)
    if place is None and ":" in name:
        place = name
    if place is None:
        place = _entry_points().get(name)
    if place is None:
        raise DeviceNotFound(f"there is no driver {name!r}{_nearest(name, names())}; drivers: {', '.join(names())}")
    spec = _resolve(place, name, {})
    if not isinstance(spec, DriverSpec):
        raise DriverMissing(f"driver {name!r}: {place} is a {type(spec).__name__}, not a hal.registry.DriverSpec")
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


def load(name: str, kind: str) -> Any:
    """The class that the driver ``name`` has for ``kind`` (``robot``, ``gripper``, ``camera``, ``gamepad``, ...).

    Raises what :func:`driver` raises, NotSupported (the driver has no such kind; lists what it has), and
    DriverMissing (a library that it needs is not installed; names the command that installs it).
    """
    spec = driver(name)
    if kind not in _KINDS:
        raise NotSupported(f"there is no kind of driver {kind!r}{_nearest(kind, _KINDS)}; kinds: {', '.join(_KINDS)}")
    place = getattr(spec, kind)
    if place is None:
        raise NotSupported(f"driver {name!r} has no {kind}; it has: {', '.join(spec.kinds) or 'nothing'}")
    return _resolve(place, name, spec.requires)


def function(name: str, place: str | None) -> Callable[..., Any] | None:
    """The function that the driver ``name`` names as ``place`` in its spec (a check, ``emulated``, ``preflight``).

    None where it names none. Raises DriverMissing.
    """
    if place is None:
        return None
    found: Callable[..., Any] = _resolve(place, name, driver(name).requires)
    return found


def checked(name: str, kind: str, record: object) -> list[tuple[str, str]]:
    """Return what the driver ``name`` finds wrong in a device's record: (key in its entry of the rig, sentence)."""
    check = function(name, driver(name).checks.get(kind))
    return list(check(record)) if check is not None else []


def missing(name: str) -> dict[str, str]:
    """Libraries that the driver ``name`` needs and that are not installed -> the command that installs each.

    Looks for them without importing them, so a program can say what is missing before it opens anything.
    """
    return {
        library: command
        for library, command in driver(name).requires.items()
        if importlib.util.find_spec(library) is None
    }


def _resolve(place: str, name: str, requires: Mapping[str, str]) -> Any:
    """The attribute named by "module:ATTRIBUTE"; trouble is reported as that of the driver ``name``."""
    module_name, _, attribute = place.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        library = (error.name or "").partition(".")[0]
        if library == "hal" and not isinstance(error, ModuleNotFoundError):
            raise  # a mistake inside the hal itself; a traceback serves whoever mends it
        remedy = requires.get(library)
        hints = [remedy] if remedy else [f"{command} (for {wanted})" for wanted, command in requires.items()]
        advice = f"; install it with: {', '.join(hints)}" if hints else ""
        if library and module_name.partition(".")[0] == library and not advice:
            advice = "; install its package, or name its folder in PYTHONPATH"
        raise DriverMissing(f"driver {name!r} does not import: {error}{advice}", name=error.name) from error
    try:
        return getattr(module, attribute)
    except AttributeError:
        raise DriverMissing(f"driver {name!r}: module {module_name} has no {attribute!r}") from None


def _entry_points() -> dict[str, str]:
    """Drivers that installed packages announce, name -> "module:ATTRIBUTE"."""
    from importlib.metadata import entry_points  # 25 ms, so only when it is needed

    return {point.name: point.value for point in entry_points(group=GROUP)}


def _nearest(word: str, choices: tuple[str, ...]) -> str:
    close = get_close_matches(word, choices, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
