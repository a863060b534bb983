"""The calibration problem of a rig: which camera, on or beside which arm, and where the result is written."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import yaml

from ..config import load
from ..config.data_files import data_folder
from ..config.files import parse_yaml
from ..config.rigfile import RigFile
from ..config.schema import PoseConfig
from ..errors import CommandError, suggest
from ..geometry import Pose
from ..kinematics.urdf import read_urdf
from ..specs import Plan, RobotSpec

if TYPE_CHECKING:
    from .solving import Eye

PLACES = ("look_at", "pose", "attached")
"""Keys that give a camera's place in a rig's file; a camera has at most one of them."""

Spec = TypeVar("Spec")


@dataclass(frozen=True)
class CalibrationSetup:
    """One camera and one arm."""

    camera: str
    robot: str
    eye: Eye
    link: str
    """Link of the URDF that carries the camera (in-hand) or the board (to-hand)."""
    link_name: str
    """Name of the same link in the rig's file."""
    known: Pose | None
    """The camera's pose in the rig's file, in the frame that it is fixed in; None if the file does not have it."""

    @property
    def frame(self) -> str:
        """Description of the frame that the camera is fixed in."""
        return f"the frame of {self.link_name}" if self.eye == "in-hand" else "the world"

    def entry(self, pose: Pose) -> tuple[str, str]:
        """Return key and value of the camera's entry in the rig's file for ``pose``, rounded to a micrometre."""
        numbers = [f"{value:.6f}" for value in pose.position] + [f"{value:.8f}" for value in pose.orientation]
        seven = f"[{', '.join(numbers)}]"
        if self.eye == "to-hand":
            return "pose", seven
        return "attached", f"{{robot: {self.robot}, link: {self.link_name}, pose: {seven}}}"


def find_setup(
    rig: RigFile,
    plan: Plan,
    camera: str | None = None,
    robot: str | None = None,
    eye: Eye | None = None,
    link: str | None = None,
) -> CalibrationSetup:
    """Determine the camera, the arm and the link of a calibration from a rig's file.

    Args:
        rig: The rig's file, from ``hal.config.load``.
        plan: The same, resolved.
        camera: Name of the camera; None if the rig has one.
        robot: Name of the arm; None for the one that carries the camera, or the only one.
        eye: Where the camera is; None if the rig's file has its place.
        link: Link that carries the camera or the board; None for the one in the rig's file, or the tcp's.

    Raises:
        CommandError: A name is missing or unknown; lists the available ones.
    """
    spec = choose_spec("camera", camera, {camera.name: camera for camera in plan.cameras})
    attached = rig.cameras[spec.name].attached
    if robot is None and attached is not None:
        robot = attached.robot
    arm = choose_spec("robot", robot, {robot.name: robot for robot in plan.robots})
    if eye is None:
        if spec.view is None:
            raise CommandError(
                f"the rig's file has no place for camera {spec.name}: add --eye in-hand if it is on the arm, --eye "
                "to-hand if it stands still",
                code="missing_eye",
            )
        eye = "to-hand" if attached is None else "in-hand"
    view, known = spec.view, None
    chosen = name = link or arm.kinematics.tcp_link
    if eye == "to-hand":
        known = view if attached is None else None
    elif view is not None and attached is not None and attached.robot == arm.name and link in (None, view.link):
        known, chosen, name = view, view.link or chosen, link or attached.link
    _check_link(arm, chosen)
    place = Pose(known.position, known.orientation) if known is not None else None
    return CalibrationSetup(spec.name, arm.name, eye, chosen, name, place)


def initial_guess(setup: CalibrationSetup, text: str | None) -> Pose:
    """Return the camera's approximate pose.

    Args:
        setup: The camera and the arm.
        text: ``[x, y, z, qx, qy, qz, qw]``, m and a unit quaternion; None for the pose in the rig's file.

    Raises:
        CommandError: The text is not a pose, or the rig's file has none.
    """
    if text is not None:
        try:
            given = PoseConfig.model_validate(parse_yaml(text))
        except (ValueError, yaml.YAMLError) as error:
            raise CommandError(
                f"--guess must be [x, y, z, qx, qy, qz, qw], m and a unit quaternion: {error}", code="bad_guess"
            ) from None
        return Pose(given.position, given.orientation)
    if setup.known is None:
        raise CommandError(
            f"the rig's file has no pose of camera {setup.camera} in {setup.frame}: add --guess with its pose to some "
            "cm and degrees, or take the views by hand (--record)",
            code="missing_guess",
        )
    return setup.known


def choose_spec(kind: str, name: str | None, specs: Mapping[str, Spec]) -> Spec:
    """Return the record with that name, or the only one. Raises CommandError, which lists the available ones."""
    if name is None:
        if len(specs) == 1:
            return next(iter(specs.values()))
        raise CommandError(f"--{kind} is needed; this rig has: {', '.join(specs) or 'none'}", code=f"missing_{kind}")
    if name not in specs:
        raise CommandError(f"this rig has no {kind} {name!r}{suggest(name, specs)}", code=f"unknown_{kind}")
    return specs[name]


def _check_link(arm: RobotSpec, link: str) -> None:
    """Raise CommandError unless the link exists and moves with the arm's joints alone."""
    urdf = read_urdf(Path(arm.urdf))
    if link not in urdf.links:
        raise CommandError(f"robot {arm.name!r} has no link {link!r}{suggest(link, urdf.links)}", code="unknown_link")
    others = [joint.name for joint in urdf.above(link) if joint.movable and joint.name not in arm.joints]
    if others:
        raise CommandError(
            f"link {link!r} also moves with {', '.join(others)}; choose one that only the arm moves",
            code="link_moves",
        )


class RigFileOutput:
    """The rig's file that a result is written to; ``check`` it before the views are taken.

    Args:
        source: The rig's file.
        path: The file to write; the same, or a copy.
        camera: Name of the camera.

    Raises:
        CommandError: The folder is missing.
    """

    @classmethod
    def of(cls, source: str, out: str | None, camera: str) -> RigFileOutput | None:
        """Return the output for the rig's file ``source``: ``out``, or that file itself.

        Returns:
            None for a built-in rig without ``out``: built-in files are never changed.
        """
        if out is None and Path(source).resolve().is_relative_to(data_folder("config").resolve()):
            return None
        return cls(Path(source), Path(source if out is None else out).expanduser(), camera)

    def __init__(self, source: Path, path: Path, camera: str) -> None:
        self.source, self.path, self.camera = source, path, camera
        if not self.path.resolve().parent.is_dir():
            raise CommandError(f"there is no folder {self.path.resolve().parent}", code="no_folder")

    def _replace_entry(self, key: str, value: str) -> str:
        return replace_camera_entry(self.source.read_bytes().decode("utf-8"), self.camera, key, value)

    def check(self, key: str, value: str) -> str:
        """Return the file's text with the entry; raises as :meth:`write`."""
        text = self._replace_entry(key, value)
        trial = self.path.resolve().with_name(f".{self.path.name}.trial.yaml")
        try:
            write_file(trial, text)
            load(trial)
        finally:
            trial.unlink(missing_ok=True)
        return text

    def write(self, key: str, value: str) -> list[str]:
        """Write the entry and keep a copy of the previous file; return messages for the terminal.

        The source is read again, because it may have been edited meanwhile.

        Raises:
            CommandError: The file cannot be edited; nothing is changed.
            ConfigError: The new file would not be a valid rig; nothing is changed.
            OSError: The file cannot be written; nothing is changed.
        """
        text = self.check(key, value)
        messages = []
        if self.path.exists():
            messages.append(f"previous version: {back_up(self.path)}")
        write_file(self.path, text)
        return [*messages, f"written: {self.path}"]


def replace_camera_entry(text: str, camera: str, key: str, value: str) -> str:
    """Replace a camera's place, or another key, in the text of a rig's file; every other character stays as it is.

    Libraries that edit YAML (ruamel.yaml) rewrite indentation, quotes, line ends and aligned comments elsewhere in a
    file, so the entry is located with PyYAML and replaced in the text.

    Args:
        text: Text of the file.
        camera: Name of the camera.
        key: ``pose`` or ``attached``, which replaces whichever of :data:`PLACES` is there; or another key.
        value: Its value as YAML, in one line.

    Returns:
        The new text. Comments beside the old entry stay, comments inside it are removed with it.

    Raises:
        CommandError: The place cannot be changed alone (anchors, merged or repeated keys); the message has the entry to
            write by hand.
    """
    entry, old = f"{key}: {value}", PLACES if key in PLACES else (key,)
    by_hand = f"edit cameras.{camera} by hand: replace {', '.join(old)} with\n  {entry}"
    try:
        changed = _edit_text(text, camera, entry, old)
        fits = parse_yaml(changed) == _change_data(parse_yaml(text), camera, key, value)
    except (yaml.YAMLError, LookupError, TypeError) as error:
        raise CommandError(f"the file cannot be edited ({error}); {by_hand}", code="not_editable") from None
    if not fits:
        raise CommandError(
            f"the file shares keys between entries (& * <<), so it is not edited; {by_hand}", code="shared_keys"
        )
    return changed


def _change_data(data: Any, camera: str, key: str, value: str) -> Any:
    """The file's data after the change."""
    old = PLACES if key in PLACES else (key,)
    entries = {name: item for name, item in data["cameras"][camera].items() if name not in old}
    entries[key] = parse_yaml(value)
    return {**data, "cameras": {**data["cameras"], camera: entries}}


def _edit_text(text: str, camera: str, entry: str, old: tuple[str, ...]) -> str:
    """The new text, with the entry in the place of one of the keys ``old``.

    Raises LookupError and TypeError if the file has another structure than expected.
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)  # in Python, since libyaml's counts bytes
    settings = _value(_value(root, "cameras"), camera)
    if not isinstance(settings, yaml.MappingNode) or not settings.value:
        raise LookupError(f"cameras.{camera} has no keys")
    places = [name.value for name, _ in settings.value if name.value in old]
    if len(places) > 1:
        raise LookupError(f"cameras.{camera} has {len(places)} places: {', '.join(places)}")
    for name, value in settings.value:
        if name.value in old:
            start, end = name.start_mark.index, _end(value)
            if not start < end:
                raise LookupError(f"the value of cameras.{camera}.{name.value} is elsewhere")
            return text[:start] + entry + text[end:]
    name, value = settings.value[-1]
    end = _end(value)
    if settings.flow_style:
        return f"{text[:end]}, {entry}{text[end:]}"
    line_end = text.find("\n", end)
    rest = len(text) if line_end < 0 else line_end
    newline = "\r\n" if text[:rest].endswith("\r") else "\n"
    rest -= len(newline) - 1
    return f"{text[:rest]}{newline}{' ' * name.start_mark.column}{entry}{text[rest:]}"


def _value(node: Any, key: str) -> Any:
    if not isinstance(node, yaml.MappingNode):
        raise LookupError(f"no keys where {key!r} should be")
    found = [value for name, value in node.value if name.value == key]
    if len(found) != 1:
        raise LookupError(f"the key {key!r} occurs {len(found)} times" if found else f"there is no key {key!r}")
    return found[0]


def _end(node: Any) -> int:
    """Return the index behind a value's last character; the end mark of a block is behind the comments after it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)


def write_file(path: Path, text: str) -> None:
    """Write ``text`` to a file, completely or not at all; its permissions and symbolic links stay."""
    path = path.resolve()  # of a symbolic link, the file behind it
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, temporary)
        else:
            os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def back_up(path: Path) -> Path:
    """Copy a file to an unused name beside it and return that: ``rig.yaml.bak``, ``rig.yaml.bak2``, ..."""
    number = 1
    while True:
        copy = path.with_name(f"{path.name}.bak{number if number > 1 else ''}")
        try:
            with copy.open("xb") as file:
                file.write(path.read_bytes())
        except FileExistsError:
            number += 1
            continue
        return copy
