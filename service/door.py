"""What is wrong with the words of a scan or live run, told before its job is taken; and which words say the same.

No device is asked: what only open ones know (which exposures the camera has, what the plan refuses) is told when the
job begins.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from scanner.decode import require_decoder
from scanner.errors import ConfigError, DecodeError
from scanner.filter_settings import FilterSettings
from scanner.patterns import Axis, PmpPattern, ProjectorSize
from scanner.patterns.graycode import GrayPattern
from scanner.patterns.graypmp import GrayPmpPattern
from scanner.wire import LiveStart, ScanStart
from service.scan_patterns import check_length, pattern_for

MOST_EXPOSURE_US = 10_000_000
"""No camera here exposes longer (`service.config`)."""

MOST_ENTRIES = 2048
"""Numbers, lists and maps of a pattern in all: 1024 images are 341 frequencies with their shifts, a table has 256 grey
levels. To look closely at more takes everybody's time."""

_USUAL = ProjectorSize(1152, 864)
"""Stands for a projector that is not open yet: members are checked, whether they fit is not."""

_FIXED = ("sign", "offset", "origin", "code", "inverse")
"""Members of pattern descriptions whose defaults are the same on every rig."""

_DEFAULTS: dict[str, dict[str, Any]] = {
    "pmp": PmpPattern().describe(),
    "gray": GrayPattern().describe(),
    "gray+pmp": GrayPmpPattern().describe(),
}

_NOTHING: dict[str, tuple[Any, ...]] = {"white": (None, False), "precorrection": (None,)}
"""Members that may be spelled out to say that there is none."""


def refuse_nonsense(
    params: ScanStart | LiveStart, size: tuple[int, int] | None = None, axis: Axis | None = None
) -> None:
    """Raise where no rig could do what is asked, or not this one.

    Args:
        size: (width, height) of this rig's projector, where it is open. axis: of the rig file, where it names one.

    Raises:
        ConfigError: a parameter makes no sense; the message names it.
    """
    try:
        _check_exposure(params.exposure)
        FilterSettings.from_dict(msgspec.to_builtins(params.filters))
        _check_pattern(params, None if size is None else ProjectorSize(*size), axis)
        require_decoder(params.method, params.decoder)
    except DecodeError as error:
        raise ConfigError(error.message, hint=error.hint) from error


def refuse_endless(params: ScanStart | LiveStart) -> None:
    """Raise where a pattern has more members than any: `plain` and `refuse_nonsense` look at each.

    Raises:
        ConfigError: it has.
    """
    entries = 0
    within: list[Mapping[Any, Any] | list[Any]] = [params.pattern or {}]
    while within:
        held = within.pop()
        entries += len(held)
        if entries > MOST_ENTRIES:
            raise ConfigError(
                f"the pattern has more than {MOST_ENTRIES} numbers",
                hint="no list of frequencies, shifts or codes is so long",
            )
        members = held.values() if isinstance(held, Mapping) else held
        within.extend(member for member in members if isinstance(member, list | Mapping) and member)


def plain(params: ScanStart | LiveStart) -> dict[str, Any]:
    """The parameters, without those that say what would be so without them: equal for all who ask for the same.

    Defaults that depend on the rig (frequencies, carriers, exposure) are not known here: spelled out they are a choice.
    """
    content: dict[str, Any] = msgspec.structs.asdict(params)
    content["filters"] = _filters(msgspec.to_builtins(params.filters))
    content["pattern"] = _pattern(params.method, params.pattern or {})
    whole: dict[str, Any] = _whole(content)
    return whole


def _whole(value: Any) -> Any:
    """8.0 as 8: some languages have one kind of number."""
    if isinstance(value, Mapping):
        return {key: _whole(member) for key, member in value.items()}
    if isinstance(value, list | tuple):
        return [_whole(member) for member in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _filters(given: Mapping[str, Any]) -> dict[str, Any]:
    usual = FilterSettings().as_dict()
    return {key: value for key, value in given.items() if value is not None and value != usual[key]}


def _pattern(method: str, given: Mapping[str, Any]) -> dict[str, Any]:
    usual = _DEFAULTS.get(method, {})
    said = {"method": (method,), **_NOTHING, **{key: (usual[key],) for key in _FIXED if key in usual}}
    return {key: value for key, value in given.items() if not any(_same(value, of) for of in said.get(key, ()))}


def _same(value: Any, other: Any) -> bool:
    # To Python True is 1.
    return bool(value == other) and isinstance(value, bool) == isinstance(other, bool)


def _check_exposure(exposure: float | str | None) -> None:
    if isinstance(exposure, int | float) and not 0 < exposure <= MOST_EXPOSURE_US:
        raise ConfigError(f"exposure {exposure:g} us is outside 0 .. 10 s", hint='give microseconds, or "auto"')


def _check_pattern(params: ScanStart | LiveStart, projector: ProjectorSize | None, axis: Axis | None) -> None:
    """Along the axis that the rig will choose; where that is not known, along the one that raises no objection."""
    repeat = params.repeat if isinstance(params, ScanStart) else 1
    if repeat < 1:
        raise ConfigError(f"repeat must be 1 or more, got {repeat}", hint="1 takes the sequence once")
    problem: ConfigError | DecodeError | None = None
    axes: tuple[Axis, ...] = ("y", "x") if axis is None else (axis,)
    for along in axes:
        try:
            pattern = pattern_for(params.method, params.pattern or {}, along, projector or _USUAL)
            if projector is not None:
                pattern.validate(projector)
            check_length(pattern.fringe_count, repeat)
        except (ConfigError, DecodeError) as error:
            problem = problem or error
        else:
            return
    if problem is not None:
        raise problem
