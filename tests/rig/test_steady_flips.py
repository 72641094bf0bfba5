"""KMS at the display's refresh, where nothing but the guest's own work can make it late: no blank goes by unused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext

import pytest

from drivers.kms.projector import KmsProjector
from drivers.registry import open_projector
from scanner.clock import MonotonicClock
from tests.rig.six_hundred import decoding_and_writing, flip_six_hundred


@pytest.fixture
def projector() -> Iterator[KmsProjector]:
    opened = open_projector("kms", "Virtual-1", {"mode": "640x480"}, MonotonicClock())
    assert isinstance(opened, KmsProjector)
    yield opened
    opened.close()


@pytest.mark.parametrize("beside", [nullcontext, decoding_and_writing], ids=["alone", "under-load"])
def test_six_hundred_flips_and_none_skipped(
    projector: KmsProjector, beside: Callable[[], AbstractContextManager[None]]
) -> None:
    """Both processes have the same priority and share one processor."""
    with beside():
        assert flip_six_hundred(projector) == 0
