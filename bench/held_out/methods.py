"""What is projected: each method with the axis, and where it is chosen for the rig, the pattern that suits it."""

from __future__ import annotations

from scanner.geometry import calibration_from_dict
from scanner.patterns import CompositePattern, GrayPattern, McpPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.graypmp import default_gray_pmp
from scanner.patterns.mcp_choice import choose_mcp
from scanner.patterns.sequence import Precorrection

PUBLISHED = (90.0, 106.0, 120.0, 132.0)


def published(axis, rig=None):
    """As the dissertation has it, on any rig."""
    return McpPattern(axis, 4, PUBLISHED, tuple(range(16)), levels="composite")


def _own(axis, rig):
    calibration = calibration_from_dict(rig.calibration())
    return choose_mcp(_size(rig), axis, calibration.camera_scale).pattern


def _size(rig):
    return ProjectorSize(*rig.projector.size)


METHODS = {
    "pmp": lambda axis, rig: PmpPattern((axis,), (1.0, 8.0, 64.0), (8, 8, 8)),
    "pmp4": lambda axis, rig: PmpPattern((axis,), (1.0, 8.0, 32.0), (4, 4, 4)),
    "pmp3": lambda axis, rig: PmpPattern((axis,), (1.0, 6.0, 36.0), (3, 3, 3)),
    "both": lambda axis, rig: PmpPattern(("x", "y"), (1.0, 8.0, 48.0), (4, 4, 4)),
    "heterodyne": lambda axis, rig: PmpPattern((axis,), (59.0, 64.0, 70.0), (4, 4, 4)),
    "gray": lambda axis, rig: GrayPattern((axis,), 10, _bits(axis, rig), inverse=False),
    "gray_inverse": lambda axis, rig: GrayPattern((axis,), 9, _bits(axis, rig), inverse=True),
    "gray+pmp": lambda axis, rig: default_gray_pmp((axis,), _size(rig)),
    "mcp": _own,
    "published": published,
    "cp": lambda axis, rig: CompositePattern(axis),
}


def _bits(axis, rig):
    return (_size(rig).along(axis) - 1).bit_length()


def sequence_of(method, rig, axis=None, *, bracketed=True):
    """What a program would project on this rig; axis: the one its geometry measures with."""
    axis = axis or calibration_from_dict(rig.calibration()).phase_axis
    pattern = METHODS[method](axis, rig)
    undone = Precorrection(gamma=rig.undone)
    if bracketed or method.startswith("gray"):
        return PatternSequence.bracketed(_size(rig), pattern, undone)
    return PatternSequence(_size(rig), pattern, precorrection=undone)
