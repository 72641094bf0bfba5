"""Which views agree: wrong ones among few are named and left out, whatever they do to the fit of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.calibration.observe import Observation
from scanner.calibration.solve import SolveOptions, solve
from scanner.calibration.targets import parse_target
from scanner.errors import CalibrationError
from tests.unit.calibration_bench import made_up_rig, observations, poses

RIG = made_up_rig()
SMALL = parse_target("chessboard:5x4:50")
LENGTH = SolveOptions(length=(SMALL.longest_mm, 0.01))


def spoilt(count: int, bad: dict[int, tuple[str, float]], seed: int = 0) -> list[Observation]:
    """Views of which some are shifted, by px, in the camera's picture or in the projector's."""
    every = observations(RIG, poses(count, seed=seed), target=SMALL, seed=seed)
    for k, (side, off) in bad.items():
        view = every[k].view
        moved = {side: getattr(view, side) + off * np.array([1.0, 0.3])}
        every[k] = replace(every[k], view=replace(view, **moved))
    return every


@pytest.mark.parametrize(
    ("count", "bad"),
    [
        (5, {2: ("camera", 3.0)}),
        (4, {1: ("projector", 3.0)}),
        (5, {1: ("projector", 3.0), 4: ("camera", 20.0)}),
        (10, {3: ("camera", 0.5)}),
    ],
)
def test_a_minority_of_wrong_views_is_named(count: int, bad: dict[int, tuple[str, float]]) -> None:
    found = solve(SMALL, spoilt(count, bad), LENGTH, leave_out=False)
    assert {one.name for one in found.left_out} == {f"pose{k:02d}" for k in bad}
    assert all("contradicts the other views" in one.reason for one in found.left_out)
    assert np.linalg.norm(found.state.translation - RIG.translation) < 1.0


def test_without_a_majority_the_refusal_says_so() -> None:
    every = spoilt(4, {0: ("projector", 40.0), 1: ("projector", -60.0), 2: ("camera", 90.0)}, seed=1)
    with pytest.raises(CalibrationError, match=r"no majority of the 4 views agrees|most in pose0") as refused:
        solve(SMALL, every, LENGTH, leave_out=False)
    assert "moved between captures" in str(refused.value.hint)
