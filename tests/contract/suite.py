"""The contract every driver must keep, as test classes; a driver's test module only says how to make the device.

A module derives from `ProjectorContract`, `CameraContract` or `TriggerContract` and gives the fixture `bench`: an open
device, its clock, for a camera what makes light, and for a trigger board what beats on its input VSYNC. Nothing here
knows a driver. Times are taken from the bench's clock, so the suite runs in virtual time on simulated devices and in
real time on others.
"""

from tests.contract.cameras import CameraBench, CameraContract
from tests.contract.projectors import ProjectorBench, ProjectorContract
from tests.contract.trigger_boards import TriggerBench, TriggerContract

__all__ = [
    "CameraBench",
    "CameraContract",
    "ProjectorBench",
    "ProjectorContract",
    "TriggerBench",
    "TriggerContract",
]
