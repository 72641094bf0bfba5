"""Graphics cards and their outputs: which there are, their modes, how a rig file's string picks one, and who is master.

Only one program at a time may drive a card's screens: its DRM master, normally a compositor. A master that dies, by
whatever signal, loses the card at once, and the kernel gives the console back.
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drivers.ioctl import Node, device_error, holders
from drivers.kms import drm
from scanner.errors import DeviceBusy, DeviceError, DeviceNotFound

GROUP = "video"
"""Who may open cards, on Debian and with this project's udev rules"""

CARDS = Path("/dev/dri")
_CLIENTS = Path("/sys/kernel/debug/dri")

_DOUBLE_SCAN = 1 << 5


@dataclass(frozen=True)
class Mode:
    """One mode of an output, and the kernel's own structure for it."""

    width: int
    height: int
    hz: float
    preferred: bool
    info: bytes
    """drm_mode_modeinfo"""

    def __str__(self) -> str:
        return f"{self.width}x{self.height}@{self.hz:.5g}"


@dataclass(frozen=True)
class Output:
    """One connector of a card. Writeback connectors are not among them."""

    card: str
    name: str
    """as in /sys/class/drm: "HDMI-A-1" """
    connector: int
    connected: bool
    modes: tuple[Mode, ...]
    encoders: tuple[int, ...]

    @property
    def native(self) -> Mode | None:
        """The panel's own mode: the one marked as preferred, else the largest."""
        preferred = [mode for mode in self.modes if mode.preferred]
        return preferred[0] if preferred else max(self.modes, key=lambda m: (m.width * m.height, m.hz), default=None)


def open_card(path: str) -> Node:
    """Open a card.

    Raises:
        DeviceNotFound, PermissionDenied: it cannot be opened.
        DeviceError: it is no card, or one without screens.
    """
    node = Node(path, path, group=GROUP)
    try:
        resources(node)
    except OSError as error:
        node.close()
        raise DeviceError(
            f"{path} drives no screens",
            device=path,
            hint="cards with screens are /dev/dri/cardN; /dev/dri/renderD* are not",
        ) from error
    return node


def find(device: str) -> tuple[Node, Output]:
    """Open the card of the output that a rig file's string means.

    device: "" (the first connected output), "HDMI-A-1", "card1", "card1/HDMI-A-1", or a card's path, with or without
    an output after a slash.

    Raises:
        DeviceNotFound: no such output, or nothing is connected to it; the hint lists what there is.
        PermissionDenied: the card may not be opened.
    """
    card, wanted = split(device)
    seen: list[str] = []
    refused: DeviceError | None = None
    for path in [card] if card else cards():
        try:
            node = open_card(path)
        except DeviceError as error:
            if card:
                raise
            refused = refused or error
            continue
        for output in outputs(node):
            if output.name == wanted or (not wanted and output.connected):
                if output.connected and output.modes:
                    return node, output
                node.close()
                raise DeviceNotFound(
                    f"nothing is connected to {output.name}",
                    device=device or output.name,
                    hint="is the projector on, and its cable in? One in standby may not show itself",
                )
            seen.append(f"{path}/{output.name}" + ("" if output.connected else " (nothing connected)"))
        node.close()
    if refused is not None and not seen:
        raise refused
    raise DeviceNotFound(
        f"no output {wanted or device or 'with a display'} here",
        device=device or None,
        hint=f"there are: {', '.join(seen)}" if seen else "no graphics card with screens was found in /dev/dri",
    )


def cards() -> list[str]:
    """Paths of the cards, by number."""
    numbered = [path for path in CARDS.glob("card*") if path.name[4:].isdigit()]
    return [str(path) for path in sorted(numbered, key=lambda path: int(path.name[4:]))]


def outputs(node: Node) -> list[Output]:
    """The card's outputs, with the modes of what is connected now. The card is asked anew, which may take a while."""
    found = resources(node)
    return [output for connector in found.connectors if (output := _output(node, connector)) is not None]


@dataclass(frozen=True)
class CardResources:
    """Numbers of a card's parts. The place of a crtc in its list is its bit in masks."""

    crtcs: tuple[int, ...]
    connectors: tuple[int, ...]


def resources(node: Node) -> CardResources:
    """The card's parts.

    Raises:
        OSError: it has none.
    """
    said = drm.Resources()
    node.call(drm.GETRESOURCES, said)
    crtcs, connectors = (ctypes.c_uint32 * said.count_crtcs)(), (ctypes.c_uint32 * said.count_connectors)()
    said = drm.Resources(
        crtc_id_ptr=ctypes.addressof(crtcs),
        connector_id_ptr=ctypes.addressof(connectors),
        count_crtcs=len(crtcs),
        count_connectors=len(connectors),
    )
    node.call(drm.GETRESOURCES, said)
    return CardResources(tuple(crtcs), tuple(connectors[: said.count_connectors]))


def connected(node: Node, connector: int) -> bool:
    """Whether something hangs on the output, as the kernel saw it last; asks no display and takes no time."""
    modes = (drm.ModeInfo * 1)()  # room for one keeps the kernel from probing the cable
    said = drm.Connector(connector_id=connector, count_modes=1, modes_ptr=ctypes.addressof(modes))
    node.call(drm.GETCONNECTOR, said)
    return bool(said.connection == drm.CONNECTED)


def take_master(node: Node) -> None:
    """Become the one who drives the card's screens.

    Raises:
        DeviceBusy: somebody else is; the hint names it where the kernel lets us see.
    """
    try:
        node.call(drm.SET_MASTER, 0)
    except OSError as error:
        if error.errno not in {errno.EBUSY, errno.EACCES, errno.EPERM, errno.EINVAL}:
            raise device_error(error, "the card cannot be taken over", node.name) from error
        if _is_master(node):
            return
        who = _master(node) or ", ".join(holders(node.path)) or "a compositor or another scanner, probably"
        raise DeviceBusy(
            f"another program drives the screens of {node.path}",
            device=node.name,
            hint=f"held by {who}; end it, or boot without a desktop: systemctl set-default multi-user.target",
        ) from error


def driver_name(node: Node) -> str:
    """The kernel driver's name, as "i915"."""
    room = ctypes.create_string_buffer(64)
    said = drm.Version(name_len=len(room) - 1, name=ctypes.addressof(room))
    try:
        node.call(drm.VERSION, said)
    except OSError:
        return "unknown"
    return room.value.decode(errors="replace")


def mode_info(mode: Mode) -> drm.ModeInfo:
    """The kernel's structure for a mode."""
    return drm.ModeInfo.from_buffer_copy(mode.info)


def split(device: str) -> tuple[str, str]:
    """Card's path and output's name of a device string; either may be ""."""
    if not device.startswith("/"):
        card, _, name = device.rpartition("/")
        if not card and (CARDS / name).exists() and name:
            return str(CARDS / name), ""
        return (str(CARDS / card) if card else ""), name
    card, _, name = device.rpartition("/")
    if Path(device).exists() or not Path(card).exists() or Path(card).is_dir():
        return device, ""
    return card, name


def _output(node: Node, connector: int) -> Output | None:
    said = drm.Connector(connector_id=connector)
    node.call(drm.GETCONNECTOR, said)
    if said.connector_type == drm.CONNECTOR_WRITEBACK:
        return None
    listed, encoders = (drm.ModeInfo * said.count_modes)(), (ctypes.c_uint32 * said.count_encoders)()
    if said.count_modes:  # with no room for modes the kernel would probe the cable a second time
        again = drm.Connector(
            connector_id=connector,
            modes_ptr=ctypes.addressof(listed),
            encoders_ptr=ctypes.addressof(encoders),
            count_modes=len(listed),
            count_encoders=len(encoders),
        )
        node.call(drm.GETCONNECTOR, again)
    kinds = drm.CONNECTOR_NAMES
    kind = kinds[said.connector_type] if said.connector_type < len(kinds) else "Unknown"
    return Output(
        card=node.path,
        name=f"{kind}-{said.connector_type_id}",
        connector=connector,
        connected=said.connection == drm.CONNECTED,
        modes=tuple(modes(listed)),
        encoders=tuple(encoders),
    )


def modes(listed: ctypes.Array[drm.ModeInfo]) -> Iterator[Mode]:
    """The kernel's list of modes, without those that do not show what was loaded."""
    for info in listed:
        total = info.htotal * info.vtotal
        if not total or info.flags & (drm.MODE_FLAG_INTERLACE | _DOUBLE_SCAN):
            continue  # half pictures and doubled lines are not what was loaded
        preferred = bool(info.type & drm.MODE_TYPE_PREFERRED)
        yield Mode(info.hdisplay, info.vdisplay, 1e3 * info.clock / total, preferred, bytes(info))


def _is_master(node: Node) -> bool:
    try:
        node.call(drm.AUTH_MAGIC, drm.Auth(magic=0))
    except OSError as error:
        return error.errno != errno.EACCES  # a master is told that there is no magic 0; others, that they may not ask
    return True


def _master(node: Node) -> str | None:
    """The master's name and number, from the kernel's debugging files, which root may read."""
    try:
        minor = os.minor(os.fstat(node.fd).st_rdev)
        lines = (_CLIENTS / str(minor) / "clients").read_text().splitlines()[1:]
    except OSError:
        return None
    # command, pid, dev, master, authenticated, uid, magic; a command may hold blanks
    masters = [fields for line in lines if (fields := line.rsplit(maxsplit=6))[3:4] == ["y"]]
    return next((f"{name.strip()} ({pid})" for name, pid, *_ in masters), None)
