"""The trigger board on a serial port: an Arduino Uno or Nano with the firmware in `firmware/`.

The registry opens `trigger_driver`; nothing else of this package is meant to be imported at run time.
"""

from drivers.serial_trigger.driver import SerialTriggerDriver

trigger_driver = SerialTriggerDriver()

__all__ = ["trigger_driver"]
