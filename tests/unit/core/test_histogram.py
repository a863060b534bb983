"""Percentiles in constant memory."""

import random

from hal.histogram import Histogram


def test_percentiles_are_never_too_small_and_off_by_one_bin_at_most() -> None:
    numbers = random.Random(1)
    values = [numbers.expovariate(100.0) for _ in range(5000)]
    histogram = Histogram(1e-4, 5000)
    for value in values:
        histogram.add(value)
    values.sort()
    for share in (0.5, 0.9, 0.99):
        exact = values[round(share * len(values)) - 1]
        found = histogram.percentile(share)
        assert found is not None
        assert exact <= found <= exact + 2e-4
    assert histogram.greatest == values[-1]


def test_nothing_counted_is_none_not_zero() -> None:
    assert Histogram(1e-3, 10).summary() == {"p50": None, "p99": None, "max": None}


def test_what_is_beyond_the_last_bin_still_counts() -> None:
    histogram = Histogram(1e-3, 10)
    histogram.add(5.0)
    assert histogram.greatest == 5.0
