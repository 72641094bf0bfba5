"""Stages of a decoder as pictures: told in order, drawn as what they are, left behind by a failure."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scanner.decode import decoder_for
from scanner.decode.mcp.casey2011.shown import STAGES
from scanner.decode.stages import Look, Stage
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.stage_pictures import PLOT_SIZE, StageFolder, label_colours, stage_picture
from service import cli

PATTERN = McpPattern(bits=2, carriers=(20.0, 34.0), codes=(0, 1, 2, 3), levels="composite")
SIZE = ProjectorSize(256, 192)
CAMERA = CameraFormat(256, 192)


def frame() -> np.ndarray[Any, Any]:
    """The pattern as a camera sees it that is the projector."""
    return np.asarray((10 + PATTERN.fringe(0, SIZE) * 200).astype(np.uint8))


def stages_of(image: np.ndarray[Any, Any]) -> list[Stage]:
    told: list[Stage] = []
    decoder = decoder_for(PatternSequence(SIZE, PATTERN), CAMERA, "casey2011", told.append)
    decoder.add(0, image)
    decoder.finish()
    return told


def test_every_stage_is_told_once_and_in_order() -> None:
    told = stages_of(frame())
    assert list(dict.fromkeys(stage.name.rstrip("-01") for stage in told)) == [
        *("input", "enhanced", "regions", "stripes", "slope", "spectrum", "bands", "channel", "bits", "code"),
        *("code-modal", "hmm", "hmm-modal", "blobs", "growth-mask", "grown", "all-stripes", "2x-4x", "column"),
    ]
    assert len({stage.name for stage in told}) == len(told) == len(STAGES) + 2
    assert all(stage.source.startswith("Casey 2011, ") for stage in told)
    by_name = {stage.name: stage.values for stage in told}
    assert (by_name["input"] == frame()).all()
    assert ((by_name["code"] > 0) <= (by_name["stripes"] > 0)).all()
    # Code words 1, 2, 3 stand on stripes 2, 4, 6.
    assert set(np.unique(by_name["grown"])) == {0, 1, 2, 3}
    for word in (1, 2, 3):
        y, _ = np.nonzero(by_name["grown"] == word)
        assert abs(y.mean() - ((2 * word + 0.5) * 24 - 0.5)) < 1


def test_watching_changes_nothing() -> None:
    plain, watched = (
        decoder_for(PatternSequence(SIZE, PATTERN), CAMERA, "casey2011", observer)
        for observer in (None, lambda _: None)
    )
    for decoder in (plain, watched):
        decoder.add(0, frame())
    one, other = plain.finish(), watched.finish()
    np.testing.assert_array_equal(one.rows, other.rows)
    np.testing.assert_array_equal(one.confidence, other.confidence)


@pytest.mark.parametrize("pattern", [PATTERN, PmpPattern()])
def test_a_decoder_without_stages_says_so(pattern: Any) -> None:
    with pytest.raises(DecodeError, match="'default' has no stages") as refused:
        decoder_for(PatternSequence(SIZE, pattern), CAMERA, "default", lambda _: None)
    assert "--decoder casey2011" in str(refused.value.hint)


def drawn(look: Look, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return stage_picture(Stage("a", "b", "c", look, values))


def test_pictures_show_what_the_values_are() -> None:
    ramp = np.tile(np.arange(100, dtype=np.float32), (50, 1))
    grey = drawn(Look.GREY, ramp)
    assert grey.shape == (50, 100, 3)
    assert (np.diff(grey[0, :, 0].astype(int)) >= 0).all()
    signed = drawn(Look.SIGNED, ramp - 50)
    assert signed[0, 2, 0] > signed[0, 2, 2]
    assert signed[0, 97, 2] > signed[0, 97, 0]
    line = np.zeros((50, 100), np.int32)
    line[20] = 3
    mask = drawn(Look.MASK, line) > 128
    assert mask.any(axis=(1, 2)).nonzero()[0].tolist() == [19, 20, 21]
    labels = drawn(Look.LABELS, line)
    assert (labels[20, 5] == label_colours(3)[3]).all()
    sparse = np.full((50, 100), np.nan, np.float32)
    sparse[20] = -1
    assert (drawn(Look.SIGNED, sparse)[19:22, 5] == drawn(Look.SIGNED, sparse)[20, 5]).all()
    spectrum = np.full((10, 100), 1e-3, np.float32)
    spectrum[:, 40] = 1e3
    assert drawn(Look.SPECTRUM, spectrum).shape == (30, 100, 3)
    assert len(np.unique(label_colours(60), axis=0)) == 61


def test_plots_have_their_curve_where_the_values_are() -> None:
    curve = np.zeros((1, 200))
    curve[0, 100] = 1
    plot = drawn(Look.CURVES, curve)
    assert plot.shape == (PLOT_SIZE[1], PLOT_SIZE[0], 3)
    bright = (plot.max(axis=2) > 200)[:500]
    top = bright.argmax(axis=0)
    peak = int(np.argmin(np.where(bright.any(axis=0) & (np.arange(PLOT_SIZE[0]) > 60), top, 999)))
    assert abs(peak - (60 + 1120 * 100 / 199)) < 5
    dots = drawn(Look.DOTS, np.array([[0.0, 50, 100], [0, 25, 50]]))
    y, x = np.nonzero(dots.max(axis=2) > 200)
    assert np.corrcoef(x[x > 100], y[x > 100])[0, 1] < -0.9
    assert drawn(Look.DOTS, np.zeros((2, 0))).shape == plot.shape


def test_a_failure_leaves_the_stages_up_to_it(tmp_path: Path) -> None:
    folder = StageFolder(tmp_path)
    decoder = decoder_for(PatternSequence(SIZE, PATTERN), CAMERA, "casey2011", folder)
    decoder.add(0, np.random.default_rng(0).integers(0, 255, (192, 256)).astype(np.uint8))
    with pytest.raises(DecodeError):
        decoder.finish()
    index = json.loads((tmp_path / "stages.json").read_text())
    files = [entry["file"] for entry in index["stages"]]
    assert files[:2] == ["01-input.png", "02-enhanced.png"]
    assert sorted(files) == files
    assert {path.name for path in tmp_path.iterdir()} == {*files, "stages.json"}
    assert "code" not in [entry["name"] for entry in index["stages"]]


def capture(folder: Path) -> Path:
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), frame())
    content = {
        "format": "fringed-capture",
        "version": 1,
        "projector": {"width": 256, "height": 192},
        "camera": {"width": 256, "height": 192, "bits": 8},
        "pattern": PATTERN.describe(),
        "frames": ["0.png"],
    }
    (folder / "capture.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def fringed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., int]:
    monkeypatch.chdir(tmp_path)
    return lambda *words: cli.main([str(word) for word in words])


def test_the_command_writes_them(
    fringed: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = capture(tmp_path / "seen")
    assert fringed("decode", seen, "-o", "out", "--decoder", "casey2011", "--stages", "pictures", "--json") == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["folder"] == "out"
    assert "21 stages: pictures" in captured.err
    names = sorted(path.name for path in (tmp_path / "pictures").glob("*.png"))
    assert names[0] == "01-input.png"
    assert names[3] == "04-stripes.png"
    assert names[-1] == "21-column.png"
    assert cv2.imread(str(tmp_path / "pictures" / names[0]), cv2.IMREAD_UNCHANGED).shape == (192, 256, 3)
    assert fringed("decode", seen, "-o", "again", "--decoder", "casey2011", "--stages", "pictures") == 1
    assert "not empty" in capsys.readouterr().err


def test_the_command_refuses_stages_that_are_not_there(
    fringed: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fringed("decode", capture(tmp_path / "seen"), "-o", "out", "--stages", "pictures") == 1
    captured = capsys.readouterr()
    assert "'default' has no stages" in captured.err
    assert "casey2011" in captured.err
    assert {path.name for path in tmp_path.iterdir()} == {"seen"}
