"""The contracts between the sequencer and devices: what a projector, a camera and a trigger board can do.

A driver implements one of the small protocols below and declares what its device can do (`capabilities`);
nothing is guessed. Times are CLOCK_MONOTONIC nanoseconds, each with a source and a bound. Calls come from one
thread at a time; a call may block, which is why devices live in a process of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from scanner.clock import Clock

if TYPE_CHECKING:  # its kernels take a while to load, and few devices know their own geometry
    from scanner.geometry import Calibration

Image = NDArray[np.uint8]
Pixels = NDArray[np.uint8] | NDArray[np.uint16]


class Source(StrEnum):
    """Where a time stamp comes from."""

    HARDWARE = "hardware"
    """latched by the device or the kernel at the event itself"""
    DRIVER = "driver"
    """taken by a driver near the event, with a bound that holds"""
    ESTIMATED = "estimated"
    """computed or taken late: the bound is a belief"""


@dataclass(frozen=True)
class Interval:
    """A measured duration, ns: it lies in [low_ns, high_ns]."""

    low_ns: int
    high_ns: int

    def __post_init__(self) -> None:
        if self.low_ns > self.high_ns:
            raise ValueError(f"interval is upside down: {self.low_ns} > {self.high_ns}")


@dataclass(frozen=True)
class Exposure:
    """When a frame was exposed: first row's start to last row's end (so rolling readout is inside), ns."""

    start_ns: int
    end_ns: int
    bound_ns: int
    """each of the two times is true within +- bound_ns"""
    source: Source


@dataclass(frozen=True)
class Flip:
    """When scan-out of an image began, ns. Light follows after the projector's latency."""

    t_ns: int
    vblank: int
    """the display's own count of vertical blanks"""
    bound_ns: int
    source: Source


# --- projectors -------------------------------------------------------------------------------------------------


class ProjectorKind(StrEnum):
    """The three kinds of projector."""

    STATIC = "static"
    """a slide, or a pattern that stays on"""
    FRAMEBUFFER = "framebuffer"
    """one image per refresh or per `dwell` refreshes: HDMI, V4L2 output, a window"""
    SEQUENCER = "sequencer"
    """runs a table of slots by itself: pattern-mode controllers"""


@dataclass(frozen=True)
class ProjectorCapabilities:
    """What a projector can do. Unmeasured is None, never a guess."""

    kind: ProjectorKind
    width: int
    height: int
    refresh_ns: int
    """period of the vertical blank"""
    modulation_period_ns: int | None = None
    """a grey is built over this time (colour wheel, bit planes); None: the light is constant"""
    latency: Interval | None = None
    """from the flip's stamp to the change of light at the first row that changes"""
    settle: Interval | None = None
    """from then until every row shows the new image"""
    scan: Literal["global", "rows"] = "global"
    trigger_outputs: frozenset[Literal["frame", "exposure"]] = frozenset()


@runtime_checkable
class Projector(Protocol):
    """A display that the host flips: `static` and `framebuffer`. Opened by its driver's `open_projector`."""

    @property
    def name(self) -> str:
        """The device's name in messages."""

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""

    def load(self, images: Sequence[Image]) -> None:
        """Replace the images in the device's memory, before a run. images: (height, width) uint8 each.

        Raises:
            DeviceError: wrong size or no room.
        """

    def show(self, index: int) -> Flip:
        """Flip to loaded image `index` at the next vertical blank; returns once it happened.

        Raises:
            DeviceLost: the display went away.
        """

    def close(self) -> None:
        """Leave a black screen and give the device back. May be called twice."""


@dataclass(frozen=True)
class TableSlot:
    """One slot of a projector's or trigger board's own table."""

    image: int
    exposure_us: int
    dark_us: int
    bit_planes: int = 8
    colour: Literal["white", "red", "green", "blue"] = "white"
    wait_trigger: bool = False
    """a board: it begins at an edge of the source; else when the slot before it ends"""
    emit_trigger: bool = True
    edges: int = 1
    """with `wait_trigger` on a board: it begins at this edge, counted from the one that began the waiting slot before
    (the first slot: from arming); 2 is a pattern that stays on for two refreshes"""


@runtime_checkable
class SequencedProjector(Projector, Protocol):
    """A projector that runs a table of slots by itself and says when each began."""

    def program(self, table: Sequence[TableSlot]) -> None:
        """Load the table, after `load` and before `start`."""

    def start(self) -> None:
        """Run the table once."""

    def flips(self) -> Sequence[Flip]:
        """Starts of the slots run so far, in order."""


# --- cameras ----------------------------------------------------------------------------------------------------


class TriggerMode(StrEnum):
    """What starts an exposure."""

    FREE = "free"
    SOFTWARE = "software"
    HARDWARE = "hardware"


@dataclass(frozen=True)
class CameraCapabilities:
    """What a camera can do, in its present region and pixel format."""

    width: int
    height: int
    bits: int
    """significant bits a pixel, right-aligned"""
    shutter: Literal["global", "rolling"]
    readout_ns: int
    """rolling: first row's start to last row's start; global: duration of the transfer"""
    exposure_min_ns: int
    exposure_max_ns: int
    exposure_step_ns: int
    min_gap_ns: int
    """shortest time from the end of one exposure to the start of the next; see `min_period_ns`"""
    trigger_modes: frozenset[TriggerMode]
    trigger_latency: Interval | None = None
    """software trigger call to first row's start"""
    line_latency: Interval | None = None
    """edge on the trigger line to first row's start (mode HARDWARE)"""
    stamp: Source = Source.ESTIMATED
    stamp_bound_ns: int = 1_000_000
    gain_min_db: float = 0.0
    gain_max_db: float = 0.0
    mosaic: str | None = None

    @property
    def max_value(self) -> int:
        """Largest grey level."""
        return (1 << self.bits) - 1

    def min_period_ns(self, exposure_ns: int) -> int:
        """Shortest time between the starts of two exposures, ns."""
        return exposure_ns + self.min_gap_ns


@dataclass(frozen=True)
class CameraSettings:
    """What a camera is told before a run. None leaves the device's value."""

    exposure_ns: int | None = None
    gain_db: float | None = None
    pixel_format: str | None = None
    region: tuple[int, int, int, int] | None = None
    """x, y, width, height in sensor pixels"""


@dataclass(frozen=True)
class CameraFrame:
    """One frame as the camera delivered it.

    `pixels` are lent: valid until the next `pop` or `stop` of the camera; whoever needs them longer copies them.
    """

    pixels: Pixels
    """(height, width) uint8 or uint16, right-aligned, C-contiguous"""
    frame_id: int
    """the device's own count, as it gave it (may wrap)"""
    exposure: Exposure
    complete: bool = True
    trigger: int | None = None
    """number of the trigger that started it, from 0 at `start`, where the device counts them; those that a busy
    camera dropped are counted too"""


@runtime_checkable
class Camera(Protocol):
    """A camera. Opened by its driver's `open_camera`, with automatic functions off."""

    @property
    def name(self) -> str:
        """The device's name in messages."""

    @property
    def capabilities(self) -> CameraCapabilities:
        """What it can do with the settings last applied."""

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set and read back, while stopped. Returns what the device took.

        Raises:
            ConfigError: a value outside the capabilities, named with its bounds.
        """

    def start(self, mode: TriggerMode) -> None:
        """Begin to acquire; frames from before are gone."""

    def trigger(self) -> None:
        """Start one exposure now (mode SOFTWARE). A camera that is busy drops it, as real ones do."""

    def pop(self, timeout_ns: int) -> CameraFrame | None:
        """The next frame, oldest first; None if none came in `timeout_ns`.

        Raises:
            DeviceLost: the camera went away.
        """

    def stop(self) -> None:
        """End acquisition. May be called twice."""

    def close(self) -> None:
        """Give the device back. May be called twice."""


# --- trigger boards ---------------------------------------------------------------------------------------------


class TriggerSource(StrEnum):
    """What a board's table waits for."""

    INTERNAL = "INT"
    VSYNC = "VSYNC"
    EXTERNAL = "EXT"


@dataclass(frozen=True)
class TriggerCapabilities:
    """What a trigger board can do. A slot is dark for `dark_us`, then its pulse lasts `exposure_us`."""

    sources: frozenset[TriggerSource]
    max_steps: int
    """steps in its memory; a longer table must be repetitions of so many: see `scanner.trigger_table`"""
    max_repeats: int
    dark_min_us: int
    """shortest dark time of a slot: from the edge that begins it, or the end of the slot before"""
    exposure_min_us: int
    time_max_us: int
    """longest dark time and longest exposure"""
    jitter_ns: int
    """a pulse begins within +- this of its edge plus its dark time"""
    event_bound_ns: int = 500_000
    """events of pulses are true to this at worst; behind USB the clock's fit is good to a few tenths of a ms"""


@dataclass(frozen=True)
class TriggerEvent:
    """One exposure pulse that a board gave."""

    sequence: int
    """number of the run: how often the board was armed since it was opened, from 0"""
    step: int
    """position of the slot in the table that was programmed"""
    t_ns: int
    """when the pulse began"""
    bound_ns: int
    source: Source


@dataclass(frozen=True)
class TriggerFault:
    """What a board reported about the run since `arm`. All but `lost_events` end it, outputs low."""

    kind: Literal["missing_edge", "overrun", "lost_events", "reset"]
    """no edge within the board's time-out; an edge came that should have begun a slot while another ran; pulses came
    whose events did not; the board began anew"""
    message: str
    step: int | None = None
    """position of the slot concerned, in the table that was programmed"""
    t_ns: int | None = None


@runtime_checkable
class TriggerBoard(Protocol):
    """A board that runs a table of exposures on its own timer; the host never times a frame.

        idle --program--> idle --arm--> armed --first edge, or fire--> running --last slot over, abort, fault--> idle

    The last slot's end is not reported: it is known from its event. Opened by its driver's `open`, outputs low.
    """

    @property
    def name(self) -> str:
        """The device's name in messages."""

    @property
    def capabilities(self) -> TriggerCapabilities:
        """What it can do."""

    def program(self, table: Sequence[TableSlot], source: TriggerSource) -> None:
        """Load the whole table, while idle.

        Source INTERNAL: slots follow one another from `fire` on, and none may have `wait_trigger`. VSYNC, EXTERNAL:
        the first slot has it.

        Raises:
            ConfigError: a slot outside the capabilities, named with its bounds; a table that does not fit.
            DeviceBusy: a run is under way.
        """

    def arm(self) -> None:
        """Wait for the source; events and faults from before are gone. Edges count from when this returns at latest.

        Raises:
            DeviceError: nothing is programmed.
            DeviceBusy: a run is under way.
        """

    def fire(self) -> None:
        """Start the table now (source INTERNAL).

        Raises:
            DeviceError: the board is not armed, or its source is another.
        """

    def abort(self) -> None:
        """Stop, outputs low. Always works; the board is idle after it and keeps its table."""

    def events(self) -> Sequence[TriggerEvent]:
        """Pulses given since `arm`, in order. Those of the last milliseconds may still be on their way.

        Raises:
            DeviceLost: the board went away.
        """

    def faults(self) -> Sequence[TriggerFault]:
        """What went wrong since `arm`, in order.

        Raises:
            DeviceLost: the board went away.
        """

    def close(self) -> None:
        """Abort and give the device back. May be called twice."""


# --- drivers ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DeviceInfo:
    """One device that a driver can see, for `fringed devices`."""

    driver: str
    device: str
    kind: Literal["camera", "projector", "trigger"]
    model: str
    details: dict[str, Any]


class CameraDriver(Protocol):
    """What an entry point of the group `fringed.cameras` names."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> Camera:
        """Open one camera. device: the rig file's string ("" = the first); options: the driver's own table.

        Raises:
            ConfigError: device or options make no sense to this driver.
            DeviceNotFound, DeviceBusy, PermissionDenied: it cannot be opened; the hint says what to do.
        """

    def discover(self) -> Sequence[DeviceInfo]:
        """The cameras this driver can see now. A missing library is an empty list, not an error."""


class ProjectorDriver(Protocol):
    """What an entry point of the group `fringed.projectors` names."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> Projector:
        """Open one projector; see `CameraDriver.open`."""

    def discover(self) -> Sequence[DeviceInfo]:
        """The projectors this driver can see now."""


class TriggerDriver(Protocol):
    """What an entry point of the group `fringed.triggers` names."""

    def open(self, device: str, options: Mapping[str, Any], clock: Clock) -> TriggerBoard:
        """Open one trigger board; see `CameraDriver.open`."""

    def discover(self) -> Sequence[DeviceInfo]:
        """The boards this driver can see now."""


# --- devices that know what their host must be like ------------------------------------------------------------------


class SetupFinding(Protocol):
    """One thing that a driver looked at on its host."""

    @property
    def subject(self) -> str:
        """What was looked at."""

    @property
    def ok(self) -> bool:
        """Whether it is well."""

    @property
    def text(self) -> str:
        """What was found."""

    @property
    def command(self) -> str:
        """What mends it; empty where it is well, or no command could."""


@runtime_checkable
class ChecksSetup(Protocol):
    """A camera whose driver can tell whether the host is set up for it: buffers, packets, speeds."""

    def check_setup(self, rate_hz: float | None = None) -> Sequence[SetupFinding]:
        """Look at the host. rate_hz: frames a second wanted; None: as many as the camera gives."""


# --- devices that can be looked at while nobody uses them ---------------------------------------------------------


@runtime_checkable
class KnowsPresence(Protocol):
    """A device whose driver can tell, without using it, whether it is still there."""

    def check_present(self) -> None:
        """Take a quick look, a millisecond at most; while it is open and idle.

        Raises:
            DeviceLost: it went away.
        """


@runtime_checkable
class KeepsCounts(Protocol):
    """A camera that counts what became of its frames."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Of the present run, or the last one, by the driver's own names: frames that came, were lost, sent again."""


# --- devices that know the truth ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated scene really is, on the camera's pixel grid. NaN where the ray meets nothing.

    rows, columns: (H, W) float32 projector coordinates of the seen surface point, px. xyz: (H, W, 3) float32 mm,
    camera frame. lit: (H, W) bool, inside the projector's field and not in shadow.
    """

    rows: NDArray[np.float32]
    columns: NDArray[np.float32]
    xyz: NDArray[np.float32]
    lit: NDArray[np.bool_]


@runtime_checkable
class KnowsTemperature(Protocol):
    """A camera with a thermometer: geometry moves until it is warm."""

    def temperature_c(self) -> float | None:
        """Degrees Celsius, now; None where this model has none. Called between runs.

        Raises:
            DeviceError: it could not be read.
        """


@runtime_checkable
class KnowsTruth(Protocol):
    """A camera that stands in a simulated world, and can tell what it should measure."""

    def truth(self) -> Truth:
        """The scene's truth."""

    def true_calibration(self) -> Calibration:
        """The rig's geometry, exact."""
