"""The option table of a KMS projector, as a rig file has it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from drivers.option_table import Options


class KmsOptions(Options):
    """`projector.options`; `mode` comes from the rig file's `projector.mode`."""

    mode: str | None = None
    """None: the display's native mode"""
    modulation_period_us: float | None = Field(default=None, gt=0, le=1e6)
    """of a display that builds a grey over time (colour wheel, bit planes)"""
    scan: Literal["global", "rows"] = "global"
    """rows: a new image sweeps down over one refresh, as on LCD and LCoS"""
