"""An HDMI or DisplayPort output as projector, driven by the kernel's mode setting: exact greys and true flip times.

    opened (black) --load--> images in the card --show--> flips at vertical blanks --close--> black, card given back

A flip's stamp is the kernel's time of the vertical blank at which scan-out of the image began, and comes with the
blank's number. Light follows later: the projector's latency is measured, not known here.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
from collections.abc import Sequence

from drivers.display import DisplayOptions, check_images
from drivers.ioctl import Node, device_error
from drivers.kms import drm
from drivers.kms.card import Mode, Output, connected, mode_info, resources, take_master
from drivers.kms.framebuffer import DumbBuffer
from drivers.kms.properties import make_exact
from scanner.clock import Clock
from scanner.devices import Flip, Image, ProjectorCapabilities, Source
from scanner.errors import ConfigError, DeviceError, DeviceLost

STAMP_BOUND_NS = 21_000
"""drm.timestamp_precision_usec is 20 unless somebody changed it: the kernel measures a blank again until it is that
sure of it; and events carry whole microseconds"""

FLIP_TIMEOUT_MS = 1000
RATE_TOLERANCE = 2e-4
"""Two rates are the same within this: 59.94 and 60 Hz are 1e-3 apart, and clocks are listed in whole kHz"""


class KmsProjector:
    """See `scanner.devices.Projector`. Owns the node that it is given."""

    def __init__(self, node: Node, output: Output, options: DisplayOptions, clock: Clock) -> None:
        """Become master, set the mode, show black, and look whether the display counts its blanks.

        Raises:
            ConfigError: no such mode.
            DeviceBusy: another program drives the card's screens.
            DeviceError: the card cannot do what is needed, or something changes greys and stays.
        """
        self._node = node
        self._name = f"{output.name} ({node.path})"
        node.name = self._name
        self._output = output
        self._options = options
        self._clock = clock
        self._shown: DumbBuffer | None = None
        self._images: list[DumbBuffer] = []
        self._leftover: list[DumbBuffer] = []
        self._black: DumbBuffer | None = None
        self._last_ns = 0
        self._counted = 0
        self._counts_blanks = True
        try:
            self._mode = choose_mode(output, options.mode, self._name)
            take_master(node)
            _require(node, drm.CAP_DUMB_BUFFER, "images in plain memory", self._name)
            _require(node, drm.CAP_TIMESTAMP_MONOTONIC, "stamps on CLOCK_MONOTONIC", self._name)
            # Properties and planes of the newer interface are listed only for who asks; old drivers have none.
            for capability in (drm.CLIENT_CAP_UNIVERSAL_PLANES, drm.CLIENT_CAP_ATOMIC):
                with contextlib.suppress(OSError):
                    node.call(drm.SET_CLIENT_CAP, drm.Cap(capability=capability, value=1))
            self._light_up()
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._name

    @property
    def mode(self) -> Mode:
        """The mode that is set."""
        return self._mode

    @property
    def crtc(self) -> int:
        """The number of the crtc that scans the image out."""
        return self._crtc

    @property
    def card(self) -> Node:
        """The open card, for who reads back what it sends."""
        return self._node

    @property
    def exactness(self) -> dict[str, str]:
        """What was found and set so that greys go out as they are, in words."""
        return dict(self._exactness)

    @property
    def counts_blanks(self) -> bool:
        """Whether the display has vertical blanks that the kernel counts; virtual ones may not."""
        return self._counts_blanks

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What it can do."""
        return self._options.capabilities(self._mode.width, self._mode.height, self._refresh_ns)

    def load(self, images: Sequence[Image]) -> None:
        """Replace the images; what is on show stays until the next `show`. See `scanner.devices.Projector.load`."""
        self._check_open()
        self._check_connected()
        shape = (self._mode.height, self._mode.width)
        check_images(images, shape, self._name)
        spare = [buffer for buffer in self._images if buffer is not self._shown]
        loaded: list[DumbBuffer] = []
        try:
            for image in images:
                loaded.append(spare.pop() if spare else DumbBuffer(self._node, self._mode.width, self._mode.height))
                loaded[-1].write(image)
        finally:
            self._leftover += [buffer for buffer in self._images if buffer is self._shown]
            self._images = loaded
            for buffer in spare:
                buffer.free()

    def show(self, index: int) -> Flip:
        """Flip at the next vertical blank; see `scanner.devices.Projector.show`."""
        self._check_open()
        if not 0 <= index < len(self._images):
            raise DeviceError(f"image {index} is not loaded, there are {len(self._images)}", device=self._name)
        flip = self._flip(self._images[index])
        while self._leftover:
            self._leftover.pop().free()
        return flip

    def check_present(self) -> None:
        """See `scanner.devices.KnowsPresence`."""
        self._check_open()
        self._check_connected()

    def close(self) -> None:
        """Leave a black screen and give the card back. May be called twice."""
        if not self._node.open:
            return
        # It may be gone, or never have been ours: the kernel then does what is left to do.
        with contextlib.suppress(OSError, DeviceError):
            if self._black is not None and self._shown is not None:
                self._flip(self._black)
        for buffer in [*self._images, *self._leftover, *([self._black] if self._black else [])]:
            buffer.free()
        self._images, self._leftover, self._black, self._shown = [], [], None, None
        with contextlib.suppress(OSError):
            self._node.call(drm.DROP_MASTER, 0)
        self._node.close()

    def _light_up(self) -> None:
        width, height = self._mode.width, self._mode.height
        self._crtc = self._free_crtc()
        self._black = DumbBuffer(self._node, width, height)
        info = mode_info(self._mode)
        self._refresh_ns = round(1e6 * info.htotal * info.vtotal / info.clock)
        connector = (ctypes.c_uint32 * 1)(self._output.connector)
        setting = drm.Crtc(
            crtc_id=self._crtc,
            fb_id=self._black.fb,
            set_connectors_ptr=ctypes.addressof(connector),
            count_connectors=1,
            mode_valid=1,
            mode=info,
        )
        try:
            self._node.call(drm.SETCRTC, setting)
        except OSError as error:
            raise device_error(error, f"mode {self._mode} cannot be set", self._name) from error
        self._shown = self._black
        self._exactness = make_exact(self._node, self._crtc, self._output.connector)
        first, second = self._flip(self._black), self._flip(self._black)
        if first.vblank == second.vblank:
            self._counts_blanks = False
            self._last_ns = second.t_ns

    def _free_crtc(self) -> int:
        """The crtc that drives this output already, else the first that can."""
        crtcs = resources(self._node).crtcs
        possible: list[int] = []
        for number in self._output.encoders:
            encoder = drm.Encoder(encoder_id=number)
            self._node.call(drm.GETENCODER, encoder)
            if encoder.crtc_id:
                return int(encoder.crtc_id)
            possible += [crtc for bit, crtc in enumerate(crtcs) if encoder.possible_crtcs >> bit & 1]
        busy = {crtc for crtc in possible if self._is_lit(crtc)}
        free = [crtc for crtc in possible if crtc not in busy]
        if not possible:
            raise DeviceError("the card has nothing that could drive this output", device=self._name)
        return (free or possible)[0]

    def _is_lit(self, crtc: int) -> bool:
        said = drm.Crtc(crtc_id=crtc)
        self._node.call(drm.GETCRTC, said)
        return bool(said.mode_valid)

    def _flip(self, buffer: DumbBuffer) -> Flip:
        self._check_connected()
        if not self._counts_blanks:
            self._clock.sleep_until(self._last_ns + self._refresh_ns)
        command = drm.PageFlip(crtc_id=self._crtc, fb_id=buffer.fb, flags=drm.PAGE_FLIP_EVENT)
        try:
            self._node.call(drm.PAGE_FLIP, command)
        except OSError as error:
            raise device_error(error, "the flip fails", self._name) from error
        event = self._await_event()
        self._shown = buffer
        t_ns = event.tv_sec * 1_000_000_000 + event.tv_usec * 1000
        if self._counts_blanks:
            return Flip(t_ns, event.sequence, STAMP_BOUND_NS, Source.HARDWARE)
        # No blank to go by: an own count at the mode's rate, true within a refresh.
        self._counted += max(1, round((t_ns - self._last_ns) / self._refresh_ns))
        self._last_ns = t_ns
        return Flip(t_ns, self._counted, self._refresh_ns, Source.ESTIMATED)

    def _await_event(self) -> drm.VblankEvent:
        poll = select.poll()
        poll.register(self._node.fd, select.POLLIN)
        deadline = self._clock.now_ns() + FLIP_TIMEOUT_MS * 1_000_000
        while (left_ms := (deadline - self._clock.now_ns()) // 1_000_000) > 0:
            if not poll.poll(left_ms):
                continue
            event = self._read_event()
            if event is not None:
                return event
        self._check_connected()
        raise DeviceError(
            f"no flip within {FLIP_TIMEOUT_MS / 1000:g} s", device=self._name, hint="is the display in standby?"
        )

    def _read_event(self) -> drm.VblankEvent | None:
        """The flip among the events that wait; others are of no concern."""
        size = ctypes.sizeof(drm.VblankEvent)
        try:
            waiting = os.read(self._node.fd, 1024)
        except BlockingIOError:
            return None
        except OSError as error:
            raise device_error(error, "the flip's event cannot be read", self._name) from error
        while len(waiting) >= size:
            event = drm.VblankEvent.from_buffer_copy(waiting)
            if event.type == drm.EVENT_FLIP_COMPLETE:
                return event
            waiting = waiting[max(event.length, 8) :]
        return None

    def _check_connected(self) -> None:
        try:
            here = connected(self._node, self._output.connector)
        except OSError as error:
            raise device_error(error, "the output does not answer", self._name) from error
        if not here:
            raise DeviceLost("the display went away", device=self._name, hint="plug it in again and repeat the scan")

    def _check_open(self) -> None:
        if not self._node.open:
            raise DeviceError("the projector is closed", device=self._name)


def choose_mode(output: Output, wanted: str | None, device: str) -> Mode:
    """The mode that a rig file's string means; None: the display's own.

    Raises:
        ConfigError: the display has no such mode; the hint lists those it has.
        DeviceError: it has none at all.
    """
    if wanted is None:
        native = output.native
        if native is None:
            raise DeviceError("the display offers no mode", device=device, hint="is it on? Its EDID cannot be read")
        return native
    fitting = [mode for mode in output.modes if _fits(mode, wanted, device)]
    if not fitting:
        raise ConfigError(
            f"no mode {wanted} on this display",
            device=device,
            hint="it has " + ", ".join(dict.fromkeys(str(mode) for mode in output.modes)),
        )
    return max(fitting, key=lambda mode: (mode.preferred, mode.hz))


def _fits(mode: Mode, wanted: str, device: str) -> bool:
    size, _, rate = wanted.partition("@")
    try:
        width, height = (int(part) for part in size.split("x"))
        hz = float(rate) if rate else None
    except ValueError as error:
        raise ConfigError(
            f"mode {wanted!r} makes no sense", device=device, hint='write it as "1920x1080@60"'
        ) from error
    return (mode.width, mode.height) == (width, height) and (hz is None or abs(mode.hz - hz) <= RATE_TOLERANCE * hz)


def _require(node: Node, capability: int, what: str, device: str) -> None:
    asked = drm.Cap(capability=capability)
    with contextlib.suppress(OSError):  # a kernel that does not know the question has not got it
        node.call(drm.GET_CAP, asked)
    if not asked.value:
        raise DeviceError(
            f"the card's driver has no {what}", device=device, hint="use a card with a kernel driver of its own"
        )
