"""Times from the end of an app until its arm brakes, is at rest, and its processes have ended.

    python benchmarks/ends.py [--runs 5]

Each run starts an app in a terminal of its own, waits until its arm moves, ends it in one way and watches the arm's
set-points from outside. The reference is the braking time itself: the same arm at the same speed, stopped by its own
app leaving the control session.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "kits"))
from observer import Watched


def measure(how: str) -> tuple[float, float, float | None]:
    """Return seconds to the start of braking, to rest, and until no process is left (None: they are meant to stay)."""
    with tempfile.TemporaryDirectory() as folder:
        app = Watched(Path(folder), ending="exception" if how == "exception" else "")
        try:
            full = app.speed()
            if how == "exception":
                began = when = app.wait_for(lambda: app.speed() < 0.999 * full)
            else:
                when = app.end(how)
                began = app.wait_for(lambda: app.speed() < 0.999 * full)
            rest = app.wait_for(app.at_rest)
            gone = None if how in ("SIGSTOP", "Ctrl-Z") else app.wait_for(app.nobody_left)
        finally:
            app.close()
    return began - when, rest - when, None if gone is None else gone - when


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="time from an app's end to its arm's rest")
    parser.add_argument("--runs", type=int, default=5, help="of each way (%(default)s)")
    runs = parser.parse_args().runs
    print(f"{'ms after the event: median (max)':34s}{'braking begins':>18s}{'at rest':>18s}{'processes gone':>18s}")
    for how in ("exception", "kill -9", "SIGTERM", "Ctrl-C", "closed terminal", "SIGSTOP", "Ctrl-Z"):
        found = [measure(how) for _ in range(runs)]
        cells = []
        for column in zip(*found, strict=True):
            values = [1e3 * value for value in column if value is not None]
            cells.append(f"{statistics.median(values):8.0f} ({max(values):.0f})" if values else "stay")
        name = "(reference) exception, from braking" if how == "exception" else how
        print(f"{name:34s}" + "".join(f"{cell:>18s}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
