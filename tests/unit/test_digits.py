"""Figures end where their uncertainty does."""

from __future__ import annotations

import pytest

from scanner.digits import alone, with_uncertainty
from scanner.stated_length import dominates, stated_length_of


@pytest.mark.parametrize(
    ("value", "expanded", "printed"),
    [
        (1345.9812, 0.5342, "1345.98 +- 0.53"),
        (1345.9812, 0.0996, "1345.98 +- 0.10"),
        (-0.00004, 0.0123, "0.000 +- 0.012"),
        (1234.6, 24.7, "1235 +- 25"),
        (12345.6, 1234.0, "12300 +- 1200"),
        (240.0, 0.1, "240.00 +- 0.10"),
        (3.0, 0.0, "3.0000 +- 0"),
        (-0.00001, None, "0.0000 +- unknown"),
        (0.5, float("nan"), "0.5000 +- unknown"),
    ],
)
def test_value_and_uncertainty_end_at_the_same_place(value: float, expanded: float | None, printed: str) -> None:
    assert with_uncertainty(value, expanded) == printed


def test_an_uncertainty_alone_has_two_digits() -> None:
    assert [alone(u) for u in (0.28133, 0.0, 96.7, 2e-7)] == ["0.28", "0", "97", "0.000001"]


def test_a_stated_length_is_named_where_it_is_most_of_a_variance() -> None:
    length = stated_length_of({"reference_mm": 240.0, "sigma_mm": 0.05})
    assert length is not None
    assert length.of(1346) == pytest.approx(0.2804, abs=1e-4)
    found = {"reference_mm": 240.0, "sigma_mm": 0.05, "share": length.share(1346, 0.3)}
    said = dominates(found)
    assert said is not None
    assert said.startswith(
        "the stated length 240.00 +- 0.10 mm (k = 2) dominates, with 87% of the variance of the median"
    )
    named = dominates({**found, "of": "the sphere's diameter"})
    assert named is not None
    assert named.endswith("of the variance of the sphere's diameter: measure it better")
    assert dominates({**found, "share": length.share(1346, 0.4)}) is None
    assert dominates(None) is None
    assert stated_length_of("unverified") is None
    assert stated_length_of({"reference_mm": 0, "sigma_mm": "x"}) is None
