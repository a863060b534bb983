"""Calibration of a camera by a printed board: its pose on the hand or beside the arm, and its intrinsics.

Everything that a program needs is here; importing it needs SciPy, and detecting a board needs OpenCV
(``pip install 'robot-hal[calibration]'``)::

    setup = find_setup(config, config.resolve(), camera="wrist")
    collector = Collector(rig, setup, Detector(load_board()))
    collect_views(collector, setup.known, 20, print)
    result = solve(collector.views, setup.eye)

``board`` is the printed board, ``detection`` finds it in an image, ``collecting`` moves the arm and takes the views,
``solving`` computes the pose from them, and ``setup`` reads the rig's file and writes the result into it.
``intrinsics`` is another problem with the same board: focal length and lens distortion.
"""

from __future__ import annotations

from .board import Board, load_board, print_board
from .collecting import Collector, ManualDrive, add_view, collect_views, wait_for_enter
from .detection import BoardDetection, Detector, NoView
from .intrinsics import LEAST_PICTURES, LensFit, LensViews
from .setup import CalibrationSetup, RigFileOutput, find_setup, initial_guess
from .solving import LEAST_VIEWS, Calibration, CalibrationFailed, Eye, Uncertainty, View, solve

__all__ = [
    "LEAST_PICTURES",
    "LEAST_VIEWS",
    "Board",
    "BoardDetection",
    "Calibration",
    "CalibrationFailed",
    "CalibrationSetup",
    "Collector",
    "Detector",
    "Eye",
    "LensFit",
    "LensViews",
    "ManualDrive",
    "NoView",
    "RigFileOutput",
    "Uncertainty",
    "View",
    "add_view",
    "collect_views",
    "find_setup",
    "initial_guess",
    "load_board",
    "print_board",
    "solve",
    "wait_for_enter",
]
