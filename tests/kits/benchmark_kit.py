"""The modules of ``benchmarks/``: some tests run their functions with small counts."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

_ROOT = str(Path(__file__).resolve().parents[2])


def load_benchmark(name: str) -> Any:
    """Return a module of ``benchmarks/``."""
    if _ROOT not in sys.path:
        sys.path.append(_ROOT)
    return import_module(f"benchmarks.{name}")
