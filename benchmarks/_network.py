"""Two computers on one: a server and a client in network namespaces, and a network between them.

Its delay, jitter and loss are made here, packet by packet, as by ``tc netem``; or it is an Ethernet of a certain rate.
No packet leaves the namespaces. Their addresses are loopback ones, which ``hal serve`` accepts.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

from .kit import ROOT

SERVER, CLIENT = "127.0.0.1", "127.0.0.2"
_TUN, _NO_HEADER, _SET_DEVICE = 1, 0x1000, 0x400454CA  # linux/if_tun.h
_NEW_NETWORK = 0x40000000  # CLONE_NEWNET
_SET_UP = """
ip link set lo up
ip address del 127.0.0.1/8 dev lo
for name in all net0; do echo 1 > /proc/sys/net/ipv4/conf/$name/route_localnet; done
ip address add {own} peer {other} dev net0
ip link set net0 up
"""
_SHAPE = "tc qdisc add dev net0 root tbf rate {rate:.0f}bit burst 64kb latency 20ms\n"


def run_apart(server: Sequence[str], client: Sequence[str], **network: float) -> Any:
    """Run a server, which prints a line with ``listening`` when it is ready, and a client in two namespaces.

    Args:
        server: Command; it listens at :data:`SERVER`.
        client: Command; its last line of output is JSON, which is returned.
        **network: Either ``delay`` (one way, s), ``jitter`` (s, each way at most), ``loss`` (share of the packets) and
            ``reorder`` (1: packets may overtake each other; 0: they queue), or ``rate`` (bit/s).
    """
    words = json.dumps([list(server), list(client), network])
    done = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--net", sys.executable, "-m", "benchmarks._network", words],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def _enter(server: Sequence[str], client: Sequence[str], network: dict[str, float]) -> None:
    """Run both, from the namespace of the server."""
    with subprocess.Popen(["unshare", "--net", "sleep", "600"]) as other:
        try:
            inside = ["nsenter", "--target", str(other.pid), "--net"]
            while os.readlink(f"/proc/{other.pid}/ns/net") == os.readlink("/proc/self/ns/net"):
                time.sleep(0.01)
            _connect(other.pid, **network)
            shape = _SHAPE.format(rate=network["rate"]) if "rate" in network else ""
            for prefix, own, peer in (([], SERVER, CLIENT), (inside, CLIENT, SERVER)):
                script = _SET_UP.format(own=own, other=peer) + shape
                subprocess.run([*prefix, "sh", "-e", "-c", script], check=True)
            with subprocess.Popen(server, stdout=subprocess.PIPE, text=True) as serving:
                try:
                    assert serving.stdout is not None
                    assert any("listening" in line for line in serving.stdout)
                    subprocess.run([*inside, *client], check=True)
                finally:
                    serving.terminate()
        finally:
            other.kill()


def _connect(other: int, rate: float = 0.0, **network: float) -> None:
    """Put an end of the network into this namespace and one into that of a process."""
    if rate:
        subprocess.run(f"ip link add net0 type veth peer name net0 netns {other}".split(), check=True)
        return
    here, there = os.open("/proc/self/ns/net", os.O_RDONLY), os.open(f"/proc/{other}/ns/net", os.O_RDONLY)
    libc = ctypes.CDLL(None, use_errno=True)
    ends = []
    for space in (here, there):
        assert libc.setns(space, _NEW_NETWORK) == 0, os.strerror(ctypes.get_errno())
        ends.append(os.open("/dev/net/tun", os.O_RDWR))
        fcntl.ioctl(ends[-1], _SET_DEVICE, struct.pack("16sH22x", b"net0", _TUN | _NO_HEADER))
    assert libc.setns(here, _NEW_NETWORK) == 0
    threading.Thread(target=_forward, args=ends, kwargs=network, daemon=True).start()


def _forward(
    one: int, other: int, delay: float = 0.0, jitter: float = 0.0, loss: float = 0.0, reorder: float = 0.0
) -> None:
    """Pass packets on, late, out of order, or not at all."""
    chance, waiting = random.Random(1), list[tuple[float, int, int, bytes]]()
    to, number, newest = {one: other, other: one}, 0, {one: 0.0, other: 0.0}
    while True:
        rest = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        for end in select.select([one, other], [], [], rest)[0]:
            packet, number = os.read(end, 1 << 16), number + 1
            if chance.random() >= loss:
                due = time.monotonic() + delay + jitter * chance.uniform(-1.0, 1.0)
                newest[end] = due = due if reorder else max(due, newest[end])
                heapq.heappush(waiting, (due, number, to[end], packet))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, end, packet = heapq.heappop(waiting)
            try:
                os.write(end, packet)
            except OSError:  # an end that is not up yet
                continue


if __name__ == "__main__":
    _enter(*json.loads(sys.argv[1]))
