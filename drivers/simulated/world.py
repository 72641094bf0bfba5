"""The simulated world: one scene, one rig, one clock, and what shines in it.

A camera, a projector and a trigger board opened with the same device string and the same clock stand in the same
world. The world lives as long as one of them does; it is found by a weak registry.
"""

from __future__ import annotations

import weakref
from collections import deque
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from drivers.simulated import timeline
from drivers.simulated.lines import Line, LineName
from drivers.simulated.optics import Light, Optics, Plane, look_up, spill_px
from drivers.simulated.options import Settings, WorldSettings, check_same_world
from drivers.simulated.rigs import Rig, rig
from drivers.simulated.scenes import SceneOptions, build_scene
from drivers.simulated.sensor import blur_taps, sense
from drivers.simulated.targets import POSED
from drivers.simulated.timeline import LoadedImage, Segment, Timeline
from drivers.simulated.view import View, view_scene, white_level
from scanner.clock import Clock
from scanner.errors import DeviceBusy
from scanner.geometry import Calibration

NOMINAL_EXPOSURE_NS = 33_333_333
"""Two refreshes at 60 Hz: at this exposure and 0 dB the full-on board's 99th percentile is WHITE of the range."""

WHITE = 230 / 255

POSES = 12
"""Of a printed target; after the last comes the first."""

PULSE_BANDS = 64
"""A rolling exposure that cuts pulses is taken in so many bands of rows."""

LARGE_LIGHTS = 3
"""Lights of images that change along both axes take 16 MB or more each; so many are kept."""

_worlds: WeakValueDictionary[tuple[Any, ...], World] = WeakValueDictionary()


def enter_world(settings: Settings, clock: Clock, device: str) -> World:
    """The world that the settings mean, made if there is none.

    Raises:
        ConfigError: a key that was given contradicts the world as it is.
    """
    key = (settings.key, id(clock))
    world = _worlds.get(key)
    if world is None:
        world = World(settings.world, clock)
        _worlds[key] = world
    else:
        check_same_world(settings, world.settings, device)
    return world


class World:
    """What the devices share. Holds its clock, so that a world's key stays its own."""

    def __init__(self, settings: WorldSettings, clock: Clock) -> None:
        self.settings = settings
        self.clock = clock
        self.epoch_ns = clock.now_ns()
        self.rig: Rig = rig(settings.rig)
        self.timeline = Timeline()
        self.lines: dict[LineName, Line] = {}
        """the wires between the devices, put there by whoever drives them"""
        self._large: deque[LoadedImage] = deque(maxlen=LARGE_LIGHTS)
        self._holders: dict[str, weakref.ref[Any]] = {}
        self._steps = 0
        values = np.arange(256) / 255.0
        self._response: Plane = (values**settings.optics.gamma).astype(np.float32)

    @property
    def calibration(self) -> Calibration:
        """The rig's exact geometry, and the response it is believed to have: what `precorrection` undoes."""
        response = {"projector": {"gamma": self.settings.optics.precorrection}}
        return replace(self.rig.calibration, extra={"response": response})

    def random(self, use: int) -> np.random.Generator:
        """A generator of its own for each use, the same for the same seed."""
        return np.random.default_rng([self.settings.shared.seed, use])

    def hold(self, role: str, device: Any, name: str) -> None:
        """Take the role of the world's camera, projector or trigger board.

        Raises:
            DeviceBusy: another one is open.
        """
        held = self._holders.get(role)
        if held is not None and held() is not None:
            raise DeviceBusy(f"the {role} is open already", device=name, hint="close it first")
        self._holders[role] = weakref.ref(device)

    def release(self, role: str) -> None:
        """Give the role back."""
        self._holders.pop(role, None)

    @cached_property
    def view(self) -> View:
        """The scene as the camera sees it; cast at the first call."""
        s = self.settings
        seed = s.shared.seed if s.scene in POSED else 0
        o = s.optics
        options = s.scene_options
        if self._steps:
            options = replace(options, pose=(options.pose + self._steps) % POSES)
        beyond = len(self._taps) - 1, spill_px(self._sigma)
        return _view(
            s.rig, s.scene, options, seed, o.projector_falloff, o.vignetting, o.ambient, o.camera_blur_sigma_px, *beyond
        )

    @property
    def _pose(self) -> tuple[int, ...]:
        """Of a printed target, for its noise: captures of poses, each by devices opened anew, count frames from 0."""
        s = self.settings
        return (s.scene_options.pose,) if s.scene in POSED and s.scene_options.pose else ()

    @cached_property
    def _taps(self) -> Plane:
        return blur_taps(self.settings.optics.camera_blur_sigma_px)

    def sequence_over(self) -> None:
        """A sequence was shown and will not be shown again: a target that walks goes to its next pose."""
        if self.settings.shared.walk and self.settings.scene in POSED:
            self._steps += 1
            self.__dict__.pop("view", None)

    @cached_property
    def electrons_per_light(self) -> float:
        """Electrons that light 1 (see `View.shade`) frees in the nominal exposure."""
        optics = self.settings.optics
        return WHITE * optics.full_well_e * optics.exposure_scale / _white(self.settings.rig, optics)

    def render(
        self,
        start_ns: int,
        exposure_ns: int,
        readout_ns: int,
        gain_db: float,
        bits: int,
        number: int,
        out: NDArray[np.uint8] | NDArray[np.uint16],
    ) -> None:
        """One frame.

        Args:
            start_ns: start of the first row's exposure.
            exposure_ns: of each row.
            readout_ns: from the first row's start to the last row's; 0 for a global shutter.
            gain_db: of the camera.
            bits: of `out`.
            number: of the frame: the key of its noise, with the pose that the world began in.
            out: (H, W), filled.
        """
        optics = self.settings.optics
        top = (1 << bits) - 1
        gain = 10.0 ** (gain_db / 20.0)
        sense(
            self.arriving(start_ns, exposure_ns, readout_ns),
            self._taps,
            electrons=self.electrons_per_light * exposure_ns / NOMINAL_EXPOSURE_NS,
            dn_per_electron=gain * top / optics.full_well_e,
            read_noise_e=optics.read_noise_dn * optics.full_well_e / 255.0 if optics.noise else None,
            key=(self.settings.shared.seed, number, *self._pose),
            out=out,
            max_value=top,
            gain=self.view.print_gain,
        )

    def arriving(self, start_ns: int, exposure_ns: int, readout_ns: int) -> Plane:
        """Mean light on the sensor over each row's exposure, and beside it (`View.margin`), float32.

        Valid until the next call. What falls beside the sensor is exposed with the row that it is blurred onto.
        """
        end_ns = start_ns + readout_ns + exposure_ns
        segments = self.timeline.between(start_ns, end_ns)
        manner = self.timeline.manner
        out = self._field
        if manner.period_ns:
            self._pulsed(segments, start_ns, exposure_ns, readout_ns, out)
        elif len(segments) == 1 or (readout_ns == 0 and manner.sweep_ns == 0):
            self._blended(segments, start_ns, end_ns, out)
        else:
            self._changing(segments, start_ns, exposure_ns, readout_ns, out)
        return out

    @cached_property
    def _field(self) -> Plane:
        return np.empty_like(self.view.shade)

    def _blended(self, segments: list[Segment], start_ns: float, end_ns: float, out: Plane) -> None:
        """Every pixel sees each image for the same share of the exposure."""
        begin, end, top = np.array([start_ns]), np.array([end_ns]), np.zeros(1, dtype=np.float32)
        floor = self.view.floor
        for segment in segments:
            weight = 1.0
            if len(segments) > 1:
                weight = float(timeline.share(self.timeline.manner, segment, begin, end, top)[0])
            if segment.image is not None and weight > 0:
                light = self._light(segment.image)
                gain = self.view.shade if weight == 1.0 else self.view.shade * np.float32(weight)
                look_up(light, self.view.row, self.view.column, gain, floor, out)
                floor = out
        if floor is not out:
            np.copyto(out, floor)

    def _changing(
        self, segments: list[Segment], start_ns: float, exposure_ns: float, readout_ns: float, out: Plane
    ) -> None:
        """Rows of the camera, or of the projector, change at times of their own."""
        view, manner = self.view, self.timeline.manner
        height = self.rig.calibration.camera.size[1]
        row = np.clip(np.arange(out.shape[0]) - view.margin, 0, height - 1)
        begin = start_ns + readout_ns * row[:, None] / max(height - 1, 1)
        down = view.row / np.float32(self.rig.calibration.projector.size[1]) if manner.sweep_ns else np.zeros((1, 1))
        np.copyto(out, view.floor)
        for segment in segments:
            weight = timeline.share(manner, segment, begin, begin + exposure_ns, down.astype(np.float32))
            if segment.image is not None and weight.any():
                light = self._light(segment.image)
                look_up(light, view.row, view.column, np.ascontiguousarray(view.shade * weight), out, out)

    def _pulsed(
        self, segments: list[Segment], start_ns: float, exposure_ns: float, readout_ns: float, out: Plane
    ) -> None:
        """Greys are pulses, of which an exposure may cut some."""
        view, manner = self.view, self.timeline.manner
        np.copyto(out, view.floor)
        count = PULSE_BANDS if readout_ns else 1
        height = self.rig.calibration.camera.size[1]
        for rows, begin in timeline.bands(start_ns, readout_ns, height, view.margin, count):
            for segment in segments:
                if segment.image is None:
                    continue
                response = timeline.pulsed_response(self._response, manner, segment, begin, begin + exposure_ns)
                if not response.any():
                    continue
                light = segment.image.light(response, self._sigma, keep=False)
                look_up(light, view.row[rows], view.column[rows], view.shade[rows], out[rows], out[rows])

    def _light(self, image: LoadedImage) -> Light:
        """The image's light; of large ones only the last few are kept."""
        if not image.is_flat and image not in self._large:
            if len(self._large) == LARGE_LIGHTS:
                self._large[0].forget_light()
            self._large.append(image)
        return image.light(self._response, self._sigma)

    @property
    def _sigma(self) -> float:
        return self.settings.optics.projector_blur_sigma_px


@lru_cache(maxsize=2)
def _view(
    rig_name: str,
    scene: str,
    options: SceneOptions,
    seed: int,
    falloff: float,
    vignetting: float,
    ambient: float,
    blur_px: float,
    margin: int,
    spill: int,
) -> View:
    """A view, kept for the worlds that follow: a rig's daemon opens the same scene again and again."""
    optics = Optics(projector_falloff=falloff, vignetting=vignetting, ambient=ambient, camera_blur_sigma_px=blur_px)
    chosen = rig(rig_name)
    return view_scene(chosen, build_scene(scene, options, chosen, seed), optics, margin=margin, spill=spill)


@lru_cache(maxsize=8)
def _white(rig_name: str, optics: Optics) -> float:
    return white_level(rig(rig_name), optics)
