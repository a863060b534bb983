"""Exceptions of the vendor's client libraries, raised by a robot that breaks the rules, and the faults they become."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hal.drivers.franka.faults import flags_in
from hal.drivers.franka.flags import FLAGS
from hal.errors import Fault
from hal.host import records

from .franka_kit import free_host

HERE = Path(__file__).parent
LIBRARIES = {"pylibfranka": 10, "panda_py": 5}
"""Library -> its protocol."""
STATUS = {10: {"impossible": 5, "reflex": 8, "user stop": 9}, 5: {"impossible": 3, "reflex": 6, "user stop": 7}}
"""Statuses of Move."""


@dataclass(frozen=True)
class Try:
    """Behaviour of the robot, the action that is tried, and the code of the resulting fault."""

    says: dict[str, Any]
    action: str
    code: str
    lost: bool = False
    only: str = ""
    """Library, where the other one cannot get there."""


def tries(version: int) -> dict[str, Try]:
    status = STATUS[version]
    every_flag = {"end": status["reflex"], "mode": 4, "flags": list(range(41))}
    return {
        "another version": Try({"version": 15 - version}, "read", "version", True),
        "an older system": Try({"version": 9}, "read", "version", True),
        "hangs up": Try({"hang_up": True}, "read", "closed", True),
        "no states": Try({"silent": True}, "read", "silent", True),
        "short states": Try({"short": 1}, "read", "packets", True),
        "a model without shrinking limits": Try({"model": False}, "read", "model", True, "pylibfranka"),
        "all flags": Try(every_flag, "move", "communication_constraints_violation"),
        "no flag": Try({"end": status["reflex"], "mode": 4}, "move", "reflex"),
        "user stop": Try({"end": status["user stop"], "mode": 5}, "move", "user_stopped"),
        "not now": Try({"start": status["impossible"], "mode": 3}, "move", "guiding"),
        "a safety rule": Try({"start": 4}, "move", "safety_rule", only="pylibfranka"),
        "a singular pose": Try({"start": 6 if version == 10 else 4}, "move", "singular"),
        "a bad number": Try({"status": 2}, "set", "invalid_argument"),
        "by hand only": Try({"status": 3 if version == 10 else 2}, "recover", "manual_recovery"),
        "not a number": Try({}, "nan", "not_a_number"),
        "two at once": Try({}, "twice", "occupied", only="pylibfranka"),
    }


def run_library(library: str, host: str, actions: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Try the actions in order; return what the library raised, by name."""
    options = json.dumps({"library": library, "host": host, "tries": actions})
    command = [sys.executable, str(HERE / "library_client.py"), options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    return {found["name"]: found for found in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("library", LIBRARIES)
def test_every_exception_becomes_its_fault(library: str) -> None:
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"needs the Python package {library}")
    version, host = LIBRARIES[library], free_host()
    chosen = {name: a for name, a in tries(version).items() if a.only in ("", library)}
    says = [{"layout": version, "version": version, **a.says} for a in chosen.values()]
    command = [sys.executable, str(HERE / "lying_robot.py"), json.dumps({"host": host, "says": says})]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as robot:
        try:
            assert robot.stdout.readline().strip() == "ready"
            found = run_library(library, host, {name: a.action for name, a in chosen.items()})
        finally:
            robot.kill()
    for name, a in chosen.items():
        assert found[name]["raised"] is not None, name
        fault = Fault(*found[name]["fault"])
        assert (fault.code, found[name]["lost"]) == (a.code, a.lost), (name, found[name])
        assert records.make_fault(*records.fault_values(fault)) == fault, "it fits into a state"
    assert flags_in(found["all flags"]["text"]) == FLAGS, "in the order of the packets"


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_refused_connection(library: str) -> None:
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"needs the Python package {library}")
    host = free_host()
    found = run_library(library, host, {"none": "read"})["none"]
    assert found["fault"][0] == "refused"
    assert f"{host}:1337" in found["fault"][1]
    assert found["lost"]
