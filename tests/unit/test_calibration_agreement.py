"""Which views agree: wrong ones among few are named and left out, whatever they do to the fit of all."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from scanner.calibration.observe import Observation
from scanner.calibration.solve import Solution, SolveOptions, sigmas, solve
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


def moved_between_axes(count: int, bad: tuple[int, ...], off: float, seed: int) -> list[Observation]:
    """Sharp views of which some moved down by camera px after the columns were captured: their rows are others'."""
    every = observations(RIG, poses(count, seed=seed), target=SMALL, seed=seed, noise=(0.003, 0.005))
    for k in bad:
        view = every[k].view
        rows = view.projector[:, 1] + off * view.slope[:, 1, 1]
        every[k] = replace(every[k], view=replace(view, projector=np.column_stack((view.projector[:, 0], rows))))
    return every


def sigmas_off(found: Solution) -> float:
    """Of the translation, the most."""
    return float(np.max(np.abs(found.state.translation - RIG.translation) / sigmas(found.adjusted)["translation"]))


@pytest.mark.parametrize(("bad", "seed"), [((0, 1, 2), 0), ((4, 6, 7), 0), ((2, 4, 7), 1)])
def test_views_that_bend_the_rig_alike_are_named(bad: tuple[int, ...], seed: int) -> None:
    """Three of eight, by half a pixel: rigs of three sound ones are missed by no sound one, and they by all."""
    found = solve(SMALL, moved_between_axes(8, bad, 0.5, seed), LENGTH)
    assert {one.name for one in found.left_out} == {f"pose{k:02d}" for k in bad}
    assert sigmas_off(found) < 3


def test_a_view_that_bends_the_rig_too_little_to_be_left_out_is_warned_of_and_widens_the_uncertainties() -> None:
    every = moved_between_axes(12, (11,), 0.1, 1)
    found, formal = solve(SMALL, every, LENGTH), solve(SMALL, every, LENGTH, leave_out=False)
    assert found.left_out == formal.left_out == ()
    assert sigmas_off(formal) > 4
    assert sigmas_off(found) < 2
    said = [warning for warning in found.warnings if "contradict each other" in warning]
    assert len(said) == 1
    assert "view pose11 most" in said[0]
    assert found.held_out.most_px == pytest.approx(np.nanmax(found.held_out.errors))
    clean = solve(SMALL, moved_between_axes(12, (), 0.0, 1), LENGTH)
    assert not any("contradict each other" in warning for warning in clean.warnings)
    assert sigmas_off(clean) < 3


def test_a_view_of_which_a_part_is_noisy_contradicts_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that is overexposed in part: its sigmas say so, and nobody is asked who agrees with whom."""
    every = moved_between_axes(8, (), 0.0, 2)
    view = every[3].view
    blunt = np.where(np.arange(len(view.ids))[:, None] % 2 == 0, 30.0, 1.0)
    noise = np.random.default_rng(0).normal(0, view.sigma) * np.sqrt(blunt**2 - 1)
    noisy = replace(view, projector=view.projector + noise, sigma=blunt * view.sigma)
    every[3] = replace(every[3], view=noisy)
    monkeypatch.setattr("scanner.calibration.agreement._searched", lambda *_, **__: pytest.fail("it was doubted"))
    found = solve(SMALL, every, LENGTH)
    assert found.left_out == ()
    assert not any("contradict each other" in warning for warning in found.warnings)
    assert np.nanargmax(found.held_out.errors) == 3
    assert sigmas_off(found) < 3


def knocked(count: int, late: int, off: float) -> list[Observation]:
    """Sharp views, the last of them after the camera's picture was shifted, px: a knock, or a lens touched."""
    every = observations(RIG, poses(count, seed=3), target=SMALL, seed=3, noise=(0.003, 0.005))
    for k in range(count - late, count):
        view = every[k].view
        every[k] = replace(every[k], view=replace(view, camera=view.camera + np.array([0.0, off])))
    return every


def test_a_rig_that_was_knocked_between_views_is_told() -> None:
    """What is left is then a tenth of a pixel in every view, which is little, and all of it smooth, which is odd."""
    after = solve(SMALL, knocked(8, 3, 1.0), LENGTH)
    assert {one.name for one in after.left_out} == {"pose05", "pose06", "pose07"}
    half = solve(SMALL, knocked(8, 4, 2.0), LENGTH)
    (said,) = (words for words in half.warnings if "no majority says which are right" in words)
    assert re.search(r"of pose0[04], pose0[15], pose0[26], pose0[37] alone", said)
    assert not any("no majority" in words for words in solve(SMALL, knocked(8, 0, 0.0), LENGTH).warnings)


def test_without_a_majority_the_refusal_says_so() -> None:
    every = spoilt(4, {0: ("projector", 40.0), 1: ("projector", -60.0), 2: ("camera", 90.0)}, seed=1)
    with pytest.raises(CalibrationError, match=r"no majority of the 4 views agrees|most in pose0") as refused:
        solve(SMALL, every, LENGTH, leave_out=False)
    assert "moved between captures" in str(refused.value.hint)
