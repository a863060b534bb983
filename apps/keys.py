"""Make, list and revoke the certificates with which computers may be served from and persons may connect.

hal keys make --host arm-pc 192.168.1.5 --person anna --viewer tv
hal keys list
hal keys revoke anna

The first `make` also makes the authority, on the computer where it is typed: make all others there. A certificate is
one file, key included; copy a host's to that computer, into the same folder.
"""

from __future__ import annotations

import argparse
import sys
import time

from hal.apps._common import program
from hal.errors import CommandError


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    from hal.keys import DAYS, keys_folder

    made = argparse.ArgumentParser(
        prog="hal keys",
        description="Make, list and revoke certificates for connections between computers.",
        epilog=f"They are in {keys_folder()}; HAL_KEYS names another folder.",
    )
    made.add_argument("action", choices=["make", "list", "revoke"])
    made.add_argument("names", nargs="*", metavar="NAME", help="revoke: whose certificates are refused from now on")
    made.add_argument(
        "--host",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "ADDRESS"),
        help="make: a computer that serves, with the addresses that rigs have for it; may be repeated",
    )
    made.add_argument(
        "--person", action="append", default=[], metavar="NAME", help="make: who connects; may be repeated"
    )
    made.add_argument(
        "--viewer", action="append", default=[], metavar="NAME", help="make: who may only watch; may be repeated"
    )
    made.add_argument("--days", type=int, default=DAYS, help="make: how long they are valid (%(default)s)")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    from hal.keys import keys_folder, make_key, read_list, revoke

    makes, revokes = args.host or args.person or args.viewer, args.names
    if bool(makes) != (args.action == "make") or bool(revokes) != (args.action == "revoke"):
        raise CommandError("make takes --host, --person and --viewer, revoke takes names, list takes nothing")
    for name, *addresses in args.host:
        file = make_key("host", name, addresses, args.days)
        folder = ".config/robot-hal/keys"
        print(f"{file}\n  to {name}: ssh {name} 'mkdir -p -m 700 {folder}' && scp {file} {name}:{folder}/")
    for role, names in (("person", args.person), ("viewer", args.viewer)):
        for name in names:
            print(make_key(role, name, (), args.days))
    for name in revokes:
        print(f"{name} is revoked where this list is; copy it into the same folder of each host: {revoke(name)}")
    if args.action == "list":
        today = time.strftime("%Y-%m-%d", time.gmtime())
        for line in read_list():
            state = "revoked" if line.revoked else "expired" if line.until < today else ""
            print(f"{line.role:8s}{line.name:24s}until {line.until}  {state}".rstrip())
        if not read_list():
            print(f"no certificates in {keys_folder()}: hal keys make")
    return 0


if __name__ == "__main__":
    sys.exit(main())
