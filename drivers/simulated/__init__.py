"""Simulated devices: a world in time with a scene, projector, camera and trigger board, and the faults of real ones.

Device strings and options: `options`. Rigs and scenes: scenes.json, `rigs`, `scenes`, `targets`. The registry opens
`camera_driver`, `projector_driver` and `trigger_driver`; nothing else of this package is meant to be imported at run
time.
"""

from drivers.simulated import cast, optics, sensor, textures, view
from drivers.simulated.driver import SimulatedCameraDriver, SimulatedProjectorDriver, SimulatedTriggerDriver

camera_driver = SimulatedCameraDriver()
projector_driver = SimulatedProjectorDriver()
trigger_driver = SimulatedTriggerDriver()


def warm_up() -> None:
    """Compile every kernel of the simulated devices, or load it from its cache."""
    cast.warm_up()
    optics.warm_up()
    sensor.warm_up()
    textures.warm_up()
    view.warm_up()


__all__ = ["camera_driver", "projector_driver", "trigger_driver", "warm_up"]
