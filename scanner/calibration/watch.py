"""What each scan says of its own calibration: epipolar residuals, witness marks, how warm the rig was.

`scanner.reconstruct` asks once per scan; the answers are members of report.json, `drift`, `marks` and `warm_up`, and
warnings where something has moved.
"""

from __future__ import annotations

from typing import Any

from scanner.calibration.drift import drift_of
from scanner.capture import CaptureHeader
from scanner.geometry import Calibration
from scanner.scan import Scan

MARKS = "marks"
WARM_UP = "warm_up"
"""Members of capture.json"""


def watched(scan: Scan, calibration: Calibration | None, header: CaptureHeader) -> Scan:
    """The scan with what can be said in its report.

    Raises:
        CalibrationError: the capture's marks are not as they should be.
    """
    members: dict[str, Any] = {}
    odd = () if calibration is None else calibration.warnings
    warnings = [*scan.report.get("warnings", ()), *odd]
    if (warm_up := header.extra.get(WARM_UP)) is not None:
        members["warm_up"] = warm_up
    if calibration is not None and scan.xyz is not None:
        if scan.rows is not None and scan.columns is not None:
            drift = drift_of(calibration, scan.rows, scan.columns, scan.xyz)
            members["drift"] = None if drift is None else drift.as_dict()
            warnings += [drift.warning] if drift is not None and drift.warning else []
        if (given := header.extra.get(MARKS)) is not None:
            from scanner.calibration.marks import measured_marks, parse_marks  # noqa: PLC0415  (few rigs have any)

            found = measured_marks(parse_marks(given, f"{MARKS} of the capture"), scan.albedo, scan.xyz)
            members["marks"] = found
            warnings += [found["warning"]] if found["warning"] else []
    return scan.with_report(**members, warnings=warnings) if members or odd else scan
