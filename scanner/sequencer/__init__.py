"""The sequencer: which image when (plan), the run itself, and the proof which frame saw which pattern.

`plan`, `verify` and `witness` are pure; only `acquire`, `endless`, `measure_latency` and `auto_exposure` touch devices.
"""

from scanner.sequencer.audit import CaptureCheck, check_capture
from scanner.sequencer.endless import EndlessFrame, endless
from scanner.sequencer.exposure import ExposureChoice
from scanner.sequencer.exposure import auto as auto_exposure
from scanner.sequencer.findings import Witness, Witnesses
from scanner.sequencer.hearing import Hearing
from scanner.sequencer.latency import measure as measure_latency
from scanner.sequencer.plan import Mode, Plan, light_unit_ns, plan
from scanner.sequencer.rig import Rig
from scanner.sequencer.run import Acquisition, FinishReason, FrameSink, acquire
from scanner.sequencer.timing_diagram import timing_diagram
from scanner.sequencer.verify import FrameVerdict, verify
from scanner.sequencer.witness import witness

__all__ = [
    "Acquisition",
    "CaptureCheck",
    "EndlessFrame",
    "ExposureChoice",
    "FinishReason",
    "FrameSink",
    "FrameVerdict",
    "Hearing",
    "Mode",
    "Plan",
    "Rig",
    "Witness",
    "Witnesses",
    "acquire",
    "auto_exposure",
    "check_capture",
    "endless",
    "light_unit_ns",
    "measure_latency",
    "plan",
    "timing_diagram",
    "verify",
    "witness",
]
