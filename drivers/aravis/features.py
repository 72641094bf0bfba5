"""GenICam features by name: asked for, set, and read back; and every automatic function off.

Names are those of the GenICam Standard Features Naming Convention, with the older ones beside them. A feature that a
camera lacks is no error unless somebody needs it; one that takes a value and keeps another is.
"""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from drivers.aravis.library import is_library_error, translated
from scanner.errors import ConfigError, DeviceError

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

AUTOMATIC: tuple[tuple[str, str | bool | float], ...] = (
    ("ExposureMode", "Timed"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("FocusAuto", "Off"),
    ("IrisAuto", "Off"),
    ("AcquisitionFrameRateAuto", "Off"),
    ("LightSourcePreset", "Off"),
    ("TargetBrightnessAuto", "Off"),
    ("GammaEnable", False),
    ("GammaEnabled", False),
    ("Gamma", 1.0),
    ("LUTEnable", False),
    ("ColorTransformationEnable", False),
    ("SharpeningEnable", False),
    ("SharpnessEnabled", False),
    ("SharpeningAuto", "Off"),
    ("NoiseReductionEnable", False),
    ("NoiseReduction", 0.0),
    ("SharpnessEnhancement", 0.0),
    ("HDRMode", "Off"),
    ("TestPattern", "Off"),
    ("TestImageSelector", "Off"),
)
"""What would change a grey level behind our back, and the value that stops it."""

_NEARLY = 1e-3
"""Relative: a camera may round what it is given"""


class Features:
    """The features of one opened device. Raises DeviceError (DeviceLost where it does not answer)."""

    def __init__(self, device: Any, name: str) -> None:
        """device: an Aravis.Device."""
        self._device = device
        self._name = name

    def forget(self) -> None:
        """Let go of the device: an error's traceback may keep this object for a while."""
        self._device = None

    def has(self, feature: str) -> bool:
        """Whether the camera has it, and it can be used now."""
        return bool(self._call("looking for", feature, lambda: self._device.is_feature_available(feature)))

    def writable(self, feature: str) -> bool:
        """Whether it can be set now."""
        if not self.has(feature):
            return False
        mode = self._call("looking at", feature, lambda: self._device.get_feature_access_mode(feature))
        return getattr(mode, "value_nick", "rw") in ("rw", "wo")

    def entries(self, feature: str) -> list[str]:
        """Choices of an enumeration; none where the camera lacks it."""
        if not self.has(feature):
            return []
        return list(
            self._call(
                "reading the choices of",
                feature,
                lambda: self._device.dup_available_enumeration_feature_values_as_strings(feature),
            )
        )

    def get(self, feature: str, kind: type[_T]) -> _T:
        """Its value, as str, int, float or bool."""
        device = self._device
        reader: Mapping[type, Callable[[str], Any]] = {
            str: device.get_string_feature_value,
            int: device.get_integer_feature_value,
            float: device.get_float_feature_value,
            bool: device.get_boolean_feature_value,
        }
        return kind(self._call("reading", feature, lambda: reader[kind](feature)))  # type: ignore[call-arg]

    def get_or_none(self, feature: str, kind: type[_T]) -> _T | None:
        """Its value; None where the camera lacks it."""
        return self.get(feature, kind) if self.has(feature) else None

    def bounds(self, feature: str) -> tuple[float, float]:
        """Least and largest value of a float."""
        low, high = self._call("reading the bounds of", feature, lambda: self._device.get_float_feature_bounds(feature))
        return float(low), float(high)

    def float_step(self, feature: str) -> float | None:
        """Step of a float; None where the camera tells none."""
        try:
            step = float(self._device.get_float_feature_increment(feature))
        except Exception as error:
            if is_library_error(error):  # the document gives no increment
                return None
            raise
        return step if step > sys.float_info.min else None

    def integer_bounds(self, feature: str) -> tuple[int, int, int]:
        """Least and largest value of an integer, and its step."""
        low, high = self._call(
            "reading the bounds of", feature, lambda: self._device.get_integer_feature_bounds(feature)
        )
        step = self._call("reading the step of", feature, lambda: self._device.get_integer_feature_increment(feature))
        return int(low), int(high), max(1, int(step))

    def set(self, feature: str, value: str | bool | int | float) -> Any:
        """Set, read back, return what it reads.

        Raises:
            DeviceError: it reads back as something else.
        """
        device = self._device
        writer: Mapping[type, Callable[[str, Any], Any]] = {
            str: device.set_string_feature_value,
            int: device.set_integer_feature_value,
            float: device.set_float_feature_value,
            bool: device.set_boolean_feature_value,
        }
        kind = type(value)
        self._call(f"setting to {value!r}", feature, lambda: writer[kind](feature, value))
        taken = self.get(feature, kind)
        same = math.isclose(float(taken), value, rel_tol=_NEARLY) if isinstance(value, float) else taken == value
        if not same:
            raise DeviceError(
                f"{feature} was set to {value!r} and reads back as {taken!r}",
                device=self._name,
                hint="another feature forbids it: the camera's manual says which",
            )
        return taken

    def set_if_there(self, feature: str, value: str | bool | int | float) -> bool:
        """Set and read back where the camera has the feature and lets it be set."""
        if isinstance(value, str) and value not in self.entries(feature):
            return False
        if not self.writable(feature):
            return False
        self.set(feature, value)
        return True

    def set_at_most(self, feature: str, most: int) -> None:
        """Lower an integer that is larger than this, where the camera has it."""
        if self.writable(feature) and self.get(feature, int) > most:
            self.set(feature, most)

    def execute(self, command: str) -> None:
        """Run a command."""
        self._call("executing", command, lambda: self._device.execute_command(command))

    def execute_if_there(self, command: str) -> None:
        """Run a command that the camera may lack."""
        if self.has(command):
            self.execute(command)

    def switch_off_automatics(self) -> list[str]:
        """Everything of AUTOMATIC that the camera has; returns the names of those set, all of them read back.

        One that is on and locked is warned of: it may change grey levels in the middle of a scan.
        """
        done = []
        for feature, value in AUTOMATIC:
            if not self.has(feature) or (self._is_choice(feature) and value not in self.entries(feature)):
                continue
            if self.writable(feature):
                self._set_of_its_kind(feature, value)
                done.append(feature)
            elif (now := self.get(feature, type(value))) != value:
                _log.warning("%s: %s is %r, and cannot be set to %r: greys may change", self._name, feature, now, value)
        return done

    def set_further(self, features: Mapping[str, Any]) -> None:
        """Features of the rig file, by name.

        Raises:
            ConfigError: the camera has no such feature, it cannot be set, or not to that value.
        """
        for feature, value in features.items():
            if not self.has(feature):
                raise ConfigError(
                    f"the camera has no feature {feature!r}", device=self._name, hint="see its manual for the name"
                )
            if not isinstance(value, str | bool | int | float):
                raise ConfigError(f"features.{feature} is {value!r}: neither text nor number", device=self._name)
            if not self.writable(feature):
                raise ConfigError(
                    f"features.{feature} cannot be set", device=self._name, hint="it is read-only, or locked by another"
                )
            if self._is_choice(feature) and value not in (choices := self.entries(feature)):
                raise ConfigError(
                    f"features.{feature} has no {value!r}", device=self._name, hint=f"it has {', '.join(choices)}"
                )
            self._set_of_its_kind(feature, value)

    def _set_of_its_kind(self, feature: str, value: str | bool | int | float) -> None:
        """A number may be an integer for one camera and a float for another."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            value = int(value) if "Int" in self._node(feature) else float(value)
        self.set(feature, value)

    def _is_choice(self, feature: str) -> bool:
        return "Enumeration" in self._node(feature)

    def _node(self, feature: str) -> str:
        """Name of its kind of node in the camera's description."""
        return type(self._device.get_feature(feature)).__name__

    def _call(self, doing: str, feature: str, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except Exception as error:
            if is_library_error(error):
                raise translated(error, self._name, f"{doing} {feature}") from error
            raise
