"""Pictures over a link: what arrives is what the camera took, and the newest; what makes no sense ends the link."""

from __future__ import annotations

import json
import socket
import struct
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

from hal.errors import ConnectionLost
from hal.geometry import Pose
from hal.remote.boxes import ITEM
from hal.remote.frames import (
    LARGEST,
    ReceivedFrames,
    SentFrames,
    check_camera,
    decode_frame,
    describe_camera,
    encode_frame,
)
from hal.remote.link import RigLink
from hal.specs import CameraSpec, DepthSensorSpec
from hal.testing import camera_spec
from hal.types import Frame, Stamp

STREAMS = ("color", "depth", "infrared", "segmentation")


def camera(width: int = 64, height: int = 48) -> CameraSpec:
    sensor = DepthSensorSpec("stereo", 0.001)
    return camera_spec(width=width, height=height, streams=STREAMS, depth_sensor=sensor)


def picture(spec: CameraSpec, seq: int, measured: bool = True) -> Frame:
    """Return a smooth frame; its depth is in whole units where it is ``measured``."""
    rows, columns = np.mgrid[: spec.height, : spec.width]
    color = np.stack([rows + seq, columns, rows + columns], axis=-1).astype(np.uint8)
    depth = (rows + 400).astype(np.float32) * np.float32(0.001 if measured else 0.00123)
    infrared, bodies = color[..., 0].copy(), (rows % 3 - 1).astype(np.int32)
    where = Pose([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])
    stamp = Stamp(5.0 + seq, 0.5 * seq, seq)
    return Frame(stamp, color, depth, infrared, bodies, np.eye(3), np.zeros(5), where, None, 0.004)


def test_a_camera_that_comes_back_as_another_one_is_refused() -> None:
    then = camera()
    check_camera(replace(then, at="pc", driver="served", view=None), json.loads(json.dumps(describe_camera(then))))
    for now in (camera(width=128), replace(then, K=((1.0, 0.0, 0.0), *then.K[1:])), replace(then, align="depth")):
        with raises_code(ConnectionLost, "other_camera"):
            check_camera(then, json.loads(json.dumps(describe_camera(now))))


@pytest.mark.parametrize("compress", [False, True], ids=["as it is", "compressed"])
@pytest.mark.parametrize("measured", [True, False])
def test_a_frame_arrives_as_it_was_taken(compress: bool, measured: bool) -> None:
    spec = camera()
    frame = picture(spec, 7, measured)
    data = encode_frame(frame, spec, compress)
    found = decode_frame(data, spec, shift=100.0, now=1e9)
    assert (found.t, found.t_device, found.seq, found.skew) == (112.0, 3.5, 7, 0.004)
    assert decode_frame(data, spec, shift=100.0, now=50.0).t == 50.0, "no time is later than its arrival"
    assert found.T_world_camera is not None
    assert (found.T_world_camera.position == [1.0, 2.0, 3.0]).all()
    for stream in STREAMS[1:] if compress else STREAMS:
        image, sent = getattr(found, stream), getattr(frame, stream)
        assert image.dtype == sent.dtype
        assert np.array_equal(image, sent), f"{stream} is without loss"
    assert found.infrared_right is None
    assert found.color is not None
    assert np.abs(found.color.astype(int) - frame.color).mean() < 2.0
    if compress:
        assert len(data) < 0.5 * len(encode_frame(frame, spec, compress=False))


class Ends:
    """Both ends of a link for the pictures of a camera; the one that receives takes nothing by itself."""

    def __init__(self, spec: CameraSpec) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            left = socket.create_connection(server.getsockname())
            self.here, self.there = RigLink(left, "there"), RigLink(server.accept()[0], "here")
        for link in (self.here, self.there, self.here):
            link.post("hello")
            link.send()
            other = self.there if link is self.here else self.here
            other.wait(1.0)
            other.receive()
        self.taken: Any = None
        device: Any = SimpleNamespace(spec=spec, on_frame=self._listen)
        self.here.outgoing = [SentFrames(device, self.here)]
        self.frames = ReceivedFrames(spec)
        self.there.incoming, self.there.largest = [self.frames], LARGEST

    def _listen(self, callback: Any) -> Any:
        self.taken = callback
        return lambda: None

    def close(self) -> None:
        self.here.close()
        self.there.close()


def test_only_the_newest_frame_is_sent_while_the_connection_takes_none() -> None:
    spec = camera(1280, 960)
    ends = Ends(spec)
    found: list[int] = []
    deadline = time.monotonic() + 20.0
    for seq in range(1, 6):
        ends.taken(picture(spec, seq))
        ends.here.send()
    while found[-1:] != [5]:
        assert time.monotonic() < deadline
        ends.there.receive()
        ends.here.send()
        if ends.frames.frame is not None:
            found.append(ends.frames.frame.seq)
            ends.frames.frame = None
    assert found == [1, 5]
    ends.close()


HEAD = [0.0, 1, None, None]


@pytest.mark.parametrize(
    "data",
    [
        b"\0",
        struct.pack("<dI", 1.0, 5) + b"[1,2]",
        *(
            struct.pack("<dI", 1.0, len(head)) + head + b"xyz"
            for kinds in ({"color": ["|u1", 3]}, {"smell": ["|u1", 3]}, {"depth": ["z<f4", 3]}, {"color": ["jpeg", 3]})
            for head in [json.dumps([*HEAD, kinds]).encode()]
        ),
    ],
)
def test_a_frame_that_makes_no_sense_ends_the_link(data: bytes) -> None:
    ends = Ends(camera())
    nonsense = SimpleNamespace(number=lambda: 1, pack=lambda number: (ITEM.pack(number, len(data)), data))
    ends.here.outgoing = [nonsense]  # type: ignore[list-item]
    ends.here.send()
    with raises_code(ConnectionLost, "bad_frame"):
        while ends.frames.frame is None:
            ends.there.wait(1.0)
            ends.there.receive()
    ends.close()
