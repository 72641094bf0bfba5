"""The preview between scans: pictures on a socket, exposed so that something can be seen in them."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zmq

from scanner.sequencer import Rig
from scanner.wire_images import decode_preview
from service.pipe import Preview
from service.preview import BRIGHT, DARK, LONGEST_NS, UNWATCHED_NS, Previewer, better_exposure
from tests.unit.simulated_bench import SECOND_NS, Bench


def shown(device: str, folder: Path, exposure_us: float | str | None, pictures: int) -> list[float]:
    """Levels, 0 .. 1, of the first pictures of a preview."""
    bench = Bench(device)
    rig = Rig(projector=bench.projector, camera=bench.camera)
    endpoint = f"ipc://{folder}/preview.ipc"
    with zmq.Context() as context, context.socket(zmq.SUB) as heard:
        heard.setsockopt(zmq.LINGER, 0)
        heard.setsockopt(zmq.SUBSCRIBE, b"")
        previewer = Previewer(rig, bench.clock, Preview(endpoint, 10.0, 400), exposure_us)
        heard.connect(endpoint)
        levels: list[float] = []
        begun = bench.clock.now_ns()
        while len(levels) < pictures:
            previewer.show()
            bench.clock.sleep_until(bench.clock.now_ns() + 100_000_000)
            # Pictures before the subscription counts are lost, and the first ones may be dark: not yet lit.
            while bench.clock.now_ns() > begun + SECOND_NS and heard.poll(20):
                levels.append(float(np.percentile(np.frombuffer(decode_preview(heard.recv())[1], np.uint8), 99)) / 255)
        previewer.close()
    bench.camera.close()
    bench.projector.close()
    return levels


@pytest.mark.parametrize("scale", [12.0, 0.1])
def test_pictures_find_their_own_exposure(scale: float, tmp_path: Path) -> None:
    levels = shown(f"quick/board?exposure_scale={scale}", tmp_path, "auto", 24)
    assert DARK <= levels[-1] <= BRIGHT
    assert levels[-1] == pytest.approx(levels[-2], abs=0.03)  # found, and left alone


@pytest.mark.parametrize("scale", [12.0, 0.1])
def test_the_first_picture_is_lit_and_exposed_like_those_after_it(scale: float, tmp_path: Path) -> None:
    levels = shown(f"quick/board?exposure_scale={scale}", tmp_path, "auto", 3)
    assert levels == pytest.approx([levels[-1]] * 3, abs=0.03)  # figures of others are no measure: "best" would stay


def test_a_rig_files_exposure_is_kept(tmp_path: Path) -> None:
    levels = shown("quick/board?exposure_scale=12", tmp_path, 2000.0, 14)
    assert levels[-2:] == pytest.approx([230 / 255 * 12 * 2 / 33.333] * 2, abs=0.05)


def test_without_anybody_who_looks_the_light_goes_out_until_there_is_somebody(tmp_path: Path) -> None:
    bench = Bench("quick/board")
    endpoint = f"ipc://{tmp_path}/preview.ipc"
    rig, wanted = Rig(projector=bench.projector, camera=bench.camera), Preview(endpoint, 10.0, 400)
    previewer = Previewer(rig, bench.clock, wanted, 9e3)
    assert previewer.is_of(Preview(endpoint, 10.0, 400), rig)
    assert not previewer.is_of(Preview(endpoint, 20.0, 400), rig)
    assert not previewer.is_of(wanted, Rig(projector=bench.projector, camera=bench.camera)), "opened anew"
    loaded: list[int] = []
    load = bench.projector.load
    with pytest.MonkeyPatch.context() as patch, zmq.Context() as context:
        patch.setattr(bench.projector, "load", lambda images: loaded.append(int(images[0].max())) or load(images))
        for _ in range(2):
            with context.socket(zmq.SUB) as watching:
                watching.setsockopt(zmq.LINGER, 0)
                watching.setsockopt(zmq.SUBSCRIBE, b"")
                watching.connect(endpoint)
                shows(previewer, bench, lambda watching=watching: watching.poll(1))
                assert loaded[-1] == 255
                bench.clock.sleep_until(bench.clock.now_ns() + 2 * UNWATCHED_NS)
                previewer.show()
                assert not previewer.resting, "somebody looks"
            shows(previewer, bench, lambda: previewer.resting)
            assert loaded[-1] == 0
            assert previewer.rest(), "the projector holds what no scan loaded"
        assert not previewer.rest()
        assert loaded == [255, 0, 255, 0]
    previewer.close()
    bench.camera.close()
    bench.projector.close()


def shows(previewer: Previewer, bench: Bench, until: Callable[[], object]) -> None:
    """Pictures, a second apart, until something is so: ZeroMQ's own threads take some milliseconds."""
    for _ in range(1000):
        previewer.show()
        if until():
            return
        time.sleep(0.002)
        bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS)
    pytest.fail("it never came")


def test_exposure_has_bounds(tmp_path: Path) -> None:
    capabilities = Bench("quick/board").camera.capabilities
    white, black = np.full((9, 9), 255, np.uint8), np.zeros((9, 9), np.uint8)
    assert better_exposure(white, capabilities.exposure_min_ns, capabilities) is None
    assert better_exposure(black, LONGEST_NS, capabilities) is None
    assert better_exposure(black, 10_000_000, capabilities) == 40_000_000
    assert better_exposure(white, 10_000_000, capabilities) == 4_000_000
    assert better_exposure(np.full((9, 9), 128, np.uint8), 10_000_000, capabilities) is None
