"""Captures that other people's systems made, where the machine has them: `$FRINGED_REAL_DATA`, or shared/data beside
the clone. They are not part of the project; where there are none, there are no tests here.
"""

from __future__ import annotations

import json
import os
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from scanner.decode import Decoded, Reason, decoder_for
from scanner.patterns import CameraFormat, PatternSequence, ProjectorSize

FOLDER = Path(os.environ.get("FRINGED_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
SKULL = FOLDER / "skull"


@cache
def decoded(name: str) -> Decoded:
    """What our decoder makes of a capture of the skull."""
    capture = json.loads((SKULL / name).read_text())
    camera = CameraFormat(**capture["camera"])
    sequence = PatternSequence.from_description(ProjectorSize(**capture["projector"]), capture["pattern"])
    decoder = decoder_for(sequence, camera)
    for position, file in enumerate(capture["frames"]):
        decoder.add(position, cv2.imread(str(SKULL / file), cv2.IMREAD_GRAYSCALE))
    return decoder.finish()


if SKULL.is_dir():

    def test_fringes_of_a_real_skull_agree_with_the_reference():
        reference = np.load(SKULL / "reference.npz")["columns"]
        known, found = np.isfinite(reference), np.isfinite(decoded("capture.json").columns)
        error = np.abs(decoded("capture.json").columns - reference)[known & found]
        assert (known & found).sum() >= 0.97 * known.sum()
        assert np.mean(error < 1) >= 0.99
        # Elsewhere neighbours have settled the fringe, and Gray code of the same scene sides with them.
        differs = known & found & (np.abs(decoded("capture.json").columns - reference) >= 1)
        gray = decoded("capture-gray.json").columns
        sides = np.abs(gray - decoded("capture.json").columns)[differs & np.isfinite(gray)] < 57
        assert sides.size > 20
        assert sides.mean() > 0.98

    def test_nothing_of_the_dark_room_is_taken_for_skull():
        # 1 % and 99 % of the columns of a right decode are 608 and 1204; the table it stands on is dark, not absent.
        columns = decoded("capture.json").columns
        low, high = np.nanpercentile(columns, [2, 99])
        assert low > 570
        assert high < 1240
        assert np.isfinite(columns).sum() < 1.1 * np.isfinite(np.load(SKULL / "reference.npz")["columns"]).sum()

    def test_gray_code_of_the_same_skull_tells_the_same_fringes():
        fringes, gray = decoded("capture.json").columns, decoded("capture-gray.json").columns
        reference = np.isfinite(np.load(SKULL / "reference.npz")["columns"])
        both = np.isfinite(fringes) & np.isfinite(gray)
        apart = np.abs(fringes - gray)[both]
        assert (both & reference).sum() >= 0.95 * reference.sum()
        assert np.median(apart) < 1
        # Half a fringe is 57 columns. Light thrown from bone to bone in the eye sockets costs the unit frequency more.
        assert np.mean(apart > 57) < 5e-4

    def test_every_pixel_of_the_real_captures_has_a_value_or_a_reason():
        for name in ("capture.json", "capture-gray.json"):
            found = decoded(name)
            assert np.array_equal(np.isfinite(found.columns), found.reason == Reason.VALUE)
            assert np.array_equal(found.confidence > 0, found.reason == Reason.VALUE)
