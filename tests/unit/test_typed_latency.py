"""A latency in the rig file that is not the projector's: a scan warns of it, or says so when it fails by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from scanner.capture import Capture
from scanner.capture.exposure import exposure_warnings
from scanner.clock import VirtualClock
from scanner.wire import ScanStart
from service.acquisition import Scan
from service.config import RigConfig
from service.pipe import Ended, Report
from service.scan_setup import OpenRig, open_rig
from service.write_back import WriteBacks

PATTERN = {"frequencies": [1, 8], "shifts": [4, 4]}


def scanned(folder: Path, opened: OpenRig, clock: VirtualClock) -> tuple[Ended, tuple[str, ...]]:
    """How a scan ended, and what its capture warns of."""
    said: list[Report] = []
    backs = WriteBacks()
    params = ScanStart(job_id=folder.name, method="pmp", pattern=dict(PATTERN), exposure=16_667.0)
    scan = Scan(folder.name, folder, params, opened, clock, said.append)
    scan.prepare()
    scan.run(backs)
    backs.wait()
    (ended,) = (report for report in said if isinstance(report, Ended))
    return ended, exposure_warnings(Capture.open(folder).header)


def rig(clock: VirtualClock, **projector: Any) -> OpenRig:
    device = {"driver": "simulated", "device": "quick/board"}
    config = RigConfig.model_validate({"camera": device, "projector": {**device, **projector}})
    return open_rig(config.model_dump(mode="json"), clock)


def test_one_that_is_too_long_is_a_warning_with_the_line_that_mends_it(tmp_path: Path) -> None:
    clock = VirtualClock()
    opened = rig(clock, latency_us=100_000.0, settle_us=400.0)
    for name in ("first", "second"):
        ended, warnings = scanned(tmp_path / name, opened, clock)
        assert ended.reason == "completed"
        (warning,) = warnings
        assert "latency_us, 100.0 ms, is 95." in warning
        assert "too long: every frame waits for it" in warning
        assert "In [projector] write latency_us = [" in warning
    opened.close()


def test_one_that_is_too_short_is_named_where_a_scan_fails_by_it(tmp_path: Path) -> None:
    clock = VirtualClock()
    opened = rig(clock, latency_us=0.0, settle_us=0.0, options={"latency_us": 12_000.0})
    ended, warnings = scanned(tmp_path / "scan", opened, clock)
    assert ended.reason == "sync_lost"
    assert ended.error is not None
    assert "too short: frames may show another pattern" in str(ended.error.data["hint"])
    assert len(warnings) == 1
    opened.close()


@pytest.mark.parametrize("projector", [{}, {"latency_us": [3800, 4600], "settle_us": [0, 1500]}])
def test_one_that_is_right_is_no_matter(tmp_path: Path, projector: dict[str, Any]) -> None:
    clock = VirtualClock()
    opened = rig(clock, **projector)
    assert scanned(tmp_path / "scan", opened, clock)[1] == ()
    assert opened.latency_checked == bool(projector)
    opened.close()


def test_a_rig_whose_light_cannot_be_seen_is_not_refused_for_it() -> None:
    clock = VirtualClock()
    device = {"driver": "simulated", "device": "quick/board?exposure_scale=0.001"}
    config = RigConfig.model_validate({"camera": device, "projector": {**device, "latency_us": 4e4, "settle_us": 0.0}})
    opened = open_rig(config.model_dump(mode="json"), clock)
    opened.measure_latency(clock)
    assert opened.disagreement is None
    opened.close()


def test_light_later_than_any_displays_is_named_where_a_scan_fails_by_it() -> None:
    clock = VirtualClock()
    opened = rig(clock, latency_us=4000.0, settle_us=400.0, options={"latency_us": 150_000.0})
    opened.measure_latency(clock)
    opened.close()
    assert opened.disagreement is not None
    assert opened.disagreement.startswith("the rig file's latency_us is 4.0 ms; ")
    assert "light comes later than 83 ms after a flip: turn off the projector's frame" in opened.disagreement


@pytest.mark.parametrize(
    ("projector", "hint"),
    [
        ({"latency_us": [3800, 4600]}, "take latency_us out of the rig file so that it is measured, or raise dwell"),
        (
            {"latency_us": [3800, 4600], "settle_us": [0, 1500]},
            "take latency_us and settle_us out of the rig file so that they are measured, or raise dwell",
        ),
        ({}, "the projector's latency and settling are those that its driver states: hold them against fringed "),
    ],
)
def test_a_scan_out_of_step_is_told_what_to_do_about_the_times_that_this_rig_has(
    tmp_path: Path, projector: dict[str, Any], hint: str
) -> None:
    clock = VirtualClock()
    opened = rig(clock, **projector, options={"faults": {"late_flips": 5}})
    ended, _ = scanned(tmp_path / "scan", opened, clock)
    opened.close()
    assert ended.reason == "sync_lost"
    assert ended.error is not None
    assert str(ended.error.data["hint"]).startswith(hint)
