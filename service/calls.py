"""Calls as bytes: read no further than they have to be, refused as early as they can be, and always answered.

What a method does is `service.control`'s, who may call how often `service.callers`'.
"""

from __future__ import annotations

import logging
from typing import Any, Protocol

from scanner.errors import ScannerError
from scanner.wire import Refused, Request, Response, decode_request, encode, error_body, request_id, too_long
from service.pieces import Encoded

_log = logging.getLogger(__name__)


class Methods(Protocol):
    """What answers a call."""

    def check(self, identity: bytes, method: str) -> None:
        """Raise Refused where a method is not served to this caller."""

    async def answer(self, identity: bytes, request: Request) -> Any:
        """A call's result; ScannerError: what the client is told."""


class Calls:
    """Answers and refusals of one service's calls."""

    def __init__(self, methods: Methods) -> None:
        self._methods = methods

    async def answer(self, identity: bytes, body: list[bytes]) -> bytes:
        """The answer to a call as it came: its parts, of which there should be one. Always answers."""
        try:
            request = decode_request(_only_part(body), lambda method: self._methods.check(identity, method))
            result = await self._methods.answer(identity, request)
            return result.data if isinstance(result, Encoded) else encode(Response(id=request.id, result=result))
        except ScannerError as error:
            return _refusal(body, error)
        except Exception as error:  # noqa: BLE001  (one call that fails must not end the daemon)
            _log.exception("a call failed")
            problem = ScannerError(f"the daemon failed: {type(error).__name__}: {error}", hint="see its log")
            return _refusal(body, problem)

    @staticmethod
    def refuse(body: list[bytes], waiting: int) -> bytes:
        """The answer to a call of somebody of whom `waiting` calls wait already."""
        said = f"{waiting} calls of this connection wait already"
        return _refusal(body, Refused(said, reason="queue_full", hint="read the answers before calling again"))

    @staticmethod
    def refuse_long(length: int) -> bytes:
        """The answer to a call of more bytes than are taken. They are not looked at, for the id either."""
        return encode(Response(id=None, error=error_body(too_long(length))))


def _refusal(body: list[bytes], error: ScannerError) -> bytes:
    return encode(Response(id=request_id(body[0]) if len(body) == 1 else None, error=error_body(error)))


def _only_part(body: list[bytes]) -> bytes:
    if len(body) != 1:
        raise Refused(f"a call has one part, not {len(body)}", reason="invalid_request")
    return body[0]
