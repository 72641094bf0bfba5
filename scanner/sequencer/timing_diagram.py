"""Draws when patterns shone and when frames were exposed, from a capture's stamps: SVG, or PNG for the same picture.

Time runs from left to right, in bands of up to sixteen frames. Each band has the projector's light (faint while it
may be changing), the flips, and the exposures in the colour of their verdict, with their bounds as whiskers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Literal

import numpy as np

from scanner.capture import FrameRecord
from scanner.errors import StorageError
from scanner.sequencer.audit import CaptureCheck
from scanner.sequencer.plan import Mode, Plan
from scanner.sequencer.verify import FrameVerdict

FRAMES_A_BAND = 16
WIDTH, MARGIN, BAND, HEAD, FOOT = 1240, 90, 128, 56, 46

INK, FAINT, PAPER = "#1f2933", "#9aa5b1", "#ffffff"
LIT, CHANGING = "#ffd166", "#fff1cc"
COLOURS = {"proved": "#2a9d5c", "consistent": "#3a86c8", "unproved": "#8d99a6", "suspect": "#d1495b"}


@dataclass(frozen=True)
class Box:
    """A filled rectangle."""

    x: float
    y: float
    width: float
    height: float
    fill: str
    tip: str = ""


@dataclass(frozen=True)
class Line:
    """A straight line."""

    x1: float
    y1: float
    x2: float
    y2: float
    stroke: str
    width: float = 1.0


@dataclass(frozen=True)
class Text:
    """A line of text; anchor as in SVG."""

    x: float
    y: float
    text: str
    size: float = 11
    fill: str = INK
    anchor: Literal["start", "middle", "end"] = "start"


Shape = Box | Line | Text


def timing_diagram(check: CaptureCheck, form: str = "svg") -> bytes:
    """The diagram of a checked capture.

    Args:
        form: "svg", or "png" through OpenCV.

    Returns:
        The file's content.

    Raises:
        StorageError: no such form.
    """
    if form not in ("svg", "png"):
        raise StorageError(f"a timing diagram is drawn as svg or png, not {form!r}", hint="name the file .svg or .png")
    shapes, height = draw(check)
    return to_svg(shapes, height).encode() if form == "svg" else to_png(shapes, height)


def draw(check: CaptureCheck) -> tuple[list[Shape], int]:
    """The diagram's shapes and its height in px."""
    header, plan = check.capture.header, check.plan
    stamped = sorted((r for r in check.capture.all_records if r.flip is not None), key=_time)
    title = f"{header.id or check.capture.path.name}: {header.sequence.pattern.method}, {header.frame_count} frames"
    shapes: list[Shape] = [Text(MARGIN, 24, title, 15)]
    if plan is None or not stamped:
        shapes.append(Text(MARGIN, HEAD + 20, "no time stamps: this capture was made elsewhere", 13, FAINT))
        return shapes, HEAD + 60
    shapes += _legend(plan)
    flips = sorted({r.flip.t_ns for r in stamped if r.flip is not None})
    origin = flips[0]
    verdicts = {v.pattern: _with_picture(check, v) for v in check.verdicts}
    final = {r.pattern: r for r in check.capture.all_records}
    bands = [stamped[i : i + FRAMES_A_BAND] for i in range(0, len(stamped), FRAMES_A_BAND)]
    for index, records in enumerate(bands):
        band = _Band(plan, records, flips, origin, HEAD + index * BAND)
        shapes += band.axis() + band.light() + band.flips()
        for record in records:
            counts = final.get(record.pattern) is record
            shapes += band.frame(record, verdicts.get(record.pattern) if counts else None, len(header.sequence))
    return shapes, HEAD + len(bands) * BAND + FOOT


class _Band:
    """One line of the diagram: a stretch of time."""

    def __init__(
        self, plan: Plan, records: Sequence[FrameRecord], flips: Sequence[int], origin_ns: int, top: float
    ) -> None:
        self.plan, self.top, self.origin_ns = plan, top, origin_ns
        times = [t for record in records for t in _times(record, plan)]
        first, last = min(times), max(times)
        later = [t for t in flips if t > last]
        if plan.mode is not Mode.STATIC:
            last = min([*later, last + plan.period_ns]) + plan.window_start_ns
        self.start_ns, self.end_ns = first, max(last, first + 1)
        self.shown = [t for t in flips if first - plan.period_ns <= t <= self.end_ns] or [flips[0]]
        self.last_flip = flips[-1]

    def x(self, t_ns: float) -> float:
        """Where a time stands."""
        share = (t_ns - self.start_ns) / (self.end_ns - self.start_ns)
        return MARGIN + min(max(share, 0.0), 1.0) * (WIDTH - MARGIN - 30)

    def axis(self) -> list[Shape]:
        top, step = self.top, _step((self.end_ns - self.start_ns) / 1e6)
        shapes: list[Shape] = [
            Text(MARGIN - 8, top + 34, "light", 11, FAINT, "end"),
            Text(MARGIN - 8, top + 52, "flips", 11, FAINT, "end"),
            Text(MARGIN - 8, top + 73, "exposures", 11, FAINT, "end"),
            Line(MARGIN, top + 88, WIDTH - 30, top + 88, FAINT),
        ]
        first = np.ceil((self.start_ns - self.origin_ns) / 1e6 / step) * step
        for ms in np.arange(first, (self.end_ns - self.origin_ns) / 1e6, step):
            x = self.x(self.origin_ns + ms * 1e6)
            shapes += [Line(x, top + 88, x, top + 92, FAINT), Text(x, top + 104, f"{ms:g}", 10, FAINT, "middle")]
        shapes.append(Text(WIDTH - 26, top + 104, "ms", 10, FAINT))
        return shapes

    def light(self) -> list[Shape]:
        """Pattern on: from flip + latency + settle to the next flip + latency; faint while it may be changing."""
        shapes: list[Shape] = []
        for t, following in zip(self.shown, [*self.shown[1:], None], strict=True):
            begin, steady = t + self.plan.window_end_ns, t + self.plan.window_start_ns
            gone = self.end_ns if following is None else following + self.plan.window_end_ns
            if gone <= self.start_ns:
                continue
            x0, x1, x2 = self.x(begin), self.x(min(steady, gone)), self.x(gone)
            tip = f"steady from {(steady - self.origin_ns) / 1e6:.3f} to {(gone - self.origin_ns) / 1e6:.3f} ms"
            shapes += [Box(x0, self.top + 22, x1 - x0, 18, CHANGING), Box(x1, self.top + 22, x2 - x1, 18, LIT, tip)]
        return shapes

    def flips(self) -> list[Shape]:
        visible = [t for t in self.shown if self.start_ns <= t <= self.end_ns]
        return [Line(self.x(t), self.top + 40, self.x(t), self.top + 56, INK, 1.5) for t in visible]

    def frame(self, record: FrameRecord, verdict: FrameVerdict | None, patterns: int) -> list[Shape]:
        """One frame's exposure and label; a frame without a verdict was taken again later, and is hollow."""
        position = record.pattern % patterns
        label = f"{position}" + (f".{record.attempt}" if record.attempt else "")
        exposure = record.exposure
        if exposure is None:
            x = self.x(record.flip.t_ns if record.flip else self.start_ns)
            return [
                Text(x + 3, self.top + 15, label, 10, COLOURS["suspect"]),
                Text(x + 3, self.top + 73, "missing", 10, COLOURS["suspect"]),
            ]
        name = "unproved" if verdict is None else "suspect" if verdict.suspect else verdict.verdict
        x0, x1 = self.x(exposure.start_ns), self.x(exposure.end_ns)
        low, high = self.x(exposure.start_ns - exposure.bound_ns), self.x(exposure.end_ns + exposure.bound_ns)
        y, colour = self.top + 62, COLOURS[name]
        words = "taken again" if verdict is None else "; ".join((name, *verdict.reasons))
        tip = (
            f"frame {position}, slot {record.slot}: {(exposure.start_ns - self.origin_ns) / 1e6:.3f} to "
            f"{(exposure.end_ns - self.origin_ns) / 1e6:.3f} ms, {words}"
        )
        shapes: list[Shape] = [
            Line(low, y + 7, high, y + 7, colour),
            Box(x0, y, max(x1 - x0, 1.0), 14, colour, tip),
            Text((x0 + x1) / 2, self.top + 15, label, 10, colour if name == "suspect" else INK, "middle"),
        ]
        if verdict is None and x1 - x0 > 4:
            shapes.append(Box(x0 + 1.5, y + 1.5, x1 - x0 - 3, 11, PAPER))
        return shapes


def _with_picture(check: CaptureCheck, verdict: FrameVerdict) -> FrameVerdict:
    """A verdict by time stamps, with what the frame's picture says against it."""
    against = check.against(verdict.pattern % len(check.capture.header.sequence))
    if not against:
        return verdict
    return replace(verdict, suspect=True, reasons=(*verdict.reasons, f"its picture: against {', '.join(against)}"))


def _legend(plan: Plan) -> list[Shape]:
    known = "measured" if plan.measured else "assumed"
    entries = [
        (LIT, "pattern steady"),
        (CHANGING, f"may be changing (latency, settling: {known})"),
        *((COLOURS[name], name) for name in ("proved", "consistent", "unproved", "suspect")),
    ]
    shapes: list[Shape] = []
    x = float(MARGIN)
    for colour, words in entries:
        shapes += [Box(x, 36, 12, 10, colour), Text(x + 17, 45, words, 11)]
        x += 34 + 6.2 * len(words)
    shapes.append(Text(x, 45, f"{plan.mode.value}; labels: frame.retake", 11, FAINT))
    return shapes


def _time(record: FrameRecord) -> tuple[int, int]:
    flip = record.flip.t_ns if record.flip is not None else 0
    return flip, record.exposure.start_ns if record.exposure is not None else flip


def _times(record: FrameRecord, plan: Plan) -> list[int]:
    times = [record.exposure.start_ns, record.exposure.end_ns] if record.exposure is not None else []
    if record.flip is not None and (plan.mode is not Mode.STATIC or not times):
        times.append(record.flip.t_ns)
    return times


def _step(span_ms: float) -> float:
    """A round distance of ticks: 1, 2 or 5 times a power of ten, about ten to a band."""
    rough = max(span_ms, 1e-6) / 10
    power = 10.0 ** np.floor(np.log10(rough))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= rough))


# --- output -------------------------------------------------------------------------------------------------------


def to_svg(shapes: Sequence[Shape], height: int) -> str:
    """The shapes as an SVG document; boxes with a tip show it under the mouse."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" '
        f'viewBox="0 0 {WIDTH} {height}" font-family="sans-serif">',
        f'<rect width="{WIDTH}" height="{height}" fill="{PAPER}"/>',
        *(_svg(shape) for shape in shapes),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _svg(shape: Shape) -> str:
    if isinstance(shape, Box):
        box = f'<rect x="{shape.x:.1f}" y="{shape.y:.1f}" width="{max(shape.width, 0):.1f}" height="{shape.height:g}"'
        tip = f"><title>{escape(shape.tip)}</title></rect>" if shape.tip else "/>"
        return f'{box} fill="{shape.fill}"{tip}'
    if isinstance(shape, Line):
        ends = f'x1="{shape.x1:.1f}" y1="{shape.y1:.1f}" x2="{shape.x2:.1f}" y2="{shape.y2:.1f}"'
        return f'<line {ends} stroke="{shape.stroke}" stroke-width="{shape.width:g}"/>'
    return (
        f'<text x="{shape.x:.1f}" y="{shape.y:.1f}" font-size="{shape.size:g}" fill="{shape.fill}" '
        f'text-anchor="{shape.anchor}">{escape(shape.text)}</text>'
    )


def to_png(shapes: Sequence[Shape], height: int) -> bytes:
    """The shapes as a PNG file, drawn by OpenCV."""
    import cv2  # noqa: PLC0415  (SVG needs none of it)

    picture = np.full((height, WIDTH, 3), 255, np.uint8)
    for shape in shapes:
        if isinstance(shape, Box):
            corners = (round(shape.x), round(shape.y)), (round(shape.x + shape.width), round(shape.y + shape.height))
            cv2.rectangle(picture, *corners, _bgr(shape.fill), cv2.FILLED)
        elif isinstance(shape, Line):
            ends = (round(shape.x1), round(shape.y1)), (round(shape.x2), round(shape.y2))
            cv2.line(picture, *ends, _bgr(shape.stroke), max(1, round(shape.width)), cv2.LINE_AA)
        else:
            scale = shape.size / 28
            (width, _), _ = cv2.getTextSize(shape.text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
            left = shape.x - {"start": 0.0, "middle": width / 2, "end": float(width)}[shape.anchor]
            place = (round(left), round(shape.y))
            cv2.putText(picture, shape.text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, _bgr(shape.fill), 1, cv2.LINE_AA)
    return bytes(cv2.imencode(".png", picture)[1].tobytes())


def _bgr(colour: str) -> tuple[int, int, int]:
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)
