"""What some devices know beyond their contract: their host, their presence, their counts, their warmth, the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # its kernels take a while to load, and few devices know their own geometry
    from scanner.geometry import Calibration


class SetupFinding(Protocol):
    """One thing that a driver looked at on its host."""

    @property
    def subject(self) -> str:
        """What was looked at."""

    @property
    def ok(self) -> bool:
        """Whether it is well."""

    @property
    def text(self) -> str:
        """What was found."""

    @property
    def command(self) -> str:
        """What mends it; empty where it is well, or no command could."""


@runtime_checkable
class ChecksSetup(Protocol):
    """A camera whose driver can tell whether the host is set up for it: buffers, packets, speeds."""

    def check_setup(self, rate_hz: float | None = None) -> Sequence[SetupFinding]:
        """Look at the host. rate_hz: frames a second wanted; None: as many as the camera gives."""


@runtime_checkable
class KnowsPresence(Protocol):
    """A device whose driver can tell, without using it, whether it is still there."""

    def check_present(self) -> None:
        """Take a quick look, a millisecond at most; while it is open and idle.

        Raises:
            DeviceLost: it went away.
        """


@runtime_checkable
class KeepsCounts(Protocol):
    """A camera that counts what became of its frames."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Of the present run, or the last one, by the driver's own names: frames that came, were lost, sent again."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated scene really is, on the camera's pixel grid. NaN where the ray meets nothing.

    rows, columns: (H, W) float32 projector coordinates of the seen surface point, px. xyz: (H, W, 3) float32 mm,
    camera frame. lit: (H, W) bool, inside the projector's field and not in shadow.
    """

    rows: NDArray[np.float32]
    columns: NDArray[np.float32]
    xyz: NDArray[np.float32]
    lit: NDArray[np.bool_]


@runtime_checkable
class KnowsTemperature(Protocol):
    """A camera with a thermometer: geometry moves until it is warm."""

    def temperature_c(self) -> float | None:
        """Degrees Celsius, now; None where this model has none. Called between runs.

        Raises:
            DeviceError: it could not be read.
        """


@runtime_checkable
class KnowsTruth(Protocol):
    """A camera that stands in a simulated world, and can tell what it should measure."""

    def truth(self) -> Truth:
        """The scene's truth."""

    def true_calibration(self) -> Calibration:
        """The rig's geometry, exact."""
