"""From a rig and a scan's parameters to what the sequencer runs: devices, calibration, patterns. Runs in the devices
process; it opens devices through the registry and takes no frame.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from drivers import registry
from scanner.clock import Clock
from scanner.devices import CameraSettings, Interval, KnowsTemperature, KnowsTruth, ProjectorKind, TriggerMode
from scanner.errors import ConfigError, DecodeError, DeviceError
from scanner.geometry import Calibration, load_calibration
from scanner.patterns import (
    Axis,
    CompositePattern,
    GrayPattern,
    McpPattern,
    Pattern,
    PatternSequence,
    PmpPattern,
    ProjectorSize,
    pattern_from_description,
)
from scanner.patterns.description import read_numbers
from scanner.patterns.graypmp import default_gray_pmp
from scanner.patterns.mcp_choice import choose_mcp
from scanner.sequencer import Rig, measure_latency
from scanner.wire import ScanStart
from service.rig_patterns import KnownRig, known_of

_log = logging.getLogger(__name__)

METHODS = ("pmp", "mcp", "gray", "cp", "gray+pmp")

PMP_FINEST = 64
"""Cycles of the finest default fringe."""

PMP_LEAST_PERIOD_PX = 8
"""A default fringe has at least this many projector pixels: four for each half wave, so that it is still a cosine."""

MAX_IMAGES = 1024
"""Fringe images of one sequence: the projector holds them all, 2 GB of 1920 x 1080."""

MAX_FRAMES = 65_536
"""Frames of one scan, repetitions included, unless one image stays on: 18 minutes at 60 Hz, and nobody else's turn."""


@dataclass
class OpenRig:
    """The opened devices, the rig file's words on them, and what was measured of them since."""

    rig: Rig
    settings: Mapping[str, Any]
    """the rig file as plain data"""
    calibration: Calibration | None
    loaded: PatternSequence | None = None
    """what the projector holds; None: something else"""
    opened_ns: int = 0
    """when the devices were opened, by the clock they live in"""
    marks: Mapping[str, Any] | None = None
    """witness marks of the rig file, as `Marks.as_dict` has them"""

    @property
    def projector(self) -> ProjectorSize:
        """Size of the projected image."""
        capabilities = self.rig.projector.capabilities
        return ProjectorSize(capabilities.width, capabilities.height)

    @property
    def known(self) -> KnownRig:
        """What patterns depend on."""
        camera = self.rig.camera.capabilities
        return known_of(
            self.settings["rig"]["phase_axis"], self.calibration, self.projector, (camera.width, camera.height)
        )

    @property
    def exposure(self) -> float | str | None:
        """The rig file's exposure: microseconds, "auto" or None."""
        value: float | str | None = self.settings["camera"]["settings"]["exposure_us"]
        return value

    def scan_state(self, clock: Clock) -> dict[str, Any]:
        """Members of capture.json: how warm the rig is, and its witness marks where it has any."""
        camera = self.rig.camera
        warmth: dict[str, Any] = {"devices_open_s": round((clock.now_ns() - self.opened_ns) / 1e9, 1)}
        if isinstance(camera, KnowsTemperature):
            try:
                warmth["camera_c"] = camera.temperature_c()
            except DeviceError as error:  # a scan needs no thermometer
                _log.warning("%s: its temperature was not read: %s", camera.name, error)
        return {"warm_up": warmth} | ({} if self.marks is None else {"marks": self.marks})

    def measure_latency(self, clock: Clock) -> None:
        """Measure the projector's latency and settling, once, where neither rig file nor driver knows them.

        Raises:
            SyncError: black and white cannot be told apart.
            DeviceError: a device failed.
        """
        rig, declared = self.rig, self.rig.projector.capabilities
        known = (rig.latency or declared.latency) is not None and (rig.settle or declared.settle) is not None
        if known or declared.kind is not ProjectorKind.FRAMEBUFFER:
            return
        self.loaded = None
        latency, settle = measure_latency(
            rig.projector, rig.camera, clock, settings=rig.settings, trigger_mode=rig.trigger_mode
        )
        self.rig = replace(rig, latency=latency, settle=settle)

    def close(self) -> None:
        """Give the devices back, the projector black last."""
        self.rig.camera.close()
        if self.rig.trigger is not None:
            self.rig.trigger.close()
        self.rig.projector.close()


def open_rig(settings: Mapping[str, Any], clock: Clock) -> OpenRig:
    """Open a rig's devices.

    Args:
        settings: `RigConfig.model_dump(mode="json")`.
        clock: the time that devices and sequencer live in.

    Raises:
        ConfigError, DeviceError: see `drivers.registry`.
        CalibrationError: the rig file's calibration or marks are unusable.
    """
    camera_part, projector_part, trigger_part = (settings[key] for key in ("camera", "projector", "trigger"))
    path = settings["rig"]["calibration"]
    calibration = None if path is None else load_calibration(Path(path))
    marks = _marks(settings["rig"].get("marks"))
    options = dict(projector_part["options"])
    if projector_part["mode"] is not None:
        options["mode"] = projector_part["mode"]
    projector = registry.open_projector(projector_part["driver"], projector_part["device"], options, clock)
    try:
        camera = registry.open_camera(camera_part["driver"], camera_part["device"], camera_part["options"], clock)
    except BaseException:
        projector.close()
        raise
    trigger = None
    try:
        trigger = (
            None
            if trigger_part is None
            else registry.open_trigger(trigger_part["driver"], trigger_part["device"], trigger_part["options"], clock)
        )
        if calibration is None and isinstance(camera, KnowsTruth):
            calibration = camera.true_calibration()
        wanted = camera_part["settings"]
        region = wanted["region"]
        camera_settings = camera.apply(
            CameraSettings(
                gain_db=wanted["gain_db"],
                pixel_format=wanted["pixel_format"],
                region=None if region is None else (region[0], region[1], region[2], region[3]),
            )
        )
    except BaseException:
        camera.close()
        if trigger is not None:
            trigger.close()
        projector.close()
        raise
    mode = wanted["trigger_mode"]
    rig = Rig(
        projector=projector,
        camera=camera,
        trigger=trigger,
        latency=_interval(projector_part["latency_us"]),
        settle=_interval(projector_part["settle_us"]),
        dwell=projector_part["dwell"],
        settings=replace(camera_settings, exposure_ns=None),
        trigger_mode=None if mode is None else TriggerMode(mode),
        mirror=projector_part["mirror"],
        rotate=projector_part["rotate"],
    )
    return OpenRig(rig, settings, calibration, opened_ns=clock.now_ns(), marks=marks)


def sequence_for(opened: OpenRig, params: ScanStart) -> PatternSequence:
    """The sequence that a scan projects: the method's pattern, bracketed, pre-corrected for the rig's response.

    Raises:
        ConfigError: unknown method, or a pattern that contradicts it or does not fit the projector.
    """
    known = opened.known
    try:
        pattern = pattern_for(params.method, params.pattern or {}, known.axis, known.projector, known.camera_scale)
        check_length(pattern.fringe_count, params.repeat)
        # A position as in a description, or true from the command line: full-on and full-off frames beside the pattern.
        white = isinstance(pattern, McpPattern) and (params.pattern or {}).get("white") not in (None, False)
        return PatternSequence.bracketed(known.projector, pattern, known.precorrection, white=white)
    except DecodeError as error:
        raise ConfigError(error.message, hint=error.hint) from error


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
        DecodeError: a member is wrong.
    """
    if method not in METHODS:
        raise ConfigError(f"unknown method {method!r}", hint=f"methods: {', '.join(METHODS)}")
    if given.get("method", method) != method:
        raise ConfigError(f"the pattern is {given['method']!r}, the method {method!r}", hint="leave one of them out")
    default = default_pattern(
        method, tuple(given.get("axes") or (axis,)), given.get("axis", axis), projector, camera_scale
    )
    if method == "gray+pmp" and "frequencies" in given:
        default = default_gray_pmp(
            tuple(given.get("axes") or (axis,)), projector, read_numbers(given, "frequencies")[0]
        )
    _refuse_unknown(method, given, default)
    described = {**default.describe(), **given}
    if method == "pmp" and "frequencies" in given and "shifts" not in given:
        described["shifts"] = [8] * len(given["frequencies"])
    return pattern_from_description(described)


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


def _marks(path: str | None) -> dict[str, Any] | None:
    if path is None:
        return None
    from scanner.calibration.marks import load_marks  # noqa: PLC0415  (brings detection; few rigs have marks)

    return load_marks(Path(path)).as_dict()


def _interval(microseconds: Any) -> Interval | None:
    if microseconds is None:
        return None
    low, high = microseconds if isinstance(microseconds, list | tuple) else (microseconds, microseconds)
    return Interval(round(low * 1000), round(high * 1000))
