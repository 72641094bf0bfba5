"""The simulated projector: changes what shines at vertical blanks, with the latency that real ones have.

Its flip stamps are exact. Light follows after a latency that is fixed for the device, lies inside the declared
interval and jitters a little; then the image settles, everywhere at once or row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from drivers.display import check_images
from drivers.simulated.faults import Allowance, displayed_index
from drivers.simulated.gige_light import LightRelay
from drivers.simulated.lines import Recorded, Regular
from drivers.simulated.options import Settings
from drivers.simulated.timeline import LoadedImage, Manner
from drivers.simulated.world import World
from scanner.devices import Flip, Image, Interval, ProjectorCapabilities, ProjectorKind, Source
from scanner.errors import DeviceError, DeviceLost

PERIODS_PER_REFRESH = 4
"""Modulation periods in a refresh, as a colour wheel at four times the refresh has"""

STAMP_BOUND_NS = 1000
"""Flip stamps are true to this"""

LEAST_SEQUENCE = 9
"""Different images from which a run counts as a sequence, and not as test shots of flat images"""

_OUTPUTS: dict[str, frozenset[Literal["frame", "exposure"]]] = {
    "none": frozenset(),
    "frame": frozenset({"frame"}),
    "exposure": frozenset({"exposure"}),
    "both": frozenset({"frame", "exposure"}),
}

_RANDOM_USE = 1


class SimulatedProjector:
    """A projector of kind framebuffer or static; see `scanner.devices.Projector`."""

    def __init__(self, world: World, settings: Settings, name: str) -> None:
        world.hold("projector", self, name)
        self._world = world
        self._clock = world.clock
        self._name = name
        self._options = settings.projector
        self._faults = settings.projector_faults
        self._allowance = Allowance(self._faults.times)
        self._random = world.random(_RANDOM_USE)
        options = self._options
        self._first_vblank_ns = world.epoch_ns + int(self._random.integers(options.refresh_ns))
        self._latency_ns = 1e3 * (options.latency_us + self._random.uniform(-0.5, 0.5) * options.latency_spread_us)
        self._vsync = Regular(self._first_vblank_ns, options.refresh_ns)
        self._frame_output = Regular(self._first_vblank_ns + round(self._latency_ns), options.refresh_ns)
        self._exposure_output = Recorded()
        world.lines["vsync"] = self._vsync
        if options.trigger_outputs in ("frame", "both"):
            world.lines["frame"] = self._frame_output
        if options.trigger_outputs in ("exposure", "both"):
            world.lines["exposure"] = self._exposure_output
        self._images: list[LoadedImage] = []
        self._shown: list[int] = []
        self._delay = 0
        self._last_index = -1
        self._last_vblank = -1
        self._flips_since_open = 0
        self._open = True
        self._capabilities = self._declare()
        period = self._capabilities.modulation_period_ns if options.modulation == "pwm" else None
        world.timeline.manner = Manner(
            sweep_ns=float(options.refresh_ns) if options.scan == "rows" else 0.0,
            ramp_ns=0.0 if options.kind == "sequencer" else options.settle_us * 1e3,
            period_ns=period or 0,
            phase_ns=self._first_vblank_ns,
        )
        self._relay: LightRelay | None = None
        if options.camera_socket:
            try:
                self._relay = LightRelay(world, options.camera_socket, name)
            except BaseException:
                world.release("projector")
                raise

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return self._capabilities

    def load(self, images: Sequence[Image]) -> None:
        """Replace the images; see `scanner.devices.Projector.load`."""
        self._check_open()
        shape = (self._capabilities.height, self._capabilities.width)
        check_images(images, shape, self._name)
        if self._capabilities.kind is ProjectorKind.STATIC and len(images) > 1:
            raise DeviceError(f"a static projector holds one image, got {len(images)}", device=self._name)
        if len(set(self._shown)) >= LEAST_SEQUENCE:
            self._world.sequence_over()
        self._images = [LoadedImage(np.asarray(image)) for image in images]
        self._shown = []
        self._delay = 0
        self._last_index = -1

    def show(self, index: int) -> Flip:
        """Flip at the next vertical blank; see `scanner.devices.Projector.show`."""
        self._check_open()
        if not 0 <= index < len(self._images):
            raise DeviceError(f"image {index} is not loaded, there are {len(self._images)}", device=self._name)
        vblank = self._next_vblank()
        t_ns = self._first_vblank_ns + vblank * self._options.refresh_ns
        self._clock.sleep_until(t_ns)
        self._change(t_ns, index)
        self._last_vblank = vblank
        self._flips_since_open += 1
        return Flip(t_ns, vblank, STAMP_BOUND_NS, Source.HARDWARE)

    def close(self) -> None:
        """Leave a black screen and give the device back."""
        if self._open:
            self._open = False
            self._world.timeline.show(self._clock.now_ns(), None)
            if self._relay is not None:
                self._relay.close()
            self._vsync.end(self._clock.now_ns())
            self._frame_output.end(self._clock.now_ns())
            self._world.release("projector")

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceError("the projector is closed", device=self._name)

    def _next_vblank(self) -> int:
        """Count of the next vertical blank that nothing was flipped at; DeviceLost if the display is unplugged."""
        if self._faults.unplug_after is not None and self._flips_since_open >= self._faults.unplug_after:
            raise DeviceLost("the display went away", device=self._name, hint="plug it in again and repeat the scan")
        passed = (self._clock.now_ns() - self._first_vblank_ns) // self._options.refresh_ns
        return int(max(passed, self._last_vblank)) + 1

    def _change(self, t_ns: int, index: int) -> None:
        """Put the change of light of this flip onto the timeline, as far as faults let it."""
        ordinal = len(self._shown)
        if index <= self._last_index:
            self._delay = 0  # the host has begun again, or goes back: what was queued is gone
        self._last_index = index
        wanted = displayed_index(self._faults, index, len(self._images))
        if wanted != index and not self._allowance.take("order"):
            wanted = index
        self._shown.append(wanted)
        if ordinal in self._faults.skip and self._allowance.take("skip"):
            return
        if ordinal in self._faults.double and self._allowance.take("double"):
            self._delay += 1
        late = self._delay
        if self._faults.late_flips and self._allowance.take("late_flips"):
            late += self._faults.late_flips
        if late > ordinal:
            return
        light_ns = t_ns + self._latency(ordinal)
        self._world.timeline.show(light_ns, self._images[self._shown[ordinal - late]])
        self._exposure_output.add(light_ns)

    def _latency(self, ordinal: int) -> int:
        """True latency of one flip, ns."""
        jitter = 1e3 * self._options.latency_spread_us * self._random.uniform(-0.25, 0.25)
        extra = 0.0
        if self._faults.extra_latency_us and ordinal >= self._faults.extra_latency_after:
            extra = 1e3 * self._faults.extra_latency_us if self._allowance.take("extra_latency_us") else 0.0
        return max(0, round(self._latency_ns + jitter + extra))

    def _declare(self) -> ProjectorCapabilities:
        options = self._options
        width, height = self._world.rig.calibration.projector.size
        rows = options.scan == "rows"
        sweep = options.refresh_ns if rows else 0
        declared: dict[str, Any] = {}
        if options.declare_latency:
            low = max(0.0, options.latency_us - options.latency_spread_us)
            declared["latency"] = Interval(
                round(1e3 * low), round(1e3 * (options.latency_us + options.latency_spread_us))
            )
            declared["settle"] = Interval(
                sweep + round(500 * options.settle_us), sweep + round(1500 * options.settle_us)
            )
        constant = rows or options.modulation == "none"
        outputs = _OUTPUTS[options.trigger_outputs]
        if options.kind == "sequencer":
            # Micromirrors: light is there or not, and the controller tells with an edge when.
            declared = {"latency": Interval(round(self._latency_ns), round(self._latency_ns)), "settle": Interval(0, 0)}
            outputs, constant = outputs | {"exposure"}, True
        return ProjectorCapabilities(
            kind=ProjectorKind(options.kind),
            width=width,
            height=height,
            refresh_ns=options.refresh_ns,
            modulation_period_ns=None if constant else round(options.refresh_ns / PERIODS_PER_REFRESH),
            scan="rows" if rows else "global",
            trigger_outputs=outputs,
            **declared,
        )
