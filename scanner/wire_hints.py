"""What a client is told to do about a call that could not be read: the values a parameter takes, the form of a request.

Hints name parameters of the protocol (protocol.md), not options of a command line.
"""

from __future__ import annotations

import json
import re
from typing import Any

import msgspec
from msgspec import inspect

REQUEST = 'a map of "jsonrpc": "2.0", id (integer or string), method, and params (a map) where it has any'
NOT_JSON = f"requests are MessagePack, this is JSON text: pack {REQUEST}"

_WHERE = re.compile(r"`\$\.([\w.]+)`$")
_NAMES = {"FloatType": "a number", "IntType": "an integer", "StrType": "a string", "NoneType": "null"}


def request_hint(data: bytes) -> str:
    """For bytes that are no request. `{` and `[` are small integers in MessagePack, where no request begins so."""
    return NOT_JSON if data.lstrip()[:1] in (b"{", b"[") else REQUEST


def values_hint(kind: type[msgspec.Struct], problem: str) -> str | None:
    """The values that a parameter takes of which only some are allowed.

    Args:
        kind: the parameters' type.
        problem: msgspec's words; they end with the parameter's path.

    Returns:
        "exposure: a number, "auto" or null"; None where the values are not listed ones.
    """
    where = _WHERE.search(problem)
    if where is None:
        return None
    found: Any = inspect.type_info(kind)
    for name in where[1].split("."):
        fields = {field.encode_name: field.type for field in getattr(found, "fields", ())}
        found = fields.get(name)
    kinds = found.types if isinstance(found, inspect.UnionType) else (found,)
    if not any(isinstance(one, inspect.LiteralType) for one in kinds):
        return None
    words = [word for one in kinds for word in _words(one)]
    return f"{where[1]}: {', '.join(words[:-1])} or {words[-1]}" if len(words) > 1 else f"{where[1]}: {words[0]}"


def _words(one: Any) -> list[str]:
    if isinstance(one, inspect.LiteralType):
        return [json.dumps(value) for value in one.values]
    return [_NAMES.get(type(one).__name__, type(one).__name__)]
