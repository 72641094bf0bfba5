"""Finding cameras: what answers, and which of them a rig file means."""

from __future__ import annotations

import ipaddress
import threading
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from drivers.aravis.library import USB_HINT, aravis, is_library_error, translated
from drivers.aravis.watch import GvcpProbe, Restarted
from scanner.errors import ConfigError, DeviceBusy, DeviceNotFound

USB = "USB3Vision"
"""A protocol, in Aravis's words"""

_looking = threading.Lock()
"""The library's lists are made anew by whoever looks: one at a time"""

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
    with _looking:
        library.update_device_list()
        return _listed(library)


def _listed(library: Any) -> list[Found]:
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


def open_camera(device: str) -> tuple[Any, str]:
    """The Aravis.Camera that a rig file's string means, controlled by us; and its identity, empty for an address.

    Args:
        device: an IPv4 address, vendor-model-serial, serial number, MAC address or GUID, user-defined name; "" is the
            first camera found.

    Raises:
        DeviceNotFound: nothing answers to that name; the hint lists what does.
        DeviceBusy: another program controls it.
        ConfigError: several cameras answer to it.
    """
    library = aravis()
    name, protocol = ("", "") if is_address(device) else _identity(device)
    try:
        if is_address(device):
            _look_for(device)
            # Straight to the network: a look at every USB device first would take time and leave a monitor running.
            opened = library.GvInterface.get_instance().open_device(device)
            camera = library.Camera.new_with_device(opened)
        elif protocol == USB:
            # Nor the other way round: the library asks the network first, and waits a second for answers.
            camera = library.Camera.new_with_device(library.UvInterface.get_instance().open_device(name))
        else:
            camera = library.Camera.new(name)
    except Exception as error:
        if is_library_error(error):
            raise _not_opened(error, device) from error
        raise
    if camera.is_gv_device() and not camera.get_device().is_controller():
        raise DeviceBusy("another program controls the camera", device=device or name, hint="close that program")
    return camera, name


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


def _identity(device: str) -> tuple[str, str]:
    """Aravis's name of the camera, and its protocol; names it does not list (user-defined, host names) as they are.

    One that is called by its whole identity, as after a loss, is looked for on USB first: that takes no time.
    """
    if device in _identities_on_usb():
        return device, USB
    found = find_cameras()
    if not device:
        if not found:
            raise DeviceNotFound("no camera answers", device="aravis", hint=NONE_FOUND)
        return found[0].identity, found[0].protocol
    named = [one for one in found if device in (one.identity, one.serial, one.address, one.physical)]
    if len(named) > 1:
        raise ConfigError(
            f"{len(named)} cameras answer to {device!r}",
            device="aravis",
            hint="name one of: " + ", ".join(one.identity for one in named),
        )
    return (named[0].identity, named[0].protocol) if named else (device, "")


def _identities_on_usb() -> set[str]:
    if not hasattr(aravis(), "UvInterface"):  # built without USB
        return set()
    with _looking:
        bus = aravis().UvInterface.get_instance()
        bus.update_device_list()
        return {bus.get_device_id(i) or "" for i in range(bus.get_n_devices())}


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
