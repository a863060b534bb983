"""An arm's driver in a process of its own, for a library that holds Python's lock while it blocks.

Such a library would stop the tests' threads and time-outs, and a call that hangs would end the whole run.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import Fault
from hal.host.process import Channel, Child, pack_error
from hal.specs import RobotSpec, from_json, to_json

HERE = str(Path(__file__).parent)
LIMIT = 20.0
"""s for each call; then the process is killed, and the check fails."""


class Apart(RobotDriver):
    """A driver that forwards every call to another process, and every error back."""

    modes = frozenset()  # known once the other one is made
    paces_itself = False

    def __init__(self, place: str, spec: RobotSpec) -> None:
        super().__init__(spec)
        sys.path.append(HERE)
        try:
            self._child = Child("driver", "apart:main", {"place": place, "spec": to_json(spec)})
        finally:
            sys.path.remove(HERE)
        about = self._child.wait_ready()
        self.modes = frozenset(about["modes"])
        self.paces_itself = about["paces_itself"]

    def _call(self, method: str, *arguments: Any, **knobs: Any) -> Any:
        return self._child.request(method, {"arguments": arguments, "knobs": knobs}, LIMIT)

    @property
    def engaged(self) -> bool:  # type: ignore[override]
        return bool(self._call("engaged"))

    def engage(self) -> None:
        self._call("engage")

    def open(self) -> None:
        self._call("open")

    def wait(self) -> None:
        self._call("wait")

    def read(self, now: float) -> Reading:
        reading = Reading(*self._call("read", now))
        return reading if reading.fault is None else reading._replace(fault=Fault(*reading.fault))

    def write(self, setpoint: Setpoint) -> bool | None:
        taken: bool | None = self._call("write", setpoint)
        return taken

    def halt(self) -> None:
        self._call("halt")

    def recover(self) -> None:
        self._call("recover")

    def mass_matrix(self, q: Any) -> Any:
        return self._call("mass_matrix", list(q))

    def own_tcp(self) -> Any:
        return self._call("own_tcp")

    def inject(self, **knobs: object) -> None:
        self._call("inject", **knobs)

    def close(self) -> None:
        self._call("close")

    def end(self) -> None:
        """End the process."""
        self._child.close()


def main(channel: Channel, memories: object, config: Mapping[str, Any]) -> None:
    """Main program of the other process."""
    module, _, name = config["place"].partition(":")
    driver: RobotDriver = getattr(importlib.import_module(module), name)(from_json(RobotSpec, config["spec"]))
    channel.send({"ready": {"modes": sorted(driver.modes), "paces_itself": driver.paces_itself}})
    while True:
        request = channel.receive(60.0)
        if request is None:
            continue
        if request["id"] == 0:
            driver.close()
            return
        try:
            arguments = request["params"]["arguments"]
            if request["method"] == "write":
                arguments = [Setpoint(*arguments[0])]
            attribute = getattr(driver, request["method"])
            result = attribute(*arguments, **request["params"]["knobs"]) if callable(attribute) else attribute
            channel.send({"id": request["id"], "result": _plain(result)})
        except Exception as error:
            channel.send({"id": request["id"], "error": pack_error(error)})


def _plain(result: Any) -> Any:
    if isinstance(result, Reading):
        fault = result.fault
        return [*result[:10], None if fault is None else [fault.code, fault.cause, fault.remedy], *result[11:]]
    return result.tolist() if hasattr(result, "tolist") else result
