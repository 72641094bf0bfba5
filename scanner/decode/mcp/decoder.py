"""The default MCP decoder: one image in, maps out; the stages in order, and the reason where there are no maps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.crossings import Crossings, crossings_of, turned_over
from scanner.decode import Decoded
from scanner.decode.frames import FrameCheck
from scanner.decode.mcp.decision import Decision, decide
from scanner.decode.mcp.description import LEAST_CLEAR, Agreement
from scanner.decode.mcp.door import turned, turned_back, upright_image, upside_down
from scanner.decode.mcp.locate import Array, Found, Image, Known, Stages, locate
from scanner.decode.mcp.maps import fill_rows, maps_of
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import median
from scanner.decode.mcp.resolution import if_whole, refuse_too_fine
from scanner.decode.mcp.white import RATIO_BITS, divided, in_grey_levels
from scanner.decode.mosaic import grey
from scanner.errors import DecodeError
from scanner.geometry import Calibration
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize

LEAST_DECIDED = 0.55
"""Share of the peaks of a pattern that is turned that have a name: nearly .7 and more in sound scenes, .46 and less
where coins, dim and glossy scenes make stripes of the other way"""

ANOTHER_SHAPE = 0.3
"""Natural logarithm by which a shape that the search took is not the one that is known: keystone takes less, and those
tried are two apart"""


def decode_image(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    pattern: McpPattern,
    projector: ProjectorSize,
    camera: CameraFormat,
    calibration: Calibration | None = None,
) -> Decoded:
    """Decode one image.

    Args:
        image: (H, W) uint8 or uint16, linear camera response, as captured.
        pattern: what was projected.
        projector: size of the projector's image.
        camera: format of `image`.

    Returns:
        maps on the camera's grid. All NaN, with a warning, where stripes and carriers are there but no stripe could
        be decided.

    Raises:
        DecodeError: no pattern, another pattern, one turned by 90 degrees, or stripes too fine for the camera.
    """
    return decode_next(image, pattern, projector, camera, None, calibration=calibration)[0]


def decode_next(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    pattern: McpPattern,
    projector: ProjectorSize,
    camera: CameraFormat,
    known: Known | None,
    *,
    even: bool = False,
    calibration: Calibration | None = None,
) -> tuple[Decoded, Known]:
    """Decode one image of a series.

    Args:
        image, pattern, projector, camera: as for `decode_image`.
        known: what the frame before taught; None, or where it does not hold any more: everything is searched anew.
        even: a white frame has taken print and shading out of `image`.

    Returns:
        the maps, and what the next frame may use.

    Raises:
        DecodeError: as `decode_image`.
    """
    seen, learnt = _see(image, pattern, projector, camera, known, even, calibration)
    decoded = maps_of(seen.image, seen.found, seen.decided, seen.model, seen.clock)
    decoded = upside_down(decoded) if seen.upside_down else decoded
    return decoded if pattern.axis == "y" else turned_back(decoded), learnt


def positions_next(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    pattern: McpPattern,
    projector: ProjectorSize,
    camera: CameraFormat,
    known: Known | None,
    memory: Array | None = None,
    *,
    even: bool = False,
    calibration: Calibration | None = None,
) -> tuple[Array, Known]:
    """`decode_next` for those who want rows (axis "x": columns) and no other map: (H, W) float32, NaN where undecided.

    Args:
        image, pattern, projector, camera, known, even: as for `decode_next`.
        memory: float32, as large as the image, for the result to be in: fresh memory takes longer than what is written.

    Raises:
        DecodeError: as `decode_image`.
    """
    seen, learnt = _see(image, pattern, projector, camera, known, even, calibration)
    rows = (np.empty(image.size, np.float32) if memory is None else memory).reshape(seen.image.shape)
    fill_rows(seen.found, seen.decided, seen.model, rows)
    rows = np.ascontiguousarray(rows[::-1]) if seen.upside_down else rows
    return rows if pattern.axis == "y" else turned(rows), learnt


CHECK = "check bits, carriers, codes and axis of the description against what is projected"
UNREAD = (
    "stripes are there, but their codes cannot be read: light, contrast or resolution are too low, or print outshines "
    "the carriers"
)
MORE_LIGHT = (
    "more light on the surface, or a longer exposure, and less light from elsewhere; a camera picture of more pixels, "
    "or nearer; fewer codes (bits) or lower carriers; PMP for surfaces in black and white"
)


@dataclass(frozen=True, eq=False)
class _Seen:
    """An image whose stripes have been decided; `image` is upright: stripes horizontal, the first one above."""

    image: Image
    found: Found
    decided: Decision
    model: PatternModel
    upside_down: bool
    clock: Stages


def _see(
    image: NDArray[Any],
    pattern: McpPattern,
    projector: ProjectorSize,
    camera: CameraFormat,
    known: Known | None,
    even: bool,
    calibration: Calibration | None,
) -> tuple[_Seen, Known]:
    pattern.validate(projector)
    upright = upright_image(image, pattern, camera)
    model = _model_of(pattern, projector, even)
    crossings = None if calibration is None else crossings_of(calibration, pattern, projector)
    seen = None if known is None else _by_what_is_known(upright, model, camera, known, crossings)
    if seen is not None and known is not None:
        return seen, known
    told = None if calibration is None else _pixel_shape(calibration, pattern)
    seen = _see_anew(upright, model, camera, crossings, told)
    return seen, _learnt(seen.found, seen.decided, upside_down=seen.upside_down)


@lru_cache(maxsize=8)
def _model_of(pattern: McpPattern, projector: ProjectorSize, even: bool) -> PatternModel:
    """Frames of a series ask for the same tables again and again: they are kept."""
    return PatternModel.of(pattern, projector, even=even)


def _by_what_is_known(
    upright: Image, model: PatternModel, camera: CameraFormat, known: Known, crossings: Crossings | None
) -> _Seen | None:
    """None where it does not hold any more."""
    clock = Stages()
    image = np.ascontiguousarray(upright[::-1]) if known.upside_down else upright
    found = locate(image, model, camera, clock, known)
    if found.fault is not None:
        return None
    if crossings is not None and known.upside_down:
        crossings = turned_over(crossings, len(image))
    decided = decide(found, model, clock, crossings)
    if not decided.agreement.holds or not known.still_holds(_learnt(found, decided, upside_down=known.upside_down)):
        return None
    return _Seen(image, found, decided, model, known.upside_down, clock)


def _pixel_shape(calibration: Calibration, pattern: McpPattern) -> float:
    """How large the camera sees the projector's pixels along the stripes, over across them."""
    x, y = calibration.camera_scale
    return x / y if pattern.axis == "y" else y / x


def _see_anew(
    upright: Image, model: PatternModel, camera: CameraFormat, crossings: Crossings | None, told: float | None
) -> _Seen:
    """told: see `_pixel_shape`; None without a calibration."""
    clock = Stages()
    first = locate(upright, model, camera, clock)
    by_another = first.search is not None and abs(math.log(first.search.aspect / (told or 1.0))) > ANOTHER_SHAPE
    if first.fault is not None and (told is None or first.search is None):
        _explain(first, upright, model, camera)
    decided = decide(first, model, clock, crossings) if first.fault is None else None
    if decided is not None and decided.agreement.holds:
        return _Seen(upright, first, decided, model, False, clock)
    # The projector may hang upside down: then the stripes' order is reversed.
    reversed_image = np.ascontiguousarray(upright[::-1])
    over, again = None if crossings is None else turned_over(crossings, len(upright)), decided
    if decided is not None and (found := locate(reversed_image, model, camera, clock)).fault is None:
        again = decide(found, model, clock, over)
        if again.agreement.holds:
            return _Seen(reversed_image, found, again, model, True, clock)
    if by_another or first.fault is not None:
        # Harmonics of print may outshine the carriers, and pass for those of pixels of another shape.
        for image, over_turned in ((upright, False), (reversed_image, True)):
            found = locate(image, model, camera, clock, aspects=(), told=told)
            if found.fault is not None:
                continue
            shaped = decide(found, model, clock, over if over_turned else crossings)
            if shaped.agreement.holds:
                return _Seen(image, found, shaped, model, over_turned, clock)
    if decided is None or again is None:
        _explain(first, upright, model, camera)
        raise AssertionError("_explain raises")
    _refuse_turned(upright, model, camera)
    a = max(decided.agreement, again.agreement, key=lambda agreement: (agreement.tells, agreement.agree))
    said, figures, hint = _of_codes(a, first, model, camera)
    refuse_too_fine(upright, model, camera, said, structure=True)
    raise DecodeError(said + figures, hint=hint)


def _of_codes(a: Agreement, found: Found, model: PatternModel, camera: CameraFormat) -> tuple[str, str, str]:
    """Where stripes and carriers are there and the codes are not those described: what to say, by what figures, a hint.

    A description is contradicted by words that are read clearly. Where hardly any is, nothing is said against it:
    light, contrast or resolution did not carry the words, and a wrong description is but one of the causes.
    """
    if a.exchanged:
        words = " and ".join(str(word) for word in a.exchanged)
        said = f"the codes contradict the description: code words {words} stand in one another's places"
        return said, "", 'exchange them in the description\'s "codes" if that is what is projected'
    if a.tells:
        figures = f" (of {a.clear:.0%} clear code words {a.agree:.0%} fit, {a.order:.0%} of neighbours are in order)"
        return "stripes and carriers are there, but the codes contradict the description", figures, CHECK
    peaks = found.parts()[0]
    height = float(np.median(peaks.height)) if len(peaks.height) else 0.0
    figures = (
        f" ({a.clear:.1%} of the stripes' peaks show a code word clearly, {LEAST_CLEAR:.0%} are needed; stripes are "
        f"{found.pitch:.1f} px high and {height:.0f} of {camera.max_value} grey levels bright, the finest carrier has "
        f"a period of {found.pitch / model.pitch / float(model.carriers.max()):.1f} px)"
    )
    return UNREAD, figures, f"{MORE_LIGHT}. If none of that helps: {CHECK}"


def _learnt(found: Found, decided: Decision, *, upside_down: bool) -> Known:
    peaks, _, _, _, search = found.parts()
    label = decided.label
    follow = (label[:-1] >= 0) & (label[1:] == label[:-1] + 1)
    spacing = np.diff(peaks.y)[follow]
    spacing = spacing[spacing > 0]  # not from the foot of one column to the head of the next
    return Known(
        found.pitch,
        found.match,
        search,
        upside_down,
        median(spacing) if spacing.size else found.pitch,
        decided.magnification,
        decided.agreement.hits,
        float((label >= 0).mean()) if label.size else 0.0,
    )


class McpDecoder:
    """Takes the one frame of an MCP sequence (and its white and black ones, if any) and decodes it.

    In a series, `next_frame` after each `finish` keeps what the frame taught: pitch and carriers are searched again
    only when they do not hold any more, after a change of scene or of distance.

    Raises:
        DecodeError: the sequence is not MCP.
    """

    def __init__(self, sequence: PatternSequence, camera: CameraFormat, calibration: Calibration | None = None) -> None:
        if not isinstance(sequence.pattern, McpPattern):
            raise DecodeError(f"the MCP decoder was given method {sequence.pattern.method!r}")
        self._sequence = sequence
        self._pattern = sequence.pattern
        self._camera = camera
        self._calibration = calibration
        self._known: Known | None = None
        self._memory = np.empty(0, np.float32)
        self.next_frame()

    def next_frame(self) -> None:
        """Forget the frames taken, keep what they taught; see `scanner.decode.SeriesDecoder`."""
        self._check = FrameCheck(self._sequence, self._camera)
        self._image: NDArray[Any] | None = None
        self._black: NDArray[Any] | None = None
        self._white: NDArray[Any] | None = None

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position`; see `scanner.decode.Decoder`."""
        self._check.take(position, frame)
        if position == self._sequence.fringes[0]:
            self._image = frame.copy()
        elif position == self._sequence.black:
            self._black = frame.copy()
        elif position == self._sequence.white:
            self._white = frame.copy()

    def finish(self) -> Decoded:
        """The maps; see `scanner.decode.Decoder`."""
        known, self._known = self._known, None  # a frame that is refused teaches nothing
        image, camera = self._to_decode()
        two, size = self._white is not None, self._sequence.projector
        decoded, self._known = decode_next(
            image, self._pattern, size, camera, known, even=two, calibration=self._calibration
        )
        if self._white is None:
            return decoded
        white = grey(self._white, self._camera)
        black = None if self._black is None else grey(self._black, self._camera)
        return replace(
            decoded,
            albedo=in_grey_levels(decoded.albedo, white, black),
            modulation=in_grey_levels(decoded.modulation, white, black),
            details={**decoded.details, "divided_by_white": True},
        )

    def positions(self) -> Array:
        """Rows or columns alone; see `scanner.decode.PositionsDecoder`."""
        known, self._known = self._known, None
        image, camera = self._to_decode()
        if self._memory.size != image.size:
            self._memory = np.empty(image.size, np.float32)
        two, size = self._white is not None, self._sequence.projector
        rows, self._known = positions_next(
            image, self._pattern, size, camera, known, self._memory, even=two, calibration=self._calibration
        )
        return rows

    def _to_decode(self) -> tuple[NDArray[Any], CameraFormat]:
        """The one image that holds the pattern alone."""
        if self._white is None:
            return self.frame(), self._camera
        if self._image is None:
            self.frame()
            raise AssertionError("frame() raises without the MCP frame")
        image, white = grey(self._image, self._camera), grey(self._white, self._camera)
        black = None if self._black is None else grey(self._black, self._camera)
        camera = CameraFormat(self._camera.width, self._camera.height, RATIO_BITS)
        return divided(image, white, black, self._camera.max_value), camera

    def frame(self) -> NDArray[Any]:
        """The one frame, the black one taken off where there is one.

        Raises:
            DecodeError: it has not come.
        """
        if self._image is None:
            raise DecodeError("the MCP frame is missing", hint=f"it is frame {self._sequence.fringes[0]}")
        return self._image if self._black is None else cv2.subtract(self._image, self._black)


def _explain(found: Found, image: Image, model: PatternModel, camera: CameraFormat) -> None:
    """Raise what `locate` found wrong; a pattern turned by 90 degrees, or too fine for the camera, is named."""
    if found.pitch > 0:
        _refuse_turned(image, model, camera)
    refuse_too_fine(image, model, camera, str(found.fault), structure=found.pitch > 0)
    hints = [hint for hint in (found.hint, if_whole(image, model)) if hint is not None]
    raise DecodeError(str(found.fault), hint="; ".join(hints) or None)


def _refuse_turned(image: Image, model: PatternModel, camera: CameraFormat) -> None:
    """Raise DecodeError if the pattern is there, codes and all, once the image is turned."""
    clock = Stages()
    found = locate(turned(image), model, camera, clock)
    seen = decide(found, model, clock) if found.fault is None else None
    if seen is not None and seen.agreement.holds and (seen.label >= 0).mean() >= LEAST_DECIDED:
        raise DecodeError(
            "the pattern is turned by 90 degrees: its stripes run the other way",
            hint='the other "axis" in the description, or turn projector or camera',
        )
