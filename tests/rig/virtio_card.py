"""A graphics card that can be taken away whole while it is in use: QEMU's virtio-gpu, bound to its driver and unbound.

Its display has no vertical blanks, so flips are estimates; what it is here for is to go and to come back. Modules of
cards in use cannot be removed, and vkms has no driver to be unbound from.
"""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

PLACE = "pci-0000:00:10.0"
"""See setup/rig.sh"""

CARD = Path(f"/dev/dri/by-path/{PLACE}-card")
DEVICE = str(CARD)
"""Without its output's name, which counts on over all cards: vkms has Virtual-1"""

_BUS = Path("/sys/bus/virtio")
_DRIVER = _BUS / "drivers/virtio_gpu"
_GPU = "0x0010\n"
"""The kind of virtio device that is a GPU (virtio 1.2, section 5)"""


def plug_in() -> None:
    """Load its driver, which the guest's start leaves out, bind it unless it is, and wait for the node."""
    if not _DRIVER.exists():
        subprocess.run(["modprobe", "virtio-gpu"], check=True)
    if not (_DRIVER / _name()).exists():
        bind()
    deadline = time.monotonic() + 10
    while not CARD.exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def bind() -> None:
    (_DRIVER / "bind").write_text(_name())


def unplug() -> None:
    (_DRIVER / "unbind").write_text(_name())


def _name() -> str:
    (found,) = [path for path in (_BUS / "devices").iterdir() if (path / "device").read_text() == _GPU]
    return found.name
