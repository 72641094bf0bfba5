"""A calibration file's id: the hash of its contents, by which scans say what they rest on."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any


def content_id(content: Mapping[str, Any]) -> str:
    """16 hexadecimal digits of SHA-256 over everything but id and date: equal rigs have equal ids."""
    plain = {key: value for key, value in content.items() if key not in ("id", "created")}
    return hashlib.sha256(json.dumps(plain, sort_keys=True, separators=(",", ":")).encode()).hexdigest()[:16]


def id_warnings(content: Mapping[str, Any], name: str) -> list[str]:
    """What is odd about an id that looks like one of ours. Names that people and other programs give are free."""
    told = content.get("id")
    if not isinstance(told, str) or not re.fullmatch(r"[0-9a-f]{16}", told) or told == content_id(content):
        return []
    return [
        f"{name}: its id {told} is not that of its contents: edited by hand? What is made with it now rests on "
        "what it says now"
    ]
