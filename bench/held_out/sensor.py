"""The camera behind its lens: blur, vignetting, shot noise, black level, clipping; and the folder of a capture."""

from __future__ import annotations

import json

import cv2
import numpy as np

from held_out.light import shown

FULL = 0.82
"""Of the range: what the brightest hundredth but a half of a white frame's scattered light is set to"""


def exposure_of(view):
    """Grey levels per unit of radiance."""
    white = shown(view, np.full(view.rig.projector.size[::-1], 255, np.uint8))
    return FULL * 255 * view.scene.exposure / float(np.percentile(white[view.lit] * view.shade[view.lit], 97))


def frame(view, image, gain, rng):
    """(H, W) uint8 of one projected image."""
    rig = view.rig
    radiance = shown(view, image) + rig.ambient * view.scene.ambient * view.albedo
    radiance = cv2.GaussianBlur(radiance, (0, 0), rig.camera_blur_px) * view.shade
    level = gain * radiance
    electrons = level * rig.full_well_e / 255
    noise = rng.standard_normal(level.shape, np.float32)
    level = level + noise * np.sqrt(np.maximum(electrons, 0)) * (255 / rig.full_well_e)
    level = np.clip(level / 255, 0, None) ** (1 / rig.camera_gamma) * 255 if rig.camera_gamma != 1 else level
    level = level + rig.black_dn + rig.read_noise_dn * rng.standard_normal(level.shape, np.float32)
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def write_capture(folder, sequence, frames, calibration, camera_size, *, as_png=False):
    """capture.json, calibration.json and frames, as a program of somebody else would write them."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration.json").write_text(json.dumps(calibration), encoding="utf-8")
    header = {
        "format": "fringed-capture",
        "version": 1,
        "projector": {"width": sequence.projector.width, "height": sequence.projector.height},
        "camera": {"width": camera_size[0], "height": camera_size[1], "bits": 8},
        "pattern": sequence.describe(),
        "calibration": "calibration.json",
    }
    if as_png:
        header["frames"] = [f"{k:03d}.png" for k in range(len(frames))]
        for name, each in zip(header["frames"], frames, strict=True):
            cv2.imwrite(str(folder / name), each)
    else:
        np.save(folder / "frames.npy", np.stack(frames))
    (folder / "capture.json").write_text(json.dumps(header), encoding="utf-8")


def capture(view, sequence, folder, seed=0, *, as_png=False):
    """Show each image of a sequence to a view and write the folder; the frames."""
    rng = np.random.default_rng(seed)
    gain = exposure_of(view)
    frames = [frame(view, sequence.image(k), gain, rng) for k in range(len(sequence))]
    write_capture(folder, sequence, frames, view.rig.calibration(), view.rig.camera.size, as_png=as_png)
    return frames
