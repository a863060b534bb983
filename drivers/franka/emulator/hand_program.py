"""An emulated hand as a program: commands on standard input, and on a loopback port."""

from __future__ import annotations

import argparse
import json
import socketserver
import sys
import threading
from typing import Any

from .hand import HandServer

__all__ = ["CONTROL_PORT", "main"]

CONTROL_PORT = 1340
"""TCP; lines as on the arm's own port (:mod:`.console`): words, or ``{"command": ["object", "0.03"]}``."""


class _Control(socketserver.StreamRequestHandler):
    server: _ControlServer

    def handle(self) -> None:
        for line in self.rfile:
            self.wfile.write(json.dumps(_obey(self.server.hand, line.decode(errors="replace"))).encode() + b"\n")


class _ControlServer(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, hand: HandServer, host: str) -> None:
        self.hand = hand
        super().__init__((host, CONTROL_PORT), _Control)


def _obey(hand: HandServer, line: str) -> dict[str, Any]:
    try:
        words = json.loads(line)["command"] if line.lstrip().startswith("{") else line.split()
        return {"ok": True, **hand.command([str(word) for word in words])}
    except (ValueError, KeyError, TypeError) as error:
        return {"ok": False, "error": str(error)}


def main() -> None:
    """Run until standard input ends."""
    parser = argparse.ArgumentParser(description="A program that stands in for a Franka Hand.")
    parser.add_argument("--host", default="127.0.0.2", help="address on this computer (default: %(default)s)")
    parser.add_argument("--object", type=float, metavar="W", help="a thing of W m between the fingers")
    parser.add_argument("--period", type=float, default=0.02, metavar="S", help="s between states (%(default)s)")
    parser.add_argument("--unhomed", action="store_true", help="as after switching on")
    arguments = parser.parse_args()
    hand = HandServer(
        arguments.host, object_width=arguments.object, period=arguments.period, homed=not arguments.unhomed
    )
    hand.start()
    control = _ControlServer(hand, arguments.host)
    threading.Thread(target=control.serve_forever, daemon=True).start()
    print(f"a Franka Hand is at {arguments.host}; words go here or to port {CONTROL_PORT}; help lists them", flush=True)
    for line in sys.stdin:
        answer = _obey(hand, line)
        print(answer.get("text") or json.dumps(answer), flush=True)
    control.shutdown()
    hand.stop()
