"""A response from flat grey levels: exponents and tables found again, and what cannot show one."""

from __future__ import annotations

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from scanner.calibration.grey_levels import LEVELS, response_of_levels
from scanner.errors import CalibrationError
from scanner.patterns.sequence import Precorrection
from service.cli import main
from service.commands import calibrate_response
from service.rig_patterns import inverse_table

SHAPE = (60, 80)


def bent(value):
    """No exponent: a foot and a shoulder, as picture modes have them."""
    x = np.asarray(value) / 255.0
    return 0.5 - 0.5 * np.cos(np.pi * x**1.4)


def shots(response, levels=LEVELS, noise=0.8, ambient=9.0, drift=0.0, flicker=0.0, seed=1):
    random = np.random.default_rng(seed)
    albedo = np.where(np.mgrid[: SHAPE[0], : SHAPE[1]][1] > 70, 0.02, random.uniform(0.5, 1.0, SHAPE))
    lights = 1 + drift * np.arange(len(levels)) / len(levels) + flicker * random.normal(size=len(levels))
    grey = [
        ambient + 200 * albedo * response(v) * lamp + random.normal(0, noise, SHAPE)
        for v, lamp in zip(levels, lights, strict=True)
    ]
    return [np.rint(np.clip(g, 0, 255)).astype(np.uint8) for g in grey]


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.3])
def test_an_exponent_is_found_again(gamma):
    found = response_of_levels(LEVELS, shots(lambda v: (v / 255) ** gamma), 255)
    assert found.gamma == pytest.approx(gamma, abs=max(5 * found.sigma, 0.005))
    assert found.sigma < 0.01
    assert found.response == {"gamma": pytest.approx(gamma, abs=0.01)}
    assert found.pixels == 60 * 71


def test_an_exponent_is_no_surer_than_rounding_lets_it_be():
    """Without noise and texture all pixels are rounded alike, and the fit's own remainder may come out as nothing."""
    albedo = np.ones(SHAPE)
    told = []
    for white in range(60, 240, 20):
        frames = [np.rint(albedo * white * v / 255).astype(np.uint8) for v in LEVELS]
        found = response_of_levels(LEVELS, frames, 255)
        told.append((found.gamma - 1) / found.sigma)
        assert 0.2 / white < found.sigma < 1.0 / white
    assert np.abs(told).max() < 3
    sixteen = [np.full(SHAPE, 200 * v, np.uint16) for v in LEVELS]
    assert response_of_levels(LEVELS, sixteen, 65535).sigma == 1e-4  # four decimals are kept


def test_another_response_comes_as_a_table_that_undoes_it():
    found = response_of_levels(LEVELS, shots(bent), 255)
    table = found.response["table"]
    np.testing.assert_allclose(table, bent(np.arange(256)), atol=0.006)
    light = np.linspace(0.02, 0.98, 50, dtype=np.float32)
    shown = bent(Precorrection(table=inverse_table(table)).apply(light))
    assert np.abs(shown - light).max() < 0.012


def test_levels_up_and_down_cancel_a_lamp_that_drifts():
    levels = (*LEVELS, *LEVELS[::-1])
    found = response_of_levels(levels, shots(lambda v: (v / 255) ** 2.2, levels, drift=0.1), 255)
    assert found.gamma == pytest.approx(2.2, abs=0.01)
    assert found.levels == LEVELS


@pytest.mark.parametrize("levels", [LEVELS, (*LEVELS, *LEVELS[::-1])])
@pytest.mark.parametrize(("gamma", "flicker"), [(0.6, 0.003), (1.0, 0.01), (2.2, 0.01)])
def test_an_exponent_is_no_surer_than_the_light_is_steady(gamma, flicker, levels):
    """Of single shots of each level, too: white, by which all are divided, is one of them."""
    off = []
    for seed in range(100):
        found = response_of_levels(levels, shots(lambda v: (v / 255) ** gamma, levels, flicker=flicker, seed=seed), 255)
        off.append(abs(found.gamma - gamma) / found.sigma)
    assert np.mean(np.array(off) < 2) >= 0.87
    assert np.sqrt(np.mean(np.square(off))) < 1.3


def test_light_that_is_not_steady_is_told_from_a_response_that_is_no_exponent():
    twice = (*LEVELS, *LEVELS[::-1])
    for seed in range(20):
        found = response_of_levels(twice, shots(lambda v: (v / 255) ** 2.2, twice, flicker=0.02, seed=seed), 255)
        assert found.unsteady == pytest.approx(0.02, rel=0.6)
        assert "gamma" in found.response
        assert "table" in response_of_levels(twice, shots(bent, twice, flicker=0.005, seed=seed), 255).response
    drifting = response_of_levels(twice, shots(lambda v: (v / 255) ** 2.2, twice, drift=0.1), 255)
    assert drifting.unsteady == pytest.approx(0, abs=0.002)
    assert response_of_levels(LEVELS, shots(bent), 255).unsteady is None


def test_a_level_that_was_shown_as_another_once_is_told():
    twice = (*LEVELS, *LEVELS[::-1])
    for gamma, late in ((1.0, 12), (2.2, 14), (2.2, 25)):
        frames = shots(lambda v, g=gamma: (v / 255) ** g, twice)
        frames[late] = frames[late - 1]
        with pytest.raises(CalibrationError, match=f"level {twice[late]} was seen with lights that are .* apart"):
            response_of_levels(twice, frames, 255)


def test_a_camera_that_clips_below_full_scale_is_told():
    frames = [np.minimum(frame, 150) for frame in shots(lambda v: (v / 255) ** 1.5)]
    with pytest.raises(CalibrationError, match="at grey level 150: the camera clips there"):
        response_of_levels(LEVELS, frames, 255)


@pytest.mark.parametrize(
    ("levels", "response", "said"),
    [
        ((0, 50, 100, 150, 200), lambda v: v / 255, "do not show a response"),
        ((0, 50, 100, 150, 200, 255), lambda v: 0 * v, "differ by"),
        ((0, 50, 200, 100, 150, 255), None, "darker than level"),
        (LEVELS, lambda v: np.minimum(4 * v / 255, 2.8), "without clipping"),
    ],
)
def test_what_shows_no_response_is_refused(levels, response, said):
    frames = shots(lambda v: v / 255, sorted(levels)) if response is None else shots(response, levels)
    with pytest.raises(CalibrationError, match=said):
        response_of_levels(levels, frames, 255)
    with pytest.raises(CalibrationError, match="one level for each"):
        response_of_levels(levels, frames[1:], 255)


def test_the_command_reads_images_and_writes_into_a_calibration(tmp_path, capsys, rig_of):
    folder = tmp_path / "levels"
    folder.mkdir()
    levels = (*LEVELS[::2], 255)
    for i, frame in enumerate(shots(lambda v: (v / 255) ** 2.1, levels)):
        cv2.imwrite(str(folder / f"{i:02d}.png"), frame)
    rig = tmp_path / "calibration.json"
    rig.write_text(json.dumps(rig_of("y").as_dict()))
    said = ",".join(map(str, levels))
    assert main(["calibrate", "response", str(folder), "--levels", said, "--write", str(rig), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["gamma"] == pytest.approx(2.1, abs=0.01)
    written = json.loads(rig.read_text())
    assert written["response"] == {"projector": told["response"], "camera": None}
    assert written["id"] != "small-y"
    assert main(["calibrate", "response", str(folder), "--levels", "0,255"]) == 1
    assert "one level for each frame" in capsys.readouterr().err
    assert main(["calibrate", "response", str(folder), "--levels", said]) == 0
    assert "gamma" in capsys.readouterr().out


def test_a_folder_of_levels_says_which_image_is_at_fault(tmp_path):
    def refused():
        with pytest.raises(CalibrationError) as caught:
            calibrate_response._of_images(tmp_path, "0,255", SimpleNamespace(stage=lambda words: None))
        assert caught.value.hint
        return str(caught.value)

    assert "has no images" in refused()
    for name, size in (("a.png", (8, 6)), ("b.png", (8, 6)), ("c.png", (9, 6))):
        cv2.imwrite(str(tmp_path / name), np.zeros(size[::-1], np.uint8))
    assert "a.png is 8 x 6 of 8 bits, c.png is 9 x 6 of 8 bits" in refused()
    (tmp_path / "b.png").write_bytes(b"no image")
    assert "cannot read b.png" in refused()
