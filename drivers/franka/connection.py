"""The way to one arm: taken for this program alone, found, lost, and looked for again."""

from __future__ import annotations

import contextlib
import time

from hal.errors import ConnectionLost, HalError
from hal.lock import DeviceLock
from hal.types import Fault

from .claim import claim_arm
from .faults import ARM_PORT, fault_of_exception
from .link import Link, Mode, Sample
from .links import link_to
from .preflight_network import Answer, knock, resolve
from .settings import ArmSettings, is_emulated

__all__ = ["Connection"]

_RETRY = 0.5
"""s between attempts to find a lost robot again."""
_PATIENCE, _KNOCK = 2.0, 0.05
"""s to wait for a robot that is asked whether it is there, at first and when it was lost."""
_BREATH = 0.02
"""s between that question and the connection, so that the robot does not take them for two clients."""
_SAYS = {
    Answer.REFUSED: "Connection to FCI refused",
    Answer.SILENT: "Connection timeout",
    Answer.NO_WAY: "Connection error",
}
"""How the libraries would say it."""
_START = "start it in another terminal: python -m hal.drivers.franka.emulator --host {} (--help says more)"


class Connection:
    """A link that may be lost. ``link`` is None while there is none, and ``lost`` says why."""

    def __init__(self, name: str, settings: ArmSettings) -> None:
        self.name = name
        self.settings = settings
        self.link: Link | None = None
        self.lost: Fault | None = None
        self.troubles: tuple[type[Exception], ...] = (RuntimeError,)
        """What the library raises of its own."""
        self.found_again = 0
        """How often a lost robot was found."""
        self._claim: DeviceLock | None = None
        self._configured = False
        self._retry_at = 0.0

    def open(self) -> Sample:
        """Take the arm and connect; its first state. Raises ControlTaken, DriverMissing and ConnectionLost."""
        self._claim = claim_arm(resolve(self.settings.host) or self.settings.host)
        try:
            link = link_to(self.settings.arm)
            self._find(_PATIENCE)
            return self._connect(link)
        except BaseException as error:
            self.close()
            if isinstance(error, self.troubles) and not isinstance(error, HalError):
                raise self.error(self.explain(error)) from None
            raise

    def _find(self, patience: float) -> None:
        """Raise ConnectionLost when nobody listens there: a library that calls nobody may hang for a minute."""
        host = self.settings.host
        if resolve(host) is None:
            raise self.error(self.explain(RuntimeError("Host not found")))
        answer = knock(host, ARM_PORT, patience)
        if answer is Answer.REFUSED and is_emulated({"host": host}):
            raise self.error(Fault("refused", f"no emulator listens at {host}, port {ARM_PORT}", _START.format(host)))
        if answer is not Answer.OPEN:
            raise self.error(self.explain(RuntimeError(_SAYS[answer])))
        time.sleep(_BREATH)

    def _connect(self, link: Link) -> Sample:
        self.link = link
        self.troubles = link.troubles
        link.connect(self.settings.host)
        self._configured = False
        sample = link.read()
        self.configure(sample)
        self.lost = None
        return sample

    def configure(self, sample: Sample) -> None:
        """Tell the robot the rig's settings. One that is stopped or in reflex takes none: it gets them later."""
        if not self._configured and self.link is not None and sample.mode is Mode.IDLE:
            self.link.configure(self.settings)
            self._configured = True

    def lose(self, reason: Fault) -> None:
        """The robot does not answer: the library's object is of no use any more."""
        self.lost = reason
        self._retry_at = time.monotonic() + _RETRY
        link, self.link = self.link, None
        if link is not None:
            with contextlib.suppress(*self.troubles):  # it may complain that it could not say goodbye
                link.disconnect()

    def look_for_it(self) -> Sample | None:
        """One attempt to connect again, now and then; in between, a pause instead of the robot's pace."""
        if time.monotonic() < self._retry_at:
            time.sleep(0.01)
            return None
        try:
            self._find(_KNOCK)
            sample = self._connect(link_to(self.settings.arm))
        except ConnectionLost as error:
            self.lose(error.fault or self.explain(error))
        except self.troubles as error:
            self.lose(self.explain(error))
        else:
            self.found_again += 1
            return sample
        return None

    def explain(self, error: BaseException) -> Fault:
        """What an error of the library means."""
        return fault_of_exception(error, host=self.settings.host)

    def error(self, fault: Fault | None = None) -> ConnectionLost:
        """What to raise while there is no connection."""
        fault = fault or self.lost or Fault("closed", "it is not open", "open the rig")
        error = ConnectionLost(f"{self.name}: {fault.cause}; {fault.remedy}")
        error.fault = fault
        return error

    def close(self) -> None:
        """Hang up, and let others have the arm. Idempotent."""
        link, self.link = self.link, None
        try:
            if link is not None:
                link.disconnect()
        finally:
            if self._claim is not None:
                self._claim.release()
                self._claim = None
