"""ArUco markers in a picture: a board that has them is a ChArUco board, however it is described."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.targets import Target

DICTIONARIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")
"""Each contains the smaller ones of its kind."""
MARKERS = "; there are ArUco markers: is it a ChArUco board (charuco:)?"
"""Of a picture in which no target without markers is found"""
FEWEST = 4
"""Markers of one kind: a square of a scene, or a speck in one, passes for one now and then"""


def markers_in(image: NDArray[Any]) -> int:
    """How many markers of one kind a picture (H, W) of grey levels shows; 0 for fewer than FEWEST."""
    picture = np.nan_to_num(np.asarray(image, dtype=np.float32))
    top = max(float(np.percentile(picture, 99.5)), 1e-6)
    grey = np.clip(picture * (235.0 / top), 0, 255).astype(np.uint8)
    most = 0
    for name in DICTIONARIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
        most = max(most, 0 if ids is None else len(np.unique(ids)))
    return most if most >= FEWEST else 0


def of_another_kind(image: NDArray[Any], target: Target) -> str | None:
    """What to say of a chessboard that has markers; None where nothing is."""
    if target.kind != "chessboard" or not (count := markers_in(image)):
        return None
    named = f"charuco:{target.columns + 1}x{target.rows + 1}:{target.spacing_mm:g}"
    return (
        f"{count} ArUco markers are in the picture, and a chessboard has none: this is a ChArUco board, whose markers "
        f"disturb corners that are measured as a chessboard's. Describe it as it was printed: {named}[:MARKER[:DICT]]"
    )
