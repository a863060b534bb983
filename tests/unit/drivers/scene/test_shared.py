"""The world that emulated arms share: one program at a time has it, and its loss is repaired or said."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from dataclasses import replace

import pytest
from can_kit import can_overrides
from waiting import wait_until

import hal
from hal.config.loader import load
from hal.drivers.scene import shared
from hal.drivers.scene.shared import SharedWorld, address_of, join_world
from hal.specs import BodySpec, WorldSpec, to_json
from hal_emulators.shared_world import ArmInWorld
from hal_emulators.world import WorldServer

BALL = to_json(BodySpec("ball", (0.1, 0.3, 0.64), (0.0, 0.0, 0.0, 1.0), "sphere", radius=0.03, mass=0.1))


@pytest.fixture
def spec() -> WorldSpec:
    """The world of a rig with an emulated arm."""
    camera = "scene: {sim: true, model: realsense_d435, look_at: {target: [0, 0, 0.6], distance: 0.9}}"
    overrides = [*can_overrides("udp_multicast"), "objects=[floor]", f"cameras={{{camera}}}"]
    world = load("yam_emulator", sim=False, overrides=overrides).resolve().world
    assert world is not None
    return world


@contextlib.contextmanager
def serve(spec: WorldSpec) -> Iterator[WorldServer]:
    """Step a world in a thread until the end of the block; its clients lose it then."""
    server = WorldServer(spec)
    until, end = os.pipe()
    thread = threading.Thread(target=server.run, args=(until,))
    thread.start()
    try:
        yield server
    finally:
        os.close(end)
        thread.join()
        os.close(until)
        server.close()


def join(spec: WorldSpec) -> SharedWorld:
    """Join the world that is served."""
    world = join_world(spec)
    assert world is not None
    return world


def lost(world: SharedWorld, reason: str) -> bool:
    """Step a world; return whether a request tells this reason why it is not joined."""
    world.step()
    try:
        world.request("names", {})
    except hal.ConnectionLost as error:
        return reason in str(error)
    return False


def test_a_second_program_is_refused_and_the_first_goes_on(spec: WorldSpec) -> None:
    with serve(spec), contextlib.closing(join(spec)) as first:
        first.request("add", {"spec": BALL})
        with pytest.raises(hal.ControlTaken, match="another program"):
            join_world(spec)
        with pytest.raises(hal.ControlTaken):
            join_world(replace(spec, bodies=()))
        with pytest.raises(ValueError, match="no arm 'left', but arm"):
            ArmInWorld(address_of(spec.robots[0]), "left")
        assert "ball" in first.request("names", {})
        before, stamp = first.version, first.stamp(0.0)
        wait_until(lambda: first.step() or first.version != before, "it is stepped")
        assert first.stamp(0.0) > stamp
        first.close()
        with contextlib.closing(join(spec)) as second:
            assert "ball" not in second.request("names", {}), "the next program begins anew"


def test_a_lost_world_is_joined_again_with_its_edits(spec: WorldSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "_AGAIN", 0.01)
    with serve(spec):
        world = join(spec)
        world.request("add", {"spec": BALL})
    with contextlib.closing(world):
        wait_until(lambda: lost(world, "gone"), "the world is lost")
        before = world.version
        world.step()
        assert world.version == before, "nothing looks new"
        with serve(replace(spec, bodies=())):
            wait_until(lambda: lost(world, "another scene"), "another scene is refused, with the reason")
        with serve(spec) as server:
            wait_until(lambda: not lost(world, ""), "it is joined again")
            assert "ball" in server.world.request("names", {})
            assert world.revision == 1


def test_an_arm_that_loses_the_world_says_so_and_harms_no_other(
    spec: WorldSpec, capsys: pytest.CaptureFixture[str]
) -> None:
    with serve(spec), contextlib.closing(join(spec)) as world:
        arm = ArmInWorld(address_of(spec.robots[0]), "arm")
        arm.object_width = 0.03
        wait_until(lambda: arm.exchange(0.01, [0.0]) or arm.object_width is None, "it is dropped for one joint of six")
        found = capsys.readouterr().err
        assert "ValueError: arm: 1 joint positions, not 6" in found
        assert len([line for line in found.splitlines() if "start the emulators again; until then" in line]) == 1
        assert world.request("names", {}) == ["floor", "arm"]


def test_a_late_answer_is_not_taken_for_the_next(spec: WorldSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "_PATIENCE", 0.3)
    with serve(spec) as server, contextlib.closing(join(spec)) as world:
        answer, go_on = server.world.request, threading.Event()

        def wait(method: str, params: dict[str, object]) -> object:
            assert go_on.wait(10.0)
            return answer(method, params)

        monkeypatch.setattr(server.world, "request", wait)
        with pytest.raises(hal.ConnectionLost, match="does not answer"):
            world.request("pose", {"name": "floor"})
        go_on.set()
        assert world.request("names", {}) == ["floor", "arm"]


def test_fingers_and_programs_wait_for_a_late_world(spec: WorldSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    with serve(spec) as server, contextlib.closing(join(spec)) as world:
        arm = ArmInWorld(address_of(spec.robots[0]), "arm")
        step, go_on = server.world.step, threading.Event()

        def be_late() -> None:
            assert go_on.wait(10.0)
            step()

        monkeypatch.setattr(server.world, "step", be_late)
        wait_until(lambda: arm.exchange(0.005, [0.0] * 6) or arm.now > arm.now_of_fingers + 0.2, "the fingers wait")
        threading.Timer(0.1, go_on.set).start()
        world.request("names", {})
        assert world.stamp(0.0) > arm.now - 0.01, "the answer is of the world that the program has asked about"
        wait_until(lambda: arm.exchange(0.005, [0.0] * 6) or arm.now == arm.now_of_fingers, "they go on")
