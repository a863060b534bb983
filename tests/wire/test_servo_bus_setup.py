"""Motors of an arm on a servo bus are set up and calibrated by the command line, moved by the emulator's hand."""

from __future__ import annotations

import builtins
import json
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from servo_bus_kit import SteppedServos
from waiting import wait_until

from hal import registry
from hal.apps import calibrate, setup_motors

RIGS = ("so101", "viperx")


@pytest.fixture(params=RIGS)
def far(request: pytest.FixtureRequest) -> Iterator[SteppedServos]:
    with SteppedServos(request.param) as far:
        yield far


def options(far: SteppedServos, *more: str) -> list[str]:
    """Return the options that name the rig of an emulator."""
    rig = "so101" if far.spec.model == "so101" else "viperx"
    given = ["cameras={}", "gamepads={}", f"robots.arm.real.port={far.arm.port}"]
    return ["--real", "--config", rig, *(word for value in given for word in ("--set", value)), *more]


def answer(monkeypatch: pytest.MonkeyPatch, *steps: Callable[[], Any]) -> None:
    """Let each Enter that a program waits for be a step."""
    left = iter(steps)
    monkeypatch.setattr(builtins, "input", lambda *_: (next(left)() and "") or "")


def test_a_leaders_motors_get_their_ids_too(monkeypatch: pytest.MonkeyPatch) -> None:
    with SteppedServos() as far:
        servos = far.arm.servos
        far.execute("baud 57600")
        for servo in servos:
            servo.put(servo.protocol.id_address, 1)
        answer(monkeypatch, *(lambda k=k: far.execute(f"plug {k}") for k in range(len(servos), 0, -1)))
        leader = f"leaders={{lead: {{model: so101_leader, port: {far.arm.port}}}}}"
        assert setup_motors.main(options(far, "--set", leader, "--robot", "lead")) == 0
        assert [(servo.id, servo.baud) for servo in servos] == [(id, 1_000_000) for id in range(1, 7)]


def test_new_motors_get_the_ids_of_the_rig_one_after_the_other(
    far: SteppedServos, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    servos, protocol = far.arm.servos, far.arm.protocol
    wanted = [servo.id for servo in servos]
    far.execute("baud 57600")
    for servo in servos:
        servo.put(protocol.id_address, 1)
        servo.put(protocol.delay_address, 250)
    answer(monkeypatch, lambda: None)
    assert setup_motors.main(options(far)) == 2
    assert "several motors" in capsys.readouterr().err
    answer(monkeypatch, *(lambda k=k: far.execute(f"plug {k}") for k in range(len(servos), 0, -1)))
    assert setup_motors.main(options(far)) == 0
    far.execute("plug all")
    assert [servo.id for servo in servos] == wanted
    assert {servo.baud for servo in servos} == {1_000_000}
    with closing(registry.load(far.spec.driver, "robot")(far.spec)) as driver:
        driver.open()
        assert not any(registers.return_delay for registers in driver.chain.registers)


def test_an_arm_is_calibrated_by_hand_and_its_file_restores_it(
    far: SteppedServos, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    plant, jaw, file = far.arm.plant, far.arm.jaw, tmp_path / "arm.json"
    assert jaw is not None
    way, before = jaw.upper, far.spec.initial

    def move(q: Any, share: float) -> None:
        with far.lock:
            jaw.q = share * way
            plant.place(q)
            far.arm.step(0.0)

    def through_the_range() -> None:
        seen = len(watched)
        for q, share in ((plant.lower, 0.0), (plant.upper, 1.0)):
            move(q, share)
            wait_until(lambda: len(watched) >= seen + 2, "seen")  # noqa: B023
            seen = len(watched)

    watched: list[Any] = []
    service = registry.function(far.spec.driver, registry.driver(far.spec.driver).motors)
    watch = service.watch  # type: ignore[union-attr]
    monkeypatch.setattr(service, "watch", lambda self: (watched.append(1), watch(self))[1])
    middle = [0.0] * len(before)
    answer(monkeypatch, lambda: None, lambda: move(middle, 0.5), through_the_range)
    assert calibrate.main(["arm", *options(far, "--out", str(file))]) == 0
    found = json.loads(file.read_text())
    assert set(found[far.spec.joints[0]]) == {"id", "drive_mode", "homing_offset", "range_min", "range_max"}
    far.execute(f"place {' '.join(map(str, before))}")

    def read() -> tuple[float, ...]:
        with closing(registry.load(far.spec.driver, "robot")(far.spec)) as driver:
            driver.open()
            return tuple(driver.read(1000.0).q)

    assert read() == pytest.approx(before, abs=3e-3)
    far.arm.servos[1].put(20 if far.spec.driver == "dynamixel" else 31, 100)
    assert abs(read()[1] - before[1]) > 0.02
    answer(monkeypatch, lambda: None)
    assert calibrate.main(["arm", *options(far, "--restore", str(file))]) == 0
    assert read() == pytest.approx(before, abs=3e-3)


def test_a_motor_that_was_not_moved_is_named_and_all_keep_their_calibration(
    far: SteppedServos, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    protocol = far.arm.protocol

    def stored() -> list[Any]:
        at, size = protocol.stored
        return [protocol.decode_registers(bytes(one.registers[at : at + size])).calibration for one in far.arm.servos]

    before = stored()
    answer(monkeypatch, *[lambda: None] * 3)
    assert calibrate.main(["arm", *options(far, "--out", str(tmp_path / "arm.json"))]) == 2
    told = capsys.readouterr().err
    assert all(f"{name}: was moved through 0.00 rad" in told for name in (far.spec.joints[1], "gripper"))
    assert stored() == before
    assert not list(tmp_path.iterdir())


def test_a_motor_that_falls_silent_keeps_no_other_from_its_calibration(
    far: SteppedServos, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    servos = far.arm.servos
    before = [servo.decode().calibration for servo in servos]
    for servo in servos:
        servo.put(far.arm.protocol.delay_address, 250)
    answer(monkeypatch, lambda: None, lambda: far.execute(f"silent {servos[-1].id} on"))
    assert calibrate.main(["arm", *options(far, "--out", str(tmp_path / "arm.json"))]) == 2
    assert "gripper" in capsys.readouterr().err
    assert [servo.decode().calibration for servo in servos[:-1]] == before[:-1]
    assert {servo.decode().return_delay for servo in servos} == {0}, "as hal check promises"
