"""What a card really sends out, read back where it has a writeback connector: a witness for exact greys.

Cards in phones and single-board computers have one, and the kernel's vkms; desktop cards do not. It is for tests and
`doctor`, not for scans: the commit may blank the display for a moment.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select

import numpy as np
from numpy.typing import NDArray

from drivers.ioctl import device_error
from drivers.kms import drm
from drivers.kms.card import resources
from drivers.kms.framebuffer import DumbBuffer
from drivers.kms.projector import KmsProjector
from drivers.kms.properties import properties
from scanner.errors import DeviceError

TIMEOUT_MS = 2000


def read_back(projector: KmsProjector) -> NDArray[np.uint8]:
    """The picture on its way to the display, (H, W, 3) uint8: red, green, blue.

    Raises:
        DeviceError: the card has no writeback connector, or it fails.
    """
    node = projector.card
    with contextlib.suppress(OSError):  # a kernel that refuses shows no such connector either
        node.call(drm.SET_CLIENT_CAP, drm.Cap(capability=drm.CLIENT_CAP_WRITEBACK_CONNECTORS, value=1))
    connector = _connector(projector)
    if connector is None:
        raise DeviceError(
            "this card cannot read back what it sends", device=projector.name, hint="a photodiode or a camera can tell"
        )
    names = {name: prop.id for name, prop in properties(node, connector, drm.OBJECT_CONNECTOR).items()}
    target = DumbBuffer(node, projector.mode.width, projector.mode.height)
    fence = ctypes.c_int32(-1)
    try:
        _commit(
            projector,
            connector,
            {
                names["CRTC_ID"]: projector.crtc,
                names["WRITEBACK_FB_ID"]: target.fb,
                names["WRITEBACK_OUT_FENCE_PTR"]: ctypes.addressof(fence),
            },
        )
        _await(fence.value, projector)
        return target.read()
    finally:
        if fence.value >= 0:
            os.close(fence.value)
            _commit(projector, connector, {names["CRTC_ID"]: 0})
        target.free()


def _connector(projector: KmsProjector) -> int | None:
    for number in resources(projector.card).connectors:
        said = drm.Connector(connector_id=number)
        projector.card.call(drm.GETCONNECTOR, said)
        if said.connector_type == drm.CONNECTOR_WRITEBACK:
            return number
    return None


def _commit(projector: KmsProjector, connector: int, values: dict[int, int]) -> None:
    objects, counts = (ctypes.c_uint32 * 1)(connector), (ctypes.c_uint32 * 1)(len(values))
    ids, settings = (ctypes.c_uint32 * len(values))(*values), (ctypes.c_uint64 * len(values))(*values.values())
    request = drm.Atomic(
        flags=drm.ATOMIC_ALLOW_MODESET,
        count_objs=1,
        objs_ptr=ctypes.addressof(objects),
        count_props_ptr=ctypes.addressof(counts),
        props_ptr=ctypes.addressof(ids),
        prop_values_ptr=ctypes.addressof(settings),
    )
    try:
        projector.card.call(drm.ATOMIC, request)
    except OSError as error:
        raise device_error(error, "the picture cannot be read back", projector.name) from error


def _await(fence: int, projector: KmsProjector) -> None:
    poll = select.poll()
    poll.register(fence, select.POLLIN)
    if not poll.poll(TIMEOUT_MS):
        raise DeviceError(f"no picture came back within {TIMEOUT_MS / 1000:g} s", device=projector.name)
