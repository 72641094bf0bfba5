"""Promised times on an emulated machine: it may be late, whatever it runs; only what is late every time is a fault."""

from __future__ import annotations

from collections.abc import Callable

import pytest

ATTEMPTS = 3


def punctual(limit_s: float, attempt: Callable[[], float]) -> None:
    """Make attempts until one takes no longer than `limit_s`; each returns the seconds that it took."""
    took: list[float] = []
    while len(took) < ATTEMPTS:
        took.append(attempt())
        if took[-1] <= limit_s:
            return
    pytest.fail(f"late every time: {', '.join(f'{seconds:.2f}' for seconds in took)} s, {limit_s} s are promised")
