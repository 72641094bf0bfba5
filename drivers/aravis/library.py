"""The Aravis library through GObject introspection: loaded when first needed, its errors in our words.

It comes from the distribution (gir1.2-aravis-0.8, python3-gi), not from a package index, and need not be there:
without it this driver sees no camera and says which package is missing.
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost, DeviceNotFound, PermissionDenied

VERSIONS = ("0.8", "0.10")
"""Typelibs, in the order they are tried"""

PACKAGES = "apt install gir1.2-aravis-0.8 python3-gi"

USB_HINT = (
    "udev/70-fringed.rules gives USB3 Vision cameras to the group video: install it, be a member of the group, "
    "and plug the camera in again"
)


@cache
def aravis() -> Any:
    """The module.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import gi  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError(
            "cameras of the driver aravis need python3-gi, which is not installed",
            hint=f"{PACKAGES}; the environment must see the system's packages (make setup makes it so)",
        ) from error
    for version in VERSIONS:
        try:
            gi.require_version("Aravis", version)
            with warnings.catch_warnings():
                # PyGObject 3.42's importer is of the old kind, which Python 3.11 warns of.
                warnings.simplefilter("ignore", ImportWarning)
                from gi.repository import Aravis  # noqa: PLC0415
        except (ImportError, ValueError):
            continue
        return Aravis
    raise ConfigError("cameras of the driver aravis need the Aravis library, which is not installed", hint=PACKAGES)


def translated(error: Exception, device: str, what: str) -> DeviceError:
    """A GLib error of the library as one of ours. what: was being done, "setting ExposureTime"."""
    text = str(getattr(error, "message", error))
    kind = _kind(error)
    if kind in ("TIMEOUT", "NOT_CONNECTED", "TRANSFER_ERROR"):
        return DeviceLost(f"{what}: {text}", device=device, hint="is it plugged in and powered? Look at its cable")
    if kind == "PROTOCOL_ERROR_ACCESS_DENIED" or "claim" in text.lower():
        return DeviceBusy(f"{what}: {text}", device=device, hint="another program holds the camera: close it")
    if "permission" in text.lower() or "access denied" in text.lower():
        return PermissionDenied(f"{what}: {text}", device=device, hint=USB_HINT)
    if kind == "NOT_FOUND":
        return DeviceNotFound(f"{what}: {text}", device=device, hint="`fringed devices` lists the cameras that answer")
    return DeviceError(f"{what}: {text}", device=device)


def is_library_error(error: BaseException) -> bool:
    """Whether it comes from GLib."""
    return hasattr(error, "domain") and hasattr(error, "code")


def _kind(error: Exception) -> str:
    """The nickname of a device error, upper case; empty for others."""
    if "device" not in str(getattr(error, "domain", "")):
        return ""
    for name in dir(aravis().DeviceError):
        member = getattr(aravis().DeviceError, name)
        if name.isupper() and int(member) == int(getattr(error, "code", -1)):
            return name
    return ""
