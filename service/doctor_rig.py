"""What a rig's own devices do: opened, timed, looked at and fired, as a scan would, and judged.

The devices must be free: a daemon that drives them is asked to end first. Nothing is written; what was measured is
told in the words of the rig file, to be put there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import Any

from scanner.clock import Clock
from scanner.devices import CameraSettings, ChecksSetup, ProjectorKind, Source, TableSlot, TriggerSource
from scanner.errors import ScannerError
from scanner.sequencer import Rig, measure_latency
from scanner.sequencer.light import Light, measure_light
from scanner.sequencer.picture import measure_picture
from service.config import RigConfig
from service.doctor import Finding, Level
from service.rig_check import half_known
from service.scan_setup import OpenRig, open_rig, timing_lines

MOST_PULSING = 0.02
"""Of a grey over phases of the refresh: below, a part of a refresh sees a grey to two hundredths, as noise does"""

MOST_FLICKER = 0.005
"""Of white from frame to frame: half a per cent moves a phase of three shifts by a 400th of a fringe"""

LINEAR = 0.05
"""Gammas nearer to 1 leave a second harmonic below 2 %, which four shifts or more cancel"""

MOST_MISFIT = 0.02
"""Rms that a pure exponent may leave: beyond, a table is wanted"""

LEAST_CHECKER = 0.45
"""Of white's light, for a checker of single pixels: a tenth less than the half that it has where pixels stay pixels. A
picture scaled at gamma 2.2 has a third; wires too slow for a pixel clock lose light likewise"""

MOST_DYNAMIC = 0.1
"""By which a white patch may change when all around it turns black: stray light of lens and scene is some per cent,
dynamic contrast and automatic exposure are tens"""

SAME_RATE = 3e-4
"""59.94 and 60 Hz are 1e-3 apart; the clocks of graphics cards and ours are good to 1e-4"""

PULSES = 20

SMALLER = "take a smaller region or fewer frames a second, or a faster link"

Stage = Callable[[str], None]
"""Told what is measured next."""


def examine_rig(config: RigConfig, clock: Clock, stage: Stage) -> Iterator[Finding]:
    """Open a rig's devices, measure, and give them back."""
    stage("opening devices")
    try:
        opened = open_rig(config.model_dump(mode="json"), clock)
    except ScannerError as error:
        yield Finding("devices", Level.BAD, str(error), error.hint or "")
        return
    try:
        yield Finding("devices", Level.OK, f"{opened.rig.camera.name}; {opened.rig.projector.name}")
        looks = [("host", host), ("latency", latency), ("light", light), ("picture", picture)]
        looks += [("trigger line", pulses)] if opened.rig.trigger is not None else []
        for name, look in looks:
            stage(f"measuring {name}")
            try:
                yield from look(opened, clock)
            except ScannerError as error:
                yield Finding(name, Level.BAD, str(error), error.hint or "")
    finally:
        opened.close()


def host(opened: OpenRig, clock: Clock) -> Iterator[Finding]:
    """What the camera's own driver finds on this machine, at the camera's full rate."""
    camera = opened.rig.camera
    if isinstance(camera, ChecksSetup):
        for found in camera.check_setup():
            level = Level.OK if found.ok else Level.BAD
            yield Finding(found.subject, level, found.text, found.command or ("" if found.ok else SMALLER))
    stamp = camera.capabilities.stamp
    said = f"frames are stamped by {stamp.value}, true within {camera.capabilities.stamp_bound_ns / 1e3:.4g} us"
    if stamp is Source.ESTIMATED:
        mend = "nothing is proved by estimates; the driver's page of the documentation says how to measure its stamps"
        yield Finding("stamps", Level.NOTE, said, mend)
    else:
        yield Finding("stamps", Level.OK, said)


def latency(opened: OpenRig, clock: Clock) -> Iterator[Finding]:
    """From flip to light, against what rig file or driver say."""
    rig, declared = opened.rig, opened.rig.projector.capabilities
    if declared.kind is not ProjectorKind.FRAMEBUFFER:
        yield Finding("latency", Level.OK, "the projector does not flip")
        return
    found, settle = measure_latency(
        rig.projector, rig.camera, clock, settings=rig.settings, trigger_mode=rig.trigger_mode
    )
    words = timing_lines(found, settle)
    said = f"{found.low_ns / 1e6:.2f} .. {found.high_ns / 1e6:.2f} ms, settled {settle.high_ns / 1e6:.2f} ms later"
    known, source = rig.latency or declared.latency, "rig file" if rig.latency else "driver"
    if found.low_ns == 0 and found.high_ns > declared.refresh_ns // 4:
        again = "try again while the machine has nothing else to do"
        yield Finding("latency", Level.NOTE, f"{said}: the light's begin was not caught", again)
    elif known is None:
        yield Finding("latency", Level.NOTE, f"{said}; the rig file has none", f"in [projector] write:\n{words}")
    elif found.high_ns < known.low_ns or found.low_ns > known.high_ns:
        wrong = f"{said}; the {source} says {known.low_ns / 1e6:.2f} .. {known.high_ns / 1e6:.2f} ms"
        yield Finding("latency", Level.BAD, wrong, f"in [projector] write:\n{words}")
    elif not rig.light_known:
        half = half_known(latency=True, settle=False)
        yield Finding("latency", Level.NOTE, f"{said}; {half}", f"in [projector] write:\n{words}")
    else:
        yield Finding("latency", Level.OK, f"{said}, as the {source} says")


def light(opened: OpenRig, clock: Clock) -> Iterator[Finding]:
    """Contrast, pulses, flicker and gamma."""
    rig = opened.rig
    found = measure_light(
        rig.projector,
        rig.camera,
        clock,
        settings=CameraSettings(None, rig.settings.gain_db, rig.settings.pixel_format, rig.settings.region),
        trigger_mode=rig.trigger_mode,
    )
    said = f"black {found.black:.1f}, white {found.white:.1f} at {found.exposure_ns / 1e6:.2f} ms"
    yield Finding("light", Level.OK, f"{said}, on {found.lit_share:.0%} of the image")
    yield _pulsing(found, rig)
    yield _flicker(found)
    if found.gamma is not None:
        yield _gamma(found, opened)


def picture(opened: OpenRig, clock: Clock) -> Iterator[Finding]:
    """Whether pixels stay pixels, greys stay what they are, and the refresh is the one that is set."""
    rig, declared = opened.rig, opened.rig.projector.capabilities
    if declared.kind is not ProjectorKind.FRAMEBUFFER:
        yield Finding("pixels", Level.OK, "the projector shows its own pictures")
        return
    settings = CameraSettings(None, rig.settings.gain_db, rig.settings.pixel_format, rig.settings.region)
    found = measure_picture(rig.projector, rig.camera, clock, settings=settings, trigger_mode=rig.trigger_mode)
    off = (
        "on the projector, switch keystone, overscan, zoom and sharpness off, and set the rig file's mode to its native"
    )
    said = f"a checker of single pixels has {found.checker:.0%} of white's light"
    sharp = abs(found.checker - 0.5) <= 0.5 - LEAST_CHECKER
    yield Finding("pixels", Level.OK if sharp else Level.BAD, said, "" if sharp else f"{off} one")
    said = f"a white patch on black has {found.patch:.0%} of its light in a white picture"
    steady = abs(found.patch - 1) <= MOST_DYNAMIC
    mend = "switch the projector's dynamic contrast, iris and eco modes off, and the camera's automatics"
    yield Finding("dynamics", Level.OK if steady else Level.BAD, said, "" if steady else mend)
    said = f"black differs by {found.room:.2%} of white from frame to frame"
    calm = found.room < MOST_FLICKER
    mend = "keep the room's lamps off it, or expose for whole periods of mains light: 10 ms at 50 Hz, 8.33 ms at 60 Hz"
    yield Finding("room light", Level.OK if calm else Level.BAD, said, "" if calm else mend)
    yield _rate(found.refresh_ns, declared.refresh_ns)


def _rate(measured_ns: float | None, declared_ns: int) -> Finding:
    declared = f"{1e9 / declared_ns:.3f} Hz"
    if measured_ns is None:
        return Finding("refresh", Level.OK, f"{declared}, as the driver says: its stamps are estimates")
    said = f"{1e9 / measured_ns:.3f} Hz, the driver says {declared}"
    if abs(measured_ns - declared_ns) <= SAME_RATE * declared_ns:
        return Finding("refresh", Level.OK, said)
    mend = (
        f'in [projector] set mode = "...@{1e9 / measured_ns:.2f}": exposures are whole refreshes, and 59.94 is not 60'
    )
    return Finding("refresh", Level.BAD, said, mend)


def pulses(opened: OpenRig, clock: Clock) -> Iterator[Finding]:
    """Whether a trigger board hears the vertical blank and pulses at its period."""
    board, refresh = opened.rig.trigger, opened.rig.projector.capabilities.refresh_ns
    if board is None:
        return
    if TriggerSource.VSYNC not in board.capabilities.sources:
        yield Finding("trigger line", Level.BAD, "the board has no vertical-sync input", "wire and flash one that has")
        return
    dark, pulse = board.capabilities.dark_min_us, max(board.capabilities.exposure_min_us, 100)
    board.program([TableSlot(i, pulse, dark, wait_trigger=True) for i in range(PULSES)], TriggerSource.VSYNC)
    board.arm()
    clock.sleep_until(clock.now_ns() + (PULSES + 5) * refresh)
    events, faults = board.events(), board.faults()
    board.abort()
    if faults or len(events) < PULSES:
        said = faults[0].message if faults else f"{len(events)} of {PULSES} pulses were reported"
        yield Finding("trigger line", Level.BAD, said, "check the wire from the display's vertical sync to the board")
        return
    gaps = [after.t_ns - before.t_ns for before, after in pairwise(events)]
    period = (events[-1].t_ns - events[0].t_ns) / (PULSES - 1)
    worst = max(abs(gap - period) for gap in gaps)
    said = f"{1e9 / period:.3f} Hz, the display says {1e9 / refresh:.3f} Hz; spacing within {worst / 1e3:.0f} us"
    level = Level.OK if abs(period - refresh) < 0.01 * refresh else Level.BAD
    mend = "" if level is Level.OK else "is it this display's vertical sync? Set its mode in the rig file"
    yield Finding("trigger line", level, said, mend)


def _pulsing(found: Light, rig: Rig) -> Finding:
    period = rig.projector.capabilities.modulation_period_ns
    if found.pulsing < MOST_PULSING:
        return Finding("grey", Level.OK, f"constant over the refresh ({found.pulsing:.1%})")
    said = f"built of pulses over the refresh (a short exposure sees {found.pulsing:.0%} more or less)"
    if period is not None:
        return Finding("grey", Level.OK, f"{said}; exposures are whole periods of {period / 1e6:.2f} ms")
    mend = "expose for whole refreshes: leave exposure_us out, or set it to a multiple of the refresh"
    return Finding("grey", Level.BAD, f"{said}, and the driver says it is constant", mend)


def _flicker(found: Light) -> Finding:
    said = f"white differs by {found.flicker:.2%} from frame to frame"
    if found.flicker < MOST_FLICKER:
        return Finding("flicker", Level.OK, said)
    mend = "shield the room's light, switch the projector's eco and dynamic modes off, or expose for more refreshes"
    return Finding("flicker", Level.BAD, said, mend)


def _gamma(found: Light, opened: OpenRig) -> Finding:
    content = {} if opened.calibration is None else opened.calibration.extra.get("response") or {}
    known: Mapping[str, Any] = content.get("projector") or {}
    said = f"greys follow an exponent of {found.gamma:.2f}"
    if "table" in known:
        return Finding("gamma", Level.OK, f"{said}; the calibration has a table that undoes it")
    if found.gamma_misfit > MOST_MISFIT:
        mend = "switch picture modes, keystone and dynamic contrast off; fringed calibrate response measures a table"
        return Finding("gamma", Level.BAD, f"{said} badly ({found.gamma_misfit:.1%} rms left)", mend)
    undone = float(known.get("gamma", 1.0))
    if found.gamma is None or abs(found.gamma - undone) < LINEAR * undone:
        return Finding("gamma", Level.OK, said if undone == 1 else f"{said}, which the calibration undoes")
    other = f"the calibration undoes {undone:.2f}" if "gamma" in known else "nothing undoes it"
    mend = f'put "response": {{"projector": {{"gamma": {found.gamma:.2f}}}}} into the calibration file'
    return Finding("gamma", Level.NOTE, f"{said}; {other}", mend)
