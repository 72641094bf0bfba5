"""A window on a desktop as projector, through SDL: for trials and for machines that keep their desktop."""

from drivers.window.projector import WindowProjectorDriver

projector_driver = WindowProjectorDriver()

__all__ = ["projector_driver"]
