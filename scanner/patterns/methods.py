"""The methods by name: which pattern a description means."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scanner.errors import DecodeError
from scanner.patterns.composite import CompositePattern
from scanner.patterns.description import Pattern
from scanner.patterns.graycode import GrayPattern
from scanner.patterns.graypmp import GrayPmpPattern
from scanner.patterns.mcp import McpPattern
from scanner.patterns.pmp import PmpPattern

_Patterns = type[PmpPattern] | type[McpPattern] | type[GrayPattern] | type[CompositePattern] | type[GrayPmpPattern]

_METHODS: Mapping[str, _Patterns] = {
    "pmp": PmpPattern,
    "mcp": McpPattern,
    "gray": GrayPattern,
    "gray+pmp": GrayPmpPattern,
    "cp": CompositePattern,
}


def pattern_from_description(description: Mapping[str, Any]) -> Pattern:
    """The pattern that a description means.

    Raises:
        DecodeError: unknown method, missing or wrong members, named.
    """
    if not isinstance(description, Mapping):
        raise DecodeError("pattern description is not an object")
    method = description.get("method")
    if not isinstance(method, str) or method not in _METHODS:
        raise DecodeError(f"unknown pattern method {method!r}", hint=f"known methods: {', '.join(sorted(_METHODS))}")
    pattern: Pattern = _METHODS[method].from_description(description)
    return pattern
