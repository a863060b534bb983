"""Serve the arms and grippers of a rig to a program on another computer, whose rig has ``at: ADDRESS`` for them.

hal serve --config arm.yaml
hal serve --config panda_table --sim --listen 127.0.0.1:7447

The devices are opened for a client and closed, at rest, when it leaves. Nothing moves without a control session of the
client's program. One client at a time.
"""

from __future__ import annotations

import argparse
import sys

from hal.apps._common import ACTION_NEEDED, add_config_options, config_options, program
from hal.apps._display import list_devices
from hal.apps.check import may_open


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal serve", description="Serve the arms of this computer to a program on another one."
    )
    add_config_options(made)
    made.add_argument(
        "--listen",
        metavar="ADDRESS[:PORT]",
        help="address to listen at (default: 127.0.0.1:7447; port 0 for a free one). Every other than 127.0.0.1 needs "
        "certificates: hal keys",
    )
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.config import load
    from hal.remote.link import PORT
    from hal.remote.server import Server
    from hal.views import Listen

    listen = Listen.parse(args.listen)
    plan = load(**config_options(args)).resolve()
    if not may_open(plan):
        return ACTION_NEEDED
    server = Server(plan, listen.address, listen.port if listen.fixed else PORT, _report)
    for line in list_devices(plan):
        if line.startswith(("robot", "limits", "world")):
            _report(f"  {line}")
    keys = server.entrance.credentials
    who = "reachable from this computer only" if keys is None else f"for those with a certificate, as {keys.file.stem}"
    _report(f"listening at {server.address}:{server.port}, {who}; Ctrl-C ends")
    server.run()
    return 0


def _report(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
