"""The same scan twice: from the simulated camera directly, and through GigE packets and Aravis. Depth errors of both.

    python bench/gige_scan.py [--scene casey2011/sphere_board] [--method pmp]

Issue 5 asks for a depth error over GigE within 10 % of the direct path's. Frames are compared, too: the camera on the
wire sees the same light with the same noise, so they are equal unless a stamp, a packet or a bit went astray.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ADDRESS = "127.0.0.62"
EXPOSURE_US = 33_333
FRINGED = (sys.executable, "-m", "service.cli")

RIG = """
[rig]
calibration = "calibration.json"
[camera]
driver = "aravis"
device = "{address}"
[projector]
driver = "simulated"
device = "{scene}"
[projector.options]
camera_socket = "{light}"
"""


def fringed(*words: Any) -> dict[str, Any]:
    """Run a command and read its JSON."""
    ran = subprocess.run(
        [*FRINGED, *map(str, words), "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True
    )
    found: dict[str, Any] = json.loads(ran.stdout)
    return found


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", default="casey2011/sphere_board")
    parser.add_argument("--method", default="pmp")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        light, rig = folder / "light", folder / "rig.toml"
        rig.write_text(RIG.format(address=ADDRESS, scene=given.scene, light=light))
        words = ("--method", given.method, "--exposure", EXPOSURE_US)
        direct = fringed(
            "scan", "--rig", f"simulated:{given.scene}", *words, "--compare-truth", "-o", folder / "direct"
        )
        wire = ("simulate", "gige", given.scene, "--address", ADDRESS, "--light", light)
        command = [*FRINGED, *map(str, wire), "--calibration", folder / "calibration.json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as camera:
            assert camera.stdout is not None
            try:
                while not (line := camera.stdout.readline()).startswith("socket"):
                    assert line, "the camera did not start"
                fringed("scan", "--rig", rig, *words, "-o", folder / "gige")
            finally:
                camera.terminate()
        shutil.copy(folder / "direct/capture/truth.npz", folder / "gige/capture")
        gige = fringed("decode", folder / "gige/capture", "--compare-truth", "-o", folder / "again")
        lines = [(folder / path / "capture/frames.jsonl").read_text().splitlines() for path in ("direct", "gige")]
        digests = [[json.loads(line)["xxh3"] for line in each] for each in lines]
        equal = sum(a == b for a, b in zip(*digests, strict=True))
    errors = [report["report"]["truth"]["inside"]["depth_mm"]["rms"] for report in (direct, gige)]
    print(f"{given.scene}, {given.method}: depth error rms, direct {errors[0]:.4f} mm, over GigE {errors[1]:.4f} mm")
    print(f"ratio {errors[1] / errors[0]:.3f}; {equal} of {len(digests[0])} frames are equal to the last bit")
    print(f"verdicts over GigE: {gige['report']['sync']['verdicts']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
