"""Both renderers against geometry that is known on paper: depth, projection, orientation, segmentation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from pictures_kit import box, camera, drawn, look_at, rays, renderer
from specs import data, panda

from hal.drivers.scene.lighting import Light
from hal.drivers.scene.meshes import MeshLibrary
from hal.drivers.scene.renderer import RenderedImages
from hal.drivers.scene.shapes import parts_of
from hal.geometry import Pose
from hal.specs import BodySpec, CameraSpec

BOTH = pytest.mark.parametrize("name", ["gl", "tiny"])
OFF_CENTRE = {"centre": (41.3, 88.6), "focal": 131.0, "fy": 118.0}
TILTED = Pose.from_rpy((0.0, 0.0, 0.0), (0.15, 0.2, 0.1))


@contextmanager
def picture(name: str, *bodies: BodySpec, spec: CameraSpec, pose: Pose) -> Iterator[RenderedImages]:
    with closing(renderer(name, drawn(*bodies))) as draws:
        yield draws.render(spec, pose)


def plane_depth(spec: CameraSpec, pose: Pose, point: Any, normal: Any) -> np.ndarray:
    """Depth of a plane along the optical axis, in each pixel."""
    directions = rays(spec) @ pose.matrix()[:3, :3].T
    return np.dot(np.subtract(point, pose.position), normal) / (directions @ np.asarray(normal))


@BOTH
@pytest.mark.parametrize("intrinsics", [{}, OFF_CENTRE], ids=["centred", "off-centre"])
@pytest.mark.parametrize("pose", [Pose(), TILTED], ids=["square", "tilted"])
def test_depth_of_a_plane_is_unbiased(name: str, intrinsics: dict[str, Any], pose: Pose) -> None:
    spec = camera(**intrinsics)
    wall = box("wall", (4.0, 4.0, 0.05), (0.0, 0.0, 1.05))  # its face is the plane z = 1
    with picture(name, wall, spec=spec, pose=pose) as images:
        error = images.depth - plane_depth(spec, pose, (0, 0, 1.0), (0, 0, -1.0))
    assert abs(error.mean()) < 2e-5
    assert np.abs(error).max() < 1e-3
    # No slope either: half a pixel of offset tilts the plane.
    assert abs(error[: spec.height // 2].mean() - error[spec.height // 2 :].mean()) < 5e-5
    assert abs(error[:, : spec.width // 2].mean() - error[:, spec.width // 2 :].mean()) < 5e-5


@BOTH
def test_depth_of_a_box(name: str) -> None:
    spec = camera(320, 240, centre=(150.0, 131.0))
    half = np.array([0.15, 0.1, 0.2])
    pose = look_at((0.9, -0.6, 0.5), (0.0, 0.0, 0.0))
    with picture(name, box("box", tuple(half), (0.0, 0.0, 0.0)), spec=spec, pose=pose) as images:
        directions = rays(spec) @ pose.matrix()[:3, :3].T
        with np.errstate(divide="ignore"):
            near = (-np.sign(directions) * half - pose.position) / directions
            far = (np.sign(directions) * half - pose.position) / directions
        expected = np.where(near.max(axis=-1) < far.min(axis=-1), near.max(axis=-1), 0.0)
        both = (images.depth > 0) & (expected > 0)
        assert both.sum() > 2000
        assert ((images.depth > 0) != (expected > 0)).sum() <= 0.005 * both.sum()  # pixels cut by the outline
        error = (images.depth - expected)[both]
        # An edge between two faces may fall on either side of a pixel's centre.
        assert np.percentile(np.abs(error), 99) < 2e-4
        assert abs(error[np.abs(error) < 2e-3].mean()) < 2e-5


@BOTH
@pytest.mark.parametrize("intrinsics", [{}, OFF_CENTRE], ids=["centred", "off-centre"])
def test_K_projects_corners_into_their_pixels(name: str, intrinsics: dict[str, Any]) -> None:
    """The edges of a square, found to a fraction of a pixel by area, lie where K says."""
    spec = camera(**intrinsics)
    centre, half = np.array([0.03, -0.05]), 0.071
    square = box("square", (half, half, 0.01), (centre[0], centre[1], 0.61))  # its face is at z = 0.6
    with picture(name, square, spec=spec, pose=Pose()) as images:
        assert images.segmentation is not None
        mask = images.segmentation == 0
        coloured = np.ptp(images.color.reshape(-1, 3), axis=0).max() > 0
    assert mask.any()
    assert coloured
    K = np.array(spec.K)
    low = K @ [*(centre - half), 0.6] / 0.6
    high = K @ [*(centre + half), 0.6] / 0.6
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    # A pixel belongs to the square when its centre does.
    for found, edge in ((columns[0] - 0.5, low[0]), (columns[-1] + 0.5, high[0])):
        assert abs(found - edge) <= 0.5 + 1e-3
    for found, edge in ((rows[0] - 0.5, low[1]), (rows[-1] + 0.5, high[1])):
        assert abs(found - edge) <= 0.5 + 1e-3


@BOTH
def test_picture_is_upright_and_not_mirrored(name: str) -> None:
    """From the front: red up, green to the right, blue below, seen against nothing."""
    size = (0.05, 0.05, 0.05)
    marks = (
        box("up", size, (0.0, 0.0, 0.3), rgba=(1.0, 0.0, 0.0, 1.0)),
        box("right", size, (0.0, 0.3, 0.0), rgba=(0.0, 1.0, 0.0, 1.0)),
        box("below", size, (0.0, 0.0, -0.3), rgba=(0.0, 0.0, 1.0, 1.0)),
    )
    spec = camera(120, 120)
    with picture(name, *marks, spec=spec, pose=look_at((-1.2, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))) as images:
        assert images.segmentation is not None
        rows, columns = np.mgrid[:120, :120]
        middle = [(rows[images.segmentation == k].mean(), columns[images.segmentation == k].mean()) for k in range(3)]
        strongest = [int(images.color[images.segmentation == k].mean(axis=0).argmax()) for k in range(3)]
    (up_row, _), (_, right_column), (below_row, _) = middle
    assert up_row < 45
    assert below_row > 75
    assert right_column < 45  # +y is to the left of somebody who looks along +x
    assert strongest == [0, 1, 2]


def test_a_floor_is_lit_and_gleams_by_the_formulas_of_its_light() -> None:
    """Light from above, from the camera and from the first light, and the gloss of its reflection (Blinn, 1977)."""
    grey, spec = 102 / 255, camera(120, 120)
    to_light = np.array(Light().direction) / np.linalg.norm(Light().direction)
    pose = look_at(to_light * (-1.0, -1.0, 1.0), (0.0, 0.0, 0.0))  # the reflection is in the middle
    floor = box("floor", (4.0, 4.0, 0.05), (0.0, 0.0, -0.05), rgba=(grey, grey, grey, 1.0))
    with picture("gl", floor, spec=spec, pose=pose) as images:
        found = images.color
    to_eye = -rays(spec) @ pose.matrix()[:3, :3].T
    to_eye /= np.linalg.norm(to_eye, axis=-1, keepdims=True)
    middle = to_eye + to_light
    gloss = 0.05 * (middle[..., 2] / np.linalg.norm(middle, axis=-1)) ** 24
    light = np.array([0.52, 0.54, 0.57]) + (0.12 * to_eye[..., 2] + 0.36 * to_light[2])[..., None]
    assert np.ptp(gloss) > 0.02
    assert np.abs(found - 255.0 * (grey * light + gloss[..., None])).max() < 1.0


@BOTH
def test_segmentation_counts_bodies_as_the_world_does(name: str) -> None:
    spec = camera(80, 60)
    wall = box("wall", (0.2, 4.0, 0.05), (0.3, 0.0, 1.0))
    hidden = box("hidden", (0.1, 0.1, 0.05), (0.3, 0.0, 2.0))
    ball = BodySpec("ball", (-0.4, 0.0, 1.0), (0, 0, 0, 1), "sphere", radius=0.1, fixed=True)
    scene = drawn(wall, hidden, ball)
    with closing(renderer(name, scene)) as draws:
        before = draws.render(spec, Pose()).segmentation
        scene.request("remove", {"name": "hidden"})
        after = draws.render(spec, Pose()).segmentation
    assert before is not None
    assert after is not None
    assert (set(np.unique(before)), set(np.unique(after))) == ({-1, 0, 2}, {-1, 0, 1})
    assert np.array_equal(before == 2, after == 1)


@BOTH
def test_depth_is_zero_outside_the_cameras_range(name: str) -> None:
    spec = camera(80, 60, depth_min=0.5, depth_max=1.5)
    near, good, far = (box(f"at_{z}", (0.1, 4.0, 0.01), (x, 0.0, z)) for x, z in ((-0.15, 0.4), (0.0, 1.0), (0.8, 2.0)))
    with picture(name, near, good, far, spec=spec, pose=Pose()) as images:
        assert images.segmentation is not None
        assert (images.depth[images.segmentation == 0] == 0).all()
        assert (images.depth[images.segmentation == 1] > 0.9).all()
        assert (images.depth[images.segmentation == 2] == 0).all()
        assert (images.depth[images.segmentation == -1] == 0).all()
        assert {0, 1, 2, -1} <= set(np.unique(images.segmentation))


@BOTH
@pytest.mark.parametrize("streams", [("depth",), ("color",), ("infrared",), ("segmentation",)])
def test_only_what_is_streamed_is_computed(name: str, streams: tuple[str, ...]) -> None:
    wall = box("wall", (0.2, 0.2, 0.05), (0.0, 0.0, 1.0), rgba=(0.9, 0.2, 0.2, 1.0))
    with closing(renderer(name, drawn(wall))) as draws:
        images = draws.render(camera(80, 60, streams=streams), Pose())
        everything = draws.render(camera(80, 60, streams=("color", "depth", "infrared", "segmentation")), Pose())
    for stream in RenderedImages._fields:
        image, whole = getattr(images, stream), getattr(everything, stream)
        assert (image is not None) == (stream in streams)
        assert image is None or np.array_equal(image, whole)
        assert np.ptp(whole) > 0
    luminance = everything.color @ np.array([0.299, 0.587, 0.114])
    assert np.abs(luminance - everything.infrared).max() <= 1.5


def test_both_renderers_show_the_same_world() -> None:
    """Meshes of every link and object are where PyBullet's own renderer has them, whatever their frames."""
    bodies = [
        BodySpec("duck", (0.4, -0.25, 0.1), (0.1, 0.2, 0.3, 0.9), "urdf", urdf=data("duck_vhacd.urdf")),
        BodySpec("lego", (0.4, 0.2, 0.1), (0, 0, 0.4, 0.9), "urdf", urdf=data("lego/lego.urdf"), scale=3.0),
        BodySpec("can", (0.55, 0.0, 0.1), (0.5, 0.1, 0, 0.8), "cylinder", radius=0.05, length=0.16),
        BodySpec("ball", (0.3, 0.4, 0.1), (0, 0, 0, 1), "sphere", radius=0.08),
    ]
    spec = camera(320, 240)
    pose = look_at((1.5, -0.8, 0.9), (0.2, 0.0, 0.35))
    scene = drawn(*bodies, robots=(panda(),))
    with closing(renderer("gl", scene)) as draws:
        gl = draws.render(spec, pose)
    with closing(renderer("tiny", scene)) as draws:
        tiny = draws.render(spec, pose)
    assert gl.segmentation is not None
    assert tiny.segmentation is not None
    for index in range(len(bodies) + 1):
        ours, theirs = gl.segmentation == index, tiny.segmentation == index
        assert theirs.sum() > 150
        assert (ours & theirs).sum() / (ours | theirs).sum() > 0.9
    both = (gl.segmentation == tiny.segmentation) & (gl.depth > 0) & (tiny.depth > 0)
    assert np.percentile(np.abs(gl.depth - tiny.depth)[both], 90) < 2.5e-3


def test_a_small_picture_is_drawn_with_a_third_of_the_triangles_and_hardly_differs(monkeypatch):
    pytest.importorskip("pybullet_data")  # the meshes
    pose = look_at((1.5, -0.8, 0.9), (0.2, 0.0, 0.35))
    small, large = camera(256, 256), camera(1280, 960)
    scene = drawn(robots=(panda(),))
    with closing(renderer("gl", scene)) as draws:
        fast, same = draws.render(small, pose), draws.render(large, pose)
        monkeypatch.setattr("hal.drivers.scene.renderer._COARSE_PIXELS", 0.0)
        full, whole = draws.render(small, pose), draws.render(large, pose)
        parts = parts_of(0, scene.visuals(scene.bodies["panda"].id), MeshLibrary().load)
    heavy = {part.link for part in parts if part.coarse}
    triangles = [sum(len(p.mesh.faces) for p in parts if p.link in heavy and p.coarse == k) for k in (True, False)]
    assert triangles[0] < 0.4 * triangles[1]
    difference = np.abs(fast.color.astype(float) - full.color)
    assert 0.0 < difference.mean() < 1.0, "of 255, and not nothing"
    assert ((fast.depth > 0) != (full.depth > 0)).mean() < 0.002
    assert np.abs(fast.depth - full.depth)[(fast.depth > 0) & (full.depth > 0)].mean() < 0.005
    assert np.array_equal(same.color, whole.color), "a large picture is drawn in full"
