"""Simulated devices: a world in time with a scene, a projector and a camera, and the faults that real ones have.

Device strings and options: `options`. Rigs and scenes: scenes.json, `rigs`, `scenes`, `targets`. The registry opens
`camera_driver` and `projector_driver`; nothing else of this package is meant to be imported at run time.
"""

from drivers.simulated import cast, optics, sensor, textures, view
from drivers.simulated.driver import SimulatedCameraDriver, SimulatedProjectorDriver

camera_driver = SimulatedCameraDriver()
projector_driver = SimulatedProjectorDriver()


def warm_up() -> None:
    """Compile every kernel of the simulated devices, or load it from its cache."""
    cast.warm_up()
    optics.warm_up()
    sensor.warm_up()
    textures.warm_up()
    view.warm_up()


__all__ = ["camera_driver", "projector_driver", "warm_up"]
