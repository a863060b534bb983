"""Calibration of a camera by a printed board: its pose on the hand or beside the arm, and its intrinsics.

Everything that a program needs is here; the modules behind it are loaded when they are first used, so importing this
package needs neither OpenCV nor SciPy::

    setup = find_setup(config, config.resolve(), camera="wrist")
    collector = Collector(rig, setup, Detector(load_board()))
    collect_views(collector, setup.known, 20, print)
    result = solve(collector.views, setup.eye)

``board`` is the printed board, ``detection`` finds it in an image, ``collecting`` moves the arm and takes the views,
``solving`` computes the pose from them, and ``setup`` reads the rig's file and writes the result into it.
``intrinsics`` is another problem with the same board: focal length and lens distortion.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .board import Board as Board
    from .board import load_board as load_board
    from .board import print_board as print_board
    from .collecting import Collector as Collector
    from .collecting import ManualDrive as ManualDrive
    from .collecting import add_view as add_view
    from .collecting import collect_views as collect_views
    from .collecting import wait_for_enter as wait_for_enter
    from .detection import BoardDetection as BoardDetection
    from .detection import Detector as Detector
    from .detection import NoView as NoView
    from .intrinsics import LEAST_PICTURES as LEAST_PICTURES
    from .intrinsics import LensFit as LensFit
    from .intrinsics import LensViews as LensViews
    from .setup import CalibrationSetup as CalibrationSetup
    from .setup import RigFileOutput as RigFileOutput
    from .setup import find_setup as find_setup
    from .setup import initial_guess as initial_guess
    from .solving import LEAST_VIEWS as LEAST_VIEWS
    from .solving import Calibration as Calibration
    from .solving import CalibrationFailed as CalibrationFailed
    from .solving import Eye as Eye
    from .solving import Uncertainty as Uncertainty
    from .solving import View as View
    from .solving import solve as solve

_MODULES = {
    "board": ("Board", "load_board", "print_board"),
    "collecting": ("Collector", "ManualDrive", "add_view", "collect_views", "wait_for_enter"),
    "detection": ("BoardDetection", "Detector", "NoView"),
    "intrinsics": ("LEAST_PICTURES", "LensFit", "LensViews"),
    "setup": ("CalibrationSetup", "RigFileOutput", "find_setup", "initial_guess"),
    "solving": ("LEAST_VIEWS", "Calibration", "CalibrationFailed", "Eye", "Uncertainty", "View", "solve"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}

__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
