"""What a decoder shows of its way: intermediate images by name, handed to an observer as they are made.

A decoder that has stages takes an observer and tells it each; without one it makes nothing for show. How a stage is
drawn is said by `look` and done elsewhere (`scanner.stage_pictures`); nothing is kept here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from numpy.typing import NDArray


class Look(StrEnum):
    """What a stage's values are, and so how they are drawn."""

    GREY = "grey"
    """(H, W) brightness"""
    SIGNED = "signed"
    """(H, W) about zero; NaN: none"""
    MASK = "mask"
    """(H, W) 0 or more"""
    LABELS = "labels"
    """(H, W) integers, 0 none: code words or indices on pixels of peaks"""
    SPECTRUM = "spectrum"
    """(V, U) power from DC on, drawn in logarithms"""
    CURVES = "curves"
    """(N, L) curves over one abscissa"""
    DOTS = "dots"
    """(2, L) x and y of points"""


@dataclass(frozen=True, eq=False)
class Stage:
    """One intermediate image.

    name: short, lower case, the same for every capture ("stripes"). title: what it is, for people. source: section and
    figure of the publication that shows the like, or "". values: see `Look`; only valid during the call.
    """

    name: str
    title: str
    source: str
    look: Look
    values: NDArray[Any]


Observer = Callable[[Stage], None]
"""Told each stage in order. It must not change the values."""
