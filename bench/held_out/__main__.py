"""Render, decode through the public door, compare, and print a table."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

import cv2
import numba
import numpy as np

from held_out import figures, page, relit
from held_out.light import view_of
from held_out.methods import METHODS, published, sequence_of
from held_out.rigs import RIGS
from held_out.scenes import SCENES
from held_out.sensor import capture, write_capture
from scanner.capture import Capture
from scanner.errors import ScannerError
from scanner.patterns import PatternSequence, ProjectorSize
from scanner.patterns.mcp_choice import choose_mcp
from scanner.reconstruct import TRUTH_FILE, ambiguity_px, calibration_for, load_truth, reconstruct

PIXELS = (
    "cover",
    "point",
    "wrong",
    "wrong_pt",
    "unlit",
    "zmed",
    "z99",
    "bias",
    "beyond",
    "k1",
    "k2",
    "e1",
    "e2",
    "conf_wrong",
)
STRIPES = ("right", "recall", "pzmed", "p1mm", "pbeyond", "punlit")

ONE_FRAME = ("mcp", "published", "cp")


def decoded(folder, truth):
    """Found of a capture folder, opened as anybody's, and its scan."""
    found = figures.Found()
    opened = Capture.open(folder)
    calibration, sequence = calibration_for(opened), opened.header.sequence
    try:
        scan = reconstruct(opened, calibration)
    except ScannerError as error:
        found.refused = f"{type(error).__name__}: {error}"
        return found, None
    period = ambiguity_px(sequence) or max(sequence.projector.width, sequence.projector.height) / 16
    found.figures = figures.of_scan(scan, truth, calibration, period)
    if sequence.pattern.method == "mcp" and scan.peaks is not None:
        found.figures |= figures.of_stripes(scan, sequence, truth, calibration)
    found.warnings = tuple(scan.report.get("warnings", ()))
    return found, scan


def main():
    parser = argparse.ArgumentParser(prog="python -m held_out", description=__doc__)
    parser.add_argument("--rigs", default=",".join(RIGS))
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--methods", default="mcp,published,pmp", help=f"of {', '.join(METHODS)}")
    parser.add_argument("--axis", choices=("x", "y"), help="instead of the one that suits the rig")
    parser.add_argument("--scale", type=float, help="of the camera's pixels; by default 1, and 0.5 for many frames")
    parser.add_argument("--rays", type=int, default=2, help="along a pixel's side")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plain", action="store_true", help="no sentinels and bars round sequences")
    parser.add_argument("--keep", type=Path, help="folder for captures")
    parser.add_argument("--relit", type=Path, nargs="+", help="PMP captures of real scenes, to be relit by MCP")
    parser.add_argument("--page", action="store_true", help="write the documentation's page")
    parser.add_argument("--again", type=Path, nargs="+", help="kept captures to be decoded, nothing else")
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    if chosen.again:
        found = [
            (*folder.name.split("-", 2), _told(folder, load_truth(folder), folder.name)) for folder in chosen.again
        ]
        _page(found, chosen)
        return 0
    if chosen.relit:
        for folder in chosen.relit:
            _relit(folder, chosen)
        return 0
    root = chosen.keep or Path(tempfile.mkdtemp(prefix="held-out-"))
    found = []
    methods = chosen.methods.split(",")
    groups = {1.0: [m for m in methods if m in ONE_FRAME], 0.5: [m for m in methods if m not in ONE_FRAME]}
    groups = groups if chosen.scale is None else {chosen.scale: methods}
    for rig_name, scene, scale in product(chosen.rigs.split(","), chosen.scenes.split(","), groups):
        if not groups[scale]:
            continue
        view = view_of(SCENES[scene], RIGS[rig_name].at(scale), chosen.rays)
        for method in groups[scale]:
            told = _one(view, method, root / f"{rig_name}-{scene}-{method}", chosen)
            found.append((rig_name, scene, method, told))
    if chosen.keep is None:
        shutil.rmtree(root)
    _page(found, chosen)
    return 0


def _page(found, chosen):
    if chosen.page:
        print(page.write(found))


def _one(view, method, folder, chosen):
    sequence = sequence_of(method, view.rig, chosen.axis, bracketed=not chosen.plain)
    began = time.perf_counter()
    capture(view, sequence, folder, chosen.seed, as_png=len(sequence) == 1)
    shown = time.perf_counter() - began
    truth = figures.truth_of(view)
    np.savez(folder / TRUTH_FILE, rows=truth.rows, columns=truth.columns, xyz=truth.xyz, lit=truth.lit)
    told = _told(folder, truth, f"{view.rig.name} {view.scene.name} {method} ({shown:.0f} s)")
    if chosen.keep is None:
        shutil.rmtree(folder)
    return told


def _relit(folder, chosen):
    """Relight one real scene by the MCP patterns, along each axis that the rig measures with."""
    scene = relit.scene_of(folder)
    truth, calibration = scene[:2]
    size = ProjectorSize(*calibration.projector.size)
    axis = chosen.axis or calibration.phase_axis
    root = chosen.keep or Path(tempfile.mkdtemp(prefix="held-out-"))
    for method, pattern in (
        ("mcp", choose_mcp(size, axis, calibration.camera_scale).pattern),
        ("published", published(axis)),
    ):
        out = root / f"relit-{folder.name}-{method}"
        image = relit.relit(scene, pattern, size, chosen.seed)
        write_capture(out, PatternSequence(size, pattern), [image], calibration.as_dict(), calibration.camera.size)
        np.savez(out / TRUTH_FILE, rows=truth.rows, columns=truth.columns, xyz=truth.xyz, lit=truth.lit)
        _told(out, truth, out.name)
    if chosen.keep is None:
        shutil.rmtree(root)


def _told(folder, truth, name):
    """Decode a folder and print a line."""
    found, _ = decoded(folder, truth)
    told = found.figures
    cells = [f"{name} {told[name]:.4f}" for name in (*STRIPES, *PIXELS) if name in told and not np.isnan(told[name])]
    print(f"{name}: " + (found.refused or "  ".join(cells)), flush=True)
    for said in found.warnings:
        print(f"    warns: {said}")
    return found


if __name__ == "__main__":
    sys.exit(main())
