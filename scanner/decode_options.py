"""What a user may choose about decoding, and what must fit before any frame is decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from scanner.capture import CaptureHeader
from scanner.errors import CalibrationError
from scanner.filter_settings import FilterSettings
from scanner.geometry import Calibration


@dataclass(frozen=True)
class DecodeOptions:
    """What a user may choose about decoding."""

    decoder: str = "default"
    filters: FilterSettings = field(default_factory=FilterSettings)
    compare_truth: bool = False
    correct_ripple: bool = False
    """PMP: take off what the response has put into coordinates, as far as the frequencies tell"""

    def as_dict(self) -> dict[str, Any]:
        """Plain data, for the wire and for reports."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> DecodeOptions:
        """The options that `as_dict` described; absent members have their defaults.

        Raises:
            ConfigError: a member has a value that makes no sense.
        """
        return cls(
            decoder=str(content.get("decoder", "default")),
            filters=FilterSettings.from_dict(content.get("filters") or {}),
            compare_truth=bool(content.get("compare_truth", False)),
            correct_ripple=bool(content.get("correct_ripple", False)),
        )


def require_sizes(header: CaptureHeader, calibration: Calibration) -> None:
    """Raise CalibrationError where camera or projector of the capture have another size than the calibration's."""
    projector = header.sequence.projector
    for name, calibrated, here, hint in (
        ("camera", calibration.camera.size, header.camera.shape[::-1], "made with this camera and region"),
        ("projector", calibration.projector.size, (projector.width, projector.height), "made with this projector"),
    ):
        if calibrated != here:
            raise CalibrationError(
                f"the calibration is for a {name} of {calibrated[0]} x {calibrated[1]}, "
                f"the capture is of one of {here[0]} x {here[1]}",
                hint=f"use the calibration {hint}",
            )
