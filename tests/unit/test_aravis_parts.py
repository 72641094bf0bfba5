"""The aravis driver's parts that need neither library nor camera: pixels, clock, options, watch, network, ids."""

from __future__ import annotations

import functools
import itertools
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.aravis import camera_driver, library, reopening
from drivers.aravis.clock_fit import CRYSTAL, ClockFit
from drivers.aravis.frame_ids import FrameIds
from drivers.aravis.network import buffer_bytes, check_buffer, check_network, interface_to
from drivers.aravis.options import AravisOptions
from drivers.aravis.pixels import FORMATS, unpacked
from drivers.aravis.reopening import Reopening
from drivers.aravis.triggers import count_triggers
from drivers.aravis.watch import PROBES, GvcpProbe, Restarted, Watch
from drivers.option_table import read_options
from drivers.simulated.gige_features import PIXEL_FORMATS
from drivers.simulated.gige_pixels import packed, payload_bytes
from scanner.clock import MonotonicClock
from scanner.devices import Interval
from scanner.devices.receive_buffers import enlarging
from scanner.errors import ConfigError, DeviceLost

SECOND_NS = 1_000_000_000


# --- pixels ---------------------------------------------------------------------------------------------------------


@given(
    name=st.sampled_from(sorted(PIXEL_FORMATS)),
    height=st.integers(1, 9),
    width=st.integers(1, 13),
    seed=st.integers(0, 1000),
)
def test_what_a_camera_packs_is_unpacked(name: str, height: int, width: int, seed: int) -> None:
    """The camera's packing is written apart from the driver's unpacking."""
    known, code = FORMATS[name], PIXEL_FORMATS[name]
    frame = np.random.default_rng(seed).integers(0, 1 << known.bits, (height, width)).astype(known.dtype)
    content = np.concatenate((packed(frame, code), np.full(7, 255, np.uint8)))  # chunks follow
    assert known.image_bytes(height * width) in (payload_bytes(code, height * width), len(content) - 7)
    found = unpacked(content, frame.shape, known)
    assert found.dtype == frame.dtype
    assert found.flags.c_contiguous
    assert np.array_equal(found, frame)


def test_unpacked_formats_are_views_and_short_content_is_refused() -> None:
    content = np.zeros(24, np.uint8)
    assert np.shares_memory(unpacked(content, (4, 6), FORMATS["Mono8"]), content)
    with pytest.raises(ValueError, match="23 bytes"):
        unpacked(content[:23], (4, 6), FORMATS["Mono8"])


def test_bayer_frames_keep_their_mosaic() -> None:
    mosaics = {name: FORMATS[f"Bayer{name}12p"].mosaic for name in ("RG", "GR", "GB", "BG")}
    assert mosaics == {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}
    assert FORMATS["Mono12"].mosaic is None


# --- clock ----------------------------------------------------------------------------------------------------------


def latched(ppm: float, seconds: float, seed: int, every_s: float = 0.5) -> tuple[ClockFit, float]:
    """A fit fed with readings of a clock that is `ppm` fast; returns it and the clock's rate."""
    rng, fit, rate = np.random.default_rng(seed), ClockFit(latched=True), 1.0 + ppm * 1e-6
    for t in np.arange(0.0, seconds, every_s):
        for _ in range(4):
            host = int(t * SECOND_NS) + int(rng.integers(1_000_000))
            before, after = rng.integers(20_000, 400_000, 2)
            fit.add(device_at(host, rate), host - int(before), host + int(after))
    return fit, rate


def device_at(host_ns: int, rate: float) -> int:
    return 7_000_000_000_000 + round(host_ns * rate)


@given(ppm=st.floats(-99, 99), seconds=st.floats(0.6, 40), seed=st.integers(0, 10_000))
def test_mapped_times_are_true_within_their_bounds(ppm: float, seconds: float, seed: int) -> None:
    fit, rate = latched(ppm, seconds, seed)
    for ahead_s in (0.0, 0.4, 2.0):
        host = int((seconds + ahead_s) * SECOND_NS)
        at, bound = fit.host(device_at(host, rate))
        assert abs(at - host) <= bound
        assert bound < 400_000 + 2 * CRYSTAL * (ahead_s + 1.0) * SECOND_NS
    assert fit.residual_ns < 400_000


def test_a_long_fit_knows_the_rate() -> None:
    fit, rate = latched(42.0, 30.0, 1)
    assert fit.rate == pytest.approx(1 / rate, abs=5e-6)
    _, near = fit.host(device_at(30 * SECOND_NS, rate))
    short, _ = latched(42.0, 1.0, 1)
    _, far = short.host(device_at(30 * SECOND_NS, rate))
    assert near < far / 10


def test_a_clock_that_jumps_shows_in_the_residual() -> None:
    fit, _ = latched(0.0, 10.0, 3)
    calm = fit.residual_ns
    for i in range(8):
        host = (10 + i) * SECOND_NS
        fit.add(device_at(host, 1.0) + 5_000_000, host - 50_000, host + 50_000)
    assert fit.residual_ns > calm + 1_000_000


def test_arrivals_bound_the_clock_by_the_quickest() -> None:
    rng, fit = np.random.default_rng(5), ClockFit(latched=False, slack_ns=3_000_000)
    for i in range(200):
        host = i * SECOND_NS // 60
        fit.add(device_at(host, 1.0), arrival := host + 1_000_000 + int(rng.exponential(3e6)), arrival)
    at, bound = fit.host(device_at(4 * SECOND_NS, 1.0))
    assert abs(at - 4 * SECOND_NS) <= bound
    assert at - 4 * SECOND_NS < 2_000_000


def test_a_clock_never_compared_says_so() -> None:
    with pytest.raises(ValueError, match="never compared"):
        ClockFit(latched=True).host(0)


# --- ids, options, network --------------------------------------------------------------------------------------------


def test_frame_ids_go_on_where_the_camera_begins_again() -> None:
    ids = FrameIds()
    told = [65_533, 65_534, 65_535, 1, 2, 5]
    assert [ids.next(each) for each in told] == [65_533, 65_534, 65_535, 65_536, 65_537, 65_540]
    late = FrameIds()
    assert [late.next(each) for each in (65_534, 1, 65_535, 2, 65_000)] == [65_534, 65_536, 65_535, 65_537, 65_000]
    extended = FrameIds()
    assert [extended.next(each) for each in (70_000, 70_001)] == [70_000, 70_001]


def test_options_are_read_and_refused_by_name() -> None:
    options = read_options(
        AravisOptions, {"packet_size": 9000, "line_latency_us": [5, 12], "features": {"Gamma": 1.0}}, "cam"
    )
    assert options.packet_size == 9000
    assert options.line_latency == Interval(5_000, 12_000)
    assert read_options(AravisOptions, {}, "cam") == AravisOptions()


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"packet_sise": 1}, "did you mean 'packet_size'"),
        ({"packet_size": 1.5}, "packet_size"),
        ({"packet_size": 100}, "576"),
        ({"resend": 1}, "resend"),
        ({"clock": "ptp"}, "'auto', 'latch' or 'arrival'"),
        ({"trigger_latency_us": [9, 3]}, "[low, high]"),
        ({"features": 3}, "features"),
        ({"trigger_line": 1}, "trigger_line"),
        ({"frame_rate_hz": True}, "frame_rate_hz"),
        ({"loss_ms": float("nan")}, "loss_ms"),
    ],
)
def test_what_is_no_option_is_refused(table: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as raised:
        read_options(AravisOptions, table, "cam")
    assert said in f"{raised.value} {raised.value.hint}"


def test_a_small_receive_buffer_is_named_with_the_command_that_mends_it() -> None:
    frame = 1_447_680
    small = check_buffer(frame, limit=212_992)
    assert not small.ok
    assert small.command == enlarging(frame), "the same line as for any camera that needs no more"
    assert "sysctl -w net.core.rmem_max=67108864" in small.command
    assert "/70-fringed.conf" not in small.command, "the installation's"
    assert f"net.core.rmem_max={buffer_bytes(10 * frame)}" in check_buffer(10 * frame, limit=212_992).command
    assert check_buffer(frame, limit=buffer_bytes(frame)).ok
    assert check_buffer(frame, limit=buffer_bytes(frame)).command == ""


def test_the_way_to_a_camera_is_looked_at() -> None:
    assert interface_to("127.0.0.9") == "lo"
    findings = {finding.subject: finding for finding in check_network("127.0.0.9", 1000, 10.0)}
    assert set(findings) == {"receive buffer", "packet size", "link speed"}
    assert findings["packet size"].ok
    assert findings["link speed"].ok
    assert interface_to("255.255.255.255") is None
    lost = check_network("255.255.255.255", 1000, 10.0)
    assert [finding.ok for finding in lost] == [False]


# --- watch ------------------------------------------------------------------------------------------------------------


class Scripted:
    """A probe that answers as told: True, False, or a restart."""

    def __init__(self, answers: list[bool | None]) -> None:
        self.answers = itertools.chain(answers, itertools.repeat(answers[-1]))
        self.closed = False

    def alive(self, patience_s: float) -> bool:
        answer = next(self.answers)
        if answer is None:
            raise Restarted
        if not answer:
            time.sleep(patience_s)
        return answer

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("answers", "least_s", "said"),
    [
        ([True, False], 0.04, "has not answered"),
        ([False] * (PROBES - 1) + [True] + [False], 0.07, "has not answered"),
        ([True, None], 0.0, "begun anew"),
    ],
)
def test_a_silent_camera_is_lost_and_told_once(answers: list[bool | None], least_s: float, said: str) -> None:
    told, heard, probe, begun = [], threading.Event(), Scripted(answers), time.monotonic()
    watch = Watch(probe, 0.04, lambda what: (told.append(what), heard.set()))
    assert heard.wait(5.0)
    assert time.monotonic() - begun >= least_s
    watch.close()
    assert len(told) == 1
    assert said in told[0]
    assert probe.closed


def test_frames_are_a_sign_of_life() -> None:
    told: list[str] = []
    watch = Watch(Scripted([False]), 0.12, told.append)
    for _ in range(30):
        watch.heard()
        time.sleep(0.008)
    assert told == []
    watch.close()


def test_a_camera_that_no_network_leads_to_is_silent_and_no_error() -> None:
    """As after its cable was pulled: the search for it must go on."""
    probe = GvcpProbe("255.255.255.255")  # broadcasts are refused to a socket that has not asked for them
    assert not probe.alive(0.01)
    probe.close()


# --- lost and found ---------------------------------------------------------------------------------------------------


class FakeLink:
    """A link as far as the search for a lost camera knows it."""

    address = ""

    def __init__(self, on_lost: Callable[[str], None]) -> None:
        self.lost, self.closed, self._on_lost = threading.Event(), False, on_lost

    def lose(self) -> None:
        self.lost.set()
        self._on_lost("gone")

    def loss(self) -> DeviceLost:
        return DeviceLost("gone")

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> tuple[list[FakeLink], Callable[..., Any]]:
    """The links that were opened, and an opener; what is in `troubles` befalls the next ones."""
    monkeypatch.setattr(reopening, "PAUSE_S", 0.001)
    links: list[FakeLink] = []

    def opener(device: str, on_lost: Callable[[str], None], troubles: list[str]) -> FakeLink:
        trouble = troubles.pop(0) if troubles else ""
        if trouble == "no network":
            raise OSError(101, "Network is unreachable")
        links.append(FakeLink(on_lost))
        if trouble == "lost at once":
            links[-1].lose()
        return links[-1]

    return links, opener


def test_a_camera_lost_while_it_is_opened_is_not_looked_for(opened: tuple[list[FakeLink], Callable[..., Any]]) -> None:
    links, opener = opened
    with pytest.raises(DeviceLost):
        Reopening("cam", functools.partial(opener, troubles=["lost at once"]), "cam")
    assert [link.closed for link in links] == [True]
    assert not [one for one in threading.enumerate() if one.name == "aravis finder"]


def test_a_lost_camera_is_looked_for_whatever_befalls_the_search(
    opened: tuple[list[FakeLink], Callable[..., Any]],
) -> None:
    links, opener = opened
    hold = Reopening("cam", functools.partial(opener, troubles=["", "no network", "lost at once"]), "cam")
    links[0].lose()
    until = time.monotonic() + 5
    while len(links) < 3 or hold.newest is not links[2]:
        assert time.monotonic() < until
        time.sleep(0.001)
    assert hold.losses == 1
    hold.close()
    assert [link.closed for link in links] == [True] * 3


# --- triggers ---------------------------------------------------------------------------------------------------------


class FakeFeatures:
    """A camera whose counter has an event for each kind of edge."""

    def __init__(self) -> None:
        self.values: dict[str, object] = {}

    def has(self, feature: str) -> bool:
        return True

    def entries(self, feature: str) -> list[str]:
        events = ["Line0RisingEdge", "Line0FallingEdge"]
        return {"CounterEventSource": events, "ChunkSelector": ["CounterValue"]}.get(feature, [])

    def set(self, feature: str, value: object) -> None:
        self.values[feature] = value

    def set_if_there(self, feature: str, value: object) -> None:
        self.values[feature] = value

    def execute_if_there(self, command: str) -> None:
        self.values[command] = "executed"


@pytest.mark.parametrize("edge", ["RisingEdge", "FallingEdge"])
def test_the_edges_that_fire_the_camera_are_those_counted(edge: str) -> None:
    features = FakeFeatures()
    assert count_triggers(features, "Line0", AravisOptions(trigger_activation=edge))  # type: ignore[arg-type]
    assert features.values["CounterEventSource"] == f"Line0{edge}"


# --- without the library ----------------------------------------------------------------------------------------------


def test_without_the_library_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    library.aravis.cache_clear()
    monkeypatch.setitem(sys.modules, "gi", None)
    try:
        with pytest.raises(ConfigError) as raised:
            camera_driver.open("127.0.0.2", {}, MonotonicClock())
        assert "gir1.2-aravis-0.8" in str(raised.value.hint)
        assert camera_driver.discover() == []
    finally:
        library.aravis.cache_clear()
