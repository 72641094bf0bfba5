"""What `fringed calibrate solve` says of its uncertainties, and of lengths that are stated too well."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from scanner.calibration.calibration_file import calibration_dict
from scanner.calibration.solve import SolveOptions, solve
from service.commands.calibrate_solve import length_given, report
from tests.unit.calibration_bench import TARGET, made_up_rig, observations, poses


def test_wider_uncertainties_than_the_stated_length_makes_are_explained(capsys: pytest.CaptureFixture[str]) -> None:
    seen, options = observations(made_up_rig(), poses(8)), SolveOptions(length=(240.0, 0.01))
    formal, found = (solve(TARGET, seen, options, leave_out=tried) for tried in (False, True))
    wide, narrow = (np.diag(one.adjusted.covariance) for one in (found, formal))
    assert (wide > 0.999 * found.held_out.widened**2 * narrow).all()
    for times, said in ((1.0, "figures\n"), (1.26, "figures; all are 1.3 times what residuals and stated length make")):
        one = replace(found, held_out=replace(found.held_out, widened=times))
        report(one, calibration_dict(one), Path("rig.json"), None, as_json=False)
        assert f"k = 2, of each of these {said}" in capsys.readouterr().out


@pytest.mark.parametrize("given", ["240:1e-9", "240:0.00002"])
def test_a_length_that_nothing_measures_so_well_is_refused(given: str) -> None:
    with pytest.raises(typer.BadParameter, match="nothing measures 240 mm to"):
        length_given(given)
    assert length_given("240:0.00003") == (240.0, 0.00003)
