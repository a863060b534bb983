"""One view of the arm at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import StaleStateError
from .detection import Detector
from .errors import NoView
from .looking import look_of
from .setting import Setting
from .views import View

if TYPE_CHECKING:
    from ..rig import Rig

__all__ = ["Collector"]

REST = 0.01
"""rad/s: slower than this is at rest."""
PATIENCE = 3.0
"""s to wait for that."""
SETTLE = 0.2
"""s at rest before the picture, for what shakes without the joints' knowing it."""
SHAKE = 5e-4
"""rad that a joint may move while the picture is taken."""
ALIKE = 0.02, np.radians(3.0)
"""m and rad: a view that is nearer to another one than both of these tells nothing new."""


class Collector:
    """Takes views, and keeps those that are of use."""

    def __init__(self, rig: Rig, setting: Setting, detector: Detector) -> None:
        self.setting = setting
        self.robot, self.camera = rig.robots[setting.robot], rig.cameras[setting.camera]
        self.detector = detector
        self.views: list[View] = []
        self.rejected: list[str] = []
        """Why, one line for each picture that could not be used."""
        self._clock = rig.clock
        self._pictures = 0

    def take(self) -> View:
        """Look, and keep the view. Raises NoView, which says why this one is of no use; it is counted too."""
        self._pictures += 1
        try:
            view = self.look()
            self._check_new(view)
        except NoView as reason:
            self.rejected.append(f"picture {self._pictures}: {reason}")
            raise
        self.views.append(view)
        return view

    def look(self) -> View:
        """A view of the arm where it rests now, whatever it is good for."""
        self._wait_for_rest()
        self._clock.sleep(SETTLE)
        before = self.robot.state()
        try:
            frame = self.camera.read(timeout=PATIENCE, after=self._clock.now())
        except StaleStateError as error:
            raise NoView(str(error)) from None
        after = self.robot.state()
        if np.abs(after.q - before.q).max() > SHAKE:
            raise NoView("the arm moved while the picture was taken")
        look = look_of(frame, self.camera.info, self.camera.spec.align)
        sighting = self.detector.find(look.picture, look.K, look.distortion)
        if self.views and not np.allclose(self.views[0].sighting.K, sighting.K):
            raise NoView("the camera's K is not what it was in the first view")
        q = (before.q + after.q) / 2.0
        link = self.robot.base @ self.robot.kinematics.link_pose(self.setting.link, q)
        return View(f"view {len(self.views) + 1}", link, sighting, q, look.T_color_eye)

    def _wait_for_rest(self) -> None:
        end = self._clock.now() + PATIENCE
        while np.abs(self.robot.state().dq).max() > REST:
            if self._clock.now() > end:
                raise NoView("the arm does not come to rest")
            self._clock.sleep(0.02)

    def _check_new(self, view: View) -> None:
        for other in self.views:
            distance, angle = view.T_world_link.distance(other.T_world_link)
            if distance < ALIKE[0] and angle < ALIKE[1]:
                raise NoView(f"{1e3 * distance:.0f} mm and {np.degrees(angle):.1f} degrees from {other.name}: too near")
