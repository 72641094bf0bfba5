"""check-config: everything that can be judged without a device, in one run, with its line; and what is odd."""

import json
from dataclasses import replace
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from scanner.geometry import Calibration, Lens
from service.config import KINDS
from service.rig_check import examine, examine_simulated


def look(tmp_path: Path, text: str) -> tuple[list[str], list[str]]:
    """(problems without the file's name, warnings) of a rig file."""
    path = tmp_path / "rig.toml"
    path.write_text(dedent(text).lstrip())
    found = examine(path)
    assert (found.rig is None) == bool(found.problems)
    return [str(problem).removeprefix(f"{path}:") for problem in found.problems], found.warnings


def test_all_that_is_wrong_is_named_in_one_run(tmp_path: Path) -> None:
    problems, _ = look(
        tmp_path,
        """
        rig.calibration = "none.json"
        rig.marks = "marks.json"
        [camera]
        driver = "simulated"
        device = "quick/bord?sed=1"
        gain_db = 3
        options = { sed = 3, shutter = "leaf" }
        [projector]
        driver = "simulated"
        mode = "1920x1080"
        [projector.options]
        latency_us = "long"
        faults = { oder = "reverse" }
        [trigger]
        driver = "serial"
        options = { edge = "up", pins = 3 }
        """,
    )
    expected = [
        ("1:", "there is no file"),
        ("2:", "there is no file"),
        ("5: camera.device", "did you mean 'board'?"),
        ("5: camera.device", "did you mean 'seed'?"),
        ("6: camera.gain_db", "it belongs into [camera.settings]"),
        ("7: camera.options.sed", "did you mean 'seed'?"),
        ("7: camera.options.shutter", "global, rolling"),
        ("10: projector.mode", "one mode, 1152x864, and not 1920x1080"),
        ("12: projector.options.latency_us", "takes a number, got 'long'"),
        ("13: projector.options.faults", "did you mean 'order'?"),
        ("16: trigger.options.edge", "'rising' or 'falling'"),
        ("16: trigger.options.pins", "unknown option 'pins'"),
    ]
    assert len(problems) == len(expected)
    for problem, (place, words) in zip(problems, expected, strict=True):
        assert problem.startswith(place), problem
        assert words in problem


@pytest.mark.parametrize(
    ("kind", "driver"),
    [("camera", "aravis"), ("camera", "v4l2"), ("projector", "kms"), ("projector", "v4l2"), ("projector", "window")],
)
def test_every_driver_judges_its_options_without_a_device(tmp_path: Path, kind: str, driver: str) -> None:
    other = next(name for name in KINDS if name != kind)
    problems, _ = look(
        tmp_path, f'{other}.driver = "simulated"\n{kind}.driver = "{driver}"\n{kind}.options.colour = 3\n'
    )
    assert len(problems) == 1
    assert problems[0].startswith(f"3: {kind}.options.colour = 3: ")
    assert "unknown option 'colour'" in problems[0]


def test_a_built_in_rig_that_is_none() -> None:
    found = examine_simulated("simulated:quick/bord?seed=x")
    assert found.rig is None
    scene, seed = (problem.expected for problem in found.problems)
    assert "did you mean 'board'?" in scene
    assert "takes a whole number, got 'x'" in seed
    assert examine_simulated("simulated:quick/board?seed=3").rig is not None


def test_mode_and_region_are_held_against_the_calibration(tmp_path: Path) -> None:
    lens = Lens((640, 480), np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.zeros(5))
    rig = Calibration(lens, replace(lens, size=(320, 240)), np.eye(3), np.array([100.0, 0, 0]))
    (tmp_path / "c.json").write_text(json.dumps(rig.as_dict()))
    text = """
        rig.calibration = "c.json"
        camera.driver = "v4l2"
        camera.settings.region = [0, 0, 320, 480]
        projector.driver = "kms"
        projector.mode = "1920x1080@60"
        """
    problems, _ = look(tmp_path, text)
    assert [problem.partition(" = ")[0] for problem in problems] == ["3: camera.settings.region", "5: projector.mode"]
    assert "for a camera of 640 x 480" in problems[0]
    assert "for a projector of 320 x 240" in problems[1]
    assert look(tmp_path, text.replace("320, 480", "640, 480").replace("1920x1080", "320x240"))[0] == []


def test_one_time_of_a_projector_without_the_other_is_odd(tmp_path: Path) -> None:
    head = 'camera.driver = "simulated"\nprojector.driver = "simulated"\n'
    assert look(tmp_path, head) == ([], [])
    assert look(tmp_path, f"{head}projector.latency_us = 5\nprojector.settle_us = 5\n") == ([], [])
    for known, unknown in (("latency_us", "settle_us"), ("settle_us", "latency_us")):
        problems, warnings = look(tmp_path, f"{head}projector.{known} = 5\n")
        assert problems == []
        assert f"{known} without {unknown}" in warnings[0]


def test_simulated_devices_of_two_worlds_are_odd(tmp_path: Path) -> None:
    camera, projector = (f'{{ driver = "simulated", device = "quick/{scene}" }}' for scene in ("board", "bust"))
    _, warnings = look(tmp_path, f"camera = {camera}\nprojector = {projector}\n")
    assert "'quick/board', 'quick/bust'" in warnings[0]


@pytest.mark.parametrize(
    ("outputs", "said"),
    [
        ('["CAM1", "CAM9"]', "option outputs: takes 'CAM1', 'CAM2', 'SYNC' or 'LED', got 'CAM9'"),
        ("[]", "option outputs: takes a list of 1 or more"),
        ('"CAM1"', "option outputs: takes a list, got 'CAM1'"),
        ('["LED"], timeout_ms = "x"', "option timeout_ms: takes a valid integer, got 'x'"),
    ],
)
def test_a_list_that_does_not_fit_is_told_in_the_files_own_words(tmp_path: Path, outputs: str, said: str) -> None:
    (problem,), _ = look(
        tmp_path,
        f"""
        camera.driver = "simulated"
        projector.driver = "simulated"
        trigger = {{ driver = "serial", options = {{ outputs = {outputs} }} }}
        """,
    )
    assert said in problem
