"""The contract of projectors, as a test class: see `suite`."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest

from scanner.clock import Clock
from scanner.devices import (
    Projector,
    ProjectorKind,
)
from scanner.errors import DeviceError


@dataclass
class ProjectorBench:
    """An open projector that nobody looks at."""

    projector: Projector
    clock: Clock

    def images(self, count: int) -> list[np.ndarray]:
        """Plain images of different greys, as many as its kind holds of `count`."""
        c = self.projector.capabilities
        count = 1 if c.kind is ProjectorKind.STATIC else count
        return [np.full((c.height, c.width), 40 * (i + 1), dtype=np.uint8) for i in range(count)]


class ProjectorContract:
    """What every `Projector` keeps."""

    def test_is_a_projector_with_sane_capabilities(self, bench: ProjectorBench) -> None:
        c = bench.projector.capabilities
        assert isinstance(bench.projector, Projector)
        assert bench.projector.name
        assert c.width > 0
        assert c.height > 0
        assert c.refresh_ns > 0
        assert c.modulation_period_ns is None or 0 < c.modulation_period_ns <= c.refresh_ns
        for interval in (c.latency, c.settle):
            assert interval is None or 0 <= interval.low_ns <= interval.high_ns

    def test_flips_lie_on_the_vertical_blanks_it_declares(self, bench: ProjectorBench) -> None:
        projector = bench.projector
        images = bench.images(3)
        projector.load(images)
        flips = [projector.show(i % len(images)) for i in range(6)]
        refresh = projector.capabilities.refresh_ns
        for before, after in itertools.pairwise(flips):
            blanks = after.vblank - before.vblank
            assert blanks >= 1
            slack = before.bound_ns + after.bound_ns + refresh // 1000
            assert abs(after.t_ns - before.t_ns - blanks * refresh) <= slack

    def test_show_returns_once_the_flip_has_happened(self, bench: ProjectorBench) -> None:
        bench.projector.load(bench.images(2))
        called = bench.clock.now_ns()
        flip = bench.projector.show(0)
        assert called - flip.bound_ns <= flip.t_ns <= bench.clock.now_ns() + flip.bound_ns

    def test_a_flip_waits_for_the_next_blank_only(self, bench: ProjectorBench) -> None:
        """A machine may be late now and then; a driver that waits for a later blank always is."""
        images = bench.images(2)
        bench.projector.load(images)
        waits = []
        for attempt in range(5):
            called = bench.clock.now_ns()
            flip = bench.projector.show(attempt % len(images))
            waits.append(flip.t_ns - called - flip.bound_ns)
            if waits[-1] <= 2 * bench.projector.capabilities.refresh_ns:
                return
        pytest.fail(f"every flip was late: {waits} ns")

    def test_load_takes_its_own_size_only(self, bench: ProjectorBench) -> None:
        c = bench.projector.capabilities
        with pytest.raises(DeviceError):
            bench.projector.load([np.zeros((c.height, c.width + 1), dtype=np.uint8)])

    def test_load_copies_or_keeps_what_it_was_given(self, bench: ProjectorBench) -> None:
        """Loading again replaces what was there, and images are the caller's own afterwards."""
        images = bench.images(2)
        bench.projector.load(images)
        images[0][:] = 0
        bench.projector.load(bench.images(1))
        bench.projector.show(0)
        with pytest.raises(DeviceError):
            bench.projector.show(1)

    def test_an_image_that_is_not_loaded_is_an_error(self, bench: ProjectorBench) -> None:
        bench.projector.load(bench.images(1))
        for index in (1, -1):
            with pytest.raises(DeviceError):
                bench.projector.show(index)

    def test_closes_twice_and_then_refuses(self, bench: ProjectorBench) -> None:
        bench.projector.load(bench.images(1))
        bench.projector.close()
        bench.projector.close()
        with pytest.raises(DeviceError):
            bench.projector.show(0)
