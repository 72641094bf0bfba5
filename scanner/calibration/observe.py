"""From a capture of a target to what the adjustment takes: its points in camera and projector.

A capture that cannot serve (one axis only, out of step, no target in it) gives a reason, not an error: a folder of
poses of which some are unusable still calibrates, and says which were left out and why.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.calibration.copies import again, capture_key
from scanner.calibration.detection import FEWEST_POINTS, NotFound, detect
from scanner.calibration.markers import MARKERS, markers_in, of_another_kind
from scanner.calibration.problem import View
from scanner.calibration.projector_points import LEAST_REACH_PX, projector_points
from scanner.calibration.targets import Target
from scanner.capture import FRAMES_FILE, Capture
from scanner.decode import Decoded, Decoder, Reason, decoder_for
from scanner.decode.reasons import tally
from scanner.errors import ConfigError, DecodeError, ScannerError, SyncError
from scanner.sequencer import check_capture

HEADER_FILE = "capture.json"
DEEPEST = 3
"""Folders below one that is named in which captures are looked for."""
MOST_NAMED = 4
"""Captures with one fault that are named; the others are counted."""
FLATTEST = 0.02
"""Width over length of a view's points on the target, below which they lie on a line."""
MOST_CLIPPED = 0.05
"""Share of a target's pixels that may be saturated: glints"""
EXPOSE_LESS = "expose for less (--exposure auto), lower the gain, or close the lens"


@dataclass(frozen=True, eq=False)
class Observation:
    """One usable capture. response: what its patterns were corrected for; created: when it was taken; warm_up: how warm
    the rig was, as capture.json has it; key: what its copies have too; warnings: what is wrong with it, though it
    serves."""

    view: View
    camera_size: tuple[int, int]
    projector_size: tuple[int, int]
    response: dict[str, Any] | None = None
    created: str = ""
    warm_up: Mapping[str, Any] = field(default_factory=dict)
    key: Hashable = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class LeftOut:
    """A capture that could not be used."""

    name: str
    reason: str
    out_of_step: bool = False
    unreadable: bool = False
    """its frames cannot be read or decoded; what they show was not looked at"""


def find_captures(paths: Sequence[Path]) -> list[Path]:
    """The captures that paths name: a capture folder, its JSON file, a scan's folder, or a folder of those.

    Each once, in the order in which people count: pose 2 before pose 10.

    Raises:
        ConfigError: a path is not there, or holds no capture.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise ConfigError(f"no such capture: {path}")
        here = [path] if path.is_file() else list(_below(path, DEEPEST))
        if not here:
            raise ConfigError(f"{path} holds no capture", hint=f"a capture is a folder with a {HEADER_FILE} in it")
        found += [capture for capture in here if capture not in found]
    return sorted(found, key=natural)


def natural(path: Path) -> list[str | int]:
    """A key that sorts paths by their numbers' values: text and numbers take turns."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+)", str(path)))]


def observe(
    paths: Sequence[Path], target: Target, progress: Callable[[int, int], None] | None = None
) -> tuple[list[Observation], list[LeftOut]]:
    """Look at every capture; see `observe_capture`. Copies of one that serves are left out. progress: (done, total)."""
    observations: list[Observation] = []
    left_out: list[LeftOut] = []
    names = _names(paths)
    seen: dict[Hashable, tuple[Path, str]] = {}
    for done, (path, name) in enumerate(zip(paths, names, strict=True)):
        # All show the same target, and a look for markers takes as long as all else.
        outcome = observe_capture(path, name, target, doubt_kind=not observations)
        if isinstance(outcome, Observation) and (how := again(path, (outcome.key,), seen)) is not None:
            outcome = LeftOut(name, f"it {how}, and tells nothing new")
        if isinstance(outcome, Observation):
            observations.append(outcome)
            seen[outcome.key] = path, name
        else:
            left_out.append(outcome)
        if progress is not None:
            progress(done + 1, len(paths))
    return observations, left_out


def warm_up_of(observations: Sequence[Observation]) -> dict[str, list[float]]:
    """Least and most of what the captures say of how warm the rig was: devices_open_s, camera_c (where known)."""
    found: dict[str, list[float]] = {}
    for name in ("devices_open_s", "camera_c"):
        values = [value for one in observations if isinstance(value := one.warm_up.get(name), int | float)]
        if values:
            found[name] = [float(min(values)), float(max(values))]
    return found


def observe_capture(path: Path, name: str, target: Target, *, doubt_kind: bool = False) -> Observation | LeftOut:
    """Decode one capture and find the target in it. doubt_kind: warn of one that is of another kind than described."""
    try:
        capture = Capture.open(path)
        sequence = capture.header.sequence
        axes = set(getattr(sequence.pattern, "axes", ()))
        if axes != {"x", "y"}:
            return LeftOut(name, "its patterns run along one axis only: capture with --axis xy")
        if capture.header.state == "failed":
            return LeftOut(name, f"its capture failed ({capture.header.reason or 'no reason told'}): capture it again")
        capture.require_any()
        check_capture(capture).raise_if_out_of_step()
        decoder = decoder_for(sequence, capture.header.camera)
        for pattern in capture.records:
            if pattern < len(sequence):
                decoder.add(pattern, capture.frame(pattern))
        decoded = _finished(decoder, capture)
        at = sequence.white
        white = None if at is None or at not in capture.records else capture.frame(at)
        key = capture_key(capture)
    except SyncError as error:
        return LeftOut(name, f"frames out of step: {error}", out_of_step=True)
    except ScannerError as error:
        said = str(error) if error.hint is None else f"{error}; {error.hint}"
        if path.is_dir() and not (path / HEADER_FILE).is_file():
            said = f"no {HEADER_FILE} in it: nothing was captured here, or the file was lost"
        return LeftOut(name, said.replace(f"{path}/", ""), unreadable=True)
    view = observe_decoded(name, decoded, target, white=white, mosaic=capture.header.camera.mosaic is not None)
    if isinstance(view, LeftOut):
        charuco = doubt_kind and target.kind in ("chessboard", "circles", "acircles") and markers_in(decoded.albedo) > 0
        return replace(view, reason=view.reason + MARKERS) if charuco else view
    camera, projector = capture.header.camera, sequence.projector
    other_kind = of_another_kind(decoded.albedo, target) if doubt_kind else None
    correction = sequence.precorrection
    return Observation(
        view,
        (camera.width, camera.height),
        (projector.width, projector.height),
        None if correction is None else correction.describe(),
        capture.header.created,
        capture.header.extra.get("warm_up") or {},
        key,
        (*filter(None, [other_kind, capture.lost, _overexposed(decoded, target, view)]), *decoded.warnings),
    )


def warnings_of(observations: Sequence[Observation]) -> list[str]:
    """What is wrong with captures that serve, each thing once, after the names of those that have it."""
    named: dict[str, list[str]] = {}
    for one in observations:
        for said in one.warnings:
            named.setdefault(said, []).append(one.view.name)
    return [f"{_and_more('capture', names)} (used): {said}" for said, names in named.items()]


def _and_more(what: str, names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{what}{'s' if len(names) > 1 else ''} {', '.join(names[:MOST_NAMED])}{more}"


def observe_decoded(
    name: str,
    decoded: Decoded,
    target: Target,
    *,
    white: NDArray[Any] | None = None,
    mosaic: bool = False,
) -> View | LeftOut:
    """The target's points in decoded maps; in the white frame where there is one and it shows the target, else in the
    albedo, which is the mean of many frames. Pictures with a colour mosaic are smoothed over its 2 x 2 sites."""
    found: Any = NotFound("no picture")
    for picture in (white, decoded.albedo):
        if picture is None:
            continue
        # 1 2 1 in both directions weighs the four sites of a mosaic alike wherever it stands, and moves nothing.
        plain = np.asarray(picture, dtype=np.float32)
        found = detect(cv2.GaussianBlur(plain, (3, 3), 0.85) if mosaic else plain, target)
        if not isinstance(found, NotFound):
            break
    if isinstance(found, NotFound):
        return LeftOut(name, found.reason)
    seen = projector_points(decoded, found.points, found.spacing)
    kept = np.isfinite(seen.points).all(axis=1) & np.isfinite(seen.slope).all(axis=(1, 2))
    if kept.sum() < FEWEST_POINTS:
        return LeftOut(
            name, f"the projector's pixel is known of {int(kept.sum())} points only: {_why(decoded, found.points)}"
        )
    on_target = target.points[found.ids[kept]]
    extents = np.linalg.svd(on_target - on_target.mean(axis=0), compute_uv=False)
    if extents[1] < FLATTEST * extents[0]:
        return LeftOut(name, "the points that are seen lie on a line")
    return View(name, found.ids[kept], found.points[kept], seen.points[kept], seen.sigma[kept], seen.slope[kept])


def _why(decoded: Decoded, points: NDArray[Any]) -> str:
    """What to do about most of a target's points whose surroundings have no value."""
    at = np.clip(np.rint(points[:, ::-1]).astype(int), 0, np.array(decoded.reason.shape) - 1)
    around = np.zeros(decoded.reason.shape, np.uint8)
    around[at[:, 0], at[:, 1]] = 1
    near = cv2.dilate(around, np.ones((2 * LEAST_REACH_PX + 1,) * 2, np.uint8)).astype(bool)
    causes = tally(decoded.reason[near])
    causes[Reason.VALUE] = 0
    if int(np.argmax(causes)) == Reason.CLIPPED:
        return f"it is overexposed: {EXPOSE_LESS}"
    return "light the whole target with the projector, and expose until its white is bright"


def _overexposed(decoded: Decoded, target: Target, view: View) -> str | None:
    """What to say of a flat target of which a good part is saturated, though enough points are left to serve."""
    if not target.flat:
        return None
    homography: Any = cv2.findHomography(target.points[view.ids, :2], view.camera)[0]
    if homography is None:  # no view of a plane
        return None
    outline = cv2.convexHull(cv2.perspectiveTransform(target.points[:, None, :2], homography).astype(np.float32))
    there = np.zeros(decoded.reason.shape, np.uint8)
    cv2.fillConvexPoly(there, np.rint(outline).astype(np.int32), 1)
    share = float(np.mean(decoded.reason[there > 0] == Reason.CLIPPED)) if there.any() else 0.0
    if share < MOST_CLIPPED:
        return None
    return f"a part of the target is overexposed, and has no points: {EXPOSE_LESS}"


def _finished(decoder: Decoder, capture: Capture) -> Decoded:
    """What is decoded; an error names what is to blame for the first of the frames that are not there."""
    try:
        return decoder.finish()
    except DecodeError as error:
        if not capture.missing:
            raise
        raise DecodeError(f"{error}; {capture.fault(capture.missing[0])}", hint=error.hint) from error


def _below(folder: Path, depth: int) -> Iterator[Path]:
    """Captures; and what should be one: frames without a header, and folders with nothing in them."""
    if (folder / HEADER_FILE).is_file() or (folder / FRAMES_FILE).is_file():
        yield folder
    elif depth:
        for child in folder.iterdir():
            if child.is_dir() and any(child.iterdir()):
                yield from _below(child, depth - 1)
            elif child.is_dir():
                yield child


def _names(paths: Sequence[Path]) -> list[str]:
    """Short names that tell the captures apart: the folder's, and its parents' where that does not do."""
    parts = [(path.parent if path.name == HEADER_FILE else path).absolute().parts for path in paths]
    parts = [part[:-1] if part[-1] == "capture" and len(part) > 1 else part for part in parts]
    for length in range(1, max(map(len, parts), default=1) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]
