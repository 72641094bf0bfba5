"""Measuring how a rig keeps time, and keeping it in the rig file."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanner.clock import VirtualClock
from scanner.errors import ConfigError, StorageError
from scanner.wire import ScanStart
from service.config import RigConfig, load_rig, simulated_rig
from service.rig_file_edit import set_values
from service.scan_setup import open_rig, sequence_for
from service.sync_measure import Sync, measure_sync

RIG = """# my rig
[camera]
driver = "simulated"  # a comment
device = "quick/board"

[projector]
driver = "simulated"
# about this projector
device = "quick/board"
{more}
[daemon]
workers = 1
"""


def measured(device: str) -> Sync:
    return measure_sync(simulated_rig(device), VirtualClock(), lambda _: None)


@pytest.mark.parametrize("latency_us", [0, 4_000, 21_000])
def test_the_measured_latency_holds_the_true_one(latency_us: int) -> None:
    found = measured(f"quick/board?latency_us={latency_us}&latency_spread_us=200&declare_latency=false")
    assert found.latency.low_ns <= 1000 * latency_us <= found.latency.high_ns
    assert found.latency.high_ns - found.latency.low_ns < 3_000_000
    assert found.refused is None
    assert found.plan is not None
    assert found.plan["why"]["trigger_delay_ns"].startswith("measured")
    low, high = found.rig_lines()["latency_us"]
    assert 1000 * low <= found.latency.low_ns
    assert 1000 * high >= found.latency.high_ns


def test_the_exposure_it_tells_is_the_one_that_a_scan_then_chooses() -> None:
    found = measured("quick/board")
    clock = VirtualClock()
    opened = open_rig(simulated_rig("quick/board").model_dump(mode="json"), clock)
    chosen_ns, told = opened.exposure_for(clock, sequence_for(opened, ScanStart("a")))
    opened.close()
    assert found.exposure.pop("level") == pytest.approx(told.pop("level"), abs=0.01)  # each has frames of its own
    assert found.exposure == told
    assert found.plan is not None
    assert found.plan["exposure_ns"] == pytest.approx(chosen_ns, rel=1e-3)


def test_what_cannot_work_is_told_in_words() -> None:
    """An exposure that the camera cannot reach on this projector's periods."""
    settings = {"exposure_us": 9_000_000.0}
    camera = {"driver": "simulated", "device": "quick/board", "settings": settings}
    rig = RigConfig.model_validate({**simulated_rig("quick/board").model_dump(mode="json"), "camera": camera})
    found = measure_sync(rig, VirtualClock(), lambda _: None)
    assert found.plan is None
    assert found.refused is not None
    assert "outside the camera's" in found.refused


def test_a_static_projector_has_no_latency() -> None:
    with pytest.raises(ConfigError, match="not flipped by the host"):
        measured("quick/board?kind=static")


@pytest.mark.parametrize("more", ["", "latency_us = 7\nsettle_us = [1, 2]  # guessed\n", "settle_us = 3\n\n"])
def test_values_are_put_where_they_belong_and_nothing_else_changes(tmp_path: Path, more: str) -> None:
    path = tmp_path / "rig.toml"
    before = RIG.format(more=more)
    path.write_text(before)
    kept = set_values(path, "projector", {"latency_us": [3500, 4800], "settle_us": [0, 900]})
    assert kept.read_text() == before
    rig = load_rig(path)
    assert rig.projector.latency_us == (3500, 4800)
    assert rig.projector.settle_us == (0, 900)
    left = [line for line in path.read_text().splitlines() if not line.startswith(("latency_us", "settle_us"))]
    assert left == [line for line in before.splitlines() if not line.startswith(("latency_us", "settle_us"))]


@pytest.mark.parametrize(
    "text",
    [
        'camera.driver = "simulated"\nprojector.driver = "simulated"\n',
        '[camera]\ndriver = "simulated"\n[projector]\ndriver = "simulated"\nlatency_us = [\n  1,\n  2,\n]\n',
    ],
)
def test_a_file_written_otherwise_is_left_as_it_was(tmp_path: Path, text: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        set_values(path, "projector", {"latency_us": [1, 2]})
    assert "latency_us = [1, 2]" in caught.value.hint
    assert path.read_text() == text


def test_line_ends_comments_and_links_stay(tmp_path: Path) -> None:
    target, link = tmp_path / "target.toml", tmp_path / "link.toml"
    before = RIG.format(more="latency_us = 7  # guessed\n").replace("\n", "\r\n")
    target.write_bytes(before.encode())
    link.symlink_to(target)
    kept = set_values(link, "projector", {"latency_us": [3500, 4800]})
    assert link.is_symlink()
    assert kept.read_bytes() == before.encode()
    assert target.read_bytes().decode() == before.replace(
        "latency_us = 7  # guessed", "latency_us = [3500, 4800]  # guessed"
    )


def test_a_header_inside_a_text_is_none(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    text = '[rig]\nname = """\n[projector]\nlatency_us = 1\n"""\n' + RIG.format(more="")
    path.write_text(text)
    with pytest.raises(ConfigError, match="by line"):
        set_values(path, "projector", {"latency_us": [1, 2]})
    assert path.read_text() == text


def test_a_read_only_file_is_left(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.format(more=""))
    path.chmod(0o444)
    with pytest.raises(StorageError, match="read-only"):
        set_values(path, "projector", {"latency_us": [1, 2]})
