"""The contracts between the sequencer and devices: what a projector, a camera and a trigger board can do.

A driver implements one of the small protocols below and declares what its device can do (`capabilities`);
nothing is guessed. Times are CLOCK_MONOTONIC nanoseconds, each with a source and a bound. Calls come from one
thread at a time; a call may block, which is why devices live in a process of their own.
"""

from scanner.devices.cameras import Camera, CameraCapabilities, CameraFrame, CameraSettings, Pixels, TriggerMode
from scanner.devices.drivers import CameraDriver, ChecksOptions, DeviceInfo, ProjectorDriver, TriggerDriver
from scanner.devices.knowing import (
    ChecksSetup,
    KeepsCounts,
    KnowsPresence,
    KnowsTemperature,
    KnowsTruth,
    SetupFinding,
    Truth,
)
from scanner.devices.projectors import (
    Image,
    Projector,
    ProjectorCapabilities,
    ProjectorKind,
    SequencedProjector,
    TableSlot,
)
from scanner.devices.times import Exposure, Flip, Interval, Source
from scanner.devices.triggers import TriggerBoard, TriggerCapabilities, TriggerEvent, TriggerFault, TriggerSource

__all__ = [
    "Camera",
    "CameraCapabilities",
    "CameraDriver",
    "CameraFrame",
    "CameraSettings",
    "ChecksOptions",
    "ChecksSetup",
    "DeviceInfo",
    "Exposure",
    "Flip",
    "Image",
    "Interval",
    "KeepsCounts",
    "KnowsPresence",
    "KnowsTemperature",
    "KnowsTruth",
    "Pixels",
    "Projector",
    "ProjectorCapabilities",
    "ProjectorDriver",
    "ProjectorKind",
    "SequencedProjector",
    "SetupFinding",
    "Source",
    "TableSlot",
    "TriggerBoard",
    "TriggerCapabilities",
    "TriggerDriver",
    "TriggerEvent",
    "TriggerFault",
    "TriggerMode",
    "TriggerSource",
    "Truth",
]
