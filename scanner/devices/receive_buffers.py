"""The command that lets sockets receive more at once: the same from every place that finds too little room.

GigE cameras send a frame in one burst. Who needs how much is told by `drivers.aravis.network` and `service.doctor`.
"""

from __future__ import annotations

INSTALLED_BYTES = 67_108_864
"""What the installation as a service sets, in its own 70-fringed.conf: four frames of 8 MB, and as much again for what
the kernel adds to small packets"""

OWN_FILE = "/etc/sysctl.d/71-fringed-buffers.conf"
"""Written by hand, never by the installation; read after that one's file"""


def enlarging(wanted_bytes: int) -> str:
    """The line to type for receive buffers of so many bytes, or of what the installation sets if that is more."""
    line = f"net.core.rmem_max={max(wanted_bytes, INSTALLED_BYTES)}"
    return f"echo {line} | sudo tee {OWN_FILE} && sudo sysctl -w {line}"
