"""What all contracts have in common: a bench to try a driver on, and checks that may be left out with a reason."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import pytest

from .benches import Bench

__all__ = ["Contract", "bench_of", "needs"]

_Check = TypeVar("_Check", bound=Callable[..., Any])


def needs(*abilities: str) -> Callable[[_Check], _Check]:
    """Marks a check that only a bench with these abilities can carry."""

    def mark(check: _Check) -> _Check:
        check.needs = abilities  # type: ignore[attr-defined]
        return check

    return mark


def bench_of(make: Callable[[], AbstractContextManager[Bench]]) -> Any:
    """The fixture ``bench`` from a context manager: ``bench = bench_of(my_bench)`` in the body of the class."""

    @pytest.fixture
    def bench(self: object) -> Iterator[Bench]:
        with make() as made:
            yield made

    return bench


class Contract:
    """A class of checks. Inherit from one of the four contracts, give it a fixture ``bench``, and run pytest.

    A check that the device cannot be brought to is left out by name and with a reason, never skipped::

        class TestMyCamera(CameraContract, left_out={"lose": "it is a file: there is no link"}): ...

    What is neither given to the bench nor left out fails, so that nothing is forgotten in silence.
    """

    abilities: ClassVar[tuple[str, ...]] = ()
    """What may be left out: names of what the bench can do, and of what a device may lack."""
    left_out: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Ability -> why this device, or this bench, does not have it."""

    def __init_subclass__(cls, *, left_out: Mapping[str, str] = MappingProxyType({})) -> None:
        super().__init_subclass__()
        for ability, reason in left_out.items():
            if ability not in cls.abilities:
                known = ", ".join(cls.abilities)
                raise TypeError(f"{cls.__name__}, left_out: there is no {ability!r}; there are: {known}")
            if not reason.strip():
                raise TypeError(f"{cls.__name__}, left_out: say why there is no {ability!r}")
        cls.left_out = MappingProxyType({**cls.left_out, **left_out})
        for name in dir(cls):
            if set(cls.left_out) & set(getattr(getattr(cls, name), "needs", ())):
                setattr(cls, name, None)  # pytest collects what can be called

    @pytest.fixture
    def bench(self) -> Any:
        """The driver with what surrounds it; every check gets a new one, not opened."""
        raise NotImplementedError(
            f"{type(self).__name__} has nothing to check: give it a fixture `bench` that yields a bench with your "
            "driver (hal.testing.CameraBench and its siblings), and closes the driver afterwards"
        )

    @pytest.fixture(autouse=True)
    def _complete(self, bench: Bench) -> None:
        """Is every ability given, or left out with a reason?"""
        for ability in self.abilities:
            given, out = bench.has(ability), ability in self.left_out
            assert given or out, (
                f"the bench has no {ability!r}: give it one ({type(bench).__name__}.{ability} says what it has to do), "
                f"or leave it out: class {type(self).__name__}(..., left_out={{{ability!r}: 'why'}})"
            )
            assert not (out and bench.gave(ability)), (
                f"{type(self).__name__} leaves out {ability!r}, but its bench has one: take it out of left_out"
            )
