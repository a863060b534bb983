"""Serve the devices of a rig to programs on other computers: ``at: ADDRESS`` in their rigs.

hal serve --config arm.yaml
hal serve --config panda_table --sim --listen 127.0.0.1:7447

The devices stay open until the server ends. An arm belongs to one program at a time, and comes to rest when that one
leaves; nothing moves without a control session of the program. Any number of them may watch a camera or read
a gamepad.
"""

from __future__ import annotations

import argparse
import sys

from hal.apps._common import ACTION_NEEDED, add_config_options, config_options, discard_output, program
from hal.apps._display import banner
from hal.apps.check import may_open


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal serve", description="Serve the devices of this computer to programs on others."
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
    import hal
    from hal.config import load
    from hal.registry import pad_driver
    from hal.remote.link import PORT
    from hal.remote.server import Server, check_servable
    from hal.views import Listen

    listen = Listen.parse(args.listen)
    plan = load(**config_options(args)).resolve()
    check_servable(plan)
    if not may_open(plan):
        return ACTION_NEEDED
    pad = pad_driver("plugged") if sys.platform == "linux" else "none"  # whose library is installed there only
    with hal.open(**config_options(args), pad=pad) as rig:
        server = Server(rig, listen.address, listen.port if listen.fixed else PORT, _report)
        _report(banner(rig))
        keys = server.entrance.credentials
        who = (
            "reachable from this computer only"
            if keys is None
            else f"for those with a certificate, as {keys.file.stem}"
        )
        _report(f"listening at {server.address}:{server.port}, {who}; Ctrl-C ends")
        server.run()
    return 0


def _report(line: str) -> None:
    try:
        print(line, flush=True)
    except OSError:  # nothing reads the output any more; what is lent stays lent
        discard_output()


if __name__ == "__main__":
    sys.exit(main())
