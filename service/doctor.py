"""What keeps a machine from scanning, found before the scan: permissions, displays, buffers, clocks, room.

Reads /dev, /proc and /sys and changes nothing. Each finding says what is, and for what is wrong the command that mends
it. What a rig's own devices do is measured in `service.doctor_rig`.
"""

from __future__ import annotations

import grp
import os
import pwd
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from scanner.devices.receive_buffers import enlarging

ROOM_BYTES = 5_000_000_000
"""A scan of 30 frames of 2 MP with its results is 0.25 GB: room for twenty"""

RECEIVE_BYTES = 2 * 4 * 2448 * 2048
"""Four frames of a common 5 MP sensor, 8 bit, while nobody reads; the kernel accounts small packets twice"""

USBFS_MB = 256
"""Transfers in flight of a USB3 Vision camera: dozens of frames; the kernel's default is 16"""


class Level(StrEnum):
    """How bad a finding is."""

    OK = "ok"
    NOTE = "note"
    """works, or concerns only some rigs"""
    BAD = "bad"


@dataclass(frozen=True)
class Finding:
    """One thing looked at."""

    subject: str
    level: Level
    says: str
    mend: str = ""
    """what to type or do; empty where all is well"""


@dataclass(frozen=True)
class Machine:
    """Where this system's files are; tests give others."""

    dev: Path = Path("/dev")
    proc: Path = Path("/proc")
    sys: Path = Path("/sys")


def examine(machine: Machine, state: Path) -> Iterator[Finding]:
    """Everything that can be said without opening a device.

    Args:
        machine: the system's files.
        state: folder in which captures are kept.
    """
    yield from device_nodes(machine)
    yield from display_holders(machine)
    yield aravis()
    yield receive_buffers(machine)
    yield from modules(machine)
    yield clock_source(machine)
    yield room(state)


def device_nodes(machine: Machine) -> Iterator[Finding]:
    """Whether this user may open cameras, displays and serial lines."""
    patterns = ("video[0-9]*", "dri/card[0-9]*", "ttyACM[0-9]*", "ttyUSB[0-9]*")
    nodes = sorted(node for pattern in patterns for node in machine.dev.glob(pattern))
    if not nodes:
        yield Finding("device nodes", Level.NOTE, "no V4L2 device, display or serial line is plugged in")
    for node in nodes:
        if os.access(node, os.R_OK | os.W_OK):
            yield Finding(str(node), Level.OK, "may be opened")
            continue
        group = _group_of(node)
        user = pwd.getpwuid(os.geteuid()).pw_name
        said = f"belongs to group {group}, of which {user} is no member"
        yield Finding(str(node), Level.BAD, said, f"sudo usermod -aG {group} {user}   # then log in again")


def display_holders(machine: Machine) -> Iterator[Finding]:
    """Programs that have a display open: one of them may be its master."""
    for card in sorted(machine.dev.glob("dri/card[0-9]*")):
        holders = sorted(set(_holders(machine, card)))
        if not holders:
            yield Finding(f"{card} in use", Level.OK, "nobody has it open, as far as this user may see")
            continue
        yield Finding(
            f"{card} in use",
            Level.NOTE,
            f"open in {', '.join(holders)}: a desktop keeps the KMS driver from it",
            "sudo systemctl isolate multi-user.target   # or use the window driver on the desktop",
        )


def aravis() -> Finding:
    """Whether GigE and USB3 Vision cameras can be driven."""
    places = Path("/usr/lib").glob("*/girepository-1.0/Aravis-0.*.typelib")
    if any(places):
        return Finding("Aravis", Level.OK, "installed: GigE Vision and USB3 Vision cameras")
    mend = "sudo apt install --no-install-recommends gir1.2-aravis-0.8 python3-gi"
    return Finding("Aravis", Level.NOTE, "not installed: no GigE Vision or USB3 Vision cameras", mend)


def receive_buffers(machine: Machine) -> Finding:
    """Whether a GigE camera's burst fits."""
    found = _text(machine.proc / "sys/net/core/rmem_max")
    said = f"net.core.rmem_max is {found or 'not told'}; GigE cameras of 5 MP want {RECEIVE_BYTES}"
    if found.isdigit() and int(found) < RECEIVE_BYTES:
        return Finding("receive buffers", Level.NOTE, f"{said}, others nothing", enlarging(RECEIVE_BYTES))
    return Finding("receive buffers", Level.OK, said)


def modules(machine: Machine) -> Iterator[Finding]:
    """Kernel modules whose defaults lie or are too small."""
    stamps = _text(machine.sys / "module/uvcvideo/parameters/hwtimestamps")
    if stamps in ("0", "N"):
        yield Finding(
            "uvcvideo stamps",
            Level.BAD,
            "UVC cameras stamp frames when the host got them, and claim the start of exposure",
            "echo options uvcvideo hwtimestamps=1 | sudo tee /etc/modprobe.d/fringed-uvcvideo.conf"
            " && sudo rmmod uvcvideo && sudo modprobe uvcvideo",
        )
    elif stamps:
        yield Finding("uvcvideo stamps", Level.OK, "UVC cameras stamp frames themselves")
    memory = _text(machine.sys / "module/usbcore/parameters/usbfs_memory_mb")
    if memory.isdigit() and 0 < int(memory) < USBFS_MB:
        yield Finding(
            "USB transfers",
            Level.NOTE,
            f"usbfs_memory_mb is {memory}: too small for USB3 Vision cameras at full rate",
            f"echo {USBFS_MB} | sudo tee {machine.sys}/module/usbcore/parameters/usbfs_memory_mb",
        )


def clock_source(machine: Machine) -> Finding:
    """Whether reading the clock is quick: a slow source makes every stamp late."""
    source = _text(machine.sys / "devices/system/clocksource/clocksource0/current_clocksource")
    if source in ("hpet", "acpi_pm", "jiffies"):
        return Finding("clock", Level.NOTE, f"the clock source is {source}: slow to read", "boot with clocksource=tsc")
    return Finding("clock", Level.OK, f"the clock source is {source or 'not told'}")


def room(state: Path) -> Finding:
    """Whether captures have room."""
    place = next(folder for folder in (state, *state.parents) if folder.exists())
    free = shutil.disk_usage(place).free
    said = f"{free / 1e9:.1f} GB are free below {place}"
    if free < ROOM_BYTES:
        return Finding("disk", Level.BAD, said, "delete old scans (fringed status lists them), or set daemon.spool")
    return Finding("disk", Level.OK, said)


def _holders(machine: Machine, card: Path) -> Iterator[str]:
    for link in machine.proc.glob("[0-9]*/fd/*"):
        try:
            if link.readlink() == card:
                yield f"{_text(link.parents[1] / 'comm')} ({link.parents[1].name})"
        except OSError:  # it ended, or is somebody else's
            continue


def _group_of(node: Path) -> str:
    number = node.stat().st_gid
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
