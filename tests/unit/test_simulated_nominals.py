"""Nominal sizes of the simulated scenes: those that the scenes are built with, on the page, in the listing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.simulated import targets
from drivers.simulated.driver import SimulatedCameraDriver
from drivers.simulated.nominals import nominals
from drivers.simulated.optics import Optics
from drivers.simulated.rigs import rig, rig_names
from drivers.simulated.scenes import SceneOptions, build_scene
from drivers.simulated.view import view_scene
from scanner.calibration.targets import parse_target
from service import cli

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "simulated-rigs.md"


@pytest.mark.parametrize("name", ["bench2026", "quick"])
def test_what_is_seen_has_the_nominal_sizes(name: str) -> None:
    r = rig(name)
    told = nominals(r)

    def points(scene: str) -> np.ndarray:
        xyz = view_scene(r, build_scene(scene, SceneOptions(), r, 0), Optics(), stride=8).truth.xyz
        return xyz[np.isfinite(xyz[..., 2])].astype(np.float64)

    for scene in ("sphere_board", "sphere_dark"):
        seen = points(scene)
        from_centre = np.linalg.norm(seen - told[scene]["centre_mm"], axis=1)
        assert from_centre.min() == pytest.approx(told[scene]["diameter_mm"] / 2, abs=1e-3)
        assert seen[:, 2].max() == pytest.approx(told[scene]["wall_mm"], abs=1e-3)
    assert points("board")[:, 2] == pytest.approx(told["board"]["wall_mm"], abs=1e-3)
    wall = told["blocks"]["wall_mm"]
    heights = wall - points("blocks")[:, 2]
    assert all((np.abs(heights - height) < 0.01).any() for height in told["blocks"]["heights_mm"])
    assert np.ptp(points("wedge")[:, 2]) == pytest.approx(told["wedge"]["depth_mm"], rel=0.02)


def test_targets_are_named_as_a_calibration_names_them() -> None:
    for name in rig_names():
        for scene in targets.POSED:
            told = nominals(rig(name))[scene]
            target = parse_target(told["target"])
            assert target.longest_mm == pytest.approx(told["longest_row_mm"])
            points = targets.target_points(scene, rig(name))
            assert target.points == pytest.approx(points)
            first_row = points[points[:, 1] == points[0, 1]]
            assert np.ptp(first_row[:, 0]) == pytest.approx(told["longest_row_mm"])


def rows() -> list[str]:
    """Those of the page's table."""
    of_rigs = [nominals(rig(name)) for name in rig_names()]
    lines = []
    for scene, figures in of_rigs[0].items():
        for name in figures:
            if name != "disc_centres_mm":
                values = " | ".join(_cell(nominal[scene][name]) for nominal in of_rigs)
                lines.append(f"| `{scene}` | `{name}` | {values} |")
    return lines


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_cell, value))
    return f"`{value}`" if isinstance(value, str) else f"{value:.7g}"


def test_the_page_and_the_listing_say_them(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    page = PAGE.read_text()
    assert [row for row in rows() if row not in page] == []
    monkeypatch.setattr("drivers.registry.discover", SimulatedCameraDriver().discover)
    assert cli.main(["devices"]) == 0
    assert any(line.split() == ["sphere_board", "diameter_mm", "160.0", "161.4414", "103.7838"] for line in
               capsys.readouterr().out.splitlines())  # fmt: skip
    assert cli.main(["devices", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["devices"]
    assert len(listed[0]["details"]["nominals"]["wedge"]["disc_centres_mm"]) == 18
