"""The end of a link at the devices: it lends those of an open rig to clients, each arm to one at a time."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..commands import NO_SESSION, DeadmanRecord, Session
from ..errors import CommandError, ConnectionLost, ControlTaken, HalError, NotSupported
from ..gamepad import Gamepad
from ..host.hosts import RemoteHost
from ..host.process import STOP_LIMIT, pack_error
from ..host.records import GripperMail, RobotMail
from ..host.scheduling import LINK_PRIORITY, raise_thread
from ..servo.watchdog import SILENCE
from ..specs import CameraSpec, PadSpec, Plan, RobotSpec, to_json
from .boxes import CommandBox, boxes_of_hosts, boxes_of_program
from .entrance import Entrance
from .frames import describe_camera, send_frames
from .link import CLOSE_LIMIT, MOST_ROUND_TRIP, RigLink, describe_version
from .measure import echo
from .pads import send_readings

if TYPE_CHECKING:
    from ..rig import Rig

PERIOD = 0.002
"""Longest time from a new state to its frame, s."""
MOST_READERS = 64
"""Connections that may read cameras and gamepads, and as many viewers of arms."""
_LEAVING = 1.0
"""Longest wait for a client that is about to leave, s."""


class Served:
    """Groups of a rig, lent to a client: what it writes reaches them, and what they publish reaches it.

    Args:
        hosts: The groups.
        link: The connection.
        wish: What the client wants: names of its arms, each with the number of joints, and of its grippers.
        over: Set when the server ends.
    """

    def __init__(self, hosts: Sequence[RemoteHost], link: RigLink, wish: dict[str, Any], over: threading.Event) -> None:
        self._over = over
        self._watches = link.viewer
        self.link = link
        self.hosts = hosts
        self._robots = {robot.name: robot for host in hosts for robot in host.spec.robots}
        robots = {name: self._find_robot(name, n) for name, n in wish["robots"]}
        grippers = {name: self._find_gripper(name) for name in wish["grippers"]}
        memories = [host.memory for host in hosts]
        ahead = {name: self._robots[name].deadline_max for name in robots}
        if not self._watches:  # nothing that a viewer writes reaches a host
            link.incoming = boxes_of_program(memories, robots, grippers, ahead)
        link.outgoing = boxes_of_hosts(memories, robots, grippers)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="hal-serve-request")  # one request at a time

    def run(self) -> None:
        """Copy until the client leaves or is gone; bring the arms to rest."""
        link = self.link
        try:
            for host in () if self._watches else self.hosts:
                host.lend(True)
            realtime = all(host.child.ready["realtime"] for host in self.hosts)
            if realtime and not self._watches:
                raise_thread(LINK_PRIORITY)
            link.post({"ready": {"realtime": realtime}})
            self._copy()
            self._take_back()
            link.say_last({"closed": True})
        except BaseException as error:
            self._take_back()
            link.say_last({"error": pack_error(error)})
            raise
        finally:
            self._worker.shutdown(wait=True)

    def _copy(self) -> None:
        link = self.link
        while True:
            link.wait(PERIOD)
            for message in link.receive():
                if message["method"] == "close":
                    return
                self._worker.submit(self._answer, message)
            link.send()
            if self._over.is_set():
                raise ConnectionLost("the server was ended", code="server_ended")
            for host in self.hosts:
                host.child.check()

    def _take_back(self) -> None:
        """End what the client began.

        Its arms come to rest before there is another sign of life, and its grippers stop for the lack of one.
        """
        if self._watches:
            return
        self.link.incoming = self.link.outgoing = ()  # the end of its sessions is not news for it, the reason is
        arms = [mail for host in self.hosts for mail in host.memory.robots.values()]
        for mail in arms:
            mail.put_session(NO_SESSION)
            mail.put_deadman(DeadmanRecord(False, False, 0, -math.inf))
        time.sleep(2.0 * SILENCE)
        deadline = time.monotonic() + STOP_LIMIT
        while any((servo := mail.peek()) is not None and servo.session for mail in arms):
            if time.monotonic() > deadline:  # a device that does not answer: no session is opened meanwhile
                break
            time.sleep(PERIOD)
        for host in self.hosts:
            host.lend(False)

    def _find_robot(self, name: str, n: int) -> RobotMail:
        spec = self._robots.get(name)
        if spec is None or len(spec.joints) != n:
            raise NotSupported(f"no robot {name!r} with {n} joints is served here", code="no_robot")
        return next(host.memory.robots[name] for host in self.hosts if name in host.memory.robots)

    def _find_gripper(self, name: str) -> GripperMail:
        found = [host.memory.grippers[name] for host in self.hosts if name in host.memory.grippers]
        if not found:
            raise NotSupported(f"no gripper {name!r} is served here", code="no_gripper")
        return found[0]

    # Requests.

    def _answer(self, message: dict[str, Any]) -> None:
        """Answer a request, in the thread of the requests."""
        try:
            answer = {"result": self._request(message["method"], message["params"])}
        except Exception as error:
            answer = {"error": pack_error(error)}
        self.link.post({"id": message["id"], **answer})

    def _request(self, method: str, params: dict[str, Any]) -> Any:
        if self._watches and method == "reset_statistics":
            return self.link.offset.forget_round_trips()
        if self._watches and method not in ("warnings", "statistics"):
            raise NotSupported("a viewer may only watch: `hal keys make --person` for who drives", code="read_only")
        if method in ("warnings", "reset_statistics", "statistics"):
            results = [host.request(method) for host in self.hosts]
            if method == "reset_statistics":
                self.link.offset.forget_round_trips()
            if method == "warnings":
                return [text for result in results for text in result]
            return self._merge_statistics(results) if method == "statistics" else None
        if method.startswith("world."):
            raise NotSupported("the simulated world of another computer cannot be changed from here", code="no_world")
        if method == "begin":
            params = params | {"session": self._check_session(params["robot"], params["session"])}
        name = params.get("robot") or params.get("gripper")
        for host in self.hosts:
            if name in host.memory.robots or name in host.memory.grippers:
                return host.request(method, params)
        raise NotSupported(f"no robot or gripper {name!r} is served here", code="no_robot")

    def _check_session(self, name: str, session: list[Any]) -> list[Any]:
        """Return the terms of a session inside those of this rig. Raises ConnectionLost if the link is too slow."""
        spec, asked = self._robots[name], Session(*session)
        round_trip = self.link.offset.round_trip
        if not round_trip <= MOST_ROUND_TRIP:
            text = f"a round trip to {name} takes {1e3 * round_trip:.0f} ms, more than {1e3 * MOST_ROUND_TRIP:.0f} ms"
            raise ConnectionLost(f"{text}: a released dead-man would stop it too late", code="link_too_slow")
        for box in self.link.incoming:
            if isinstance(box, CommandBox):
                box.on_the_way = 0.5 * round_trip
        most = 1.0 if asked.is_motion else spec.speed
        if not (0.0 < asked.speed <= most and 0.0 < asked.tcp_speed <= spec.tcp_speed):
            raise CommandError(f"faster than the rig that serves {name} allows", code="too_fast")
        return session

    def _merge_statistics(self, results: list[dict[str, Any]]) -> dict[str, Any]:
        """Return the statistics of all groups as those of one, and those of the link."""
        merged = dict(results[0])
        for key in ("robots", "grippers"):
            merged[key] = {name: value for result in results for name, value in result[key].items()}
        merged["link"] = self.link.statistics()
        return merged


class Server:
    """Listens for clients, and lends the devices of a rig to them: each arm to one at a time, cameras to any number.

    Args:
        rig: The open rig, in real time.
        address: Address to listen at.
        port: Port; 0 for a free one.
        report: Called with each line that a user should see.

    Raises:
        NotSupported: An address other than 127.0.0.1, ::1 and localhost without a certificate (``code`` is
            ``no_certificates``, or see :func:`~hal.keys.find_key`), or a rig in lock-step (``needs_real_time``).
        CommandError: There is nothing to serve (``code`` is ``no_devices``), or the port is taken (``bad_address``).
    """

    def __init__(self, rig: Rig, address: str, port: int, report: Callable[[str], object]) -> None:
        self.entrance = Entrance(address, report)
        check_servable(rig.plan)
        self._rig = rig
        self._hosts = [host for host in rig._hosts if isinstance(host, RemoteHost)]
        self._report = report
        self._leases = threading.Condition()
        self._over = threading.Event()
        self._readers = threading.Semaphore(MOST_READERS)
        self.served: list[Served] = []
        """What is lent at present."""
        try:
            self._socket = socket.create_server(
                (address, port), family=socket.AF_INET6 if ":" in address else socket.AF_INET
            )
        except OSError as error:
            raise CommandError(
                f"cannot listen at {address}, port {port}: {error.strerror}", code="bad_address"
            ) from None
        self.address = address
        self.port: int = self._socket.getsockname()[1]

    def close(self) -> None:
        """End :meth:`run`, from another thread. Idempotent."""
        self._over.set()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def run(self) -> None:
        """Serve until :meth:`close`, or until an exception, such as Ctrl-C, ends it.

        Raises:
            ConnectionLost: A process that owns devices is gone.
        """
        threads: list[threading.Thread] = []
        self._socket.settimeout(_LEAVING)
        try:
            while not self._over.is_set():
                for host in self._hosts:
                    host.child.check()
                try:
                    sock, peer = self._socket.accept()
                except TimeoutError:
                    continue
                except OSError:
                    if self._over.is_set():
                        return
                    raise
                at = f"{peer[0]}:{peer[1]}"
                self.entrance.enter(at, sock)
                thread = threading.Thread(target=self._welcome, args=(sock, at), daemon=True)
                thread.start()
                threads = [other for other in threads if other.is_alive()] + [thread]
        finally:
            self._socket.close()
            self._over.set()
            for thread in threads:
                thread.join(CLOSE_LIMIT)

    def _welcome(self, sock: socket.socket, peer: str) -> None:
        """Serve one connection, in a thread of its own."""
        link = None
        try:
            link = self.entrance.admit(sock, peer, PERIOD)
            self._serve(link, peer, link.await_message())
        except HalError as error:
            self.entrance.report(peer, error)
        except Exception:
            self._report(f"{peer}: {traceback.format_exc()}")
        finally:
            self.entrance.leave(peer)
            if link is not None:
                link.close()

    def _serve(self, link: RigLink, peer: str, wish: dict[str, Any]) -> None:
        want = wish["want"]
        try:
            check_version(wish)
            if want == "devices":
                link.say_last(describe_devices(self._rig.plan))
                return
            if want == "echo":
                echo(link, self._over)
                return
            if want == "control":
                served = self._lend(link, wish)
            elif link.viewer and want == "pad":
                raise NotSupported("a viewer may not use a gamepad", code="read_only")
            else:
                device = self._rig.gamepads[wish["pad"]] if want == "pad" else self._rig.cameras[wish["camera"]]
            if want != "control" and not self._readers.acquire(blocking=False):
                raise ControlTaken(f"there are {MOST_READERS} readers of cameras and gamepads", code="too_many_readers")
        except HalError as error:
            link.say_last({"error": pack_error(error)})
            raise
        self.entrance.leave(peer)
        try:
            if want == "control":
                self._run(served, ", ".join(name for name, _ in wish["robots"]))
            elif isinstance(device, Gamepad):
                send_readings(device, link, self._over)
            else:
                send_frames(device, link, self._over)
        except ConnectionLost as error:
            self._report(f"{link.at}: {error}")
            if want != "control":
                link.say_last({"error": pack_error(error)})
        finally:
            if want != "control":
                self._readers.release()

    def _run(self, served: Served, names: str) -> None:
        at = served.link.at
        try:
            served.link.post({"accepted": True})
            self._report(f"{at} {'watches' if served.link.viewer else 'has taken'} {names}")
            served.run()
        finally:
            with self._leases:
                self.served.remove(served)
                self._leases.notify_all()
            self._report(f"{at} has left")

    def _lend(self, link: RigLink, wish: dict[str, Any]) -> Served:
        """Lend the groups of a client's devices. Raises ControlTaken while another client has one of them."""
        names = {*(name for name, _ in wish["robots"]), *wish["grippers"]}
        hosts = [host for host in self._hosts if names & {*host.memory.robots, *host.memory.grippers}]

        def owners() -> list[str]:
            lent = [served for served in self.served if not served.link.viewer]
            return [served.link.at for served in lent if not set(hosts).isdisjoint(served.hosts)]

        with self._leases:
            if link.viewer and len(self.served) >= MOST_READERS:
                raise ControlTaken(f"{len(self.served)} programs watch", code="too_many_readers")
            if not link.viewer and not self._leases.wait_for(lambda: not owners(), _LEAVING):
                raise ControlTaken(f"this rig is in use by {owners()[0]}", code="in_use")
            self.served.append(Served(hosts, link, wish, self._over))
            return self.served[-1]


def check_servable(plan: Plan) -> None:
    """Raise NotSupported or CommandError for a rig that cannot be served, as :class:`Server`."""
    if plan.clock == "lock_step":
        raise NotSupported("a served rig needs real time; leave out the clock lock_step", code="needs_real_time")
    devices: tuple[RobotSpec | CameraSpec | PadSpec, ...] = (*plan.robots, *plan.cameras, *plan.pads)
    for device in devices:
        if device.at is not None:
            raise NotSupported(
                f"{device.name} is served by another computer: name that one in the rig", code="served_twice"
            )
    if not devices:
        raise CommandError(f"{plan.source} has no arm, camera or gamepad to serve", code="no_devices")


def check_version(wish: dict[str, Any]) -> None:
    """Raise NotSupported unless the other end has this version of the package and this layout of records."""
    own = describe_version()
    theirs = {key: wish.get(key) for key in own}
    if theirs != own:
        text = f"the two computers must have one version of hal: here {own['version']}, there {theirs['version']}"
        layouts = "" if theirs["version"] != own["version"] else ", with other records"
        raise NotSupported(text + layouts, code="version_mismatch")


def describe_devices(plan: Plan) -> dict[str, Any]:
    """Return the records of all devices and the text of their URDFs, without the options of the drivers."""
    public = [
        replace(robot, options={}, gripper=None if robot.gripper is None else replace(robot.gripper, options={}))
        for robot in plan.robots
    ]
    pads = [replace(pad, options={}, model=None, models=()) for pad in plan.pads]
    pads = [pad if pad.leader is None else replace(pad, leader=replace(pad.leader, follow=0.0)) for pad in pads]
    files = {path for robot in public for path in (robot.urdf, robot.kinematics.urdf)}
    files |= {
        pad.leader.kinematics.urdf for pad in pads if pad.leader is not None and pad.leader.kinematics is not None
    }
    return {
        "robots": [to_json(robot) for robot in public],
        "cameras": [describe_camera(camera) for camera in plan.cameras],
        "pads": [to_json(pad) for pad in pads],
        "urdfs": {path: Path(path).read_text(encoding="utf-8") for path in sorted(files)},
    }
