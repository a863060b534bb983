"""Benchmarks: figures of docs/measured.md, measured again. ``python -m benchmarks`` lists them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "kits"))
