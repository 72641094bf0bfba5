"""What runs through a trigger line are planned for: a display of 60 Hz and a camera, without devices."""

from __future__ import annotations

from scanner.devices import CameraCapabilities, Interval, ProjectorCapabilities, ProjectorKind, TriggerMode

MS = 1_000_000
REFRESH = 16_666_667
PROJECTOR = ProjectorCapabilities(
    ProjectorKind.FRAMEBUFFER, 320, 240, REFRESH, latency=Interval(4 * MS, 5 * MS), settle=Interval(0, MS // 2)
)
CAMERA = CameraCapabilities(
    320,
    240,
    8,
    "global",
    5 * MS,
    10_000,
    1000 * MS,
    1000,
    1 * MS,
    frozenset(TriggerMode),
    line_latency=Interval(5_000, 15_000),
)
