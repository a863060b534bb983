"""State and command packets of both protocols: sizes, places, what goes in comes out."""

from __future__ import annotations

import struct

import pytest

from hal_emulators.franka.protocol import COMMAND, PROTOCOLS, STATE, RequestOutcome, StatePacket, read_command


def test_sizes_are_those_that_clients_accept() -> None:
    assert {version: layout.size for version, layout in STATE.items()} == {5: 2373, 10: 1377}
    assert {version: layout.size for version, layout in COMMAND.items()} == {5: 370, 10: 371}


OFFSETS = {
    5: {"q": 1184, "ddq_d": 1408, "O_T_EE_c": 1944, "motion_generator_mode": 2280, "reflex_reason": 2323},
    10: {"q": 596, "ddq_d": 708, "O_T_EE_c": 976, "motion_generator_mode": 1288, "reflex_reason": 1331},
}
OFFSETS[5] |= {"robot_mode": 2364}
OFFSETS[10] |= {"accelerometer_top": 1144, "robot_mode": 1372}


@pytest.mark.parametrize("version", [5, 10])
def test_places_in_a_state(version: int) -> None:
    assert {name: STATE[version].fields[name].offset for name in OFFSETS[version]} == OFFSETS[version]


@pytest.mark.parametrize("version", [5, 10])
def test_what_is_put_is_what_is_read_and_nothing_else_changes(version: int) -> None:
    packet = StatePacket(version)
    numbers = iter(range(1, 1000))
    written = {}
    for name, field in packet.layout.fields.items():
        values = tuple(next(numbers) % 200 for _ in range(field.values))
        packet.put(name, values)
        written[name] = values
    for name, values in written.items():
        assert packet.get(name) == values, name


@pytest.mark.parametrize("version", [5, 10])
def test_the_quick_ways_write_the_same_places(version: int) -> None:
    packet = StatePacket(version)
    packet.put_joints(range(56))
    packet.put_motors(range(56, 70))
    packet.put_modes(3, 2)
    names = ("tau_J", "tau_J_d", "dtau_J", "q", "q_d", "dq", "dq_d", "ddq_d", "theta", "dtheta")
    for k, name in enumerate(names):
        assert packet.get(name) == tuple(range(7 * k, 7 * k + 7)), name
    assert packet.get("motion_generator_mode") == (3,)
    assert packet.get("controller_mode") == (2,)
    with pytest.raises(struct.error):
        packet.put_joints(range(55))


@pytest.mark.parametrize("version", [5, 10])
def test_a_command_is_taken_apart(version: int) -> None:
    values = [7, *(k / 10 for k in range(14)), *([0.0] * 24), 1, 0, *(k + 0.5 for k in range(7))]
    kinds = "<Q14d24dBB7d"
    data = struct.pack(kinds, *values) + (b"\0" if version == 10 else b"")
    command = read_command(data, version)
    assert (command.message_id, command.q) == (7, tuple(k / 10 for k in range(7)))
    assert command.dq == tuple(k / 10 for k in range(7, 14))
    assert command.tau == tuple(k + 0.5 for k in range(7))
    assert not command.finished
    assert read_command(data[:-1], version) is None
    assert read_command(data + b"\0", version) is None
    finished = bytearray(data)
    finished[313] = 1
    assert read_command(bytes(finished), version).finished
    assert version == 5 or read_command(bytes(370) + b"\1", 10).finished, "torque control has an end of its own"


def test_codes_sizes_and_statuses_of_requests() -> None:
    new, old = PROTOCOLS[10], PROTOCOLS[5]
    assert (new.codes["AutomaticErrorRecovery"], old.codes["AutomaticErrorRecovery"]) == (10, 12)
    assert (new.codes["GetRobotModel"], old.codes["LoadModelLibrary"]) == (11, 13)
    assert (new.requests[new.codes["Move"]].size, old.requests[old.codes["Move"]].size) == (125, 68)
    assert (new.status("Move", RequestOutcome.REFLEX), old.status("Move", RequestOutcome.REFLEX)) == (8, 6)
    assert (new.status("Move", RequestOutcome.EMERGENCY), old.status("Move", RequestOutcome.EMERGENCY)) == (9, 7)
    assert (new.status("Move", RequestOutcome.ABORTED), old.status("Move", RequestOutcome.ABORTED)) == (11, 9)
    assert new.status("AutomaticErrorRecovery", RequestOutcome.MANUAL) == 3
    assert old.status("AutomaticErrorRecovery", RequestOutcome.MANUAL) == 2
    assert new.status("StopMove", RequestOutcome.INVALID) == new.status("StopMove", RequestOutcome.NOT_POSSIBLE) == 1
