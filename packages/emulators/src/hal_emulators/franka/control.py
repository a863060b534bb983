"""Client of a running emulator's control port, for shells.

python -m hal_emulators.franka.control --host 127.0.0.2 reflex joint_reflex
"""

from __future__ import annotations

import argparse
import json
import sys

from hal_emulators.control import EmulatorControl

from .faults import help_text


def main(arguments: list[str] | None = None) -> int:
    """Run the program, and return its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m hal_emulators.franka.control",
        description="Send one command to a running emulator, and print its answer as JSON.",
        epilog="commands:\n" + help_text(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--host", default="127.0.0.2", help="address of the emulator (%(default)s)")
    parser.add_argument("command", nargs="+", help="the command and its arguments")
    options = parser.parse_args(arguments)
    try:
        with EmulatorControl(options.host) as control:
            answer = control.send(*options.command)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(answer.get("text") or json.dumps(answer, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
