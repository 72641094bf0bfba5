"""Cameras of the GigE Vision and USB3 Vision standards, through the distribution's Aravis library.

The registry opens `camera_driver`. Whether this machine is set up for a GigE camera: `network.check_network`. The
library is loaded when a camera is opened or looked for, not before.
"""

from drivers.aravis.driver import AravisDriver
from drivers.aravis.network import Finding, check_network

camera_driver = AravisDriver()

__all__ = ["Finding", "camera_driver", "check_network"]
