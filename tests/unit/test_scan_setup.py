"""What a scan projects by default, on any projector; no device is opened."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.errors import ConfigError, DecodeError
from scanner.patterns import McpPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.sequence import Precorrection
from service.rig_patterns import inverse_table
from service.scan_patterns import METHODS, check_length, pattern_for

SIZES = [(320, 240), (640, 360), (854, 480), (912, 1140), (1152, 864), (1280, 800), (1920, 1080), (3840, 2160)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("method", METHODS)
def test_defaults_fit_every_projector(size: tuple[int, int], axis: str, method: str) -> None:
    projector = ProjectorSize(*size)
    pattern = pattern_for(method, {}, axis, projector)  # type: ignore[arg-type]
    sequence = PatternSequence.bracketed(projector, pattern)
    described = pattern.describe()
    assert described.get("axis", described.get("axes")) in (axis, [axis])
    assert sequence.image(len(sequence) // 2).shape == (size[1], size[0])


def test_a_projector_that_is_large_enough_gets_the_published_patterns() -> None:
    projector = ProjectorSize(1152, 864)
    assert pattern_for("pmp", {}, "y", projector) == PmpPattern(axes=("y",), frequencies=(1, 8, 64), shifts=(8, 8, 8))
    assert pattern_for("mcp", {}, "y", projector) == McpPattern(axis="y")


def test_given_members_go_before_defaults() -> None:
    projector = ProjectorSize(1152, 864)
    pattern = pattern_for("pmp", {"frequencies": [1, 5], "axes": ["x", "y"]}, "y", projector)
    assert pattern == PmpPattern(axes=("x", "y"), frequencies=(1, 5), shifts=(8, 8))
    with pytest.raises(DecodeError, match="shifts"):
        pattern_for("pmp", {"shifts": [2, 2, 2]}, "y", projector)


def test_what_is_no_method() -> None:
    with pytest.raises(ConfigError, match="laser") as caught:
        pattern_for("laser", {}, "y", ProjectorSize(640, 480))
    assert "pmp" in str(caught.value.hint)
    with pytest.raises(ConfigError, match="too small"):
        pattern_for("mcp", {}, "y", ProjectorSize(16, 12))


@pytest.mark.parametrize(("images", "repeat", "said"), [(200_000, 1, "images"), (31, 10_000, "310000 frames")])
def test_a_scan_without_end_is_refused(images: int, repeat: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_length(images, repeat)
    check_length(1, 1_000_000)
    check_length(31, 1000)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_the_inverse_of_a_response_makes_light_linear(gamma: float) -> None:
    light = (np.arange(256) / 255) ** gamma
    values = Precorrection(table=inverse_table(light)).apply(np.linspace(0, 1, 256, dtype=np.float32))
    steps = np.diff(light).max()
    assert np.abs(light[values] - np.linspace(0, 1, 256)).max() <= steps


@pytest.mark.parametrize("table", [[0.0] * 256, list(np.linspace(1, 0, 256)), [0.0, 1.0], list(np.linspace(0, 2, 256))])
def test_what_is_no_response(table: list[float]) -> None:
    with pytest.raises(ConfigError, match="rising"):
        inverse_table(table)


@pytest.mark.parametrize(
    ("method", "given", "says"),
    [
        ("pmp", {"frequencys": [1, 8]}, "did you mean 'frequencies'"),
        ("pmp", {"axis": "q"}, "did you mean 'axes'"),
        ("mcp", {"bitz": 3}, "did you mean 'bits'"),
        ("gray", {"zzz": 1}, "its members"),
    ],
)
def test_a_member_that_says_nothing_is_refused(method: str, given: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match="says nothing") as caught:
        pattern_for(method, given, "y", ProjectorSize(1152, 864))
    assert says in (caught.value.hint or "")


@pytest.mark.parametrize(
    ("method", "given", "says"),
    [
        ("pmp", {"axes": 5}, '"axes"'),
        ("pmp", {"axes": ["q"]}, '"axes"'),
        ("mcp", {"axis": 5}, '"axis"'),
        ("pmp", {"frequencies": 8}, '"frequencies"'),
        ("gray+pmp", {"frequencies": ["many"]}, '"frequencies"'),
        ("gray", {"bits": 1.5}, '"bits"'),
    ],
)
def test_a_member_of_the_wrong_kind_is_refused_by_name(method: str, given: dict[str, object], says: str) -> None:
    with pytest.raises(DecodeError, match=says):
        pattern_for(method, given, "y", ProjectorSize(1152, 864))


def test_a_description_may_be_given_back_as_it_was_written() -> None:
    projector = ProjectorSize(1152, 864)
    for method in ("pmp", "mcp", "gray", "cp"):
        pattern = pattern_for(method, {}, "y", projector)
        sequence = PatternSequence.bracketed(projector, pattern)
        assert pattern_for(method, sequence.describe(), "y", projector) == pattern


@pytest.mark.parametrize("frequencies", [[8.0, 64.0], [6.0]])
def test_fringes_that_nothing_can_unwrap_are_refused_before_a_frame_is_taken(frequencies: list[float]) -> None:
    with pytest.raises(DecodeError, match="do not tell one end of the projector from the other"):
        pattern_for("pmp", {"frequencies": frequencies}, "y", ProjectorSize(1152, 864))
    assert pattern_for("pmp", {"frequencies": [59.0, 64.0, 70.0]}, "y", ProjectorSize(1152, 864)).fringe_count == 24
