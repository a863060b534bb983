"""Which devices of a rig are recorded, and whether they can be."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from ..errors import CommandError
from ..host.hosts import groups_of
from .cameras import CameraTrack
from .columns import MORE_STREAMS, TIMES
from .sampling import Sampler, movable

if TYPE_CHECKING:
    from ..rig import Rig

__all__ = ["check_rate", "chosen"]


def check_rate(rig: Rig, fps: int) -> None:
    """Raise CommandError where a simulation in lock-step makes fewer steps than rows are wanted."""
    if rig.lock_step and fps > (steps := groups_of(rig.plan)[0].rate_hz):
        raise CommandError(f"fps must be at most {steps:g}, the steps of this simulation in a second, not {fps}")


def chosen(
    rig: Rig, cameras: Collection[str] | None, streams: Collection[str]
) -> tuple[Sampler, list[CameraTrack], list[str]]:
    """Return the sampler of every arm and pad, a track per camera of these names, else of all, and notes for a person.

    Raises CommandError for what cannot be recorded, DeviceNotFound, StaleStateError, ConnectionLost.
    """
    if unknown := [stream for stream in streams if stream not in ("color", "depth", *MORE_STREAMS)]:
        known = ", ".join(("color", "depth", *MORE_STREAMS))
        raise CommandError(f"there is no stream {unknown[0]!r}; streams: {known}")
    if not rig.robots:
        raise CommandError("this rig has no arm to record")
    if odd := [name for name in movable(rig) if "/" in name]:
        raise CommandError(f"an object's name becomes that of a column, which has no slash: {odd[0]!r}")
    names = tuple(rig.cameras) if cameras is None else tuple(dict.fromkeys(cameras))
    tracks, notes = [], []
    for name in names:
        track = CameraTrack(rig.cameras[name], streams=streams, lock_step=rig.lock_step)
        setup = track.setup
        if setup.videos and (setup.width % 2 or setup.height % 2):
            size = f"{setup.width}x{setup.height}"
            raise CommandError(f"a video has even sizes: change cameras.{name}.output, which is {size}")
        if setup.videos or setup.depths:
            tracks.append(track)
        own = rig.cameras[name].spec.streams
        if left := [stream for stream in own if stream in MORE_STREAMS and stream not in streams]:
            notes.append(f"camera {name}: {', '.join(left)} not recorded")
        if missing := [stream for stream in streams if stream in MORE_STREAMS and stream not in own]:
            notes.append(f"camera {name} has no {', '.join(missing)}")
    for files in ([track.setup.videos for track in tracks], [track.setup.depths for track in tracks]):
        file_names = [name for each in files for name in each]
        if double := [name for name in file_names if file_names.count(name) > 1]:
            raise CommandError(f"two streams would be called {double[0]}: rename a camera")
    sampler = Sampler(rig, [track.camera.name for track in tracks])
    for track in tracks:
        seq = sampler.place_of(f"{TIMES}camera.{track.camera.name}") + 2
        track.setup = track.setup._replace(seq=seq)
    return sampler, tracks, notes
