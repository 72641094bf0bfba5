"""Golden timing files of the trigger board (tests/golden/trigger): read, played to a board, and compared.

A file says what goes in (`do`), what the board must say by itself (`says`) and which pins must change (`pins`). Times
are microseconds of the board's clock. The same files are drawn in docs/reference/trigger-protocol.md; the fields and
tolerances are described there.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "golden" / "trigger"

ANSWER_WITHIN_US = 20_000
SAID_WITHIN_US = 60_000
"""A fault of a missing edge is noticed when the board next looks: at most a lap of its timer later"""
CAMERA_WITHIN_US = 1.0
OTHERS_WITHIN_US = 40.0
"""SYNC and LED are not driven by the timer itself: they follow"""
CLOCK_WITHIN_US = 2
"""Of a time that the board tells"""
EDGE_US = 100
"""Length of a pulse on an input"""


@dataclass(frozen=True)
class Golden:
    """One file."""

    name: str
    title: str
    end_us: int
    do: tuple[dict[str, Any], ...]
    says: tuple[dict[str, Any], ...]
    pins: tuple[dict[str, Any], ...]


@dataclass
class Transcript:
    """What a board did: lines and pin changes with their times, us."""

    lines: list[tuple[float, str]] = field(default_factory=list)
    pins: list[tuple[float, str, int]] = field(default_factory=list)


def golden_files() -> list[Golden]:
    """All of them, by name."""
    return [golden(path) for path in sorted(FOLDER.glob("*.json"))]


def golden(path: Path) -> Golden:
    """One of them."""
    content = json.loads(path.read_text())
    return Golden(path.stem, content["title"], content["end"], *(tuple(content[key]) for key in ("do", "says", "pins")))


def actions(file: Golden) -> list[tuple[float, str, Any]]:
    """What goes in, in order: (us, "bytes", data) with the time of the last byte, or (us, "VSYNC" | "EXT", level)."""
    found: list[tuple[float, str, Any]] = []
    for step in file.do:
        if "send" in step:
            found.append((step["t"], "bytes", step["send"].encode() + b"\n"))
        elif "bytes" in step:
            found.append((step["t"], "bytes", bytes.fromhex(step["bytes"])))
        else:
            found += [(step["t"], step["edge"], 1), (step["t"] + EDGE_US, step["edge"], 0)]
    return sorted(found, key=lambda action: action[0])


def differences(file: Golden, transcript: Transcript) -> list[str]:
    """Where the board did not do as the file says; empty: it did."""
    said = [line for line in transcript.lines if line[1].startswith("!")]
    answers = [line for line in transcript.lines if not line[1].startswith("!")]
    return [*_answers(file, answers), *_said(file, said), *_pins(file, transcript.pins)]


def _answers(file: Golden, answers: list[tuple[float, str]]) -> list[str]:
    wanted = [step for step in file.do if "answer" in step]
    found = []
    if len(answers) != len(wanted):
        found.append(f"{len(answers)} answers, expected {len(wanted)}: {answers}")
    for step, (t, line) in zip(wanted, answers, strict=False):
        if line != step["answer"] or not step["t"] <= t <= step["t"] + ANSWER_WITHIN_US:
            found.append(f"{step['send']!r} at {step['t']}: {line!r} at {t:.0f}, expected {step['answer']!r}")
    return found


def _said(file: Golden, said: list[tuple[float, str]]) -> list[str]:
    wanted = [{"t": 0, "line": "!EVT READY"}, *file.says]
    found = []
    if len(said) != len(wanted):
        found.append(f"{len(said)} lines by itself, expected {len(wanted)}: {said}")
    for step, (t, line) in zip(wanted, said, strict=False):
        within = step.get("within", CLOCK_WITHIN_US)
        head, _, stamp = step["line"].rpartition("@")
        if stamp or not head:
            right = line == step["line"]
        else:
            told = line.removeprefix(head)
            right = line.startswith(head) and told.isdigit() and abs(int(told) - step["t"]) <= within
        if not right or not step["t"] - within <= t <= step["t"] + within + SAID_WITHIN_US:
            found.append(f"{line!r} at {t:.0f}, expected {step['line']!r} at {step['t']} +- {within}")
    return found


def _pins(file: Golden, pins: list[tuple[float, str, int]]) -> list[str]:
    found = []
    by_pin: dict[str, list[tuple[float, int]]] = {}
    for t, pin, level in pins:
        by_pin.setdefault(pin, []).append((t, level))
    came: list[float | None] = []
    for step in file.pins:
        if not by_pin.get(step["pin"]):
            found.append(f"{step['pin']} did not go {step['level']} at {step['t']}")
            came.append(None)
            continue
        t, level = by_pin[step["pin"]].pop(0)
        came.append(t)
        since = came[step["after"]] if "after" in step else 0.0
        late = t - (since or 0.0) - step["t"]
        follows = step["pin"] in ("SYNC", "LED")
        within = step.get("within", CAMERA_WITHIN_US)
        if level != step["level"] or not -within <= late <= (max(within, OTHERS_WITHIN_US) if follows else within):
            found.append(f"{step['pin']} went {level}, {late:+.2f} us from {step['t']}, expected {step['level']}")
    found += [f"{pin} went {level} at {t:.2f}, unasked" for pin, left in by_pin.items() for t, level in left]
    return found
