"""Faults by configuration: each does what its name says, as often as it may, and says nothing of it."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.simulated.faults import ProjectorFaults, displayed_index
from scanner.devices import CameraFrame, TriggerMode
from scanner.errors import DeviceLost
from tests.unit.simulated_bench import SECOND_NS, Bench

GREYS = (30, 70, 110, 150, 190, 230)


def bench_with(camera: dict[str, object] | None = None, projector: dict[str, object] | None = None) -> Bench:
    bench = Bench(
        "quick/board?noise=false&gamma=1",
        {"faults": camera} if camera else {},
        {"faults": projector} if projector else {},
    )
    bench.greys(*GREYS)
    return bench


def seen_grey(frame: CameraFrame) -> int:
    """Which of GREYS a frame shows."""
    level = float(frame.pixels[100:140, 140:180].mean())
    return int(np.argmin([abs(level - (0.87 * 0.9 * grey + 0.04 * 215)) for grey in GREYS]))


def shown(bench: Bench, indexes: range) -> list[int]:
    """The greys that steady frames of these flips show."""
    bench.start(TriggerMode.SOFTWARE)
    seen = []
    for i in indexes:
        bench.steady(i)
        seen.append(seen_grey(bench.shot()))
    bench.camera.stop()
    return seen


def test_without_faults_every_flip_shows_its_image() -> None:
    assert shown(bench_with(), range(6)) == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("faults", "expected"),
    [
        ({"order": "swap:2,3"}, [0, 1, 3, 2, 4, 5]),
        ({"order": "reverse"}, [5, 4, 3, 2, 1, 0]),
        ({"order": "rotate:1,4"}, [0, 2, 3, 4, 1, 5]),
        ({"order": "rotate:1,4,2"}, [0, 3, 4, 1, 2, 5]),
        ({"permute": [1, 0]}, [1, 0, 2, 3, 4, 5]),
        ({"late_flips": 2}, [0, 0, 0, 1, 2, 3]),
        ({"skip": [3]}, [0, 1, 2, 2, 4, 5]),
        ({"double": [3]}, [0, 1, 2, 2, 3, 4]),
        ({"skip": [2, 3], "times": 1}, [0, 1, 1, 3, 4, 5]),
        ({"order": "reverse", "times": 2}, [5, 4, 2, 3, 4, 5]),
    ],
)
def test_wrong_images(faults: dict[str, object], expected: list[int]) -> None:
    seen = shown(bench_with(projector=faults), range(6))
    if "late_flips" in faults:
        seen, expected = seen[2:], [0, 1, 2, 3]  # before, the screen is black
    assert seen == expected


def test_a_doubled_flip_is_over_when_the_host_begins_again() -> None:
    bench = bench_with(projector={"double": [3]})
    assert shown(bench, range(6)) == [0, 1, 2, 2, 3, 4]
    assert shown(bench, range(6)) == [0, 1, 2, 3, 4, 5]


def test_a_permutation_beyond_the_loaded_images_leaves_the_flip_alone() -> None:
    assert displayed_index(ProjectorFaults(permute=(9, 0)), 0, 2) == 0
    assert displayed_index(ProjectorFaults(permute=(9, 0)), 1, 2) == 0
    assert displayed_index(ProjectorFaults(order="swap:1,5"), 1, 2) == 1


def test_extra_latency_is_not_declared() -> None:
    bench = bench_with(projector={"extra_latency_us": 20000.0, "extra_latency_after": 1})
    latency = bench.projector.capabilities.latency
    assert latency is not None
    assert latency.high_ns < 10_000_000
    bench.start(TriggerMode.SOFTWARE, 5_000_000)
    greys = []
    for index in (5, 0):
        flip = bench.projector.show(index)
        bench.clock.sleep_until(flip.t_ns + 10_000_000)
        greys.append(float(bench.shot().pixels.mean()))
        bench.clock.sleep_until(flip.t_ns + 100_000_000)
    assert greys[1] == pytest.approx(greys[0], rel=0.05)


def test_the_projector_is_unplugged_for_good() -> None:
    bench = bench_with(projector={"unplug_after": 2})
    bench.steady(0)
    bench.steady(1)
    for _ in range(2):
        with pytest.raises(DeviceLost) as caught:
            bench.projector.show(2)
        assert caught.value.hint


def test_the_camera_is_unplugged_for_good() -> None:
    bench = bench_with(camera={"unplug_after": 2})
    bench.start(TriggerMode.SOFTWARE)
    bench.shot()
    bench.shot()
    with pytest.raises(DeviceLost):
        bench.camera.trigger()
    with pytest.raises(DeviceLost):
        bench.camera.pop(0)
    with pytest.raises(DeviceLost):
        bench.camera.start(TriggerMode.SOFTWARE)


@pytest.mark.parametrize(("hides", "ids"), [(False, [0, 1, 3, 4]), (True, [0, 1, 2, 3])])
def test_dropped_frames_leave_a_gap_in_the_ids_unless_it_is_hidden(hides: bool, ids: list[int]) -> None:
    bench = bench_with(camera={"drop": [2], "drop_hides_id": hides})
    bench.start(TriggerMode.FREE, 10_000_000)
    frames = [bench.popped() for _ in range(4)]
    assert [f.frame_id for f in frames] == ids
    gaps = np.diff([f.exposure.start_ns for f in frames])
    assert gaps[1] == pytest.approx(2 * gaps[0], rel=1e-3)


def test_a_dropped_triggered_frame_never_comes_and_the_next_run_is_whole() -> None:
    bench = bench_with(camera={"drop": [1], "times": 1})
    bench.start(TriggerMode.SOFTWARE)
    bench.shot()
    bench.camera.trigger()
    assert bench.camera.pop(SECOND_NS) is None
    bench.camera.stop()
    bench.start(TriggerMode.SOFTWARE)
    assert [bench.shot().frame_id for _ in range(3)] == [0, 1, 2]


def test_drops_by_chance_are_as_frequent_as_asked() -> None:
    bench = Bench("quick/board", {"drop_probability": 0.3, "ring": 1})
    bench.start(TriggerMode.FREE, 1_000_000)
    last = [bench.popped().frame_id for _ in range(300)][-1]
    assert 300 / (last + 1) == pytest.approx(0.7, abs=0.1)


def test_a_camera_that_drops_everything_only_times_out() -> None:
    bench = bench_with(camera={"drop_probability": 1.0})
    bench.start(TriggerMode.FREE, 1_000_000)
    called = bench.clock.now_ns()
    assert bench.camera.pop(SECOND_NS) is None
    assert bench.clock.now_ns() - called == SECOND_NS


def stamped(bench: Bench, flips: int) -> list[tuple[int, CameraFrame]]:
    bench.start(TriggerMode.SOFTWARE)
    found = []
    for i in range(flips):
        bench.steady(i)
        frame = bench.shot()
        found.append((seen_grey(frame), frame))
    return found


def test_a_doubled_frame_has_old_pixels_and_a_new_stamp() -> None:
    found = stamped(bench_with(camera={"double": [2]}), 4)
    assert [grey for grey, _ in found] == [0, 1, 1, 3]
    assert [frame.frame_id for _, frame in found] == [0, 1, 2, 3]
    starts = [frame.exposure.start_ns for _, frame in found]
    assert starts == sorted(starts)


def test_swapped_frames_exchange_their_pixels() -> None:
    bench = bench_with(camera={"swap": [1]})
    bench.start(TriggerMode.SOFTWARE)
    bench.steady(0)
    bench.shot()
    bench.steady(1)
    bench.camera.trigger()
    assert bench.camera.pop(SECOND_NS) is None
    bench.steady(2)
    bench.camera.trigger()
    first, second = bench.popped(), None
    assert (seen_grey(first), first.frame_id) == (2, 1)
    second = bench.popped()
    assert (seen_grey(second), second.frame_id) == (1, 2)


def test_an_incomplete_frame_says_so() -> None:
    bench = bench_with(camera={"incomplete": [1], "times": 1})
    found = stamped(bench, 3)
    assert [frame.complete for _, frame in found] == [True, False, True]


def lateness(bench: Bench) -> list[int]:
    """Stamp of a triggered frame minus its trigger, ns."""
    bench.start(TriggerMode.SOFTWARE, 5_000_000)
    late = []
    for _ in range(4):
        bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS)
        before = bench.clock.now_ns()
        late.append(bench.shot().exposure.start_ns - before)
    return late


def test_a_lying_stamp_is_late_and_claims_to_be_exact() -> None:
    bench = bench_with(camera={"stamp_lie_ns": 7_000_000, "times": 3})
    late = lateness(bench)
    assert all(abs(t - 7_040_000) < 20_000 for t in late[:3])
    assert late[3] < 100_000


def test_jitter_shows_in_true_stamps() -> None:
    late = lateness(bench_with(camera={"jitter_us": 3000.0}))
    assert max(late) > 200_000
    assert min(late) < 3_100_000


def test_a_shifted_phase_does_not_show_in_the_stamps() -> None:
    """The exposure begins half a frame late: its stamp says otherwise, its pixels are of what came after."""
    bench = bench_with(camera={"phase_frames": 0.5})
    bench.start(TriggerMode.SOFTWARE)
    bench.steady(0)
    bench.clock.sleep_until(bench.clock.now_ns() + SECOND_NS)
    asked = bench.clock.now_ns()
    bench.camera.trigger()
    bench.projector.show(5)
    frame = bench.popped()
    assert frame.exposure.start_ns - asked < 100_000
    assert bench.clock.now_ns() - frame.exposure.end_ns > 15_000_000
    assert float(frame.pixels.mean()) > 150


def test_faults_of_both_sides_may_stand_in_the_device_string() -> None:
    bench = Bench("quick/board?drop=1&skip=2&camera.times=0&projector.times=5&noise=false&gamma=1")
    bench.greys(*GREYS)
    assert shown(bench, range(4)) == [0, 1, 1, 3]
