"""The simulated world in time: who shares it, what an exposure sees, what the projector and the camera promise."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from drivers.simulated import camera_driver, projector_driver
from drivers.simulated.timeline import LoadedImage, Timeline
from scanner.clock import VirtualClock
from scanner.devices import CameraSettings, KnowsTruth, ProjectorKind, TriggerMode
from scanner.errors import ConfigError, DeviceBusy, DeviceError
from tests.unit.simulated_bench import SECOND_NS, Bench

REFRESH_NS = 16_666_667


def mean_of(frame: np.ndarray) -> float:
    return float(frame[100:140, 140:180].mean())


def levels(bench: Bench) -> tuple[float, float]:
    """Mean of a black and of a white frame."""
    black, white = bench.captured([np.full((240, 320), v, dtype=np.uint8) for v in (0, 255)])
    return mean_of(black), mean_of(white)


def change_seen(bench: Bench, exposure_start_to_change_ns: float, exposure_ns: int = 10_000_000) -> np.ndarray:
    """Black to white in an exposure that begins so long before the declared middle of the change."""
    bench.greys(0, 255)
    bench.start(TriggerMode.SOFTWARE, exposure_ns)
    bench.steady(0)
    flip = bench.projector.show(1)
    latency = bench.projector.capabilities.latency
    trigger = bench.camera.capabilities.trigger_latency
    assert latency is not None
    assert trigger is not None
    change = flip.t_ns + (latency.low_ns + latency.high_ns) / 2
    bench.clock.sleep_until(int(change - exposure_start_to_change_ns - (trigger.low_ns + trigger.high_ns) / 2))
    pixels = bench.shot().pixels.astype(np.float64)
    bench.camera.stop()
    return pixels


# --- who shares a world --------------------------------------------------------------------------------------------


def test_same_string_and_clock_share_a_world_and_others_do_not() -> None:
    bench = Bench("quick/board?noise=false")
    black, white = levels(bench)
    assert white > 5 * black
    stranger = projector_driver.open("quick/board?noise=false", {}, VirtualClock())
    stranger.load([np.zeros((240, 320), dtype=np.uint8)])
    stranger.show(0)
    bench.start(TriggerMode.SOFTWARE)
    assert mean_of(bench.shot().pixels) == pytest.approx(white, abs=1)


def test_defaults_are_casey2011_and_the_bust() -> None:
    assert "casey2011/bust" in projector_driver.open("", {}, VirtualClock()).name
    assert "casey2011/board" in projector_driver.open("board", {}, VirtualClock()).name
    assert "quick/bust" in projector_driver.open("quick", {}, VirtualClock()).name


def test_a_world_ends_with_its_devices() -> None:
    clock = VirtualClock()
    first = projector_driver.open("quick/board", {"seed": 1}, clock)
    first.close()
    del first
    gc.collect()
    other = projector_driver.open("quick/board", {"seed": 2}, clock)  # refused in a world of seed 1
    assert "quick/board" in other.name
    other.close()


def test_settings_of_the_world_may_stand_in_either_table_but_not_differ() -> None:
    clock = VirtualClock()
    camera = camera_driver.open("quick/board", {"seed": 3, "ambient": 0.1}, clock)
    with pytest.raises(ConfigError, match="seed is 4 here and 3") as caught:
        projector_driver.open("quick/board", {"seed": 4}, clock)
    assert caught.value.hint
    projector_driver.open("quick/board", {"seed": 3}, clock).close()
    camera.close()


def test_a_device_is_held_by_one_at_a_time() -> None:
    clock = VirtualClock()
    camera = camera_driver.open("quick/board", {}, clock)
    with pytest.raises(DeviceBusy):
        camera_driver.open("quick/board", {}, clock)
    camera.close()
    camera_driver.open("quick/board", {}, clock).close()


@pytest.mark.parametrize(
    ("device", "options", "message", "hint"),
    [
        ("quack/board", {}, "no simulated rig named 'quack'", "did you mean 'quick'"),
        ("quick/bord", {}, "no simulated scene named 'bord'", "did you mean 'board'"),
        ("quick/board?ambint=1", {}, "unknown option 'ambint'", "did you mean 'ambient'"),
        ("quick/board?seed", {}, "bad query field", "options look like"),
        ("quick/board?seed=x", {}, "seed takes a whole number", None),
        ("quick/board?gamma=nan", {}, "gamma is nan", None),
        ("quick/board?bits=17", {}, "must lie in 8 .. 16", None),
        ("quick/board?shutter=roling", {}, "shutter is 'roling'", "did you mean 'rolling'"),
        ("quick/board", {"scan": "rows"}, "unknown option 'scan' of the simulated camera", "known:"),
        ("quick/board", {"faults": {"dropp": [1]}}, "unknown fault 'dropp'", "did you mean 'drop'"),
        ("quick/board", {"faults": 3}, "faults must be a table", None),
        ("quick/board", {"drop": [1.5]}, "drop takes", None),
        ("quick/board", {"noise": "maybe"}, "noise takes true or false", None),
        ("quick/board?order=sideways", {}, "order 'sideways'", "swap:5,6"),
    ],
)
def test_what_is_not_understood_is_named(
    device: str, options: dict[str, object], message: str, hint: str | None
) -> None:
    with pytest.raises(ConfigError) as caught:
        camera_driver.open(device, options, VirtualClock())
    assert message in str(caught.value)
    assert hint is None or hint in (caught.value.hint or "")


def test_drivers_list_a_device_for_each_rig() -> None:
    for driver in (camera_driver, projector_driver):
        found = driver.discover()
        assert [info.device for info in found] == ["casey2011/bust", "bench2026/bust", "quick/bust"]
        assert "board" in found[0].details["scenes"]


def test_what_shines_later_is_not_seen() -> None:
    shown = Timeline()
    first, second = (LoadedImage(np.full((2, 2), value, np.uint8)) for value in (1, 2))
    shown.show(100, first)
    shown.show(200, second)
    assert [segment.image for segment in shown.between(110, 190)] == [first]
    assert [segment.image for segment in shown.between(10, 110)] == [None, first]
    assert [segment.image for segment in shown.between(150, 210)] == [first, second]


# --- what an exposure sees -----------------------------------------------------------------------------------------


def test_level_is_linear_in_exposure_and_gain() -> None:
    bench = Bench("quick/board?noise=false&bits=12")
    bench.greys(150)
    bench.steady(0)
    seen = []
    for exposure_ns, gain_db in ((20_000_000, 0.0), (10_000_000, 0.0), (10_000_000, 20 * np.log10(2))):
        bench.camera.apply(CameraSettings(exposure_ns=exposure_ns, gain_db=gain_db))
        bench.camera.start(TriggerMode.SOFTWARE)
        seen.append(mean_of(bench.shot().pixels))
        bench.camera.stop()
    assert seen[1] == pytest.approx(seen[0] / 2, rel=2e-3)
    assert seen[2] == pytest.approx(seen[0], rel=2e-3)


def test_ambient_light_is_there_without_the_projector() -> None:
    bench = Bench("quick/board?noise=false&bits=12&ambient=0.2")
    black, white = levels(bench)
    assert black / (white - black) == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("up_s", [1, 86_400, 100 * 86_400])
@pytest.mark.parametrize("share", [0.25, 0.75])
def test_a_change_within_an_exposure_gives_a_blended_frame(share: float, up_s: int) -> None:
    """On a machine that started a second ago, a day or a hundred days."""
    bench = Bench("quick/board?noise=false&bits=12&latency_us=14000&latency_spread_us=1&settle_us=2", up_s=up_s)
    black, white = levels(bench)
    scale = 10_000_000 / 33_333_000
    seen = mean_of(change_seen(bench, share * 10_000_000))
    assert (seen - black * scale) / ((white - black) * scale) == pytest.approx(1 - share, abs=2e-3)


@pytest.mark.parametrize("options", ["shutter=global", "shutter=rolling", "scan=rows", "modulation=pwm"])
def test_the_first_image_may_come_within_an_exposure(options: str) -> None:
    bench = Bench(f"quick/board?noise=false&bits=12&{options}")
    bench.greys(255)
    bench.start(TriggerMode.SOFTWARE, 100_000_000)
    dark = mean_of(bench.shot().pixels)
    bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS)
    bench.camera.trigger()
    bench.projector.show(0)
    assert mean_of(bench.popped().pixels) > 3 * dark


def test_light_lies_within_the_declared_latency_and_settle() -> None:
    """Exposures that end before the earliest change or begin after the latest see one image only."""
    for seed in range(3):
        bench = Bench(f"quick/board?noise=false&bits=12&latency_us=14000&seed={seed}")
        black, white = levels(bench)
        c = bench.projector.capabilities
        assert c.latency is not None
        assert c.settle is not None
        half = (c.latency.high_ns - c.latency.low_ns) / 2
        before = mean_of(change_seen(bench, 10_000_000 + half + 20_000)) * 3.3333
        after = mean_of(change_seen(bench, -(half + c.settle.high_ns + 20_000))) * 3.3333
        assert before == pytest.approx(black, abs=3)
        assert after == pytest.approx(white, abs=3)


def test_a_rolling_shutter_sees_the_change_run_down_the_frame() -> None:
    bench = Bench(
        "quick/board?noise=false&bits=12&shutter=rolling&readout_us=8000&latency_us=14000&latency_spread_us=1&settle_us=2"
    )
    seen = change_seen(bench, 9_000_000)[:, 150:170].mean(axis=1)
    assert seen[-5:].mean() > 4 * seen[:5].mean()
    assert (np.diff(seen[5:-5]) > -2).all()


def test_a_row_scanned_projector_changes_from_the_top() -> None:
    bench = Bench("quick/board?noise=false&bits=12&scan=rows&latency_spread_us=1&settle_us=200")
    assert bench.projector.capabilities.scan == "rows"
    assert bench.projector.capabilities.modulation_period_ns is None
    seen = change_seen(bench, -4_000_000, exposure_ns=1_000_000)[:, 150:170].mean(axis=1)
    truth = bench.camera.truth().rows[:, 160]
    top, bottom = seen[truth < 240 * 3.5 / 16.67], seen[truth > 240 * 5.6 / 16.67]
    assert top.min() > 4 * bottom.max()


@pytest.mark.parametrize("shutter", ["global", "rolling"])
def test_pulsed_greys_need_whole_periods(shutter: str) -> None:
    bench = Bench(f"quick/board?noise=false&bits=12&modulation=pwm&shutter={shutter}&gamma=1")
    period = bench.projector.capabilities.modulation_period_ns
    assert period == round(REFRESH_NS / 4)
    grey, white = bench.greys(100, 255)
    assert grey is not None
    assert white is not None

    def ratio(exposure_ns: int) -> tuple[float, float]:
        bench.start(TriggerMode.SOFTWARE, exposure_ns)
        seen = []
        for index in (0, 1):
            bench.steady(index)
            seen.append(bench.shot().pixels[80:160, 150:170].mean(axis=1) - 0.04 * 800 * exposure_ns / 33_333_333)
        bench.camera.stop()
        shares = seen[0] / seen[1]
        return float(shares.min()), float(shares.max())

    whole = ratio(4 * period)
    assert whole == pytest.approx((100 / 255, 100 / 255), abs=0.03)
    low, high = ratio(period // 2)
    assert max(abs(low - 100 / 255), abs(high - 100 / 255)) > 0.05


def test_the_projector_starts_dark_and_closing_leaves_it_dark() -> None:
    bench = Bench("quick/board?noise=false")
    bench.start(TriggerMode.SOFTWARE)
    dark = mean_of(bench.shot().pixels)
    bench.greys(255)
    bench.steady(0)
    assert mean_of(bench.shot().pixels) > 5 * dark
    bench.projector.close()
    bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS)
    assert mean_of(bench.shot().pixels) == pytest.approx(dark, abs=0.6)


# --- what the devices promise --------------------------------------------------------------------------------------


def test_an_unmeasured_projector_still_has_its_latency() -> None:
    bench = Bench("quick/board?declare_latency=false&noise=false")
    c = bench.projector.capabilities
    assert (c.latency, c.settle) == (None, None)
    bench.greys(0, 255)
    bench.start(TriggerMode.SOFTWARE, 1_000_000)
    bench.steady(0)
    flip = bench.projector.show(1)
    bench.clock.sleep_until(flip.t_ns + 2_000_000)
    assert mean_of(bench.shot().pixels) < 1
    bench.clock.sleep_until(flip.t_ns + 10_000_000)
    assert mean_of(bench.shot().pixels) > 4


def test_a_static_projector_holds_one_image() -> None:
    projector = projector_driver.open("quick/board", {"kind": "static"}, VirtualClock())
    assert projector.capabilities.kind is ProjectorKind.STATIC
    image = np.zeros((240, 320), dtype=np.uint8)
    projector.load([image])
    with pytest.raises(DeviceError, match="one image"):
        projector.load([image, image])


def test_frames_are_lost_when_the_buffers_are_full_and_their_ids_tell() -> None:
    bench = Bench("quick/board?buffers=3")
    bench.start(TriggerMode.FREE, 10_000_000)
    bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS)
    ids = [bench.popped().frame_id for _ in range(5)]
    assert ids[:3] == [0, 1, 2]
    assert ids[3] > 50
    assert ids[4] == ids[3] + 1


def test_triggers_are_counted_also_those_that_are_dropped() -> None:
    bench = Bench("quick/board")
    bench.start(TriggerMode.SOFTWARE)
    bench.camera.trigger()
    bench.camera.trigger()
    assert bench.popped().trigger == 0
    second = bench.shot()
    assert (second.trigger, second.frame_id) == (2, 1)
    assert Bench("quick/board?counts_triggers=false").camera.name


def test_the_same_seed_gives_the_same_frames() -> None:
    def run(seed: int) -> list[np.ndarray]:
        bench = Bench(f"quick/sphere_board?seed={seed}")
        return bench.captured([np.full((240, 320), v, dtype=np.uint8) for v in (40, 200)])

    a, b, c = run(1), run(1), run(2)
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a[0], c[0])


def test_pixel_formats_set_the_bits() -> None:
    bench = Bench("quick/board")
    taken = bench.camera.apply(CameraSettings(pixel_format="Mono12"))
    assert taken.pixel_format == "Mono12"
    assert bench.camera.capabilities.max_value == 4095
    bench.start(TriggerMode.SOFTWARE)
    assert bench.shot().pixels.dtype == np.uint16


def test_a_ring_hands_out_the_same_frames_in_turn_without_copying() -> None:
    bench = Bench("quick/board", camera={"ring": 3, "period_us": 0})
    bench.greys(255)
    bench.steady(0)
    bench.start(TriggerMode.FREE)
    frames = [bench.popped() for _ in range(6)]
    assert [f.frame_id for f in frames] == list(range(6))
    for early, late in zip(frames[:3], frames[3:], strict=True):
        assert early.pixels is late.pixels
    assert not np.array_equal(frames[0].pixels, frames[1].pixels)
    assert mean_of(frames[0].pixels) > 150
    timed = Bench("quick/board", camera={"ring": 2, "period_us": 2000.0})
    timed.start(TriggerMode.FREE, 1_000_000)
    starts = [timed.popped().exposure.start_ns for _ in range(4)]
    assert np.diff(starts) == pytest.approx([2_000_000] * 3, abs=2000)


def test_the_camera_knows_the_truth() -> None:
    bench = Bench("quick/sphere_board")
    assert isinstance(bench.camera, KnowsTruth)
    assert bench.camera.true_calibration().camera.size == (320, 240)


def test_the_projector_has_one_mode() -> None:
    clock = VirtualClock()
    with pytest.raises(ConfigError, match="one mode, 320x240"):
        projector_driver.open("quick/board", {"mode": "640x480"}, clock)
    projector_driver.open("quick/board", {"mode": "320x240@60"}, clock).close()
