"""The options that say what to project, for every command that takes them: one parameter `pattern` stands for all.

What they mean, and what members of a description they become, is `options.PatternOptions`.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, get_type_hints

from service.commands.options import (
    AxisOption,
    Bits,
    Carriers,
    Code,
    Codes,
    First,
    Frequencies,
    Inverse,
    Levels,
    PatternOptions,
    Profile,
    Shifts,
    Unmodulated,
    White,
)

UNSAID = PatternOptions()

_OPTIONS: Mapping[str, Any] = {
    "frequencies": Frequencies,
    "shifts": Shifts,
    "axis": AxisOption,
    "bits": Bits,
    "carriers": Carriers,
    "profile": Profile,
    "levels": Levels,
    "codes": Codes,
    "first": First,
    "unmodulated": Unmodulated,
    "white": White,
    "code": Code,
    "inverse": Inverse,
}
"""By name, in the order in which help lists them"""


def takes_pattern(command: Callable[..., int]) -> Callable[..., int]:
    """A command whose parameter `pattern`, a `PatternOptions`, is given by the options, which stand in its place."""
    hints = get_type_hints(command, include_extras=True)
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name == "pattern":
            parameters += [
                parameter.replace(name=name, annotation=kind, default=False if kind is White else None)
                for name, kind in _OPTIONS.items()
            ]
        else:
            parameters.append(parameter.replace(annotation=hints[parameter.name]))

    @functools.wraps(command)
    def with_options(**given: Any) -> int:
        said = {name: given.pop(name) for name in _OPTIONS}
        return command(pattern=PatternOptions(**{**said, "white": said["white"] or None}), **given)

    # What the command line is made from.
    with_options.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    with_options.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_options
