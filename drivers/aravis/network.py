"""Whether this machine is set up to receive a GigE camera, and the command that mends it where it is not.

What is looked at: the limit of a socket's receive buffer, the network interface's packet size and speed, and whether
the frames fit through. Reads /proc and /sys; changes nothing.
"""

from __future__ import annotations

import fcntl
import socket
import struct
from dataclasses import dataclass
from pathlib import Path

from scanner.devices.receive_buffers import enlarging

FRAMES_BUFFERED = 4
"""Frames that the receive buffer must hold while this process does not run for a moment"""

SMALL_PACKETS = 2.0
"""The kernel accounts small packets with up to this times their size"""

JUMBO_BYTES = 9000
ETHERNET_EXTRA = 38
"""Bytes that a packet takes on the wire beyond its own: preamble, header, check sum, gap"""
PROTOCOL_BYTES = 36
HEADROOM = 0.9
"""Share of a link that frames may take"""

RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
_SIOCGIFADDR = 0x8915


@dataclass(frozen=True)
class Finding:
    """One thing looked at. `command` mends it; empty where it is well, or no command could."""

    subject: str
    ok: bool
    text: str
    command: str = ""


def check_network(address: str, frame_bytes: int, rate_hz: float, packet_size: int | None = None) -> list[Finding]:
    """Look at what a camera at `address` needs to send `rate_hz` frames of `frame_bytes` a second.

    Args:
        address: of the camera, IPv4.
        frame_bytes: of one frame on the wire (PayloadSize).
        rate_hz: frames a second.
        packet_size: agreed with the camera; None: what the interface allows.

    Returns:
        Findings, those that are well among them. An address that no interface leads to is one finding.
    """
    interface = interface_to(address)
    if interface is None:
        return [Finding("route", False, f"no network interface leads to {address}", "ip -brief address")]
    findings = [check_buffer(frame_bytes)]
    mtu = _number(Path(f"/sys/class/net/{interface}/mtu")) or 1500
    findings.append(_check_mtu(interface, mtu))
    size = min(packet_size or mtu, mtu)
    findings.append(_check_speed(interface, frame_bytes, rate_hz, size))
    return findings


def buffer_bytes(frame_bytes: int, frames: int = FRAMES_BUFFERED) -> int:
    """Receive buffer that holds so many frames."""
    return int(SMALL_PACKETS * frames * frame_bytes)


def check_buffer(frame_bytes: int, frames: int = FRAMES_BUFFERED, limit: int | None = None) -> Finding:
    """The limit of receive buffers (net.core.rmem_max) against what frames of this size need. limit: for tests."""
    wanted = buffer_bytes(frame_bytes, frames)
    found = limit if limit is not None else _number(RMEM_MAX) or 0
    text = f"net.core.rmem_max is {found}, {frames} frames of {frame_bytes} bytes need {wanted}"
    return Finding("receive buffer", found >= wanted, text, "" if found >= wanted else enlarging(wanted))


def interface_to(address: str) -> str | None:
    """Name of the network interface through which `address` is reached; None: there is none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, 9))
        except OSError:
            return None
        own = probe.getsockname()[0]
        if own.startswith("127."):
            return "lo"
        for _, name in socket.if_nameindex():
            try:
                answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, struct.pack("256s", name.encode()[:15]))
            except OSError:  # an interface without an IPv4 address
                continue
            if socket.inet_ntoa(answer[20:24]) == own:
                return name
    return None


def _check_mtu(interface: str, mtu: int) -> Finding:
    ok = mtu >= JUMBO_BYTES or interface == "lo"
    text = f"{interface} takes packets of {mtu} bytes" + ("" if ok else f"; {JUMBO_BYTES} would halve the load")
    return Finding("packet size", ok, text, "" if ok else f"sudo ip link set dev {interface} mtu {JUMBO_BYTES}")


def _check_speed(interface: str, frame_bytes: int, rate_hz: float, packet_size: int) -> Finding:
    speed_mbit = _number(Path(f"/sys/class/net/{interface}/speed"))
    share = (packet_size + ETHERNET_EXTRA) / max(1, packet_size - PROTOCOL_BYTES)
    needed_mbit = 8e-6 * frame_bytes * rate_hz * share
    text = f"{rate_hz:g} frames a second of {frame_bytes} bytes need {needed_mbit:.0f} Mbit/s"
    if speed_mbit is None or speed_mbit <= 0:
        return Finding("link speed", True, f"{text}; {interface} does not tell its speed")
    possible = HEADROOM * speed_mbit
    most = rate_hz * possible / needed_mbit if needed_mbit else 0.0
    text += f", {interface} has {speed_mbit}"
    if needed_mbit <= possible:
        return Finding("link speed", True, text)
    return Finding("link speed", False, f"{text}: at most {most:.1f} frames a second, or a smaller region")


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):  # absent, or an interface that does not know
        return None
