"""Collection of views: by the arm itself around the board, or by a user who drives or guides it.

:class:`Collector` takes a view of the arm at rest. :func:`collect_views` plans poses from which the board is seen well,
moves the arm from one to the next and takes a view at each. :class:`ManualDrive` lets a user drive between views.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, MotionStopped, StaleStateError, Unreachable
from ..geometry import Pose
from .board import Board
from .detection import Detector, NoView, select_image
from .setup import CalibrationSetup
from .solving import LEAST_VIEWS, CalibrationFailed, Eye, View, motion, solve

if TYPE_CHECKING:
    from ..deadman import Deadman
    from ..gamepad import Gamepad
    from ..rig import Rig
    from ..robot import Robot
    from ..teleop import Teleop

Array = NDArray[np.float64]
Report = Callable[[str], None]

REST = 0.01
"""Largest joint speed of an arm at rest, rad/s."""
PATIENCE = 3.0
"""Longest wait for the arm to come to rest, and for an image, s."""
SETTLE = 0.2
"""Pause at rest before the image, s, for vibrations that the joints do not measure."""
SHAKE = 5e-4
"""Largest motion of a joint while the image is taken, rad."""
ALIKE = 0.02, np.radians(3.0)
"""m and rad: a view nearer to another one than both of these adds nothing."""
FARTHEST = 1.6
"""Largest distance of a joint from the first view, rad, so that the posture stays the one that the user chose."""
NEAREST = 0.6
"""Least distance between the camera and the board's centre on the way, as a share of the nearest view's."""
RATE_HZ = 50.0
"""Rate of the commands while a user drives."""

_PLACES_PER_VIEW = 3
"""Planned poses for each view that is wanted: not all can be reached."""
_ON_THE_WAY = 12
"""Checked points of a motion."""
_STARTS = 3
_TILTS = np.radians([15.0, 25.0, 35.0])
_TURNS = np.radians([0.0, 25.0, -25.0, 50.0, -50.0])
_DISTANCES = (0.75, 0.9, 1.05)
"""As shares of the distance in the first view."""
_AZIMUTH = np.radians(137.5)
"""Golden angle: any number of tilts is spread to all sides."""
_SQUARE_PX = 14.0
"""Least side of a square in the image at which its marker is read."""
_MARGIN = 0.6
"""Share of half the image within which the board's centre stays."""


class Collector:
    """Takes views of the board and keeps those that are usable.

    Args:
        rig: The open rig.
        setup: Its camera and arm; see :func:`hal.calibration.find_setup`.
        detector: Detector of the board.
    """

    def __init__(self, rig: Rig, setup: CalibrationSetup, detector: Detector) -> None:
        self.setup = setup
        self.robot, self.camera = rig.robots[setup.robot], rig.cameras[setup.camera]
        self.detector = detector
        self.views: list[View] = []
        self.rejected: list[str] = []
        """Reasons, one for each image that could not be used."""
        self._clock = rig.clock
        self._images = 0

    def take_view(self) -> View:
        """Wait until the arm rests, take a view and keep it.

        Raises:
            NoView: The view is not usable; the reason is added to ``rejected``.
        """
        self._images += 1
        try:
            view = self._capture()
            self._check_new(view)
        except NoView as reason:
            self.rejected.append(f"image {self._images}: {reason}")
            raise
        self.views.append(view)
        return view

    def _capture(self) -> View:
        self._wait_for_rest()
        self._clock.sleep(SETTLE)
        before = self.robot.state()
        try:
            frame = self.camera.read(timeout=PATIENCE, after=self._clock.now())
        except StaleStateError as error:
            raise NoView(str(error), code="no_image") from None
        after = self.robot.state()
        if np.abs(after.q - before.q).max() > SHAKE:
            raise NoView("the arm moved while the image was taken", code="arm_moving")
        image = select_image(frame, self.camera.info, self.camera.spec.align)
        detection = self.detector.find(image.picture, image.K, image.distortion)
        if self.views and not np.allclose(self.views[0].detection.K, detection.K):
            raise NoView("the camera's K differs from the first view's", code="camera_changed")
        q = (before.q + after.q) / 2.0
        link = self.robot.base @ self.robot.kinematics.link_pose(self.setup.link, q)
        return View(f"view {len(self.views) + 1}", link, detection, q, image.T_color_eye)

    def _wait_for_rest(self) -> None:
        end = self._clock.now() + PATIENCE
        while np.abs(self.robot.state().dq).max() > REST:
            if self._clock.now() > end:
                raise NoView("the arm does not come to rest", code="arm_moving")
            self._clock.sleep(0.02)

    def _check_new(self, view: View) -> None:
        for other in self.views:
            distance, angle = view.T_world_link.distance(other.T_world_link)
            if distance < ALIKE[0] and angle < ALIKE[1]:
                text = f"{1e3 * distance:.0f} mm and {np.degrees(angle):.1f} degrees"
                raise NoView(f"too similar to {other.name}, {text} away", code="too_similar")


def add_view(collector: Collector, report: Report) -> View | None:
    """Take a view and report the outcome; return None if it is not usable."""
    try:
        view = collector.take_view()
    except NoView as reason:
        report(f"rejected: {reason}")
        return None
    detection = view.detection
    report(
        f"{view.name}: {len(detection.points)} corners, {detection.error_px:.2f} px, board "
        f"{detection.T_camera_board.position[2]:.2f} m away ({len(collector.rejected)} rejected)"
    )
    return view


def collect_views(
    collector: Collector,
    guess: Pose,
    wanted: int,
    report: Report,
    *,
    deadman: Deadman | None = None,
    unattended: bool = False,
) -> None:
    """Let the arm take views around the board by itself, with ``move_to``, and return to where it started.

    Start with the whole board in the image. The motions avoid the board and keep the rig's workspace; no other
    collision is checked.

    Args:
        collector: Receives the views.
        guess: Approximate pose of the colour sensor, in the frame of the link (in-hand) or in the world (to-hand), to
            some cm and ten degrees. It only plans the motions, and is replaced by the views' own result as soon as
            there are enough of them.
        wanted: Number of views.
        report: Called with progress messages.
        deadman: Dead-man control that must be held while the arm moves; see ``Robot.move_to``.
        unattended: Whether a real arm may move without one.

    Raises:
        CalibrationFailed: The board is not in the image at the start (``no_board``).
        MotionStopped: The arm was stopped; other errors of ``move_to`` likewise.
    """
    first = add_view(collector, report)
    if first is None or first.q is None:
        raise CalibrationFailed("move the arm to where the camera sees the board, and start again", code="no_board")
    route = _Route(collector, first, guess, _PLACES_PER_VIEW * wanted)
    while len(collector.views) < wanted:
        q = route.find_next_position()
        if q is None:
            break
        try:
            collector.robot.move_to(q, deadman=deadman, unattended=unattended)
        except CommandError as error:  # the motion would leave the workspace
            report(f"skipped: {error}")
            continue
        add_view(collector, report)
        if len(collector.views) == LEAST_VIEWS:
            route.improve_guess(report)
    report(
        f"{len(collector.views)} views, {len(collector.rejected)} images rejected, {route.skipped} poses out of reach"
    )
    collector.robot.move_to(first.q, deadman=deadman, unattended=unattended)


class _Route:
    """The remaining poses. ``_camera`` is the optical frame of the images."""

    def __init__(self, collector: Collector, first: View, guess: Pose, count: int) -> None:
        assert first.q is not None
        self._collector = collector
        spec, board = collector.camera.spec, collector.detector.board
        self._middle = board.centre
        self._reach = ArmReach(collector.robot, collector.setup.link, collector.setup.eye, first.q)
        self._to_eye = first.T_color_eye
        self._camera = guess @ self._to_eye
        seen = first.detection.T_camera_board
        link = first.T_world_link if collector.setup.eye == "in-hand" else first.T_world_link.inverse()
        self._board = link @ self._camera @ seen
        self._places = plan_views(board, first.detection.K, (spec.width, spec.height), seen, count)
        self._nearest = min(float(np.linalg.norm(place.transform(self._middle))) for place in [*self._places, seen])
        self.skipped = 0

    def improve_guess(self, report: Report) -> None:
        """Use the views' own result from now on, if there is one."""
        try:
            found = solve(self._collector.views, self._collector.setup.eye)
        except CalibrationFailed:
            return
        camera = found.camera @ self._to_eye
        distance, angle = self._camera.distance(camera)
        report(f"the camera is {1e3 * distance:.0f} mm and {np.degrees(angle):.1f} degrees from the initial guess")
        self._camera, self._board = camera, found.board

    def find_next_position(self) -> Array | None:
        """(n,) rad of the pose with the shortest motion that stays clear of the board; None if none is left."""
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


class ArmReach:
    """Joint positions from which the board is seen in a given pose.

    Args:
        robot: The arm.
        link: Its link that carries the camera or the board.
        eye: Which of the two.
        q: (n,) joint positions of the first view, rad.

    Raises:
        CommandError: The link does not move with the tcp.
    """

    def __init__(self, robot: Robot, link: str, eye: Eye, q: Array) -> None:
        self.robot, self.link, self.eye, self.first = robot, link, eye, np.asarray(q, float)
        self._tool = self._tool_pose(self.first)
        distance, angle = self._tool.distance(self._tool_pose(self.first + 0.3))
        if distance > 1e-6 or angle > 1e-6:
            raise CommandError(
                f"link {link!r} does not move with the tcp, so the arm cannot position it by itself: take the views by "
                "hand (--record)",
                code="link_not_at_tcp",
            )

    def _tool_pose(self, q: Array) -> Pose:
        """The tcp in the frame of the link."""
        kinematics = self.robot.kinematics
        return kinematics.link_pose(self.link, q).inverse() @ kinematics.pose(q)

    def joints(self, seen: Pose, camera: Pose, board: Pose, q_seed: Array) -> Array:
        """Return joint positions (n,), rad, at which the board is at ``seen`` in the camera's frame.

        Raises:
            Unreachable: There are none near the first view.
            CommandError: The tcp would leave the workspace.
        """
        if self.eye == "in-hand":
            link = board @ seen.inverse() @ camera.inverse()
        else:
            link = camera @ seen @ board.inverse()
        tcp = self.robot.base.inverse() @ link @ self._tool
        box = self.robot.spec.workspace
        if box is not None and ((tcp.position < box.lower) | (tcp.position > box.upper)).any():
            raise CommandError("the tcp would leave the workspace", code="outside_workspace")
        q = self.robot.kinematics.solve(tcp, q_seed, position_tolerance=1e-3, rotation_tolerance=1e-2, starts=_STARTS)
        if np.abs(q - self.first).max() > FARTHEST:
            raise Unreachable("the arm would change its posture", position_error=0.0, rotation_error=0.0)
        return q

    def is_clear(self, start: Array, end: Array, camera: Pose, board: Pose, middle: Array, nearest: float) -> bool:
        """Return whether camera and board keep their distance on the straight line in joint space.

        Args:
            start: (n,) rad.
            end: (n,) rad.
            camera: Its pose where it is fixed.
            board: Its pose where it is fixed.
            middle: (3,) centre of the board in its frame, m.
            nearest: Distance of the nearest view, m.
        """
        for share in np.linspace(0.0, 1.0, _ON_THE_WAY)[1:]:
            link = self.robot.base @ self.robot.kinematics.link_pose(self.link, start + share * (end - start))
            if self.eye == "in-hand":
                seen = (link @ camera).inverse() @ board
            else:
                seen = camera.inverse() @ link @ board
            if np.linalg.norm(seen.transform(middle)) < NEAREST * nearest:
                return False
        return True


def plan_views(board: Board, K: Array, size: tuple[int, int], first: Pose, count: int) -> list[Pose]:
    """Return poses of the board in the camera's frame: tilted, turned, nearer and farther, around the first one.

    The result is deterministic.

    Args:
        board: The board.
        K: (3, 3) of the camera.
        size: Width and height of its images, pixels.
        first: The board in the camera's frame, as first seen.
        count: Number of poses.
    """
    start = first.matrix()
    middle = start[:3, :3] @ board.centre + start[:3, 3]
    far = K[0, 0] * board.square / _SQUARE_PX
    near = K[0, 0] * max(board.size) / (0.9 * min(size))
    found = []
    for k in range(count):
        distance = float(np.clip(_DISTANCES[k % 3] * np.linalg.norm(middle), min(near, far), far))
        ray = _aim_ray(middle, K, size, (k % 4) / 3.0)
        facing = _find_rotation(start[:3, 2], ray) @ start[:3, :3]
        side = np.cross(ray, [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        tilt = _make_rotation(_make_rotation(ray, k * _AZIMUTH) @ side, _TILTS[(k // 2) % 3])
        pose = np.eye(4)
        pose[:3, :3] = _make_rotation(ray, _TURNS[k % 5]) @ tilt @ facing
        pose[:3, 3] = distance * ray - pose[:3, :3] @ board.centre
        found.append(Pose.from_matrix(pose))
    return found


def _aim_ray(middle: Array, K: Array, size: tuple[int, int], share: float) -> Array:
    """Direction of the board's centre: from where it was first seen (0) to the centre of the image (1)."""
    seen = (K @ (middle / middle[2]))[:2]
    half = np.array(size) / 2.0
    inside = half + np.clip(seen - half, -_MARGIN * half, _MARGIN * half)
    ray = np.linalg.inv(K) @ [*(inside + share * (half - inside)), 1.0]
    return np.asarray(ray / np.linalg.norm(ray))


def _make_rotation(axis: Array, angle: float) -> Array:
    """Rotation (3, 3) about a unit vector."""
    return motion(np.array([0.0, 0.0, 0.0, *(angle * axis)]))[:3, :3]


def _find_rotation(a: Array, b: Array) -> Array:
    """The shortest rotation (3, 3) from the unit vector ``a`` to ``b``."""
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return _make_rotation(axis / sine, float(np.arctan2(sine, a @ b)))


def wait_for_enter() -> bool:
    """Block until Enter is pressed in the terminal; return False for ``q`` and Enter, and at the end of the input."""
    try:
        answer = input("Enter takes a view; q and Enter ends: ")
    except EOFError:
        return False
    return not answer.strip().lower().startswith("q")


class ManualDrive:
    """Drives the arm with a gamepad between views. The gripper is not commanded, because it may hold the board.

    Args:
        rig: The open rig.
        robot: Its arm.
        pad: Its gamepad.
        teleop: Mapping from the gamepad to twists; needs the actions ``record`` and ``finish``.
        report: Called with messages.

    Raises:
        CommandError: The mapping lacks one of the actions.
    """

    def __init__(self, rig: Rig, robot: Robot, pad: Gamepad, teleop: Teleop, report: Report) -> None:
        actions = teleop.mapping.actions
        missing = [action for action in ("record", "finish") if action not in actions]
        if missing:
            raise CommandError(
                f"the mapping has no button for {', '.join(missing)}: add it to its actions", code="missing_action"
            )
        self._rig, self._robot, self._pad, self._teleop, self._report = rig, robot, pad, teleop, report
        self._record, self._finish = actions["record"], actions["finish"]
        self._deadman = pad.hold(teleop.mapping.deadman)
        if rig.console is not None:
            rig.console.explain(teleop.labels(actions=("record", "finish")))

    def help(self) -> list[str]:
        """Return a description of the controls, in lines."""
        name = self._pad.control_name
        return [*self._teleop.help(self._pad), f"{name(self._record)}: take a view, {name(self._finish)}: finish"]

    def wait(self) -> bool:
        """Drive until a view is requested (True) or the user finishes (False).

        The arm is at rest on return and its control session is closed, because taking a view takes longer than a
        command may be late.
        """
        reported = ""
        down = self._buttons()  # a button that is still down requested the last view
        with self._robot.control(deadman=self._deadman, rate_hz=RATE_HZ) as control:
            self._teleop.reset()
            for tick in self._rig.clock.rate(RATE_HZ):
                motion, _ = self._teleop.step(self._pad.state(), tick.dt)
                try:
                    control.send(motion)
                    reported = ""
                except MotionStopped as stop:
                    if str(stop) != reported:
                        reported = str(stop)
                        self._report(f"STOPPED: {stop}")
                before, down = down, self._buttons()
                if self._record in down - before:
                    return True
                if self._finish in down - before or self._pad.finished:
                    return False
        return False

    def _buttons(self) -> set[str]:
        state = self._pad.state()
        return {button for button in (self._record, self._finish) if state.pressed(button)}
