"""Properties of crtcs, connectors and planes, and the ones that would change a grey on its way out."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from drivers.ioctl import Node, device_error
from drivers.kms import drm
from scanner.errors import DeviceError


@dataclass(frozen=True)
class Property:
    """One property of one object."""

    id: int
    name: str
    value: int
    choices: dict[str, int]
    """of an enumeration, else empty"""


def properties(node: Node, obj: int, kind: int) -> dict[str, Property]:
    """Properties of an object, by name."""
    said = drm.ObjectProperties(obj_id=obj, obj_type=kind)
    node.call(drm.OBJ_GETPROPERTIES, said)
    ids, values = (ctypes.c_uint32 * said.count_props)(), (ctypes.c_uint64 * said.count_props)()
    said.props_ptr, said.prop_values_ptr = ctypes.addressof(ids), ctypes.addressof(values)
    node.call(drm.OBJ_GETPROPERTIES, said)
    return {
        found.name: found for number, value in zip(ids, values, strict=True) if (found := _read(node, number, value))
    }


def set_property(node: Node, obj: int, kind: int, prop: Property, value: int) -> None:
    """Set one.

    Raises:
        OSError: the driver refuses.
    """
    node.call(drm.OBJ_SETPROPERTY, drm.SetProperty(value=value, prop_id=prop.id, obj_id=obj, obj_type=kind))


def make_exact(node: Node, crtc: int, connector: int) -> dict[str, str]:
    """See to it that a grey in memory is that grey on the wire, and read back. Returns what was found, in words.

    No gamma, degamma or colour matrix; full range; a fixed refresh; nothing drawn over the image.

    Raises:
        DeviceError: something stays that changes greys.
    """
    found: dict[str, str] = {}
    of_crtc = properties(node, crtc, drm.OBJECT_CRTC)
    for name in ("DEGAMMA_LUT", "CTM", "GAMMA_LUT", "VRR_ENABLED"):
        if name in of_crtc:
            _must_be(node, crtc, drm.OBJECT_CRTC, name, 0)
            found[name] = "off"
    if "GAMMA_LUT" not in of_crtc:
        found["GAMMA_LUT"] = _identity_gamma(node, crtc)
    of_connector = properties(node, connector, drm.OBJECT_CONNECTOR)
    if (rgb := of_connector.get("Broadcast RGB")) is not None and "Full" in rgb.choices:
        _must_be(node, connector, drm.OBJECT_CONNECTOR, "Broadcast RGB", rgb.choices["Full"])
        found["Broadcast RGB"] = "Full"
    else:
        found["Broadcast RGB"] = "the driver does not tell"
    _clear_planes(node, crtc)
    return found


def _read(node: Node, number: int, value: int) -> Property | None:
    said = drm.Property(prop_id=number)
    node.call(drm.GETPROPERTY, said)
    name, choices = drm.text(said.name), {}
    if said.count_enum_blobs:
        entries, values = (drm.PropertyEnum * said.count_enum_blobs)(), (ctypes.c_uint64 * said.count_values)()
        said.enum_blob_ptr, said.values_ptr = ctypes.addressof(entries), ctypes.addressof(values)
        try:
            node.call(drm.GETPROPERTY, said)
        except OSError:
            return Property(number, name, value, {})  # a list of blobs, not of choices
        choices = {drm.text(entry.name): entry.value for entry in entries}
    return Property(number, name, value, choices)


def _must_be(node: Node, obj: int, kind: int, name: str, value: int) -> None:
    prop = properties(node, obj, kind)[name]
    if prop.value == value:
        return
    try:
        set_property(node, obj, kind, prop, value)
    except OSError as error:
        raise device_error(error, f"{name} cannot be set", node.name) from error
    now = properties(node, obj, kind)[name].value
    if now != value:
        raise DeviceError(
            f"{name} stays at {now} instead of {value}",
            device=node.name,
            hint="it changes greys on their way to the projector: another output or driver is needed",
        )


def _identity_gamma(node: Node, crtc: int) -> str:
    """Write a straight line into the old kind of gamma table, and read back. Words for the report."""
    said = drm.Crtc(crtc_id=crtc)
    node.call(drm.GETCRTC, said)
    if said.gamma_size < 2:
        return "none"
    line = np.round(np.linspace(0, 0xFFFF, said.gamma_size)).astype(np.uint16)
    table, back = np.stack((line, line, line)), np.zeros((3, said.gamma_size), dtype=np.uint16)
    try:
        node.call(drm.SETGAMMA, _lut(crtc, table))
        node.call(drm.GETGAMMA, _lut(crtc, back))
    except OSError as error:
        raise device_error(error, "the gamma table cannot be set", node.name) from error
    # Tables hold 8 bits or more of each entry; a grey is exact if those agree.
    if np.abs(back.astype(np.int64) - line).max() > 0xFF:
        raise DeviceError("the gamma table does not take a straight line", device=node.name)
    return "a straight line"


def _lut(crtc: int, table: np.ndarray[tuple[int, ...], np.dtype[np.uint16]]) -> drm.CrtcLut:
    """The request for a table, which must outlive it."""
    base, row = table.ctypes.data, table.strides[0]
    return drm.CrtcLut(crtc_id=crtc, gamma_size=table.shape[1], red=base, green=base + row, blue=base + 2 * row)


def _clear_planes(node: Node, crtc: int) -> None:
    """Take off what lies over the image: a cursor or overlay that the last program left."""
    said = drm.PlaneResources()
    node.call(drm.GETPLANERESOURCES, said)
    ids = (ctypes.c_uint32 * said.count_planes)()
    said.plane_id_ptr = ctypes.addressof(ids)
    node.call(drm.GETPLANERESOURCES, said)
    for number in ids:
        plane = drm.Plane(plane_id=number)
        node.call(drm.GETPLANE, plane)
        kind = properties(node, number, drm.OBJECT_PLANE).get("type")
        if plane.crtc_id == crtc and kind is not None and kind.value != drm.PLANE_TYPE_PRIMARY:
            try:
                node.call(drm.SETPLANE, drm.SetPlane(plane_id=number, crtc_id=crtc))
            except OSError as error:
                raise device_error(error, "a cursor or overlay lies over the image and stays", node.name) from error
