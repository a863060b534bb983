"""The console's process for tests, which may be coroutines."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Iterator

import pytest
from web_kit import App


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine function, for at most a minute."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    asyncio.run(asyncio.wait_for(pyfuncitem.obj(**arguments), 60.0))
    return True


@pytest.fixture
def app() -> Iterator[App]:
    """A console's process; at its end the test fails if it logged anything."""
    with App() as found:
        yield found


@pytest.fixture
def hasty() -> Iterator[App]:
    """A console's process with shorter time-outs, so that tests wait less."""
    with App(target="child_targets:impatient_console") as found:
        yield found
