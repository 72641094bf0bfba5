"""Finding cameras: what answers, and which of them a rig file means."""

from __future__ import annotations

import ipaddress
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from drivers.aravis.library import USB_HINT, aravis, is_library_error, translated
from drivers.aravis.watch import GvcpProbe, Restarted
from scanner.errors import ConfigError, DeviceBusy, DeviceNotFound

LOOKS, LOOK_S = 3, 0.2
"""How often, and for how long each time, a camera is asked for a sign of life before it is opened"""

NONE_FOUND = (
    "is it powered, and on this network? A GigE camera is found on networks this machine has an address in; "
    "its address works where finding does not. " + USB_HINT
)


@dataclass(frozen=True)
class Found:
    """One camera that answered."""

    identity: str
    """vendor-model-serial, as Aravis names it"""
    address: str
    """of the network, or of the bus"""
    serial: str
    model: str
    vendor: str
    protocol: str
    physical: str
    """MAC address, or GUID"""


def find_cameras() -> list[Found]:
    """Every camera that answers now; takes about a second.

    Raises:
        ConfigError: the library is not installed.
    """
    library = aravis()
    library.update_device_list()
    found = []
    for i in range(library.get_n_devices()):
        one = Found(
            identity=library.get_device_id(i) or "",
            address=library.get_device_address(i) or "",
            serial=library.get_device_serial_nbr(i) or "",
            model=library.get_device_model(i) or "",
            vendor=library.get_device_vendor(i) or "",
            protocol=library.get_device_protocol(i) or "",
            physical=library.get_device_physical_id(i) or "",
        )
        if one.protocol != "Fake":
            found.append(one)
    return sorted(found, key=lambda one: one.identity)


def open_camera(device: str) -> Any:
    """The Aravis.Camera that a rig file's string means, controlled by us.

    Args:
        device: an IPv4 address, vendor-model-serial, serial number, MAC address or GUID, user-defined name; "" is the
            first camera found.

    Raises:
        DeviceNotFound: nothing answers to that name; the hint lists what does.
        DeviceBusy: another program controls it.
        ConfigError: several cameras answer to it.
    """
    library = aravis()
    name = device if is_address(device) else _identity(device)
    try:
        if is_address(device):
            _look_for(device)
            # Straight to the network: a look at every USB device first would take time and leave a monitor running.
            opened = library.GvInterface.get_instance().open_device(device)
            camera = library.Camera.new_with_device(opened)
        else:
            camera = library.Camera.new(name)
    except Exception as error:
        if is_library_error(error):
            raise _not_opened(error, device) from error
        raise
    if camera.is_gv_device() and not camera.get_device().is_controller():
        raise DeviceBusy("another program controls the camera", device=device or name, hint="close that program")
    return camera


def _look_for(address: str) -> None:
    """Ask for a sign of life: the library takes seconds to see that there is none."""
    with closing(GvcpProbe(address)) as probe:
        try:
            if any(probe.alive(LOOK_S) for _ in range(LOOKS)):
                return
        except Restarted:  # nobody controls it: that is what we hope for
            return
    raise DeviceNotFound(f"no camera answers at {address}", device="aravis", hint=NONE_FOUND)


def is_address(device: str) -> bool:
    """Whether it is an IPv4 address."""
    try:
        ipaddress.IPv4Address(device)
    except ValueError:
        return False
    return True


def _identity(device: str) -> str:
    """Aravis's name of the camera; names it does not list (user-defined ones, host names) as they are."""
    found = find_cameras()
    if not device:
        if not found:
            raise DeviceNotFound("no camera answers", device="aravis", hint=NONE_FOUND)
        return found[0].identity
    named = [one for one in found if device in (one.identity, one.serial, one.address, one.physical)]
    if len(named) > 1:
        raise ConfigError(
            f"{len(named)} cameras answer to {device!r}",
            device="aravis",
            hint="name one of: " + ", ".join(one.identity for one in named),
        )
    return named[0].identity if named else device


def _not_opened(error: Exception, device: str) -> Exception:
    known = translated(error, device or "aravis", "opening the camera")
    text = known.message.lower()
    if isinstance(known, DeviceNotFound) or "not found" in text or "can't connect" in text:
        answers = ", ".join(f"{one.identity} ({one.address})" for one in find_cameras())
        return DeviceNotFound(
            f"no camera answers to {device!r}",
            device="aravis",
            hint=f"these do: {answers}" if answers else NONE_FOUND,
        )
    return known
