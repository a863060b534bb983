"""Views from an arm that goes there by itself, or that a person drives."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, Unreachable
from ..geometry import Pose
from .checks import LEAST_VIEWS
from .collecting import Collector
from .errors import CalibrationFailed, NoView
from .reaching import Reach
from .sampling import looks
from .solving import solve
from .views import View, camera_matrix

if TYPE_CHECKING:
    from ..deadman import Deadman

__all__ = ["drive", "take_and_tell"]

Array = NDArray[np.float64]
Say = Callable[[str], None]

_MORE = 3
"""So many places are thought of for each view that is wanted: not all can be reached."""


def take_and_tell(collector: Collector, say: Say) -> View | None:
    """Take a view and say what came of it; None where it is of no use."""
    try:
        view = collector.take()
    except NoView as reason:
        say(f"no view: {reason}")
        return None
    sighting = view.sighting
    say(
        f"{view.name}: {len(sighting.points)} corners, {sighting.error_px:.2f} px, board "
        f"{sighting.T_camera_board.position[2]:.2f} m away ({len(collector.rejected)} rejected)"
    )
    return view


def drive(
    collector: Collector,
    guess: Pose,
    wanted: int,
    say: Say,
    *,
    deadman: Deadman | None = None,
    unattended: bool = False,
) -> None:
    """Take ``wanted`` views by ``move_to``, starting where the arm is and the board is seen.

    ``guess`` is where the camera's colour sensor is, to some cm and degrees; it only decides where the arm goes, and is
    replaced by what the views say as soon as there are enough of them. Raises CalibrationFailed where the board is not
    seen at the start, and what ``move_to`` raises when the arm was stopped.
    """
    first = take_and_tell(collector, say)
    if first is None or first.q is None:
        raise CalibrationFailed("bring the arm to where the camera sees the board, and start again")
    tour = _Tour(collector, first, guess, _MORE * wanted)
    while len(collector.views) < wanted:
        q = tour.next()
        if q is None:
            break
        try:
            collector.robot.move_to(q, deadman=deadman, unattended=unattended)
        except CommandError as error:  # the way there leaves the workspace
            say(f"left out: {error}")
            continue
        take_and_tell(collector, say)
        if len(collector.views) == LEAST_VIEWS:
            tour.learn(say)
    say(
        f"{len(collector.views)} views, {len(collector.rejected)} pictures rejected, {tour.skipped} places out of reach"
    )
    collector.robot.move_to(first.q, deadman=deadman, unattended=unattended)


class _Tour:
    """Where to go next. Its camera is the optical frame that the pictures are of."""

    def __init__(self, collector: Collector, first: View, guess: Pose, places: int) -> None:
        assert first.q is not None
        self._collector = collector
        spec, board = collector.camera.spec, collector.detector.board
        self._middle = board.centre
        self._reach = Reach(collector.robot, collector.setting.link, collector.setting.eye, first.q)
        self._to_eye = first.T_color_eye
        self._camera = guess @ self._to_eye
        self._board = self._believed(first)
        seen = first.sighting.T_camera_board
        self._places = looks(board, first.sighting.K, (spec.width, spec.height), seen, places)
        self._nearest = min(float(np.linalg.norm(place.transform(self._middle))) for place in [*self._places, seen])
        self.skipped = 0

    def _believed(self, view: View) -> Pose:
        """Where the board is fixed, if the camera is where it is believed to be."""
        A = Pose.from_matrix(camera_matrix(self._collector.setting.eye, view))
        return A @ self._camera @ view.sighting.T_camera_board

    def learn(self, say: Say) -> None:
        """Believe the views rather than the guess, from now on."""
        try:
            found = solve(self._collector.views, self._collector.setting.eye)
        except CalibrationFailed:
            return
        camera = found.camera @ self._to_eye
        distance, angle = self._camera.distance(camera)
        off = f"{1e3 * distance:.0f} mm and {np.degrees(angle):.1f} degrees"
        say(f"the camera is {off} from where it was believed to be")
        self._camera, self._board = camera, found.board

    def next(self) -> Array | None:
        """(n,) rad of the place that is the shortest way from here, clear of the board; None when none is left."""
        here = self._collector.robot.state().q
        reached: list[tuple[float, int, Array]] = []
        for k, place in enumerate(self._places):
            try:
                q = self._reach.joints(place, self._camera, self._board, here)
            except (Unreachable, CommandError):
                continue
            if self._reach.is_clear(here, q, self._camera, self._board, self._middle, self._nearest):
                reached.append((float(np.abs(q - here).max()), k, q))
        self.skipped = len(self._places) - len(reached)
        if not reached:
            return None
        _, k, q = min(reached, key=lambda one: one[0])
        del self._places[k]
        return q
