"""Pixel formats: what a node offers, the frame format agreed with it, and grey pixels out of and into its buffers.

Cameras: GREY, Y10, Y12, Y16 as they are; of YUYV and MJPG the luma. Luma is kept as the camera gave it, also where its
range is 16..235: widening would invent levels. Outputs: GREY and the packed RGB formats, in which a grey is exact;
YUYV only on request, since most displays widen its range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.ioctl import Node
from drivers.v4l2 import videodev2 as v
from drivers.v4l2.node import failure
from scanner.devices import Image, Pixels
from scanner.errors import ConfigError, DeviceError

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class CaptureFormat:
    """A format that can be captured. unpack: (rows of bytes (H, bytesperline), width) -> (H, W), or None: damaged."""

    code: str
    bits: int
    bytes_per_pixel: int
    """0: compressed"""

    def black(self, frame: FrameFormat) -> Pixels:
        """What stands for a frame that is not whole."""
        shape = (frame.height, frame.width)
        return np.zeros(shape, dtype=np.uint8) if self.bits <= 8 else np.zeros(shape, dtype=np.uint16)

    def unpack(self, raw: Bytes, frame: FrameFormat) -> Pixels | None:
        """Pixels (H, W) of a buffer's bytes; a view of them where it can be. None: the frame is not whole.

        raw: (N,) uint8, the bytes that the driver says it wrote.
        """
        if self.bytes_per_pixel == 0:
            return _decoded(raw, frame)
        if raw.size < frame.bytes_per_line * (frame.height - 1) + frame.width * self.bytes_per_pixel:
            return None
        lines = np.lib.stride_tricks.as_strided(
            raw, (frame.height, frame.width * self.bytes_per_pixel), (frame.bytes_per_line, 1), writeable=False
        )
        if self.code == "YUYV":
            return np.ascontiguousarray(lines[:, ::2])
        if self.bytes_per_pixel == 1:
            return np.ascontiguousarray(lines)
        return np.ascontiguousarray(lines).view("<u2")


@dataclass(frozen=True)
class FrameFormat:
    """What the driver agreed to."""

    code: str
    width: int
    height: int
    bytes_per_line: int
    size: int
    """bytes of one image"""
    full_range: bool
    """whether the driver says that 0..255 is meant; where it says nothing, YUYV is 16..235"""


CAPTURE_FORMATS = {
    fmt.code: fmt
    for fmt in (
        CaptureFormat("GREY", 8, 1),
        CaptureFormat("Y12", 12, 2),
        CaptureFormat("Y10", 10, 2),
        CaptureFormat("Y16", 16, 2),
        CaptureFormat("YUYV", 8, 2),
        CaptureFormat("MJPG", 8, 0),
    )
}
"""In the order in which one is chosen where nobody asked for one"""

ALIASES = {"Mono8": "GREY", "Mono10": "Y10", "Mono12": "Y12", "Mono16": "Y16"}
"""GenICam's names, as rig files for other cameras have them"""


def _grey(image: Image, line: Bytes) -> None:
    line[:, : image.shape[1]] = image


def _thrice(count: int, first: int) -> Callable[[Image, Bytes], None]:
    """Write a grey into the three colour bytes of pixels of `count` bytes; `first`: where they begin."""

    def write(image: Image, line: Bytes) -> None:
        pixels = line[:, : image.shape[1] * count].reshape(*image.shape, count)
        pixels[...] = 255
        pixels[..., first : first + 3] = image[..., np.newaxis]

    return write


def _luma(image: Image, line: Bytes) -> None:
    pixels = line[:, : image.shape[1] * 2].reshape(*image.shape, 2)
    pixels[..., 0] = image
    pixels[..., 1] = 128  # no colour


OUTPUT_FORMATS: dict[str, Callable[[Image, Bytes], None]] = {
    "XR24": _thrice(4, 0),
    "BX24": _thrice(4, 1),
    "BGR4": _thrice(4, 0),
    "RGB4": _thrice(4, 1),
    "RGB3": _thrice(3, 0),
    "BGR3": _thrice(3, 0),
    "GREY": _grey,
    "YUYV": _luma,
}
"""Writers of a grey image into rows of bytes (H, bytesperline), in the order in which one is chosen"""

_ON_REQUEST = frozenset({"YUYV"})


def offered(node: Node, kind: int) -> list[str]:
    """Codes of the formats that a queue of this kind offers, in the driver's order."""
    return list(_offered(node, kind))


def choose(node: Node, kind: int, wanted: str | None, known: dict[str, CaptureFormat] | dict[str, Callable]) -> str:  # type: ignore[type-arg]
    """The code to set: `wanted` (or its alias), else the first of `known` that the device offers.

    Raises:
        ConfigError: the device does not offer it, or this driver cannot read it.
        DeviceError: the device has no format that this driver can read.
    """
    has = offered(node, kind)
    usable = [code for code in known if code in has]
    if wanted is not None:
        code = ALIASES.get(wanted, wanted)
        if code not in usable:
            raise ConfigError(
                f"no pixel format {wanted!r} on this device",
                device=node.name,
                hint=f"it offers {', '.join(usable) or 'none that this driver knows'}",
            )
        return code
    fitting = [code for code in usable if code not in _ON_REQUEST] or usable
    if not fitting:
        raise DeviceError(
            f"no usable pixel format: the device offers {', '.join(has) or 'none'}",
            device=node.name,
            hint=f"this driver knows {', '.join(known)}",
        )
    return fitting[0]


def agree(node: Node, kind: int, code: str, size: tuple[int, int] | None) -> FrameFormat:
    """Set format and size, and what the driver made of them. size: (width, height); None leaves it.

    Raises:
        ConfigError: it took another size or format; the hint lists sizes.
        DeviceBusy: somebody else streams.
    """
    wanted = _get(node, kind)
    if kind in v.MULTIPLANAR:
        wanted.fmt.pix_mp.pixelformat = v.fourcc(code)
        wanted.fmt.pix_mp.field = v.FIELD_NONE
        wanted.fmt.pix_mp.num_planes = 1
        plane = wanted.fmt.pix_mp.plane_fmt[0]
        if size is not None:
            wanted.fmt.pix_mp.width, wanted.fmt.pix_mp.height = size
    else:
        wanted.fmt.pix.pixelformat = v.fourcc(code)
        wanted.fmt.pix.field = v.FIELD_NONE
        plane = wanted.fmt.pix
        if size is not None:
            wanted.fmt.pix.width, wanted.fmt.pix.height = size
    plane.bytesperline = plane.sizeimage = 0  # the driver knows
    try:
        node.call(v.S_FMT, wanted)
    except OSError as error:
        raise failure(error, f"format {code} cannot be set", node) from error
    got = present(node, kind)
    if got.code != code or (size is not None and (got.width, got.height) != size):
        asked = f"{code} {size[0]}x{size[1]}" if size else code
        raise ConfigError(
            f"asked for {asked}, the device took {got.code} {got.width}x{got.height}",
            device=node.name,
            hint=f"sizes it has for {code}: {', '.join(_sizes(node, code)) or 'it does not say'}",
        )
    return got


def present(node: Node, kind: int) -> FrameFormat:
    """The format as it is set now."""
    got = _get(node, kind)
    if kind in v.MULTIPLANAR:
        pix, plane = got.fmt.pix_mp, got.fmt.pix_mp.plane_fmt[0]
        if pix.num_planes != 1:
            raise DeviceError(f"{pix.num_planes} planes for one grey image", device=node.name)
    else:
        pix = plane = got.fmt.pix
    return FrameFormat(
        code=v.fourcc_text(pix.pixelformat),
        width=pix.width,
        height=pix.height,
        bytes_per_line=plane.bytesperline,
        size=plane.sizeimage,
        full_range=pix.quantization == v.QUANTIZATION_FULL_RANGE,
    )


def pack(image: Image, buffer: Bytes, frame: FrameFormat) -> None:
    """Write a grey image (H, W) into an output buffer (N,) of that format."""
    lines = buffer[: frame.bytes_per_line * frame.height].reshape(frame.height, frame.bytes_per_line)
    OUTPUT_FORMATS[frame.code](image, lines)


def _get(node: Node, kind: int) -> v.Format:
    got = v.Format(type=kind)
    try:
        node.call(v.G_FMT, got)
    except OSError as error:
        raise failure(error, "the format cannot be read", node) from error
    return got


def _offered(node: Node, kind: int) -> Iterator[str]:
    for index in range(256):  # a bound against drivers that never say that the list is over
        entry = v.FormatDescription(index=index, type=kind)
        try:
            node.call(v.ENUM_FMT, entry)
        except OSError:
            return  # EINVAL is how the kernel says that the list is over
        yield v.fourcc_text(entry.pixelformat)


def _sizes(node: Node, code: str) -> Iterator[str]:
    for index in range(64):
        entry = v.FrameSize(index=index, pixel_format=v.fourcc(code))
        try:
            node.call(v.ENUM_FRAMESIZES, entry)
        except OSError:
            return
        if entry.type == v.FRMSIZE_DISCRETE:
            yield "x".join(str(n) for n in entry.size.discrete)
        else:
            low_w, high_w, step_w, low_h, high_h, step_h = entry.size.stepwise
            yield f"{low_w}x{low_h} to {high_w}x{high_h} in steps of {step_w} and {step_h}"
            return


def _decoded(raw: Bytes, frame: FrameFormat) -> Pixels | None:
    # A JPEG that was cut short is decoded to a grey rest without a word: the end marker tells.
    if raw.size < 4 or raw[:2].tobytes() != b"\xff\xd8" or b"\xff\xd9" not in raw[-64:].tobytes():
        return None
    try:
        image = cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    if image is None or image.shape != (frame.height, frame.width):
        return None
    return image.astype(np.uint8, copy=False)
