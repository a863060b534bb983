"""Which image of a frame is used, with which K and which optical frame."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
import pytest
from errors_kit import raises_code

from hal.calibration import NoView
from hal.calibration.detection import select_image
from hal.driver import CameraInfo, StreamInfo
from hal.geometry import Pose
from hal.types import Frame, Stamp

K, K_INFRARED = np.diag([600.0, 600.0, 1.0]), np.diag([400.0, 400.0, 1.0])
LENS, LENS_INFRARED = np.full(5, 0.1), np.full(5, 0.2)
STEREO = Pose([-0.015, 0.0, 0.0])
COLOR, INFRARED = np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), np.uint8)


def stream(place: Pose, lens: np.ndarray) -> StreamInfo:
    return StreamInfo(None, 6, 4, 30.0, K, lens, place)


STREAMS = {
    "color": stream(Pose(), LENS),
    "depth": stream(STEREO, LENS_INFRARED),
    "infrared": stream(STEREO, LENS_INFRARED),
}


def info(*names: str, K_infrared: np.ndarray | None = K_INFRARED) -> CameraInfo:
    streams = MappingProxyType({name: STREAMS[name] for name in names})
    return CameraInfo("a camera", K, LENS, K_infrared, "simulated", streams=streams)


def frame(color: np.ndarray | None, infrared: np.ndarray | None) -> Frame:
    return Frame(Stamp(0.0, None, 1), color, None, infrared, None, K, LENS, None)


@pytest.mark.parametrize(
    ("names", "align", "place"),
    [
        (("color", "depth"), "color", Pose()),
        (("color", "depth"), "depth", STEREO),
        (("color",), "depth", Pose()),
        ((), "color", Pose()),
    ],
)
def test_colour_is_in_the_view_that_it_is_aligned_to(names: tuple[str, ...], align: str, place: Pose) -> None:
    look = select_image(frame(COLOR, INFRARED), info(*names), align)
    assert look.picture is COLOR
    assert (look.K is K, look.distortion is LENS) == (True, True)
    assert look.T_color_eye == place


@pytest.mark.parametrize("align", ["color", "depth"])
def test_infrared_has_a_frame_of_its_own(align: str) -> None:
    look = select_image(frame(None, INFRARED), info("depth", "infrared"), align)
    assert look.picture is INFRARED
    assert (look.K is K_INFRARED, look.distortion is LENS_INFRARED) == (True, True)
    assert look.T_color_eye == STEREO


def test_a_camera_whose_streams_are_all_one_view() -> None:
    look = select_image(frame(None, INFRARED), info(K_infrared=None), "color")
    assert (look.K is K, look.distortion is LENS) == (True, True)
    assert look.T_color_eye == Pose()


def test_depth_alone_is_refused() -> None:
    with raises_code(NoView, "no_image"):
        select_image(frame(None, None), info("depth"), "depth")
