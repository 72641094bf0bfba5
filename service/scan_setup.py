"""From a rig and a scan's parameters to what the sequencer runs: devices, calibration, patterns. Runs in the devices
process; it opens devices through the registry and takes no frame.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers import registry
from scanner.clock import Clock
from scanner.devices import CameraSettings, Interval, KnowsTemperature, KnowsTruth, ProjectorKind, TriggerMode
from scanner.errors import ConfigError, DecodeError, DeviceError, DeviceLost, SyncError
from scanner.geometry import Calibration, load_calibration
from scanner.patterns import McpPattern, PatternSequence, ProjectorSize
from scanner.sequencer import Rig, auto_exposure, measure_latency
from scanner.sequencer.latency import Disagreement, LateLight, disagreement
from scanner.wire import ScanStart
from service.rig_patterns import KnownRig, known_of
from service.scan_patterns import check_length, pattern_for

_log = logging.getLogger(__name__)


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
    latency_checked: bool = False
    """whether the rig file's latency was held against the light already"""
    disagreement: str | None = None
    """what is wrong with it"""

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
        timing = {} if self.disagreement is None else {"timing": {"warning": self.disagreement}}
        return {"warm_up": warmth} | ({} if self.marks is None else {"marks": self.marks}) | timing

    def measure_latency(self, clock: Clock) -> None:
        """Measure the projector's latency and settling, once, where rig file and driver do not know both.

        What the rig file says is held against one flip, once, and believed all the same: a scan warns of it.

        Raises:
            SyncError: black and white cannot be told apart.
            DeviceError: a device failed.
        """
        rig = self.rig
        if rig.projector.capabilities.kind is not ProjectorKind.FRAMEBUFFER:
            return
        if not rig.light_known:
            self.loaded = None
            latency, settle = measure_latency(
                rig.projector, rig.camera, clock, settings=rig.settings, trigger_mode=rig.trigger_mode
            )
            self.rig = replace(rig, latency=latency, settle=settle)
            self.latency_checked = True
        elif rig.latency is not None and not self.latency_checked:
            self._check_latency(clock, rig.latency, rig.settle or rig.projector.capabilities.settle or Interval(0, 0))

    def _check_latency(self, clock: Clock, latency: Interval, settle: Interval) -> None:
        self.loaded, self.latency_checked = None, True
        rig = self.rig
        try:
            found = disagreement(
                rig.projector,
                rig.camera,
                clock,
                (latency, settle),
                settings=rig.settings,
                trigger_mode=rig.trigger_mode,
            )
        except DeviceLost:
            raise
        except LateLight as error:
            found, self.disagreement = None, f"the rig file's latency_us is {_ms(latency)}; {error}: {error.hint}"
            _log.warning("%s: %s", rig.projector.name, self.disagreement)
        except (ConfigError, SyncError, DeviceError) as error:  # the scan itself says what it cannot work with
            _log.info("%s: its latency was not checked: %s", rig.projector.name, error)
            return
        if found is not None:
            self.disagreement = _disagreement(latency, found)
            _log.warning("%s: %s", rig.projector.name, self.disagreement)

    @property
    def timing_hint(self) -> str:
        """What to do where a scan is out of step: what it believed of latency and settling, and where that is from."""
        if self.disagreement is not None:
            return self.disagreement
        typed = [name for name in ("latency_us", "settle_us") if self.settings["projector"][name] is not None]
        if typed:
            names, them = " and ".join(typed), "they are" if len(typed) > 1 else "it is"
            return f"take {names} out of the rig file so that {them} measured, or raise dwell"
        if self.latency_checked:
            return (
                "light comes at other times than were measured before the scan: turn off what buffers pictures "
                "(a compositor, a television's picture mode), or raise dwell"
            )
        return (
            "the projector's latency and settling are those that its driver states: hold them against fringed "
            "calibrate sync, or raise dwell"
        )

    def exposure_for(
        self, clock: Clock, sequence: PatternSequence, given: float | str | None = None
    ) -> tuple[int, dict[str, Any]]:
        """The exposure of a scan, ns, and where it comes from, as capture.json has it.

        Args:
            given: for this scan, microseconds or "auto"; None: as the rig file says, which may leave it to test shots.

        Raises:
            DeviceError: a device failed.
            ConfigError: out of bounds, or the camera refuses its settings.
        """
        wanted = given if given is not None else self.exposure or "auto"
        if not isinstance(wanted, str):
            if not 0 < wanted <= 10_000_000:
                raise ConfigError(f"exposure {wanted:g} us is outside 0 .. 10 s", hint='give microseconds, or "auto"')
            return round(wanted * 1000), {"mode": "given", "asked_us": wanted}
        rig, self.loaded = self.rig, None
        choice = auto_exposure(
            rig.projector,
            rig.camera,
            clock,
            sequence,
            settings=rig.settings,
            trigger_mode=rig.trigger_mode,
            latency=rig.latency,
            settle=rig.settle,
        )
        return choice.exposure_ns, {
            "mode": "auto",
            "exposure_us": choice.exposure_ns / 1000,
            "level": choice.level,
            "note": choice.note,
            "warning": choice.warning,
        }

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
    for said in () if calibration is None else calibration.warnings:
        _log.warning("%s", said)
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


def _marks(path: str | None) -> dict[str, Any] | None:
    if path is None:
        return None
    from scanner.calibration.marks import load_marks  # noqa: PLC0415  (brings detection; few rigs have marks)

    return load_marks(Path(path)).as_dict()


def timing_values(latency: Interval, settle: Interval) -> dict[str, list[int]]:
    """Measured times as the rig file's table [projector] has them: whole microseconds, rounded outwards."""
    times = (("latency_us", latency), ("settle_us", settle))
    return {name: [interval.low_ns // 1000, -(-interval.high_ns // 1000)] for name, interval in times}


def timing_lines(latency: Interval, settle: Interval) -> str:
    """The same as lines of that table."""
    return "\n".join(f"{name} = {values}" for name, values in timing_values(latency, settle).items())


def _disagreement(given: Interval, found: Disagreement) -> str:
    wrong = "too long: every frame waits for it" if found.off_ns > 0 else "too short: frames may show another pattern"
    lines = timing_lines(found.latency, found.settle).replace("\n", " and ")
    return (
        f"the rig file's latency_us, {_ms(given)}, is {abs(found.off_ns) / 1e6:.1f} ms {wrong}; light came "
        f"{_ms(found.latency)} after the flip. In [projector] write {lines}"
    )


def _ms(interval: Interval) -> str:
    low, high = (f"{ns / 1e6:.1f}" for ns in (interval.low_ns, interval.high_ns))
    return f"{low} ms" if low == high else f"{low} .. {high} ms"


def _interval(microseconds: Any) -> Interval | None:
    if microseconds is None:
        return None
    low, high = microseconds if isinstance(microseconds, list | tuple) else (microseconds, microseconds)
    return Interval(round(low * 1000), round(high * 1000))
