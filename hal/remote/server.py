"""The end of a link at the devices: it opens them for one client at a time, and closes them when that one leaves."""

from __future__ import annotations

import contextlib
import socket
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..commands import Session
from ..errors import CommandError, ConnectionLost, ControlTaken, HalError, NotSupported
from ..host.hosts import RemoteHost, make_groups, start_processes
from ..host.process import pack_error
from ..host.records import GripperMail, RobotMail
from ..specs import Plan, RobotSpec, to_json
from .boxes import boxes_of_hosts, boxes_of_program
from .entrance import Entrance
from .link import CLOSE_LIMIT, MOST_ROUND_TRIP, RigLink, describe_version
from .measure import echo

PERIOD = 0.002
"""Longest time from a new state to its frame, s."""
_LEAVING = 1.0
"""Longest wait for a client that is about to leave, s."""


class Served:
    """The hosts of a rig, open for one client: what it writes reaches them, and what they publish reaches it.

    Args:
        plan: The rig.
        link: The connection.
        wish: What the client wants: names of its arms, each with the number of joints, and of its grippers.
        over: Set when the server ends.
    """

    def __init__(self, plan: Plan, link: RigLink, wish: dict[str, Any], over: threading.Event) -> None:
        self._over = over
        self._plan = plan
        self.link = link
        self._wish = wish
        self.hosts: list[RemoteHost] = []
        self._robots = {robot.name: robot for robot in plan.robots}
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="hal-serve-request")  # one request at a time
        self._failure: BaseException | None = None

    def run(self) -> None:
        """Open the devices, copy until the client leaves or is gone, bring the arms to rest and close the devices."""
        link = self.link
        closing: threading.Thread | None = None
        try:
            self._start()
            while closing is None or closing.is_alive():
                link.wait(PERIOD)
                for message in link.receive():
                    if message["method"] != "close":
                        self._worker.submit(self._answer, message)
                    elif closing is None:  # the arms come to rest while their states are still copied
                        closing = threading.Thread(target=self._close, name="hal-serve-close")
                        closing.start()
                link.send()
                if closing is None:
                    self._check()
            link.say_last({"closed": True})
        except BaseException as error:
            for host in self.hosts:
                host.request_close()
            link.say_last({"error": pack_error(error)})
            raise
        finally:
            if closing is not None:
                closing.join()
            self._close()
            self._worker.shutdown(wait=True)

    def _start(self) -> None:
        """Start the hosts, and answer when they are ready; a client without a heartbeat moves nothing meanwhile."""
        realtime = bool(self._wish["realtime"])
        for host in start_processes(make_groups(self._plan), realtime, beating=False):
            self.hosts.append(host)
            self.link.send()  # the client waits for a sign of life
        robots = {name: self._find_robot(name, n) for name, n in self._wish["robots"]}
        grippers = {name: self._find_gripper(name) for name in self._wish["grippers"]}
        memories = [host.memory for host in self.hosts]
        ahead = {name: self._robots[name].deadline_max for name in robots}
        self.link.incoming = boxes_of_program(memories, robots, grippers, ahead)
        self.link.outgoing = boxes_of_hosts(memories, robots, grippers)
        self._worker.submit(self._wait_ready)

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

    def _wait_ready(self) -> None:
        try:
            ready = [host.wait_ready() for host in self.hosts]
            self.link.post({"ready": {"realtime": all(answer["realtime"] for answer in ready)}})
        except BaseException as error:
            self._failure = error

    def _check(self) -> None:
        """Raise the error with which a host ended, or if the server ends."""
        if self._over.is_set():
            raise ConnectionLost("the server was ended", code="server_ended")
        if self._failure is not None:
            raise self._failure
        for host in self.hosts:
            host.child.check()

    # Requests.

    def _answer(self, message: dict[str, Any]) -> None:
        """Answer a request, in the thread of the requests."""
        try:
            answer = {"result": self._request(message["method"], message["params"])}
        except Exception as error:
            answer = {"error": pack_error(error)}
        self.link.post({"id": message["id"], **answer})

    def _request(self, method: str, params: dict[str, Any]) -> Any:
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
        most = 1.0 if asked.is_motion else spec.speed
        if not (0.0 < asked.speed <= most and 0.0 < asked.tcp_speed <= spec.tcp_speed):
            raise CommandError(f"faster than the rig that serves {name} allows", code="too_fast")
        return session

    def _merge_statistics(self, results: list[dict[str, Any]]) -> dict[str, Any]:
        """Return the statistics of all groups as those of one, and those of the link."""
        merged = dict(results[0])
        for key in ("robots", "grippers"):
            merged[key] = {name: value for result in results for name, value in result[key].items()}
        offset = self.link.offset
        merged["link"] = {"round_trip_s": offset.round_trip, "offset_s": offset.value, "frames": self.link.frames}
        merged["link"]["round_trips_s"] = offset.round_trips.summary()
        return merged

    def _close(self) -> None:
        """Bring the arms to rest and close the devices; the processes at the same time."""
        for host in self.hosts:
            host.request_close()
        for host in self.hosts:
            host.close()


class Server:
    """Listens for clients, and serves one at a time.

    Args:
        plan: The rig, in real time. Its cameras and pads are not served.
        address: Address to listen at.
        port: Port; 0 for a free one.
        report: Called with each line that a user should see.

    Raises:
        NotSupported: An address other than 127.0.0.1, ::1 and localhost without a certificate (``code`` is
            ``no_certificates``, or see :func:`~hal.keys.find_key`), or a rig in lock-step (``needs_real_time``).
        CommandError: There is no arm (``code`` is ``no_robot``), or the port is taken (``bad_address``).
    """

    def __init__(self, plan: Plan, address: str, port: int, report: Callable[[str], object]) -> None:
        self.entrance = Entrance(address, report)
        if plan.clock == "lock_step":
            raise NotSupported("a served rig needs real time; leave out the clock lock_step", code="needs_real_time")
        far = [robot.name for robot in plan.robots if robot.at is not None]
        if far:
            raise NotSupported(f"{far[0]} is served by another computer: name that one in the rig", code="served_twice")
        if not plan.robots:
            raise CommandError(f"{plan.source} has no robot to serve", code="no_robot")
        self._plan = replace(plan, cameras=(), pads=())
        self._report = report
        self._lease = threading.Lock()
        self._over = threading.Event()
        self.served: Served | None = None
        """The devices of the client that has them; None while there is none."""
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
        """Serve until :meth:`close`, or until an exception, such as Ctrl-C, ends it. The devices are closed first."""
        threads: list[threading.Thread] = []
        try:
            while not self._over.is_set():
                try:
                    sock, peer = self._socket.accept()
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
        try:
            check_version(wish)
            if wish["want"] == "robots":
                link.say_last(describe_robots(self._plan.robots))
                return
            if wish["want"] == "echo":
                echo(link, self._over)
                return
            self._take()
        except HalError as error:
            link.say_last({"error": pack_error(error)})
            raise
        try:
            self.entrance.leave(peer)
            link.post({"accepted": True})
            self._report(f"{link.at} has taken {', '.join(name for name, _ in wish['robots'])}")
            self.served = Served(self._plan, link, wish, self._over)
            self.served.run()
        except ConnectionLost as error:
            self._report(f"{link.at}: {error}")
        finally:
            self.served = None
            self._lease.release()
            self._report(f"{link.at} has left; the devices are closed")

    def _take(self) -> None:
        """Take the lease. Raises ControlTaken while another connection has it."""
        if not self._lease.acquire(timeout=_LEAVING):
            owner = self.served.link.at if self.served is not None else "another program"
            raise ControlTaken(f"this rig is in use by {owner}", code="in_use")


def check_version(wish: dict[str, Any]) -> None:
    """Raise NotSupported unless the other end has this version of the package and this layout of records."""
    own = describe_version()
    theirs = {key: wish.get(key) for key in own}
    if theirs != own:
        text = f"the two computers must have one version of hal: here {own['version']}, there {theirs['version']}"
        layouts = "" if theirs["version"] != own["version"] else ", with other records"
        raise NotSupported(text + layouts, code="version_mismatch")


def describe_robots(robots: tuple[RobotSpec, ...]) -> dict[str, Any]:
    """Return the records of arms and the text of their URDFs, without the options of the drivers."""
    public = [
        replace(robot, options={}, gripper=None if robot.gripper is None else replace(robot.gripper, options={}))
        for robot in robots
    ]
    files = {path for robot in robots for path in (robot.urdf, robot.kinematics.urdf)}
    return {
        "robots": [to_json(robot) for robot in public],
        "urdfs": {path: Path(path).read_text(encoding="utf-8") for path in sorted(files)},
    }
