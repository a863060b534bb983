"""Test tiers, the meaning of a skip, the simulation's engines, and plain specs to make drivers from.

Every test carries the marker of its folder: ``unit``, ``contract``, ``lock_step``, ``loops``, ``wire``, ``system``,
``browser``, ``apps``, ``docs`` or ``packaging``. The first four are the fast tier, which carries ``fast`` as well, and
is what ``pytest`` runs, in parallel where pytest-xdist is installed. ``pytest -m all`` runs everything, and a file or
folder named on the command line runs whatever its tier. See ``pytest --markers``.
"""

# ruff: noqa: E402  # numpy reads these variables when it is imported
from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # beside other tests, threads of linear algebra mostly wait for each other

import gc
import signal
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from engines_kit import Engine, need_engine

from hal import registry, testing
from hal.specs import CameraSpec, GripperSpec, PadSpec, RobotSpec

STRICT = os.environ.get("HAL_TEST_STRICT", "") not in ("", "0")
PYTHON = sys.version_info[:2]
TESTS = Path(__file__).resolve().parent
# pyproject.toml adds this for pytest itself; programs that a test starts find it here.
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(TESTS.parent / "packages/emulators/src"), *filter(None, [os.environ.get("PYTHONPATH")])]
)
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # each of a thousand programs would compile everything again

FAST = {
    "unit": "one part of the package at a time",
    "contract": "every driver against the contract of its kind (hal.testing)",
    "lock_step": "whole rigs in simulation, in lock-step",
    "loops": "what a user does, from beginning to end: each row of the tables of docs/safety.md",
}
OTHERS = {
    "wire": "drivers against emulated devices, through the vendors' client libraries",
    "system": "whole rigs in real time: processes, and faults at run time",
    "browser": "the console's page in a browser",
    "apps": "the command-line programs",
    "docs": "the code that the documents and examples show",
    "packaging": "what an installation holds",
}
MARKERS = {
    "all": "every test: 'pytest -m all' runs everything",
    "fast": "tests of the fast tier (unit, contract, lock_step and loops, without the slow ones): what 'pytest' runs",
    "slow": "takes more than a few seconds; never in the fast tier",
    "alone": "drives in real time what a busy computer would stop: CI runs nothing beside it",
    "pair": "drives in real time, and may share two processors with one other: CI runs two at once",
    "background": "needs no real time: CI runs it at idle priority beside 'browser'; all of BACKGROUND",
}
BACKGROUND = ("unit", "lock_step", "docs", "packaging")
"""Folders whose tests, as far as they are not of the fast tier, are marked ``background``."""
COLLECTED: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "not (fast": (tuple(name for name in OTHERS if name not in BACKGROUND), ("slow",)),
    "background": (("docs", "packaging"), ("slow", "background")),
    "pair": ((), ("pair",)),
    "browser": (("browser",), ()),
    "alone": ((), ("alone",)),
}
"""How an expression after -m of ``.ci/run`` begins -> folders that it takes, and markers of its tests in other ones."""


collect_ignore = ["engine_package", *([] if "HAL_TEST_LEROBOT" in os.environ else ["system/test_lerobot_tools.py"])]
"""A package that ``contract/test_outside_engine.py`` copies and runs; LeRobot, whose environment CI does not have."""


def pytest_collection_finish() -> None:
    """Take thousands of collected tests out of garbage collection: it would pause an app in this process for 0.2 s."""
    gc.collect()
    gc.freeze()


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers, and give signals that the shell ignores their effect back.

    A program inherits which signals are ignored: after ``nohup``, or ``&`` in a script, no Ctrl-C would end one.
    """
    for name, text in {**MARKERS, **FAST, **OTHERS}.items():
        config.addinivalue_line("markers", f"{name}: {text}")
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)  # as before for pytest itself; an app begins with the default


# Tiers.


def _tier(path: Path) -> str | None:
    """Return the folder of ``tests/`` that a path is in; None outside of these folders."""
    inside = path.relative_to(TESTS).parts if path.is_relative_to(TESTS) else ()
    return inside[0] if inside and (inside[0] in FAST or inside[0] in OTHERS) else None


def _named(config: pytest.Config) -> list[Path]:
    """Return what the command line names that runs whatever its tier: any file, and folders outside the fast tier."""
    paths = [(config.invocation_params.dir / argument.split("::")[0]).resolve() for argument in config.args]
    return [path for path in paths if path.is_file() or _tier(path) in OTHERS]


def _touches(path: Path, named: list[Path]) -> bool:
    """Whether a path is named, or is in a named folder, or is a folder with something named in it."""
    return any(path == one or one in path.parents or path in one.parents for one in named)


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Run the fast tier in parallel, unless -n, -s, --pdb or a file on the command line speaks against it."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        return  # a worker runs this as well, and starts none itself
    option = config.option
    plain = option.markexpr in ("", "fast") and option.capture != "no" and not option.collectonly
    if plain and not _named(config) and getattr(option, "numprocesses", 0) is None:
        option.numprocesses = "auto"
        option.maxprocesses = option.maxprocesses or 8
        option.dist = "loadscope" if option.dist == "no" else option.dist  # what a module shares is made once


def pytest_report_header(config: pytest.Config) -> str | None:
    """Say when only the fast tier runs."""
    return None if config.option.markexpr else "tests: the fast tier and what is named; 'pytest -m all' runs everything"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Without -m, or with -m fast, do not even import what is outside the fast tier; with CI's other -m the reverse."""
    tier = _tier(collection_path)
    for begin, (folders, marks) in COLLECTED.items():
        if config.option.markexpr.startswith(begin) and tier and collection_path.name.startswith("test_"):
            text = "" if tier in folders else collection_path.read_text(encoding="utf-8")
            taken = tier in folders or any(f"mark.{mark}" in text for mark in marks)
            return None if taken and not (begin == "not (fast" and tier in BACKGROUND) else True
    if config.option.markexpr not in ("", "fast") or _tier(collection_path) not in OTHERS:
        return None
    return None if _touches(collection_path, _named(config)) else True


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark every test by its folder, and without -m leave the slow ones out, unless their file is named."""
    named = _named(config)
    kept, left = [], []
    for item in items:
        tier = _tier(item.path)
        slow = item.get_closest_marker("slow") is not None
        fast = tier in FAST and not slow
        timed = any(item.get_closest_marker(name) for name in ("pair", "alone"))
        kinds = {"fast": fast, "background": tier in BACKGROUND and not fast and not timed}
        for name in ["all", *([tier] if tier else []), *(name for name, of_it in kinds.items() if of_it)]:
            item.add_marker(name)
        (left if slow and not config.option.markexpr and not _touches(item.path, named) else kept).append(item)
    if left:
        items[:] = kept
        config.hook.pytest_deselected(items=left)


# Skips.


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """With HAL_TEST_STRICT=1 a skipped test fails: CI has every package of Python that a test may ask for."""
    return _strict((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, Any]:
    """The same for a module that skips itself."""
    return _strict((yield))


WITHOUT_WHEEL = tuple(
    name for name, last in {"pybullet": (3, 11), "pylibfranka": (3, 12), "ur_rtde": (3, 13)}.items() if last < PYTHON
)
"""Libraries that this version of Python has no wheels of: tests may skip that name one of them in their reason."""
NOT_PYTHON = ("from npm",)
"""The same of what pip does not install, and a computer may not reach."""


def _strict(report: Any) -> Any:
    if STRICT and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        if any(name in str(reason).lower() for name in WITHOUT_WHEEL + NOT_PYTHON):
            return report
        report.outcome = "failed"
        report.longrepr = f"HAL_TEST_STRICT=1 does not allow to skip: {reason}"
    return report


# Engines.


@pytest.fixture(scope="session", params=registry.ENGINES)
def engine(request: pytest.FixtureRequest) -> Engine:
    """Each engine of the simulated world in turn."""
    return need_engine(request.param)


# Specs.


@pytest.fixture
def robot_spec() -> RobotSpec:
    """An arm of three joints for drivers that need no URDF."""
    return testing.robot_spec()


@pytest.fixture
def gripper_spec() -> GripperSpec:
    """A gripper that opens to 80 mm at 0.1 m/s."""
    return testing.gripper_spec()


@pytest.fixture
def camera_spec() -> CameraSpec:
    """A small fixed camera at 30 Hz with every stream."""
    return testing.camera_spec()


@pytest.fixture
def pad_spec() -> PadSpec:
    """A pad of no particular make."""
    return testing.pad_spec()
