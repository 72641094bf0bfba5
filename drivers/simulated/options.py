"""Device strings and option tables of the simulated driver, read into typed settings.

A device string is `RIG/SCENE[?key=value&...]`: "casey2011/board?seed=3". The scene alone stands on casey2011; the
empty string is casey2011/bust. Keys of the string are known to all devices, so that all may be given the same
string; a fault that several have (`times`, `double`, `unplug_after`) is for each of them unless `camera.`,
`projector.` or `trigger.` stands in front. An option table (the rig file's `options`) belongs to its own device; its
faults may stand in a nested table `faults`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints
from urllib.parse import parse_qsl

from drivers.simulated.faults import CameraFaults, ProjectorFaults, TriggerFaults, check_order
from drivers.simulated.optics import Optics
from drivers.simulated.rigs import rig_names
from drivers.simulated.scenes import SceneOptions, scene_names
from scanner.errors import ConfigError

DEFAULT_SCENE = "bust"

MOST_PAIRS = 200
"""Options in a device string: more than there are, and few enough to look at each"""

Side = Literal["camera", "projector", "trigger"]
_S = TypeVar("_S")


@dataclass(frozen=True)
class WorldOptions:
    """What the devices share beside the optics."""

    seed: int = field(default=0, metadata={"low": 0, "high": 2**31 - 1})
    """of noise, jitter, phases, and of the poses of printed targets"""
    walk: bool = False
    """a printed target goes to its next pose once a sequence was shown and the projector is given other images: as a
    preview does between scans"""


@dataclass(frozen=True)
class CameraOptions:
    """The simulated camera's make."""

    shutter: str = field(default="global", metadata={"choices": ("global", "rolling")})
    """rolling: rows begin one after the other, over `readout_us`"""
    readout_us: float = field(default=5000.0, metadata={"low": 10.0, "high": 1e6})
    """duration of a frame's readout"""
    min_gap_us: float | None = field(default=None, metadata={"low": 0.0, "high": 1e6})
    """end of one exposure to the start of the next; none: `readout_us` (a frame that is there leaves an idle camera)"""
    trigger_latency_us: float = field(default=40.0, metadata={"low": 1.0, "high": 1e5})
    """declared as this +- 25 %; the true one varies within"""
    counts_triggers: bool = True
    """frames carry the number of the trigger that started them"""
    line: str = field(default="trigger", metadata={"choices": ("trigger", "frame", "exposure")})
    """what is wired to the camera's line: the trigger board, or an output of the projector"""
    line_latency_us: float = field(default=8.0, metadata={"low": 0.0, "high": 1e5})
    """edge on the line to the first row's start, declared as this +- 25 %; the true one varies within"""
    latch: bool = False
    """an edge that comes while the camera is busy starts an exposure when it is free again; one such edge is kept"""
    buffers: int = field(default=8, metadata={"low": 1, "high": 1024})
    """frames the camera keeps for a host that is slow; further ones are lost"""
    ring: int = field(default=0, metadata={"low": 0, "high": 4096})
    """frames rendered beforehand and handed out in turn, for tests of rate; 0: every frame is rendered"""
    period_us: float | None = field(default=None, metadata={"low": 0.0, "high": 1e8})
    """FREE: time between frames; with `ring`, 0 gives them as fast as asked; none: the shortest possible"""

    @property
    def readout_ns(self) -> int:
        """Duration of the readout."""
        return round(1e3 * self.readout_us)

    @property
    def rolling_ns(self) -> int:
        """From the first row's start to the last row's; 0 for a global shutter."""
        return self.readout_ns if self.shutter == "rolling" else 0

    @property
    def gap_ns(self) -> int:
        """From the end of one exposure to the start of the next, at least."""
        return self.readout_ns if self.min_gap_us is None else round(1e3 * self.min_gap_us)

    def period_ns(self, exposure_ns: int) -> int:
        """Between the starts of two free-running exposures."""
        shortest = exposure_ns + self.gap_ns
        if self.period_us is None:
            return shortest
        return max(round(1e3 * self.period_us), 1 if self.ring else shortest)


@dataclass(frozen=True)
class ProjectorOptions:
    """The simulated projector's make."""

    kind: str = field(default="framebuffer", metadata={"choices": ("framebuffer", "static", "sequencer")})
    """framebuffer: shows what it is given at a refresh; static: one image; sequencer: plays images from its memory"""
    scan: str = field(default="global", metadata={"choices": ("global", "rows")})
    """rows: a new image sweeps down over one refresh, as on an LCD"""
    modulation: str = field(default="declared", metadata={"choices": ("declared", "pwm", "none")})
    """declared: a modulation period is declared and the light is constant; pwm: a grey is built over the period;
    none: constant light, none declared (always so with scan=rows)"""
    refresh_ns: int = field(default=16_666_667, metadata={"low": 1_000_000, "high": 10**9})
    """period of its refreshes"""
    latency_us: float = field(default=4200.0, metadata={"low": 0.0, "high": 1e6})
    """from a flip to its light"""
    latency_spread_us: float = field(default=200.0, metadata={"low": 0.0, "high": 1e5})
    """the declared interval is latency_us +- this; the true latency lies in it, with some jitter"""
    settle_us: float = field(default=200.0, metadata={"low": 0.0, "high": 1e6})
    """true time of a pixel's change, declared as 0.5 .. 1.5 of it (after the sweep, with scan=rows)"""
    trigger_outputs: str = field(default="none", metadata={"choices": ("none", "frame", "exposure", "both")})
    """frame: a pulse at every refresh, when its light begins; exposure: a pulse when a flip's new image lights up"""
    declare_latency: bool = True
    """false: latency and settle are None in the capabilities, as on an unmeasured rig"""
    camera_socket: str = ""
    """path of the socket of a simulated camera in another process, which then sees this projector"""


@dataclass(frozen=True)
class TriggerOptions:
    """The simulated trigger board's make."""

    clock_ppm: float = field(default=20.0, metadata={"low": -1e4, "high": 1e4})
    """its crystal is slow by this: dark times and exposures are longer"""
    stamp_bound_us: float = field(default=5.0, metadata={"low": 1.0, "high": 1e5})
    """events are true to this"""


@dataclass(frozen=True)
class WorldSettings:
    """Everything that makes a world; equal for all devices in it."""

    rig: str
    scene: str
    shared: WorldOptions
    optics: Optics
    scene_options: SceneOptions


@dataclass(frozen=True)
class Settings:
    """A device string and an option table, understood."""

    world: WorldSettings
    world_keys: frozenset[str]
    """keys of the world that were given, in either place"""
    key: tuple[Any, ...]
    """what the device string means; two devices with the same one share a world"""
    camera: CameraOptions
    projector: ProjectorOptions
    trigger: TriggerOptions
    camera_faults: CameraFaults
    projector_faults: ProjectorFaults
    trigger_faults: TriggerFaults


_WORLD: tuple[type[Any], ...] = (WorldOptions, Optics, SceneOptions)
_SIDES: Mapping[str, tuple[type[Any], ...]] = {
    "camera": (CameraOptions, CameraFaults),
    "projector": (ProjectorOptions, ProjectorFaults),
    "trigger": (TriggerOptions, TriggerFaults),
}


def option_kinds() -> dict[str, tuple[type[Any], ...]]:
    """The tables of options, by whose they are."""
    return {"World": _WORLD, **{side.capitalize(): kinds for side, kinds in _SIDES.items()}}


def read_settings(device: str, options: Mapping[str, Any], side: Side) -> Settings:
    """Understand a device string and the option table of one side.

    Raises:
        ConfigError: unknown rig, scene or key (with a suggestion and the list), or a value that does not fit.
    """
    rig, scene, query = _split(device)
    given: dict[str, dict[str, Any]] = {"world": {}, "camera": {}, "projector": {}, "trigger": {}}
    for key, value in query:
        _sort_query_key(key, value, given)
    key_of_world = (rig, scene, tuple(sorted(query)))
    _sort_table(options, side, given)
    camera_faults = _take(CameraFaults, given["camera"])
    projector_faults = _take(ProjectorFaults, given["projector"])
    check_order(projector_faults.order)
    return Settings(
        world=WorldSettings(
            rig,
            scene,
            _take(WorldOptions, given["world"]),
            _take(Optics, given["world"]),
            _take(SceneOptions, given["world"]),
        ),
        world_keys=frozenset(given["world"]),
        key=key_of_world,
        camera=_take(CameraOptions, given["camera"]),
        projector=_take(ProjectorOptions, given["projector"]),
        trigger=_take(TriggerOptions, given["trigger"]),
        camera_faults=camera_faults,
        projector_faults=projector_faults,
        trigger_faults=_take(TriggerFaults, given["trigger"]),
    )


def setting_problems(device: str, options: Mapping[str, Any], side: Side) -> list[tuple[str, ConfigError]]:
    """All that `read_settings` would refuse, one by one: (option, error), option "" for the device string."""
    place, _, query = device.partition("?")
    parts: list[tuple[str, str, Mapping[str, Any]]] = [("", place, {})]
    pairs = query.split("&", MOST_PAIRS)
    parts += [("", f"?{pair}", {}) for pair in pairs if query] if len(pairs) <= MOST_PAIRS else [("", device, {})]
    for key, value in options.items():
        of_table = key == "faults" and isinstance(value, Mapping)
        parts += [(key, "", {key: one}) for one in ([{name: value[name]} for name in value] if of_table else [value])]
    found = []
    for key, said, table in parts:
        try:
            read_settings(said, table, side)
        except ConfigError as error:
            found.append((key, error))
    return found


def check_same_world(settings: Settings, world: WorldSettings, device: str) -> None:
    """Raise ConfigError where a key that was given contradicts the world that the other device has opened."""
    for key in sorted(settings.world_keys):
        mine, theirs = _world_value(settings.world, key), _world_value(world, key)
        if mine != theirs:
            raise ConfigError(
                f"{key} is {mine!r} here and {theirs!r} for the other device of this simulated world",
                device=device,
                hint=f"give {key} in the device string of both, or the same value in both option tables",
            )


def _world_value(world: WorldSettings, key: str) -> Any:
    for part in (world.shared, world.optics, world.scene_options):
        if key in _names(type(part)):
            return getattr(part, key)
    raise KeyError(key)


def _split(device: str) -> tuple[str, str, list[tuple[str, str]]]:
    place, _, tail = device.partition("?")
    rig, slash, scene = place.strip("/").rpartition("/")
    if not slash and scene in rig_names():
        rig, scene = scene, ""
    rig, scene = rig or rig_names()[0], scene or DEFAULT_SCENE
    _check_name("rig", rig, rig_names(), device)
    _check_name("scene", scene, scene_names(), device)
    if tail.count("&") >= MOST_PAIRS:
        raise ConfigError(f"a device string with more than {MOST_PAIRS} options", hint="each option once is enough")
    try:
        query = parse_qsl(tail, keep_blank_values=True, strict_parsing=bool(tail))
    except ValueError as error:
        raise ConfigError(f"device {device!r}: {error}", hint="options look like ?seed=3&ambient=0.1") from error
    return rig, scene, query


def _check_name(what: str, name: str, known: tuple[str, ...], device: str) -> None:
    if name not in known:
        raise ConfigError(f"device {device!r}: no simulated {what} named {name!r}", hint=_suggest(name, known))


def _suggest(name: str, known: tuple[str, ...]) -> str:
    near = get_close_matches(name, known, n=1)
    return (f"did you mean {near[0]!r}? " if near else "") + f"known: {', '.join(known)}"


def _sort_query_key(key: str, value: str, given: dict[str, dict[str, Any]]) -> None:
    name = key.removeprefix("faults.")
    side, dot, rest = name.partition(".")
    if dot and side in _SIDES and rest in _keys(side):
        given[side][rest] = value
        return
    found = [place for place in given if name in _keys(place)]
    if not found:
        everything = tuple(sorted({known for place in given for known in _keys(place)}))
        raise ConfigError(f"unknown option {key!r} of the simulated devices", hint=_suggest(name, everything))
    for place in found:
        given[place][name] = value


def _sort_table(options: Mapping[str, Any], side: Side, given: dict[str, dict[str, Any]]) -> None:
    known = _keys("world") + _keys(side)
    faults = options.get("faults", {})
    if not isinstance(faults, Mapping):
        raise ConfigError(f"option faults must be a table, got {faults!r}")
    fault_names = _names(_SIDES[side][1])
    for key, value in faults.items():
        if key not in fault_names:
            raise ConfigError(f"unknown fault {key!r} of the simulated {side}", hint=_suggest(str(key), fault_names))
        given[side][key] = value
    for key, value in options.items():
        if key == "faults":
            continue
        if key not in known:
            raise ConfigError(f"unknown option {key!r} of the simulated {side}", hint=_suggest(str(key), known))
        given["world" if key in _keys("world") else side][key] = value


@cache
def _keys(place: str) -> tuple[str, ...]:
    kinds = _WORLD if place == "world" else _SIDES[place]
    return tuple(name for kind in kinds for name in _names(kind))


def _names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(f.name for f in dataclasses.fields(kind))


def _take(kind: type[_S], given: Mapping[str, Any]) -> _S:
    """The settings of one dataclass, from those of `given` that are its own."""
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    for f in dataclasses.fields(kind):  # type: ignore[arg-type]
        if f.name in given:
            values[f.name] = _coerce(f.name, given[f.name], hints[f.name])
            _check_bounds(f.name, values[f.name], f.metadata)
    return kind(**values)


def _coerce(name: str, value: Any, kind: Any) -> Any:
    """`value` (a string of the device string, or a TOML value) as `kind`."""
    if get_origin(kind) is UnionType:
        if value is None or value == "":
            return None
        kind = next(part for part in get_args(kind) if part is not NoneType)
    try:
        if get_origin(kind) is tuple:
            parts = [part for part in value.split(",") if part] if isinstance(value, str) else list(value)
            return tuple(_coerce(name, part, int) for part in parts)
        if kind is bool:
            return value if isinstance(value, bool) else {"true": True, "1": True, "false": False, "0": False}[value]
        if kind is str:
            return _text(value)
        if isinstance(value, bool) or (kind is int and isinstance(value, float)):
            raise TypeError(value)  # noqa: TRY301
        return kind(value)
    except (ValueError, TypeError, KeyError) as error:
        wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "a string"}.get(
            kind, "whole numbers, as 3,7 or [3, 7]"
        )
        raise ConfigError(f"option {name} takes {wanted}, got {value!r}") from error


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def _check_bounds(name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    choices = metadata.get("choices")
    if choices is not None and value not in choices:
        raise ConfigError(f"option {name} is {value!r}", hint=_suggest(str(value), choices))
    low, high = metadata.get("low", float("-inf")), metadata.get("high", float("inf"))
    if value is not None and isinstance(value, int | float) and not low <= value <= high:
        raise ConfigError(f"option {name} is {value!r}, it must lie in {low:g} .. {high:g}")
