"""Grids of discs, from pictures to a rig: symmetric and asymmetric, as the simulated rig shows them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.simulated.nominals import nominals
from drivers.simulated.rigs import rig
from scanner.calibration.lens_slopes import lens_numbers
from scanner.calibration.observe import Observation, observe_capture
from scanner.calibration.solve import SolveOptions, sigmas, solve
from scanner.calibration.targets import parse_target
from tests.unit.test_calibration_observe import write_capture

POSES = (0, 2, 5, 7, 9, 11)


@pytest.mark.parametrize("scene", ["circles_poses", "acircles_poses"])
def test_a_grid_of_discs_calibrates_a_rig(scene: str, tmp_path: Path) -> None:
    """Every disc in every pose; focal lengths, middles and the shift within three stated sigmas, and sharp ones."""
    chosen = rig("quick")
    target = parse_target(nominals(chosen)[scene]["target"])
    seen = []
    for k in POSES:
        write_capture(tmp_path / f"{k}" / "capture", f"quick/{scene}?pose={k}&seed=3")
        seen.append(observe_capture(tmp_path / f"{k}" / "capture", f"{k}", target))
    views = [one for one in seen if isinstance(one, Observation)]
    assert [len(one.view.ids) for one in views] == [len(target.points)] * len(POSES)
    found = solve(target, views, SolveOptions(length=(target.longest_mm, 0.05)))
    assert found.left_out == ()
    true, spread = chosen.calibration, sigmas(found.adjusted)
    for side in ("camera", "projector"):
        off = lens_numbers(getattr(found.state, side))[:4] - lens_numbers(getattr(true, side))[:4]
        assert np.abs(off / spread[side][:4]).max() < 3, side
        assert (np.abs(off) < 2).all(), side
    off = found.state.translation - true.translation
    assert np.abs(off / spread["translation"]).max() < 3
    assert np.linalg.norm(off) < 1
