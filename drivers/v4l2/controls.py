"""Controls by name: what a device can be told, within which bounds, set and read back; automatic functions off.

Names are those of `v4l2-ctl`: "Exposure Time, Absolute" is exposure_time_absolute. The kernel keeps controls in the
device while it is plugged in: what another program set stays set, which is why everything that matters is set here.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from difflib import get_close_matches

from drivers.ioctl import Node
from drivers.v4l2 import videodev2 as v
from drivers.v4l2.node import failure
from scanner.errors import ConfigError, DeviceError

EXPOSURE_ABSOLUTE = 0x009A0902
"""in 100 us"""
EXPOSURE = 0x00980911
"""in units of the driver, often lines"""

_INTEGER, _BOOLEAN, _MENU, _BUTTON, _INTEGER64, _CLASS, _STRING, _BITMASK, _INTEGER_MENU = range(1, 10)
_NUMBERS = frozenset({_INTEGER, _BOOLEAN, _MENU, _INTEGER64, _BITMASK, _INTEGER_MENU})

_EXPOSURE_AUTO = 0x009A0901
_GAMMA = 0x00980910
_SHARPNESS = 0x0098091B

_OFF: dict[int, tuple[int, ...]] = {
    _EXPOSURE_AUTO: (1, 2),  # manual; cameras without it call "shutter priority" what leaves the exposure time alone
    0x009A0903: (0,),  # exposure_dynamic_framerate: a longer exposure would change the period
    0x00980912: (0,),  # gain, automatic
    0x0098090C: (0,),  # white balance, automatic
    0x00980919: (0,),  # hue, automatic
    0x00980920: (0,),  # brightness, automatic
    0x0098091D: (0,),  # chroma gain, automatic
    0x0098091C: (0,),  # backlight compensation
    0x009A090C: (0,),  # focus, automatic
    0x009A0914: (0, 1),  # white balance presets: manual, else auto off is what the control above gave
    0x009A0915: (0,),  # wide dynamic range
    0x009A0916: (0,),  # image stabilisation
    0x009A0918: (0,),  # ISO, automatic
    0x009A091A: (0,),  # scene mode
}
"""Control and the values that switch it off, best first"""

LINEAR_GAMMA = 100
"""UVC 1.5, 4.2.2.3.9: gamma times 100, 100 being a straight line; V4L2 leaves the unit to the driver"""


@dataclass(frozen=True)
class Control:
    """One control. Bounds are in its own units."""

    id: int
    name: str
    kind: int
    minimum: int
    maximum: int
    step: int
    default: int
    flags: int
    menu: dict[int, str] = field(default_factory=dict)

    @property
    def settable(self) -> bool:
        """Whether it can be set now. Grabbed means: not while streaming."""
        blocked = v.CTRL_FLAG_DISABLED | v.CTRL_FLAG_READ_ONLY | v.CTRL_FLAG_INACTIVE | v.CTRL_FLAG_GRABBED
        return self.kind in _NUMBERS and not self.flags & blocked

    @property
    def bounds(self) -> str:
        """What it takes, in words."""
        if self.menu:
            return "one of " + ", ".join(f"{number} ({words})" for number, words in self.menu.items())
        steps = f" in steps of {self.step}" if self.step > 1 else ""
        return f"{self.minimum} .. {self.maximum}{steps}"


def controls(node: Node) -> dict[str, Control]:
    """Every control with a number for a value, by name."""
    return {control.name: control for control in _every_control(node)}


def read(node: Node, control: Control) -> int:
    """The present value."""
    return _exchange(node, v.G_EXT_CTRLS, control, 0)


def write(node: Node, control: Control, value: int) -> int:
    """Set and read back.

    Raises:
        ConfigError: outside the bounds, or not settable now.
        DeviceError: the device refuses.
    """
    if not control.settable:
        raise ConfigError(
            f"control {control.name} cannot be set now",
            device=node.name,
            hint="it is read-only, or inactive because an automatic function rules it",
        )
    allowed = value in control.menu if control.menu else control.minimum <= value <= control.maximum
    if not allowed:
        raise ConfigError(
            f"control {control.name}: {value} is not one of its values", device=node.name, hint=control.bounds
        )
    _exchange(node, v.S_EXT_CTRLS, control, value)
    return value if control.flags & v.CTRL_FLAG_WRITE_ONLY else read(node, control)


def write_named(node: Node, name: str, value: int | str) -> int:
    """`write` for a control of a rig file: by name, a menu's entry by its words or number.

    Raises:
        ConfigError: no such control or value; what was read back is another value.
    """
    known = controls(node)
    if name not in known:
        near = get_close_matches(name, known, n=1)
        suggestion = f"did you mean {near[0]!r}? " if near else ""
        raise ConfigError(
            f"no control {name!r} on this device", device=node.name, hint=f"{suggestion}it has: {', '.join(known)}"
        )
    control = known[name]
    number = _number(control, value, node.name)
    taken = write(node, control, number)
    if abs(taken - number) >= max(control.step, 1):
        raise ConfigError(
            f"control {name}: asked for {number}, the device took {taken}", device=node.name, hint=control.bounds
        )
    return taken


def switch_automatics_off(node: Node, keep: frozenset[str]) -> dict[str, int]:
    """Switch off what changes pictures by itself, and read back. Returns what was set. keep: names left alone.

    Gamma is made linear and sharpening least, where the device lets us.

    Raises:
        DeviceError: one stays on.
    """
    taken: dict[str, int] = {}
    for control in controls(node).values():
        if control.name in keep or not control.settable:
            continue
        values = _off_values(control)
        fitting = [
            x for x in values if (x in control.menu if control.menu else control.minimum <= x <= control.maximum)
        ]
        if not fitting:
            continue
        taken[control.name] = write(node, control, fitting[0])
        if taken[control.name] != fitting[0]:
            raise DeviceError(
                f"{control.name} does not stay off: it was set to {fitting[0]} and is {taken[control.name]}",
                device=node.name,
                hint=f'if that is harmless: options.keep = ["{control.name}"]',
            )
    return taken


def control_name(said: str) -> str:
    """A control's name as `v4l2-ctl` writes it."""
    return re.sub(r"[^a-z0-9]+", "_", said.lower()).strip("_")


def _off_values(control: Control) -> tuple[int, ...]:
    if control.id == _GAMMA:
        return (LINEAR_GAMMA,)
    if control.id == _SHARPNESS:
        return (control.minimum,)
    return _OFF.get(control.id, ())


def _number(control: Control, value: int | str, device: str) -> int:
    if isinstance(value, int):
        return value
    for number, words in control.menu.items():
        if words == value or control_name(words) == control_name(value):
            return number
    raise ConfigError(f"control {control.name} takes no {value!r}", device=device, hint=control.bounds)


def _every_control(node: Node) -> Iterator[Control]:
    last = 0
    while True:
        said = v.QueryExtControl(id=last | v.CTRL_FLAG_NEXT_CTRL)
        try:
            node.call(v.QUERY_EXT_CTRL, said)
        except OSError:
            return  # EINVAL: there are no more; ENOTTY: there are none
        last = said.id
        if said.type in _NUMBERS and not said.flags & v.CTRL_FLAG_DISABLED:
            yield Control(
                id=said.id,
                name=control_name(v.text(said.name)),
                kind=said.type,
                minimum=said.minimum,
                maximum=said.maximum,
                step=said.step,
                default=said.default_value,
                flags=said.flags,
                menu=dict(_menu(node, said)) if said.type in {_MENU, _INTEGER_MENU} else {},
            )


def _menu(node: Node, said: v.QueryExtControl) -> Iterator[tuple[int, str]]:
    for index in range(said.minimum, said.maximum + 1):
        entry = v.QueryMenu(id=said.id, index=index)
        try:
            node.call(v.QUERYMENU, entry)
        except OSError:
            continue  # menus have holes
        yield index, v.text(entry.m.name) if said.type == _MENU else str(entry.m.value)


def _exchange(node: Node, request: int, control: Control, value: int) -> int:
    item = v.ExtControl(id=control.id)
    wide = control.kind == _INTEGER64
    if wide:
        item.v.value64 = value
    else:
        item.v.value = value if value < 1 << 31 else value - (1 << 32)  # bit masks are unsigned
    several = v.ExtControls(which=v.CTRL_WHICH_CUR_VAL, count=1, controls=ctypes.pointer(item))
    try:
        node.call(request, several)
    except OSError as error:
        verb = "set" if request == v.S_EXT_CTRLS else "read"
        raise failure(error, f"control {control.name} cannot be {verb}", node) from error
    return int(item.v.value64 if wide else item.v.value)
