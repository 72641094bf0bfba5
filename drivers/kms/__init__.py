"""Kernel mode setting: a projector on HDMI or DisplayPort with no desktop between, exact greys and true flip times."""

from drivers.kms.driver import KmsProjectorDriver

projector_driver = KmsProjectorDriver()

__all__ = ["projector_driver"]
