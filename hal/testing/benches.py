"""Benches and the base class of all contracts: a driver under test with its time and its faults, and specs to make it.

A **bench** is a driver with everything around it that a check needs: how time passes, and how to break and restore its
link. A **contract** is a class of checks that runs on a bench.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import pytest

from ..clock import Clock, RealClock
from ..driver import CameraDriver, GamepadDriver, GripperDriver, RobotDriver
from ..errors import ConnectionLost, HalError, StaleStateError
from ..specs import CameraSpec, Floats, GripperSpec, KinematicsSpec, LimitsSpec, PadSpec, RobotSpec, ViewSpec

_HANGS = 15.0
"""s after which a call counts as hanging."""

_Check = TypeVar("_Check", bound=Callable[..., Any])
_T = TypeVar("_T")


# Benches.


def _not_given(*_: Any) -> Any:
    """Default of every ability that a bench was not given."""
    raise AssertionError("this bench cannot do that; a check that uses it must say so with @needs")


def _do_nothing() -> None:
    """Do nothing."""


@dataclass(kw_only=True)
class Bench:
    """A driver under test and what surrounds it. Only ``driver`` is required."""

    driver: Any
    advance: Callable[[], None] = _do_nothing
    """Called once per cycle, where a program plays the device: let one cycle of ``dt`` pass in it."""
    real_time: bool = False
    """Whether the device runs by this computer's clock (hardware, a thread, a process). Then the checks wait; otherwise
    they count a time of their own, and a minute passes in a moment."""
    patience: float = 0.0
    """Time that the driver may take to notice that the link is lost, or restored, s. 0: at once."""
    lose: Callable[[], None] = _not_given
    """Break the link: pull the plug, end the far end."""
    restore: Callable[[], None] = _not_given
    """Restore the link that ``lose`` broke."""
    freeze: Callable[[], None] = _not_given
    """Silence the device while the link stays: nothing new arrives any more."""
    dt: float = 0.01
    """Length of a cycle, s."""
    now: float = 1000.0
    """The host's clock, s; it never starts at zero."""

    def __post_init__(self) -> None:
        if self.real_time:
            self.now = time.monotonic()

    def has(self, ability: str) -> bool:
        """Return whether this bench, or its driver, has an ability (a name of :attr:`Contract.abilities`)."""
        return getattr(self, ability) is not _not_given

    def was_given(self, ability: str) -> bool:
        """Return whether the bench was made with a function for an ability."""
        return callable(getattr(self, ability, None)) and self.has(ability)

    def pass_time(self) -> float:
        """Let one cycle pass, and return the time after it, s."""
        if self.real_time:
            time.sleep(max(0.0, self.now + self.dt - time.monotonic()))
            self.now = time.monotonic()
        else:
            self.now += self.dt
        self.advance()
        return self.now

    def turns(self, seconds: float) -> range:
        """Return a range with as many items as there are cycles in ``seconds``."""
        return range(max(1, round(seconds / self.dt)))


@dataclass(kw_only=True)
class RobotBench(Bench):
    """An arm. Its cycle is that of its spec (``rate_hz``), or its own if the driver paces itself."""

    driver: RobotDriver
    dt: float = 0.0
    fail: Callable[[], str] = _not_given
    """Cause a fault that ``recover()`` clears; return a word that the fault's cause must contain."""
    joint: int = -1
    """Index of the joint that the checks move by 0.2 rad to and fro; by default the fourth, or the last."""
    initial: Floats = field(default=())
    """Joint positions when the bench is made, rad; by default ``spec.initial``."""

    def __post_init__(self) -> None:
        spec = self.driver.spec
        self.dt = self.dt or 1.0 / spec.rate_hz
        self.joint = min(3, len(spec.joints) - 1) if self.joint < 0 else self.joint
        self.initial = self.initial or spec.initial
        self.real_time = self.real_time or self.driver.paces_itself
        super().__post_init__()

    def has(self, ability: str) -> bool:
        if ability == "torque":
            return "torque" in self.driver.modes
        return ability in ("rest", "holds", "returns") or super().has(ability)

    def pass_time(self) -> float:
        if not self.driver.paces_itself:
            return super().pass_time()
        self.advance()
        self.driver.wait()
        self.now = time.monotonic()
        return self.now


@dataclass(kw_only=True)
class GripperBench(Bench):
    """A gripper, open at the start."""

    driver: GripperDriver
    dt: float = 1 / 240
    put_object: Callable[[float], None] = _not_given
    """Hold a rigid object of this width (m) between the open fingers."""


@dataclass(kw_only=True)
class CameraBench(Bench):
    """A camera. It runs by this computer's clock, unless the bench is given another one.

    If ``freeze`` is given, ``restore`` ends that, too.
    """

    driver: CameraDriver
    clock: Clock = field(default_factory=RealClock)
    """The clock of its frames' stamps."""

    def __post_init__(self) -> None:
        self.real_time = isinstance(self.clock, RealClock)
        super().__post_init__()

    @property
    def paced(self) -> bool:
        """Whether it takes frames by itself, at its rate."""
        return self.real_time and not self.driver.on_demand


@dataclass(kw_only=True)
class PadBench(Bench):
    """A gamepad at rest, plugged in, nothing pressed. ``lose`` unplugs it, ``restore`` plugs it in again."""

    driver: GamepadDriver
    press: Callable[[], None] = _not_given
    """Press the button ``south`` (Cross, A)."""
    release: Callable[[], None] = _not_given
    """Release it."""


# Contracts.


def needs(*abilities: str) -> Callable[[_Check], _Check]:
    """Mark a check that only runs on a bench with these abilities."""

    def mark(check: _Check) -> _Check:
        check.needs = abilities  # type: ignore[attr-defined]
        return check

    return mark


def bench_of(make: Callable[[], AbstractContextManager[Bench]]) -> Any:
    """Return the fixture ``bench`` made from a context manager, for the body of a contract's class.

    Args:
        make: Yields a new bench with a driver that is not open, and closes the driver afterwards.

    Example:
        ``bench = bench_of(my_bench)``
    """

    @pytest.fixture
    def bench(self: object) -> Iterator[Bench]:
        with make() as made:
            yield made

    return bench


class Contract:
    """A class of checks. Inherit from one of the five contracts, give it a fixture ``bench``, and run pytest.

    What the device cannot do is left out by name and with a reason; it is never skipped::

        class TestMyCamera(CameraContract, left_out={"lose": "it is a file: there is no link"}): ...

    An ability that is neither given to the bench nor left out fails, so that none is forgotten.
    """

    abilities: ClassVar[tuple[str, ...]] = ()
    """What may be left out: functions of the bench, and properties that a device may lack."""
    left_out: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Ability -> why this device, or this bench, does not have it."""

    def __init_subclass__(cls, *, left_out: Mapping[str, str] = MappingProxyType({})) -> None:
        super().__init_subclass__()
        for ability, reason in left_out.items():
            if ability not in cls.abilities:
                known = ", ".join(cls.abilities)
                raise TypeError(f"{cls.__name__}, left_out: unknown ability {ability!r}; known: {known}")
            if not reason.strip():
                raise TypeError(f"{cls.__name__}, left_out: give a reason for leaving out {ability!r}")
        cls.left_out = MappingProxyType({**cls.left_out, **left_out})
        for name in dir(cls):
            if set(cls.left_out) & set(getattr(getattr(cls, name), "needs", ())):
                setattr(cls, name, None)  # pytest collects what can be called

    @pytest.fixture
    def bench(self) -> Any:
        """The driver with what surrounds it, new for every check and not open."""
        raise NotImplementedError(
            f"{type(self).__name__} has no bench: give it a fixture `bench` that yields a bench with your driver "
            "(hal.testing.CameraBench, RobotBench, ...), and closes the driver afterwards"
        )

    @pytest.fixture(autouse=True)
    def _check_abilities(self, bench: Bench) -> None:
        """Fail unless every ability is given, or left out with a reason."""
        for ability in self.abilities:
            given, out = bench.has(ability), ability in self.left_out
            assert given or out, (
                f"neither bench nor driver has {ability!r}: add it (see the contract's docstring), or leave it out: "
                f"class {type(self).__name__}(..., left_out={{{ability!r}: 'why'}})"
            )
            assert not (out and bench.was_given(ability)), (
                f"{type(self).__name__} leaves out {ability!r}, but its bench has one: remove it from left_out"
            )


# Waiting.


def wait_lost(bench: Bench, use: Callable[[], object], slack: float = 0.0) -> ConnectionLost:
    """Call ``use`` until it raises ConnectionLost, at most for the bench's patience, and return the error.

    Fails for any other error. On a busy machine it may take ``slack`` s longer.
    """
    deadline = time.monotonic() + bench.patience + slack
    while True:
        try:
            use()
        except ConnectionLost as error:
            return error
        except StaleStateError:
            pass  # the loss will be noticed soon
        except Exception as error:
            expected = "a device that does not answer must raise hal.errors.ConnectionLost"
            pytest.fail(f"{expected}, not {type(error).__name__}: {error}")
        if time.monotonic() >= deadline:
            pytest.fail(f"the link is lost, and the driver does not raise ConnectionLost within {bench.patience:g} s")


def wait_restored(bench: Bench, use: Callable[[], _T], slack: float = 0.0) -> _T:
    """Call ``use`` until it raises no HalError, at most for the bench's patience, and return its result."""
    deadline = time.monotonic() + bench.patience + slack
    while True:
        try:
            return use()
        except HalError as error:
            if time.monotonic() >= deadline:
                raise AssertionError(f"the link is restored, and the driver still raises: {error}") from error
            time.sleep(0.01)


def run_in_thread(act: Callable[[], object]) -> None:
    """Run ``act`` in a thread of its own, and raise here what it raises. Fails if it hangs."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            act()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(_HANGS)
    assert not thread.is_alive(), "the call hangs in a thread other than the one that opened the device"
    if raised:
        raise raised[0]


# Specs: records to make a driver from without a rig file, for small devices of no particular make.


def robot_spec(joints: int = 3, **changes: Any) -> RobotSpec:
    """Return the spec of an arm at 100 Hz that needs no URDF.

    Args:
        joints: Number of joints.
        changes: Fields of the record.
    """
    names = tuple(f"j{k + 1}" for k in range(joints))
    lower, upper, zeros = (-2.0,) * joints, (2.0,) * joints, (0.0,) * joints
    spec = RobotSpec(
        name="arm",
        model=f"{joints}_joints",
        driver="mock",
        rate_hz=100.0,
        urdf="",
        joints=names,
        home=zeros,
        initial=tuple((-1) ** k * (k + 1) / 10 for k in range(joints)),
        limits=LimitsSpec(lower, upper, (2.0,) * joints, (10.0,) * joints, (100.0,) * joints),
        kinematics=KinematicsSpec("", names, lower, upper, zeros, None, "tip", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        base_position=(0.0, 0.0, 0.0),
        base_orientation=(0.0, 0.0, 0.0, 1.0),
    )
    return replace(spec, **changes)


def gripper_spec(**changes: Any) -> GripperSpec:
    """Return the spec of a gripper that opens to 80 mm at 0.1 m/s; ``changes`` are fields of the record."""
    spec = GripperSpec(name="arm.gripper", driver="mock", width_max=0.08, speed=0.1, force=20.0)
    return replace(spec, **changes)


def camera_spec(**changes: Any) -> CameraSpec:
    """Return the spec of a small fixed camera at 30 Hz with colour, depth, infrared and segmentation.

    Args:
        changes: Fields of the record. Most cameras have fewer ``streams``. With another size, K and the captured size
            follow, unless they are given too.
    """
    width, height = changes.get("width", 64), changes.get("height", 48)
    focal = 60.0 * width / 64
    spec = CameraSpec(
        name="scene",
        model="test",
        driver="mock",
        capture_width=width,
        capture_height=height,
        width=width,
        height=height,
        rate_hz=30.0,
        K=((focal, 0.0, (width - 1) / 2), (0.0, focal, (height - 1) / 2), (0.0, 0.0, 1.0)),
        distortion=(0.0,) * 5,
        depth_min=0.1,
        depth_max=3.0,
        streams=("color", "depth", "infrared", "segmentation"),
        view=ViewSpec((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)),
    )
    return replace(spec, **changes)


def pad_spec(**changes: Any) -> PadSpec:
    """Return the spec of a gamepad; ``changes`` are fields of the record, most often ``options``."""
    return replace(PadSpec(name="pad", driver="mock", model=None), **changes)
