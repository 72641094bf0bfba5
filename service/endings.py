"""Why scans and live runs end: the words for programs, and the errors behind them (formats.md, Wire)."""

from __future__ import annotations

import errno

from scanner.errors import ConfigError, DeviceError, ScannerError, StorageError, SyncError
from scanner.storage import is_full
from scanner.stream import EndReason
from scanner.wire import ErrorBody, error_from_body
from service.pipe import Ended


def reason_of(error: ScannerError) -> EndReason | None:
    """How a run ends that this error ends; None: it never began."""
    match error:
        case SyncError():
            return "sync_lost"
        case StorageError():
            return "disk_full" if _for_want_of_room(error) else "storage_failed"
        case DeviceError():
            return "device_lost"
        case _:
            return None


def reason_to_fail(error: ScannerError) -> str:
    """The reason of a job that this error ends."""
    return reason_of(error) or ("refused" if isinstance(error, ConfigError) else "decode_failed")


def _for_want_of_room(error: StorageError) -> bool:
    """Limits of the spool have no error of the system behind them; a missing right or a faulty disk has another."""
    cause = error.__cause__
    return not isinstance(cause, OSError) or is_full(error) or cause.errno == errno.EFBIG


def error_of(ended: Ended) -> ScannerError:
    """Why the devices ended a run."""
    if isinstance(ended.error, ErrorBody):
        return error_from_body(ended.error)
    return ScannerError(f"the scan ended: {ended.reason}")
