"""Video4Linux2: cameras (webcams, HDMI grabbers, sensors on a ribbon) and outputs (HDMI transmitters, loopbacks).

A module of its own over the kernel's interface, because OpenCV's capture drops frames, sequence numbers and bits.
"""

from drivers.v4l2.driver import V4l2CameraDriver, V4l2ProjectorDriver

camera_driver = V4l2CameraDriver()
projector_driver = V4l2ProjectorDriver()

__all__ = ["camera_driver", "projector_driver"]
