"""Video nodes: which there are, their stable names, and how a rig file's string picks one.

A string is a path, a name in `/dev/v4l/by-id` or `by-path` (these survive a reboot, `/dev/videoN` does not), a node's
own name as "video0", its bus ("usb-0000:00:14.0-3") or its card's name where only one bears it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.ioctl import Node, device_error, holders
from drivers.v4l2 import videodev2 as v
from scanner.errors import DeviceBusy, DeviceError, DeviceNotFound

Role = Literal["camera", "projector"]

GROUP = "video"
"""Who may open video nodes, on Debian and with this project's udev rules"""

DEVICES = Path("/dev")

_TYPES: dict[Role, tuple[tuple[int, int], ...]] = {
    "camera": (
        (v.CAP_VIDEO_CAPTURE, v.TYPE_VIDEO_CAPTURE),
        (v.CAP_VIDEO_CAPTURE_MPLANE, v.TYPE_VIDEO_CAPTURE_MPLANE),
    ),
    "projector": (
        (v.CAP_VIDEO_OUTPUT, v.TYPE_VIDEO_OUTPUT),
        (v.CAP_VIDEO_OUTPUT_MPLANE, v.TYPE_VIDEO_OUTPUT_MPLANE),
    ),
}


@dataclass(frozen=True)
class VideoNode:
    """What one node says of itself."""

    path: str
    card: str
    driver: str
    bus: str
    capabilities: int
    links: tuple[str, ...]
    """stable names, as paths; those by identity first, then those by place"""

    def buffer_type(self, role: Role) -> int | None:
        """The kind of buffer queue that serves `role`; None: this node does not."""
        if not self.capabilities & v.CAP_STREAMING:
            return None
        return next((kind for bit, kind in _TYPES[role] if self.capabilities & bit), None)

    @property
    def stable(self) -> str:
        """The name for a rig file."""
        return self.links[0] if self.links else self.path


def nodes(role: Role) -> list[VideoNode]:
    """The nodes that can serve `role` and that this user may open, by number."""
    return [node for node in _every_node() if node.buffer_type(role) is not None]


def find(device: str, role: Role) -> str:
    """The path that a rig file's string means; "" is the first that serves `role`.

    Raises:
        DeviceNotFound: nothing, or more than one thing, bears that name; the hint lists what there is.
    """
    if device.startswith("/"):
        return device
    for place in (DEVICES, DEVICES / "v4l/by-id", DEVICES / "v4l/by-path"):
        if device and "/" not in device and (place / device).exists():
            return str(place / device)
    seen = nodes(role)
    fitting = [node for node in seen if not device or device in {node.bus, node.card}]
    if len(fitting) == 1 or (fitting and not device):
        return fitting[0].path
    wanted = f"V4L2 {role} {device!r}" if device else f"V4L2 {role}"
    names = "; ".join(f"{node.stable} ({node.card})" for node in fitting or seen)
    raise DeviceNotFound(
        f"more than one {wanted}" if fitting else f"no {wanted} here",
        device=device or None,
        hint=f"there are: {names}" if names else f"is it plugged in, and is this user in the group {GROUP}?",
    )


def open_node(path: str, role: Role) -> tuple[Node, VideoNode]:
    """Open a node for `role`, and what it says of itself.

    Raises:
        DeviceNotFound, PermissionDenied, DeviceBusy: it cannot be opened.
        DeviceError: it is no video node, or not one for `role`.
    """
    node = Node(path, path, group=GROUP)
    try:
        found = _describe(node)
    except OSError as error:
        node.close()
        raise DeviceError(
            f"{path} is no V4L2 device", device=path, hint="V4L2 devices are /dev/videoN and the links in /dev/v4l"
        ) from error
    if found.buffer_type(role) is None:
        node.close()
        other = "captures" if role == "projector" else "shows"
        raise DeviceError(
            f"{found.card} is no streaming {role}",
            device=path,
            hint=f"perhaps the node beside it is; this one {other} or carries metadata",
        )
    return node, found


def failure(error: OSError, doing: str, node: Node) -> DeviceError:
    """`device_error`, with the holder named where somebody else has the device."""
    made = device_error(error, doing, node.name)
    if isinstance(made, DeviceBusy) and (who := holders(node.path)):
        return DeviceBusy(made.message, device=node.name, hint=f"held by {', '.join(who)}; end that program first")
    return made


def _every_node() -> Iterator[VideoNode]:
    numbered = ((int(m[1]), path) for path in DEVICES.glob("video*") if (m := re.fullmatch(r"video(\d+)", path.name)))
    for _, path in sorted(numbered):
        try:
            node = Node(str(path), str(path), group=GROUP)
        except DeviceError:
            continue  # listing what can be used is no place to fail
        try:
            yield _describe(node)
        except OSError:
            continue
        finally:
            node.close()


def _describe(node: Node) -> VideoNode:
    said = v.Capability()
    node.call(v.QUERYCAP, said)
    own = said.device_caps if said.capabilities >> 31 else said.capabilities
    return VideoNode(
        path=node.path,
        card=v.text(said.card),
        driver=v.text(said.driver),
        bus=v.text(said.bus_info),
        capabilities=own,
        links=tuple(_links(Path(node.path).resolve())),
    )


def _links(target: Path) -> Iterator[str]:
    for place in ("by-id", "by-path"):
        try:
            links = sorted((DEVICES / "v4l" / place).iterdir())
        except FileNotFoundError:
            continue  # no device has one, or none has any more
        yield from (str(link) for link in links if _leads_to(link, target))


def _leads_to(link: Path, target: Path) -> bool:
    try:
        return link.resolve() == target
    except OSError:
        return False  # udev took it away meanwhile: another device, or this one's other node, was unplugged
