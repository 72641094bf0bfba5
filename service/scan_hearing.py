"""What becomes of the words of the devices about one scan: room is made, its series begins and grows, events go out."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from service.jobs import Job
from service.pipe import Frames, Kept, LiveBegan, Need, Shot, Taken

if TYPE_CHECKING:
    from service.pipeline import Pipeline

FRAME_EVENT_S = 0.05
"""Events of captured frames are told at most this often, and for the last frame."""


class ScanHearing:
    """Hears of one scan on the devices (`service.devices_link.ScanListener`).

    They may still speak of one that is over, cancelled meanwhile: of that nothing is told and nothing begins any more.
    """

    def __init__(self, pipeline: Pipeline, job: Job) -> None:
        self._pipeline = pipeline
        self._job = job
        self._told = 0.0

    async def need(self, need: Need) -> None:
        """It is planned. Raises StorageError where the spool has no room."""
        if not self._job.state.over:
            await self._pipeline.room_for(self._job, need)

    def began(self) -> None:
        """Its capture folder is there."""
        if not self._job.state.over:
            self._pipeline.began(self._job)

    def frames(self, frames: Frames) -> None:
        """More of its frames are on disk."""
        if self._job.state.over:
            return
        job, all_there = self._job, frames.captured == self._job.total
        job.captured = frames.captured
        self._pipeline.grew(job)
        now = time.monotonic()
        if now - self._told < FRAME_EVENT_S and frames.captured < job.total:
            return
        self._told = now
        counts = {"captured": frames.captured, "total": job.total, "retakes": frames.retakes}
        self._pipeline.tell(job, "retake" if all_there and frames.retakes else "frame", counts)

    def taken(self, taken: Taken) -> None:
        """All of its frames are in the folder, which is being closed."""
        if taken.lines is not None:
            self._pipeline.taken(self._job, taken.lines)

    def live(self, report: LiveBegan | Shot | Kept) -> None:
        """Of a live run."""
        raise AssertionError(f"a scan says no {type(report).__name__}")
