"""Which camera is *the camera*, and which one the gripper's."""

from __future__ import annotations

from ...errors import CommandError
from .content import EpisodeContent

__all__ = ["CAMERA", "GRIPPER_CAMERA", "roles"]

CAMERA, GRIPPER_CAMERA = "camera", "gripper_camera"


def roles(content: EpisodeContent, camera: str | None = None, gripper_camera: str | None = None) -> dict[str, str]:
    """What each camera of an episode is called in an export.

    Unless told otherwise, the first one on an arm is ``gripper_camera``, the first one that is not on an arm is
    ``camera``, and all others keep their names. CommandError for a name that is not there, or where two would be called
    the same.
    """
    there = content.cameras
    for name in (camera, gripper_camera):
        if name is not None and name not in there:
            raise CommandError(f"there is no camera {name} in this export; cameras: {', '.join(there) or 'none'}")
    if camera is not None and camera == gripper_camera:
        raise CommandError(f"{camera} cannot be both the camera and the gripper's")
    carried = _carried(content)
    free = [name for name in there if name not in (camera, gripper_camera)]
    gripper_camera = gripper_camera or next((name for name in free if name in carried), None)
    camera = camera or next((name for name in free if name not in carried), None)
    found = {name: CAMERA if name == camera else GRIPPER_CAMERA if name == gripper_camera else name for name in there}
    if len(set(found.values())) < len(found):
        raise CommandError("two cameras would be called the same; choose with --camera and --gripper-camera")
    return found


def _carried(content: EpisodeContent) -> set[str]:
    """Cameras that an arm carries, by the rig's configuration."""
    cameras = content.episode.info["rig"]["resolved"]["cameras"]
    return {spec["name"] for spec in cameras if (spec["view"] or {}).get("robot") is not None}
