"""Write one episode as an ``.rrd`` file for the rerun viewer: pictures, curves, and the poses in the world."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import import_library
from ...geometry import Pose
from ...types import STREAMS, RobotStatus, Trip
from ..dataset import Episode
from ..layout import SETPOINT, STATE
from .content import ArmColumns, EpisodeContent, PictureStream

_TIMELINE = "episode"
_QUALITY = 90
_DEPTH_UNITS = 10_000.0
"""Steps of depth per metre: 0.1 mm, so that 16 bits reach 6.5 m."""


def write_rrd(episode: Episode, path: Path) -> None:
    """Write the file. Raises DriverMissing without rerun-sdk, OSError, and the errors of reading the episode."""
    rr = import_library("rerun", "a file for the rerun viewer", "robot-hal[review]")
    content = EpisodeContent(episode)
    recording = rr.RecordingStream("robot-hal", recording_id=f"episode {episode.number}")
    recording.save(str(path), default_blueprint=_blueprint(content))
    try:
        recording.send_recording_name(f"{episode.number}: {episode.task}")
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for arm in content.arms:
            _log_arm(rr, recording, content, arm)
        for name, poses in content.objects.items():
            _log_poses(rr, recording, f"world/objects/{name}", content.grid, poses)
            recording.log(
                f"world/objects/{name}", rr.Points3D([[0.0, 0.0, 0.0]], radii=0.015, labels=name), static=True
            )
        for stream in content.pictures:
            _log_pictures(rr, recording, content, stream)
    finally:
        recording.disconnect()  # writes the rest and closes the file


def _blueprint(content: EpisodeContent) -> Any:
    """Return the layout of the viewer's window: world and pictures on the left, all curves on the right."""
    import rerun.blueprint as rrb

    pictures = [
        rrb.Spatial2DView(origin=f"world/cameras/{stream.camera}/{stream.what}", name=f"{stream.camera} {stream.what}")
        for stream in content.pictures
    ]
    logs = rrb.TextLogView(origin="status", name="arm status")
    left: list[Any] = [
        rrb.Spatial3DView(origin="world", name="world"),
        *([rrb.Grid(*pictures)] if pictures else []),
        logs,
    ]
    curves = [
        rrb.TimeSeriesView(origin=f"joints/{arm.name}/{joint}", name=joint)
        for arm in content.arms
        for joint in content.joints(arm)
    ]
    curves += [
        rrb.TimeSeriesView(origin=f"gripper/{arm.name}", name=f"gripper of {arm.name}")
        for arm in content.arms
        if content.width(arm) is not None
    ]
    shares = [3, *([3] if pictures else []), 1]
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*left, row_shares=shares), rrb.Vertical(*curves)), collapse_panels=True
    )


def _log_arm(rr: Any, recording: Any, content: EpisodeContent, arm: ArmColumns) -> None:
    grid = content.grid
    measured, commanded = content.of(arm, STATE), content.of(arm, SETPOINT)
    for k, joint in enumerate(content.joints(arm)):
        _log_curves(rr, recording, f"joints/{arm.name}/{joint}", grid, measured[:, k], commanded[:, k])
    width, target = content.width(arm), content.width(arm, SETPOINT)
    if width is not None and target is not None:
        _log_curves(rr, recording, f"gripper/{arm.name}", grid, width, target)
    base = _base(content, arm)
    tcp = np.array([_in_world(base, row) for row in content.of(arm, "observation.tcp")])
    _log_poses(rr, recording, f"world/{arm.name}/tcp", grid, tcp)
    recording.log(f"world/{arm.name}/tcp", rr.Points3D([[0.0, 0.0, 0.0]], radii=0.01, labels=arm.name), static=True)
    recording.log(f"world/{arm.name}/path", rr.LineStrips3D([tcp[:, :3]], radii=0.001), static=True)
    last = None
    for t, (status, trip, _) in zip(grid, content.of(arm, "rig.status").tolist(), strict=True):
        if (status, trip) != last:
            recording.set_time(_TIMELINE, duration=float(t))
            why = f", stopped: {Trip(int(trip))}" if trip else ""
            level = rr.TextLogLevel.WARN if trip else rr.TextLogLevel.INFO
            recording.log(f"status/{arm.name}", rr.TextLog(f"{RobotStatus(int(status))}{why}", level=level))
            last = (status, trip)


def _log_curves(
    rr: Any, recording: Any, place: str, grid: NDArray[Any], measured: NDArray[Any], commanded: NDArray[Any]
) -> None:
    times = [rr.TimeColumn(_TIMELINE, duration=grid)]
    for name, values, colour in (("commanded", commanded, [240, 140, 30]), ("measured", measured, [0, 90, 181])):
        recording.log(f"{place}/{name}", rr.SeriesLines(colors=colour, names=name), static=True)
        recording.send_columns(f"{place}/{name}", times, rr.Scalars.columns(scalars=values.astype(np.float64)))


def _base(content: EpisodeContent, arm: ArmColumns) -> Pose:
    for robot in content.episode.info["rig"]["resolved"]["robots"]:
        if robot["name"] == arm.name:
            return Pose(robot["base_position"], robot["base_orientation"])
    return Pose()


def _in_world(base: Pose, row: NDArray[Any]) -> NDArray[np.float64]:
    pose = base @ Pose(row[:3], row[3:] / np.linalg.norm(row[3:]))
    return np.concatenate([pose.position, pose.orientation])


def _log_poses(rr: Any, recording: Any, place: str, grid: NDArray[Any], poses: NDArray[Any]) -> None:
    """Log poses (rows, 7) in the world; rows with unknown poses keep the last one."""
    known = np.isfinite(poses).all(axis=1)
    if known.any():
        columns = rr.Transform3D.columns(translation=poses[known, :3], quaternion=poses[known, 3:])
        recording.send_columns(place, [rr.TimeColumn(_TIMELINE, duration=grid[known])], columns)


def _log_pictures(rr: Any, recording: Any, content: EpisodeContent, stream: PictureStream) -> None:
    place = f"world/cameras/{stream.camera}"
    if stream is next(each for each in content.pictures if each.camera == stream.camera):
        _log_lens(rr, recording, content, stream, place)
    for t, picture in zip(content.grid, stream, strict=True):
        recording.set_time(_TIMELINE, duration=float(t))
        recording.log(f"{place}/{stream.what}", _picture(rr, stream, picture))


def _log_lens(rr: Any, recording: Any, content: EpisodeContent, stream: PictureStream, place: str) -> None:
    known = content.lenses().get(stream.camera)
    if known is None:
        return
    K = np.array(known["K"])
    height, width = stream.shape[:2]
    lens = rr.Pinhole(
        image_from_camera=K, resolution=[width, height], camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.15
    )
    recording.log(place, lens, static=True)
    key = f"rig.camera_pose.{stream.camera}"
    if content.has(key):
        _log_poses(rr, recording, place, content.grid, content.episode.columns[key])


def _picture(rr: Any, stream: PictureStream, picture: NDArray[Any]) -> Any:
    if stream.what == "rgb":
        import simplejpeg

        jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(picture), quality=_QUALITY, colorspace="RGB")
        return rr.EncodedImage(contents=jpeg, media_type="image/jpeg")
    if stream.what == "depth":
        return rr.EncodedDepthImage(_png(picture), media_type="image/png", meter=_DEPTH_UNITS)
    if STREAMS[stream.what].exact:
        return rr.SegmentationImage((picture - int(STREAMS[stream.what].lowest)).astype(np.uint16))
    return rr.Image(picture, color_model="L")


def _png(depth: NDArray[np.float32]) -> bytes:
    """Return depth (H, W), m, as a 16-bit PNG."""
    from PIL import Image

    whole = np.clip(np.rint(depth * np.float32(_DEPTH_UNITS)), 0, 65535).astype(np.uint16)
    file = io.BytesIO()
    Image.fromarray(whole).save(file, format="png", compress_level=1)
    return file.getvalue()
