"""Which pattern a scan's words mean: a method, the members that were given, and defaults for the rig's projector and
camera.

No device is known here, and nothing is imported that brings kernels: the daemon asks before it takes a job, the devices
process when it makes the sequence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from scanner.decode.unwrapping import plan_ladder
from scanner.errors import ConfigError, DecodeError
from scanner.patterns import (
    Axis,
    CompositePattern,
    GrayPattern,
    McpPattern,
    Pattern,
    PmpPattern,
    ProjectorSize,
    pattern_from_description,
)
from scanner.patterns.description import read_axes, read_choice, read_numbers
from scanner.patterns.graypmp import default_gray_pmp
from scanner.patterns.mcp_choice import choose_mcp
from scanner.patterns.sequence import read_precorrection

METHODS = ("pmp", "mcp", "gray", "cp", "gray+pmp")

PMP_FINEST = 64
"""Cycles of the finest default fringe."""

PMP_LEAST_PERIOD_PX = 8
"""A default fringe has at least this many projector pixels: four for each half wave, so that it is still a cosine."""

MAX_IMAGES = 1024
"""Fringe images of one sequence: the projector holds them all, 2 GB of 1920 x 1080."""

MAX_FRAMES = 65_536
"""Frames of one scan, repetitions included, unless one image stays on: 18 minutes at 60 Hz, and nobody else's turn."""


def check_length(images: int, repeat: int) -> None:
    """Refuse a scan that would fill memory, or the day, before an image of it is made.

    Raises:
        ConfigError: more than MAX_IMAGES, or MAX_FRAMES in all.
    """
    if images > MAX_IMAGES:
        raise ConfigError(f"the pattern has {images} images, more than {MAX_IMAGES}", hint="give fewer shifts")
    if images > 1 and images * repeat > MAX_FRAMES:
        raise ConfigError(
            f"{repeat} repetitions of {images} images are {images * repeat} frames, more than {MAX_FRAMES}",
            hint="repeat less often, or make several scans",
        )


def pattern_for(
    method: str,
    given: Mapping[str, Any],
    axis: Axis,
    projector: ProjectorSize,
    camera_scale: tuple[float, float] | None = None,
) -> Pattern:
    """A method's pattern: the given members, the others by default for this projector, and this camera if one is known.

    Raises:
        ConfigError: unknown method.
        DecodeError: a member is wrong, or frequencies that nothing can unwrap.
    """
    if method not in METHODS:
        raise ConfigError(f"unknown method {method!r}", hint=f"methods: {', '.join(METHODS)}")
    if given.get("method", method) != method:
        raise ConfigError(f"the pattern is {given['method']!r}, the method {method!r}", hint="leave one of them out")
    axes = read_axes(given) if "axes" in given else (axis,)
    along: Axis = read_choice(given, "axis", ("x", "y")) if method in ("mcp", "cp") and "axis" in given else axis
    frequencies = read_numbers(given, "frequencies") if "frequencies" in given else ()
    default = default_pattern(method, axes, along, projector, camera_scale)
    if method == "gray+pmp" and frequencies:
        default = default_gray_pmp(axes, projector, frequencies[0])
    _refuse_unknown(method, given, default)
    read_precorrection(given.get("precorrection"))  # the rig's own is applied, but nonsense is no description
    described = {**default.describe(), **given}
    if method == "pmp" and frequencies and "shifts" not in given:
        described["shifts"] = [8] * len(frequencies)
    pattern = pattern_from_description(described)
    if method == "pmp" and isinstance(pattern, PmpPattern):
        # What no decoder can unwrap is refused before it is captured.
        plan_ladder(pattern.frequencies, [2 / n for n in pattern.shifts])
    return pattern


_OF_SEQUENCES = frozenset({"method", "white", "black", "sentinels", "bars", "precorrection"})
"""Members of a whole sequence's description, which a scan makes itself: a description may be given back as it was."""


def _refuse_unknown(method: str, given: Mapping[str, Any], default: Pattern) -> None:
    """A misspelt member must not be a scan without it."""
    known = default.describe().keys()
    for name in given.keys() - known - _OF_SEQUENCES:
        near = get_close_matches(str(name), known, n=1)
        raise ConfigError(
            f"pattern member {name!r} says nothing to the method {method!r}",
            hint=f"did you mean {near[0]!r}?" if near else f"its members: {', '.join(sorted(known))}",
        )


def default_pattern(
    method: str,
    axes: tuple[Axis, ...],
    axis: Axis,
    projector: ProjectorSize,
    camera_scale: tuple[float, float] | None = None,
) -> Pattern:
    """A method's default pattern on this projector, seen at this scale if that is known."""
    if method == "pmp":
        return PmpPattern(axes=axes, frequencies=_pmp_frequencies(axes, projector), shifts=(8, 8, 8))
    if method == "gray+pmp":
        return default_gray_pmp(axes, projector)
    if method == "gray":
        bits = max(math.ceil(math.log2(projector.along(a))) for a in axes)
        return GrayPattern(axes=axes, bits=bits, code_bits=bits)
    if method == "cp":
        return _composite(axis, projector)
    return _mcp(axis, projector, camera_scale)


def _mcp(axis: Axis, projector: ProjectorSize, camera_scale: tuple[float, float] | None) -> McpPattern:
    """The one chosen for the camera; where none is known that of the publications, on a smaller projector less."""
    if camera_scale is not None:
        return choose_mcp(projector, axis, camera_scale).pattern
    pattern = McpPattern(axis=axis)
    try:
        pattern.validate(projector)
    except DecodeError:
        return _smaller_mcp(pattern, projector)
    return pattern


def _pmp_frequencies(axes: tuple[Axis, ...], projector: ProjectorSize) -> tuple[float, ...]:
    least = min(projector.along(axis) for axis in axes)
    finest = min(PMP_FINEST, max(4, least // PMP_LEAST_PERIOD_PX))
    # Equal ratios: each step of the unwrapping then has the same margin.
    return (1.0, float(round(math.sqrt(finest))), float(finest))


def _composite(axis: Axis, projector: ProjectorSize) -> CompositePattern:
    """The published carriers, in proportion to a smaller projector."""
    pattern = CompositePattern(axis=axis)
    across = projector.along("x" if axis == "y" else "y")
    scale = min(1.0, across / 4 / max(pattern.carriers))  # four pixels a period: half of what a projector can show
    if scale == 1.0:
        return pattern
    try:
        return CompositePattern(axis, tuple(float(int(f * scale)) for f in pattern.carriers))
    except DecodeError as problem:
        raise ConfigError(
            f"a projector of {projector.width} x {projector.height} is too small for cp: {problem}",
            hint="use pmp, or give carriers of your own",
        ) from problem


def _smaller_mcp(pattern: McpPattern, projector: ProjectorSize) -> McpPattern:
    """Carriers in proportion to the projector, and as many bits as leave stripes and gaps that can be decoded."""
    across = projector.along("x" if pattern.axis == "y" else "y")
    scale = across / 3 / max(pattern.carriers) / 1.6  # the default's own margin below the limit, on 1152 pixels: 1.7
    carriers = tuple(float(round(carrier * scale)) for carrier in pattern.carriers)
    problem: DecodeError | None = None
    for bits in range(pattern.bits, 1, -1):
        codes = pattern.codes if bits == pattern.bits else tuple(range(1 << bits))
        try:
            smaller = replace(pattern, bits=bits, carriers=carriers[-bits:], codes=codes)
            smaller.validate(projector)
        except DecodeError as error:
            problem = error
            continue
        return smaller
    raise ConfigError(
        f"a projector of {projector.width} x {projector.height} is too small for mcp: {problem}",
        hint="use pmp, or give a pattern of your own",
    )
