"""How fast the simulated rig is: casting each scene, rendering a frame, handing out a ring. One core.

    python bench/simulated.py [--json]

A frame of casey2011 (1392 x 1040) must take less than 25 ms of one core once the scene is cast, the cast less than
3 s: exit status 1 where one does not.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.simulated import camera_driver, projector_driver, view, warm_up
from drivers.simulated.optics import Optics
from drivers.simulated.rigs import rig
from drivers.simulated.scenes import SceneOptions, build_scene
from scanner.clock import VirtualClock
from scanner.devices import CameraSettings, TriggerMode
from scanner.patterns import McpPattern, PatternSequence, PmpPattern, ProjectorSize

MOST_FRAME_MS, MOST_CAST_S = 25.0, 3.0
SCENES = ("board", "sphere_board", "blocks", "textured", "bust", "wedge", "charuco_poses")


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Median time of one call."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def cast_times(name: str) -> dict[str, float]:
    """Seconds to cast and shade each scene."""
    chosen, optics = rig(name), Optics()
    return {
        scene: seconds(
            lambda s=scene: view.view_scene(chosen, build_scene(s, SceneOptions(), chosen, 0), optics),  # type: ignore[misc]
            2,
        )
        for scene in SCENES
    }


def frame_times(name: str, options: str = "") -> dict[str, float]:
    """Milliseconds a frame of PMP, of MCP, and of one that a flip falls into."""
    clock = VirtualClock()
    device = f"{name}/bust{options}"
    camera, projector = camera_driver.open(device, {}, clock), projector_driver.open(device, {}, clock)
    c = projector.capabilities
    size = ProjectorSize(c.width, c.height)
    axis = camera.true_calibration().phase_axis
    pmp = PatternSequence(size, PmpPattern(axes=(axis,)))
    mcp = PatternSequence(size, McpPattern(axis=axis))
    projector.load([pmp.image(12), mcp.image(0), pmp.image(13)])
    camera.apply(CameraSettings(exposure_ns=33_333_000))
    camera.start(TriggerMode.SOFTWARE)

    def frame() -> None:
        camera.trigger()
        assert camera.pop(10**9) is not None

    found = {}
    for what, index in (("pmp", 0), ("mcp", 1)):
        flip = projector.show(index)
        clock.sleep_until(flip.t_ns + 10**8)
        frame()
        found[what] = 1e3 * seconds(frame, 15)

    def blended() -> None:
        camera.trigger()
        projector.show(2)
        assert camera.pop(10**9) is not None
        projector.show(0)
        clock.sleep_until(clock.now_ns() + 10**8)

    found["blended"] = 1e3 * seconds(blended, 10)
    camera.close()
    projector.close()
    return found


def ring_rate() -> float:
    """Frames a second out of the ring."""
    camera = camera_driver.open("casey2011/board", {"ring": 8, "period_us": 0}, VirtualClock())
    camera.start(TriggerMode.FREE)
    count = 20_000
    begun = time.perf_counter()
    for _ in range(count):
        camera.pop(0)
    rate = count / (time.perf_counter() - begun)
    camera.close()
    return rate


def missed(results: dict[str, Any]) -> list[str]:
    """What takes longer than it must."""
    slow = [f"cast of {scene}: {t:.1f} s" for scene, t in results["cast_s"]["casey2011"].items() if t >= MOST_CAST_S]
    frames = results["frame_ms"]["casey2011"].items()
    return slow + [f"frame of {what}: {ms:.1f} ms" for what, ms in frames if ms >= MOST_FRAME_MS]


def main() -> int:
    """Measure and print; 1 where a figure is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    as_json = parser.parse_args().json
    warm_up()
    results = {
        "cast_s": {name: cast_times(name) for name in ("casey2011", "bench2026")},
        "frame_ms": {
            "casey2011": frame_times("casey2011"),
            "casey2011 rolling": frame_times("casey2011", "?shutter=rolling"),
            "bench2026": frame_times("bench2026"),
        },
        "ring_frames_per_s": ring_rate(),
    }
    if as_json:
        json.dump(results, sys.stdout)
    for group, figures in () if as_json else results.items():
        print(group)
        for key, value in figures.items() if isinstance(figures, dict) else [("", {"": figures})]:
            print(f"  {key:18}", "  ".join(f"{k} {v:.2f}" for k, v in value.items()))
    for problem in missed(results):
        print(f"missed: {problem}", file=sys.stderr)
    return 1 if missed(results) else 0


if __name__ == "__main__":
    sys.exit(main())
