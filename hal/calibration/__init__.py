"""Where is my camera? Its pose on the hand, or beside the arm, from pictures of a printed board.

One file, one question:

``board``       what is printed?
``printing``    how does it come onto paper, to scale?
``looking``     which picture is it, and of which sensor?
``detection``   where are the board's corners in this picture, and is the picture good enough?
``lens``        where would a camera without distortion see them?
``views``       what belongs to one picture, and what is solved for?
``closed_form`` where is the camera, roughly, from nothing but the views?
``refinement``  and exactly, by the pixels of all corners of all views?
``checks``      could these views tell it at all?
``solving``     all of that in order, bad views thrown out, with residuals and uncertainty
``sampling``    from where should the board be looked at?
``reaching``    how does the arm get there?
``collecting``  one view of the arm at rest
``recording``   views from an arm that goes there by itself, or that a person drives
``writing``     the answer, in the rig's file
"""

from __future__ import annotations

from .board import Board, load_board
from .errors import CalibrationFailed, NoView
from .solving import Calibration, solve
from .views import Eye, Sighting, View

__all__ = [
    "Board",
    "Calibration",
    "CalibrationFailed",
    "Eye",
    "NoView",
    "Sighting",
    "View",
    "load_board",
    "solve",
]
