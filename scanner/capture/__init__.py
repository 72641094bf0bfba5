"""A capture: the frames of one sequence and their folder on disk (formats.md, Capture).

Neither reader nor writer knows which frame is right: that is the sequencer's.
"""

from scanner.capture.header import (
    FRAMES_FILE,
    HEADER_FILE,
    RECORDS_FILE,
    CaptureHeader,
    FrameRecord,
    State,
    Status,
    Verdict,
    digest,
    digest_matches,
)
from scanner.capture.reader import Capture
from scanner.capture.writer import CaptureWriter, close_interrupted

__all__ = [
    "FRAMES_FILE",
    "HEADER_FILE",
    "RECORDS_FILE",
    "Capture",
    "CaptureHeader",
    "CaptureWriter",
    "FrameRecord",
    "State",
    "Status",
    "Verdict",
    "close_interrupted",
    "digest",
    "digest_matches",
]
