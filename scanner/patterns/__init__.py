"""The images to project, as data: descriptions (formats.md, Pattern descriptions) and the images they stand for."""

from scanner.patterns.composite import CompositePattern
from scanner.patterns.description import (
    Axis,
    CameraFormat,
    FrameRole,
    Pattern,
    ProjectorSize,
)
from scanner.patterns.graycode import GrayPattern
from scanner.patterns.graypmp import GrayPmpPattern
from scanner.patterns.mcp import McpPattern
from scanner.patterns.methods import pattern_from_description
from scanner.patterns.pmp import PmpPattern
from scanner.patterns.sequence import PartSequence, PatternSequence

__all__ = [
    "Axis",
    "CameraFormat",
    "CompositePattern",
    "FrameRole",
    "GrayPattern",
    "GrayPmpPattern",
    "McpPattern",
    "PartSequence",
    "Pattern",
    "PatternSequence",
    "PmpPattern",
    "ProjectorSize",
    "pattern_from_description",
]
