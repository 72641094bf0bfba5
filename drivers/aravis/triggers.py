"""What starts an exposure: free run, software or a line, set and read back; and the camera's count of triggers.

TriggerSelector is set before everything that depends on it. Functions over an opened link's features; run on the
link's thread.
"""

from __future__ import annotations

from drivers.aravis.features import Features
from drivers.aravis.options import AravisOptions
from scanner.devices import TriggerMode
from scanner.errors import ConfigError

SELECTORS = ("FrameStart", "ExposureStart", "FrameBurstStart", "AcquisitionStart")
"""What starts one frame, best first: cameras have different words for it"""

COUNTERS = ("Counter0", "Counter1")
SOFTWARE_EVENTS = ("FrameTrigger", "SoftwareSignal0", "SoftwareSignal1")


def offered_modes(features: Features) -> tuple[TriggerMode, ...]:
    """The modes that this camera has."""
    modes = [TriggerMode.FREE]
    if features.has("TriggerMode"):
        sources = features.entries("TriggerSource")
        if "Software" in sources and features.has("TriggerSoftware"):
            modes.append(TriggerMode.SOFTWARE)
        if any(source.startswith("Line") for source in sources):
            modes.append(TriggerMode.HARDWARE)
    return tuple(modes)


def set_mode(features: Features, mode: TriggerMode, options: AravisOptions, name: str) -> str | None:
    """Set the mode; returns the trigger's source, None for free run.

    Raises:
        ConfigError: a line or an activation that the camera does not have.
        DeviceError: something reads back as another value.
    """
    if not features.has("TriggerMode"):
        return None
    selector = _switch_off_all(features)
    features.set_if_there("AcquisitionMode", "Continuous")
    if mode is TriggerMode.FREE:
        return None
    if selector is not None:
        features.set("TriggerSelector", selector)
    source = "Software" if mode is TriggerMode.SOFTWARE else _line(features, options, name)
    features.set("TriggerSource", source)
    if mode is TriggerMode.HARDWARE:
        _set_edge(features, options, name)
    features.set_if_there("TriggerOverlap", _overlap(features, options, name))
    features.set("TriggerMode", "On")
    return source


def count_triggers(features: Features, source: str | None, options: AravisOptions) -> bool:
    """Let the camera count the source's edges and put the count into each frame; whether it can."""
    features.set_if_there("ChunkModeActive", False)
    event = _event(features, source, options)
    if not options.count_triggers or event is None or "CounterValue" not in _chunks(features):
        return False
    counter = next((one for one in COUNTERS if one in features.entries("CounterSelector")), None)
    if counter is not None:
        features.set("CounterSelector", counter)
    features.set("CounterEventSource", event)
    features.set_if_there("CounterEventActivation", options.trigger_activation)
    features.set_if_there("CounterTriggerSource", "Off")
    features.set("ChunkModeActive", True)
    features.set("ChunkSelector", "CounterValue")
    features.set_if_there("ChunkEnable", True)
    if counter is not None:
        features.set_if_there("ChunkCounterSelector", counter)
    features.execute_if_there("CounterReset")
    return True


def read_count(features: Features) -> int | None:
    """The counter as it stands now."""
    return features.get_or_none("CounterValue", int)


def _switch_off_all(features: Features) -> str | None:
    """Every trigger off; returns the selector of the one that starts a frame, None where there is no choice."""
    selectors = features.entries("TriggerSelector")
    for selector in selectors:
        features.set("TriggerSelector", selector)
        features.set_if_there("TriggerMode", "Off")
    if not selectors:
        features.set("TriggerMode", "Off")
        return None
    return next((one for one in SELECTORS if one in selectors), selectors[0])


def _line(features: Features, options: AravisOptions, name: str) -> str:
    lines = [source for source in features.entries("TriggerSource") if source.startswith("Line")]
    wanted = options.trigger_line or lines[0]
    if wanted not in features.entries("TriggerSource"):
        raise ConfigError(f"no trigger line {wanted!r}", device=name, hint=f"it has {', '.join(lines)}")
    features.set_if_there("LineSelector", wanted)
    features.set_if_there("LineMode", "Input")
    return wanted


def _set_edge(features: Features, options: AravisOptions, name: str) -> None:
    edges = features.entries("TriggerActivation")
    if edges and options.trigger_activation not in edges:
        raise ConfigError(
            f"no trigger activation {options.trigger_activation!r}", device=name, hint=f"it has {', '.join(edges)}"
        )
    features.set_if_there("TriggerActivation", options.trigger_activation)
    if features.has("TriggerDelay"):
        low, high = features.bounds("TriggerDelay")
        if not low <= options.trigger_delay_us <= high:
            raise ConfigError(
                f"a trigger delay of {options.trigger_delay_us:g} us lies outside {low:g} .. {high:g} us",
                device=name,
                hint="give a trigger_delay_us within these",
            )
        features.set("TriggerDelay", float(options.trigger_delay_us))
    elif options.trigger_delay_us:
        raise ConfigError("the camera has no trigger delay", device=name, hint="leave trigger_delay_us out")


def _overlap(features: Features, options: AravisOptions, name: str) -> str:
    entries = features.entries("TriggerOverlap")
    if not options.overlap:
        return "Off"
    chosen = next((one for one in ("ReadOut", "PreviousFrame") if one in entries), None)
    if chosen is None:
        raise ConfigError("the camera takes no trigger during readout", device=name, hint="leave overlap out")
    return chosen


def _event(features: Features, source: str | None, options: AravisOptions) -> str | None:
    """What the counter counts: the edges that fire the camera, under the name that this camera has for them."""
    names = SOFTWARE_EVENTS if source == "Software" else (source, f"{source}{options.trigger_activation}")
    events = features.entries("CounterEventSource")
    return next((one for one in names if one in events), None)


def _chunks(features: Features) -> list[str]:
    return features.entries("ChunkSelector") if features.has("ChunkModeActive") else []
