"""An app in the tests' own process: what a person typed and read, without an interpreter that imports everything anew.

That an app starts as a program is for one or two tests of each; which message follows which mistake is for the others.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple
from unittest import mock

__all__ = ["Done", "run_here"]


class Done(NamedTuple):
    """How it ended, as subprocess.CompletedProcess says it."""

    returncode: int
    stdout: str
    stderr: str


def run_here(main: Callable[[list[str]], int], *arguments: object, answer: str = "") -> Done:
    """Call an app's ``main``; ``answer`` is what the person types. A traceback is an exception of the test's."""
    printed, errors = io.StringIO(), io.StringIO()

    def warn(message: object, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
        errors.write(f"{filename}:{lineno}: {category.__name__}: {message}\n")

    with (
        redirect_stdout(printed),
        redirect_stderr(errors),
        mock.patch("sys.stdin", io.StringIO(answer)),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("default")
        warnings.showwarning = warn  # type: ignore[assignment]
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as ended:  # argparse
            status = int(ended.code or 0)
    return Done(status, printed.getvalue(), errors.getvalue())
