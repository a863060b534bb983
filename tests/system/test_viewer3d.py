"""The 3D viewer of a rig in real time: access, what is shown, goals of dragged handles, and its end."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs viser (pip install 'robot-hal[viewer]')")
pytest.importorskip("pybullet", reason="needs pybullet (pip install pybullet)")

import viser
from viser_kit import PlainPage, until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import hal
from hal import BodySpec, CartesianTarget, JointVelocity, MotionStopped, NotSupported, Pose, registry
from hal.drivers.viser.viewer import ViserViewer
from hal.kinematics.urdf import read_urdf

pytestmark = pytest.mark.slow

HANDLE = "/arms/panda/handle"
AMBER, RED = (240, 160, 30), (220, 40, 40)


def open_rig() -> hal.Rig:
    return hal.open("panda_table", sim=True, clock="real_time", pad="none", overrides=["cameras={}"])


@pytest.fixture(scope="module")
def rig() -> Iterator[hal.Rig]:
    with open_rig() as opened:
        yield opened


@pytest.fixture(scope="module")
def viewer(rig: hal.Rig) -> Iterator[ViserViewer]:
    made = registry.load("viser", "viewer3d")(rig)
    try:
        made.wait_ready()
        yield made
    finally:
        made.close()
        made.close()


@pytest.fixture
def page(viewer: ViserViewer) -> Iterator[PlainPage]:
    opened = PlainPage(viewer.address)
    try:
        until(lambda: opened.hear() or HANDLE in opened.nodes)
        yield opened
    finally:
        opened.close()
        until(lambda: viewer.goal("panda") is None)


def wxyz(pose: Pose) -> tuple[float, ...]:
    x, y, z, w = pose.orientation.tolist()
    return w, x, y, z


def beside(pose: Pose, x: float = 0.03) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return a pose ``x`` m farther along the base's x axis, as a page sends it."""
    return (float(pose.position[0]) + x, *pose.position[1:].tolist()), wxyz(pose)


def listening(pid: int) -> list[str]:
    """Return the addresses on which a process listens, as the kernel writes them."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        target = os.readlink(descriptor)
        if target.startswith("socket:"):
            inodes.add(target[len("socket:[") : -1])
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                found.append(fields[1].rpartition(":")[0])
    return found


def test_the_view_is_reached_by_its_user_and_through_the_console_only() -> None:
    """One open port for the console, none for viser; the console's page alone is told where the view is.

    A page that is not in control drags nothing.
    """
    with hal.open("panda_table", sim=True, pad="web", viewer="3d", listen=":0", overrides=["cameras={}"]) as rig:
        viewer, link = rig.viewer3d, urlsplit(rig.console.link)
        assert listening(viewer._child.process.pid) == []
        assert os.stat(os.path.dirname(viewer.address)).st_mode & 0o077 == 0
        site, live, protocol = f"http://{link.netloc}", f"ws://{link.netloc}/live", f"viser-v{viser.__version__}"
        driver = connect(live, subprotocols=["hal.v1", link.fragment], origin=site)
        stage = json.loads(driver.recv(timeout=5.0))["rig"]["stage"] + "/1"
        view = f"ws://{link.netloc}{stage}"
        assert status(f"{site}{stage}/") == 200
        assert status(f"{site}{stage}/", Host="evil.example:8080") == 421
        for wrong in ("/3d/", "/3d/1", f"{stage}x/", stage[:-2], f"{stage}/index.html", "/3d/%FF", f"{stage[:-1]}%FF"):
            assert status(site + wrong) == 404
        for address, origin in ((view, "http://evil.example"), (view, None), (f"{view[:-3]}/1", site), (live, "null")):
            with pytest.raises(InvalidStatus, match="40[34]"):
                connect(address, subprotocols=[protocol], origin=origin)
        page = PlainPage(stage, rig.console.link)
        until(lambda: page.hear() or HANDLE in page.nodes)
        tcp = rig.robots["panda"].state().tcp
        page.drag(HANDLE, beside(tcp, 0.2))
        page.nodes.clear()
        until(lambda: page.hear() or HANDLE in page.nodes)
        assert np.abs(np.subtract(page.nodes[HANDLE]["position"], tcp.position)).max() < 2e-3
        assert viewer.goal("panda") is None
        driver.send(json.dumps({"type": "lease", "take": True}))
        until(lambda: rig.console.driver == "page 1")
        page.drag(HANDLE, beside(tcp))
        until(lambda: viewer.goal("panda"))
        driver.close()
        until(lambda: viewer.goal("panda") is None)
        viewer._child.process.kill()
        with pytest.raises(ConnectionClosed):
            until(page.hear)
        assert status(f"{site}{stage}/") == 502


def status(address: str, **headers: str) -> int:
    """Return the status of a GET request."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.netloc, timeout=10.0)
    connection.request("GET", parts.path, headers=headers)
    try:
        return connection.getresponse().status
    finally:
        connection.close()


def way(page: PlainPage) -> np.ndarray | None:
    """Return the points (k, 3) of the line along the way of the tcp as it is shown; None if it is hidden."""
    node = page.nodes.get("/arms/panda/way", {})
    return node["points"].reshape(-1, 3) if node.get("visible") else None


def test_links_fingers_and_handle_follow_the_arm(rig: hal.Rig, viewer: ViserViewer, page: PlainPage) -> None:
    arm = rig.robots["panda"]
    q = np.array(arm.home)
    q[[0, 3]] += (0.2, -0.15)
    motion = arm.start_move_to(q, speed=0.3)
    until(lambda: page.hear() or way(page) is not None)
    assert way(page)[-1] == pytest.approx(arm.fk(q).position, abs=2e-3), "the line ends where the arm is going"
    motion.wait()
    until(lambda: page.hear() or way(page) is None)
    arm.gripper.move(0.02)
    tree = read_urdf(Path(arm.spec.urdf))

    def shown() -> bool:
        page.hear()
        state = arm.state(max_age=2.0)
        values = dict(zip(arm.spec.joints, state.q.tolist(), strict=True))
        width = arm.gripper.state().width
        values |= {"panda_finger_joint1": width / 2, "panda_finger_joint2": width / 2}
        for joint in (joint for joint in tree.joints.values() if joint.movable):
            (path,) = [name for name in page.nodes if name.endswith(f"/{joint.child}")]
            node = page.nodes[path]
            position, (x, y, z, w) = joint.placement(values)
            if np.abs(np.array(node.get("position", (0, 0, 0))) - position).max() > 1e-3:
                return False
            if abs(np.dot(node.get("wxyz", (1, 0, 0, 0)), (w, x, y, z))) < 1 - 1e-5:
                return False
        handle = Pose(page.nodes[HANDLE]["position"], [*page.nodes[HANDLE]["wxyz"][1:], page.nodes[HANDLE]["wxyz"][0]])
        distance, angle = handle.distance(state.tcp)
        return distance < 1e-3 and angle < 1e-2

    until(shown)
    assert viewer.goal("panda") is None
    assert viewer.notes == ()
    assert "viser" in viewer.describe()


def test_a_ghost_shows_the_goal_and_shapes_that_are_near_each_other_are_amber_then_red(
    rig: hal.Rig, viewer: ViserViewer, page: PlainPage
) -> None:
    def colors(root: str) -> set[tuple[int, ...]]:
        page.hear()
        shown = [node for name, node in page.nodes.items() if name.startswith(f"{root}/") and node.get("visible")]
        return {tuple(node["color"]) for node in shown}

    arm = rig.robots["panda"]
    arm.move_to(arm.home, speed=0.3)
    until(lambda: not colors("/ghost/panda") and not colors("/near/panda"))
    seen: list[set[tuple[int, ...]]] = []
    with arm.control(rate_hz=20, tcp_speed=0.2) as control:
        for tick in rig.clock.rate(20):
            here = arm.state(max_age=2.0).tcp_set
            control.send(CartesianTarget(Pose(here.position - (0.0, 0.0, 0.045), here.orientation)))  # to the table
            near = colors("/near/panda")
            if near and colors("/ghost/panda") and near not in seen:
                seen.append(near)
            if seen and RED in seen[-1]:
                break
            assert tick.elapsed < 30.0, seen
    assert seen[0] == {AMBER}
    assert RED in seen[-1]
    arm.move_to(arm.home, speed=0.3)
    until(lambda: not colors("/ghost/panda") and not colors("/near/panda"))


def test_drag_sets_a_goal_until_it_is_cleared(rig: hal.Rig, viewer: ViserViewer, page: PlainPage) -> None:
    tcp = rig.robots["panda"].state().tcp
    wanted = beside(tcp)
    page.drag(HANDLE, wanted)
    goal = until(lambda: viewer.goal("panda"))
    assert goal.position == pytest.approx(wanted[0])
    assert goal.distance(tcp)[1] < 1e-3
    assert rig.robots["panda"].state().tcp.distance(tcp)[0] < 2e-3  # a goal moves nothing
    sent = time.monotonic()
    page.drag(HANDLE, ((float("nan"), 0.0, 0.5), (1, 0, 0, 0)), ((9.0, 0.0, 0.5), (1, 0, 0, 0)), ((0.4,), (1, 0, 0, 0)))
    until(lambda: viewer._goals["panda"].t > sent + 0.2)  # repeated since
    kept = viewer.goal("panda")
    assert kept.position == pytest.approx(wanted[0])
    viewer.clear_goal("panda")
    assert viewer.goal("panda") is None
    until(lambda: page.hear() or np.abs(np.subtract(page.nodes[HANDLE]["position"], tcp.position)).max() < 2e-3)
    assert viewer.goal("panda") is None
    with pytest.raises(hal.DeviceNotFound):
        viewer.goal("pandas")


def test_goal_ends_with_its_page(rig: hal.Rig, viewer: ViserViewer) -> None:
    page = PlainPage(viewer.address)
    page.drag(HANDLE, beside(rig.robots["panda"].state().tcp), let_go=False)
    until(lambda: viewer.goal("panda"))
    page.close()
    until(lambda: viewer.goal("panda") is None)


def test_hanging_viewer_has_no_goals_and_blocks_no_caller(rig: hal.Rig, viewer: ViserViewer, page: PlainPage) -> None:
    page.drag(HANDLE, beside(rig.robots["panda"].state().tcp))
    until(lambda: viewer.goal("panda"))
    pid = viewer._child.process.pid
    os.kill(pid, signal.SIGSTOP)
    try:
        until(lambda: viewer.goal("panda") is None)
        begun = time.monotonic()
        for _ in range(1000):
            viewer.clear_goal("panda")
        assert time.monotonic() - begun < 1.0  # no call waits for it
    finally:
        os.kill(pid, signal.SIGCONT)


def test_goal_ends_when_the_arm_reaches_it(rig: hal.Rig, viewer: ViserViewer, page: PlainPage) -> None:
    arm = rig.robots["panda"]

    def comes() -> bool:
        page.drag(HANDLE, beside(arm.state(max_age=2.0).tcp, 0.02))
        try:
            goal = until(lambda: viewer.goal("panda"), 3.0)
        except AssertionError:
            return False  # a clear of the test before arrived late, and ended this goal
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                if viewer.goal("panda") is None:
                    break
                control.send(CartesianTarget(goal))
                assert tick.elapsed < 20.0
        return arm.state(max_age=2.0).tcp_set.distance(goal)[0] < 3e-3

    for _ in range(5):
        with contextlib.suppress(MotionStopped), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if comes():
                return
        # A machine that is too busy trips the arm, which ends the goal as well.
        until(lambda: viewer.goal("panda") is None)
    pytest.fail("it never came there")


def test_a_trip_ends_goals(rig: hal.Rig, viewer: ViserViewer, page: PlainPage) -> None:
    arm = rig.robots["panda"]
    page.drag(HANDLE, beside(arm.state(max_age=2.0).tcp, 0.1))
    until(lambda: viewer.goal("panda"))
    with pytest.raises(MotionStopped), arm.control(rate_hz=50) as control:
        for tick in rig.clock.rate(50):
            control.send(JointVelocity([0.05, 0, 0, 0, 0, 0, 0]))
            if tick.elapsed > 0.2:
                rig.stop()
            assert tick.elapsed < 20.0
    until(lambda: viewer.goal("panda") is None)
    rig.rearm()


def edit(rig: hal.Rig, viewer: ViserViewer, method: str, **params: object) -> None:
    """Edit the world, as ``rig.world`` does for the viewer that the rig was opened with."""
    viewer.note_edit(method, params, int(rig._hosts[0].request(f"world.{method}", params)))


def test_forces_on_the_arm_are_arrows_at_its_contacts(rig: hal.Rig, viewer: ViserViewer, page: PlainPage) -> None:
    """They point out of what the fingers hold, into the fingers, and end with the contact."""
    arm = rig.robots["panda"]
    arm.gripper.open()
    x, y, z = (arm.base @ arm.state(max_age=2.0).tcp).position.tolist()
    block = BodySpec("block", (x, y, z), (0, 0, 0, 1), "box", half_extents=(0.02, 0.02, 0.02))
    edit(rig, viewer, "add", spec=hal.specs.to_json(block))
    try:
        arm.gripper.grip(1.0)

        def drawn() -> bool:
            page.hear()
            node, contacts = page.nodes.get("/forces", {}), rig.world.contacts("panda")
            if not node.get("visible") or "points" not in node or not contacts:
                return False
            starts, ends = node["points"].reshape(-1, 2, 3).transpose(1, 0, 2)
            ways = ends - starts
            assert np.abs(starts - (x, y, z)).max() < 0.03, "at the block"
            assert (ways[:, 1] * (starts[:, 1] - y) > 0.0).all(), "out of it"
            lengths, force = np.linalg.norm(ways, axis=1), sum(contact.force for contact in contacts)
            return bool(abs(lengths.sum() - 0.005 * force) < 0.1 * 0.005 * force)

        until(drawn)
    finally:
        arm.gripper.open()
        edit(rig, viewer, "remove", name="block")
    until(lambda: page.hear() or not page.nodes["/forces"]["visible"])


def test_edits_of_the_world_are_drawn(rig: hal.Rig, viewer: ViserViewer, page: PlainPage) -> None:
    told = partial(edit, rig, viewer)
    cube = "/bodies/cube/0"
    until(lambda: page.hear() or np.abs(np.subtract(page.nodes[cube]["position"], (0.0, -0.2, 0.7))).max() < 0.1)
    ball = BodySpec("ball", (0.2, 0.0, 0.9), (0, 0, 0, 1), "sphere", radius=0.03, mass=0.1, rgba=(0, 1, 0, 1))
    told("add", spec=hal.specs.to_json(ball))
    told("set_color", name="ball", rgba=[1.0, 0.0, 0.0, 1.0])
    until(lambda: page.hear() or page.nodes.get("/bodies/ball/0", {}).get("position", (0, 0, 9))[2] < 0.7)  # it fell
    told("remove", name="ball")
    rig.world.set_pose("cube", Pose([0.1, 0.1, 0.9]))
    until(lambda: page.hear() or np.abs(np.subtract(page.nodes[cube]["position"][:2], (0.1, 0.1))).max() < 0.05)


def test_viewers_and_the_rig_are_independent() -> None:
    """Killing one viewer leaves the rig alone."""
    with open_rig() as rig:
        first, second = (registry.load("viser", "viewer3d")(rig) for _ in range(2))
        try:
            for one in (first, second):
                one.wait_ready()
            first._child.process.kill()
            until(lambda: first._thread is not None and not first._thread.is_alive())
            assert first.goal("panda") is None
            first.clear_goal("panda")
            assert rig.robots["panda"].state().q is not None
        finally:
            first.close()
            second.close()
        assert first._child.process.poll() is not None
        assert second._child.process.poll() == 0


APP = """
import hal, time
from hal import registry
rig = hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=["cameras={}"])
viewer = registry.load("viser", "viewer3d")(rig)
viewer.wait_ready()
print(viewer._child.process.pid, flush=True)
time.sleep(60)
"""


def test_viewer_ends_with_a_killed_app() -> None:
    app = subprocess.Popen([sys.executable, "-c", APP], stdout=subprocess.PIPE, text=True)
    try:
        pid = int(app.stdout.readline())
        assert Path(f"/proc/{pid}").exists()
        app.kill()
        app.wait(10)
        until(lambda: not Path(f"/proc/{pid}").exists() or "Z" in Path(f"/proc/{pid}/stat").read_text().split()[2])
    finally:
        app.kill()
        app.wait(10)


def test_lock_step_has_no_3d_view() -> None:
    with (
        hal.open("panda_table", driver="mock", clock="lock_step", pad="none") as rig,
        pytest.raises(NotSupported) as refused,
    ):
        registry.load("viser", "viewer3d")(rig)
    assert refused.value.code == "needs_real_time"
