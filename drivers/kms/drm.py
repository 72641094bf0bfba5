"""The kernel's mode-setting interface as ctypes: structures, request numbers and constants of `drm.h`, `drm_mode.h`.

For 64-bit kernels. Only what this package uses.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char, c_int32, c_int64, c_uint16, c_uint32, c_uint64

from drivers.ioctl import io, iow, iowr

# --- structures -------------------------------------------------------------------------------------------------


class Version(ctypes.Structure):
    """drm_version"""

    _fields_ = (
        ("major", c_int32),
        ("minor", c_int32),
        ("patchlevel", c_int32),
        ("name_len", c_uint64),
        ("name", c_uint64),
        ("date_len", c_uint64),
        ("date", c_uint64),
        ("desc_len", c_uint64),
        ("desc", c_uint64),
    )


class Cap(ctypes.Structure):
    """drm_get_cap and drm_set_client_cap, which are alike"""

    _fields_ = (("capability", c_uint64), ("value", c_uint64))


class Auth(ctypes.Structure):
    """drm_auth"""

    _fields_ = (("magic", c_uint32),)


class Resources(ctypes.Structure):
    """drm_mode_card_res"""

    _fields_ = (
        ("fb_id_ptr", c_uint64),
        ("crtc_id_ptr", c_uint64),
        ("connector_id_ptr", c_uint64),
        ("encoder_id_ptr", c_uint64),
        ("count_fbs", c_uint32),
        ("count_crtcs", c_uint32),
        ("count_connectors", c_uint32),
        ("count_encoders", c_uint32),
        ("min_width", c_uint32),
        ("max_width", c_uint32),
        ("min_height", c_uint32),
        ("max_height", c_uint32),
    )


class ModeInfo(ctypes.Structure):
    """drm_mode_modeinfo; clock in kHz"""

    _fields_ = (
        ("clock", c_uint32),
        ("hdisplay", c_uint16),
        ("hsync_start", c_uint16),
        ("hsync_end", c_uint16),
        ("htotal", c_uint16),
        ("hskew", c_uint16),
        ("vdisplay", c_uint16),
        ("vsync_start", c_uint16),
        ("vsync_end", c_uint16),
        ("vtotal", c_uint16),
        ("vscan", c_uint16),
        ("vrefresh", c_uint32),
        ("flags", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
    )


class Crtc(ctypes.Structure):
    """drm_mode_crtc"""

    _fields_ = (
        ("set_connectors_ptr", c_uint64),
        ("count_connectors", c_uint32),
        ("crtc_id", c_uint32),
        ("fb_id", c_uint32),
        ("x", c_uint32),
        ("y", c_uint32),
        ("gamma_size", c_uint32),
        ("mode_valid", c_uint32),
        ("mode", ModeInfo),
    )


class CrtcLut(ctypes.Structure):
    """drm_mode_crtc_lut"""

    _fields_ = (
        ("crtc_id", c_uint32),
        ("gamma_size", c_uint32),
        ("red", c_uint64),
        ("green", c_uint64),
        ("blue", c_uint64),
    )


class Encoder(ctypes.Structure):
    """drm_mode_get_encoder"""

    _fields_ = (
        ("encoder_id", c_uint32),
        ("encoder_type", c_uint32),
        ("crtc_id", c_uint32),
        ("possible_crtcs", c_uint32),
        ("possible_clones", c_uint32),
    )


class Connector(ctypes.Structure):
    """drm_mode_get_connector"""

    _fields_ = (
        ("encoders_ptr", c_uint64),
        ("modes_ptr", c_uint64),
        ("props_ptr", c_uint64),
        ("prop_values_ptr", c_uint64),
        ("count_modes", c_uint32),
        ("count_props", c_uint32),
        ("count_encoders", c_uint32),
        ("encoder_id", c_uint32),
        ("connector_id", c_uint32),
        ("connector_type", c_uint32),
        ("connector_type_id", c_uint32),
        ("connection", c_uint32),
        ("mm_width", c_uint32),
        ("mm_height", c_uint32),
        ("subpixel", c_uint32),
        ("pad", c_uint32),
    )


class Property(ctypes.Structure):
    """drm_mode_get_property"""

    _fields_ = (
        ("values_ptr", c_uint64),
        ("enum_blob_ptr", c_uint64),
        ("prop_id", c_uint32),
        ("flags", c_uint32),
        ("name", c_char * 32),
        ("count_values", c_uint32),
        ("count_enum_blobs", c_uint32),
    )


class PropertyEnum(ctypes.Structure):
    """drm_mode_property_enum"""

    _fields_ = (("value", c_uint64), ("name", c_char * 32))


class ObjectProperties(ctypes.Structure):
    """drm_mode_obj_get_properties"""

    _fields_ = (
        ("props_ptr", c_uint64),
        ("prop_values_ptr", c_uint64),
        ("count_props", c_uint32),
        ("obj_id", c_uint32),
        ("obj_type", c_uint32),
    )


class SetProperty(ctypes.Structure):
    """drm_mode_obj_set_property"""

    _fields_ = (("value", c_uint64), ("prop_id", c_uint32), ("obj_id", c_uint32), ("obj_type", c_uint32))


class PlaneResources(ctypes.Structure):
    """drm_mode_get_plane_res"""

    _fields_ = (("plane_id_ptr", c_uint64), ("count_planes", c_uint32))


class Plane(ctypes.Structure):
    """drm_mode_get_plane"""

    _fields_ = (
        ("plane_id", c_uint32),
        ("crtc_id", c_uint32),
        ("fb_id", c_uint32),
        ("possible_crtcs", c_uint32),
        ("gamma_size", c_uint32),
        ("count_format_types", c_uint32),
        ("format_type_ptr", c_uint64),
    )


class SetPlane(ctypes.Structure):
    """drm_mode_set_plane"""

    _fields_ = (
        ("plane_id", c_uint32),
        ("crtc_id", c_uint32),
        ("fb_id", c_uint32),
        ("flags", c_uint32),
        ("crtc_x", c_int32),
        ("crtc_y", c_int32),
        ("crtc_w", c_uint32),
        ("crtc_h", c_uint32),
        ("src_x", c_uint32),
        ("src_y", c_uint32),
        ("src_h", c_uint32),
        ("src_w", c_uint32),
    )


class FbCmd2(ctypes.Structure):
    """drm_mode_fb_cmd2"""

    _fields_ = (
        ("fb_id", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixel_format", c_uint32),
        ("flags", c_uint32),
        ("handles", c_uint32 * 4),
        ("pitches", c_uint32 * 4),
        ("offsets", c_uint32 * 4),
        ("modifier", c_uint64 * 4),
    )


class CreateDumb(ctypes.Structure):
    """drm_mode_create_dumb"""

    _fields_ = (
        ("height", c_uint32),
        ("width", c_uint32),
        ("bpp", c_uint32),
        ("flags", c_uint32),
        ("handle", c_uint32),
        ("pitch", c_uint32),
        ("size", c_uint64),
    )


class MapDumb(ctypes.Structure):
    """drm_mode_map_dumb"""

    _fields_ = (("handle", c_uint32), ("pad", c_uint32), ("offset", c_uint64))


class Handle(ctypes.Structure):
    """drm_mode_destroy_dumb, and the plain number of RMFB"""

    _fields_ = (("handle", c_uint32),)


class PageFlip(ctypes.Structure):
    """drm_mode_crtc_page_flip"""

    _fields_ = (
        ("crtc_id", c_uint32),
        ("fb_id", c_uint32),
        ("flags", c_uint32),
        ("reserved", c_uint32),
        ("user_data", c_uint64),
    )


class Atomic(ctypes.Structure):
    """drm_mode_atomic"""

    _fields_ = (
        ("flags", c_uint32),
        ("count_objs", c_uint32),
        ("objs_ptr", c_uint64),
        ("count_props_ptr", c_uint64),
        ("props_ptr", c_uint64),
        ("prop_values_ptr", c_uint64),
        ("reserved", c_uint64),
        ("user_data", c_uint64),
    )


class VblankEvent(ctypes.Structure):
    """drm_event_vblank, its head included"""

    _fields_ = (
        ("type", c_uint32),
        ("length", c_uint32),
        ("user_data", c_uint64),
        ("tv_sec", c_uint32),
        ("tv_usec", c_uint32),
        ("sequence", c_uint32),
        ("crtc_id", c_uint32),
    )


class CrtcSequence(ctypes.Structure):
    """drm_crtc_get_sequence"""

    _fields_ = (("crtc_id", c_uint32), ("active", c_uint32), ("sequence", c_uint64), ("sequence_ns", c_int64))


# --- requests ---------------------------------------------------------------------------------------------------

VERSION = iowr("d", 0x00, Version)
GET_CAP = iowr("d", 0x0C, Cap)
SET_CLIENT_CAP = iow("d", 0x0D, Cap)
AUTH_MAGIC = iow("d", 0x11, Auth)
SET_MASTER = io("d", 0x1E)
DROP_MASTER = io("d", 0x1F)
CRTC_GET_SEQUENCE = iowr("d", 0x3B, CrtcSequence)
GETRESOURCES = iowr("d", 0xA0, Resources)
GETCRTC = iowr("d", 0xA1, Crtc)
SETCRTC = iowr("d", 0xA2, Crtc)
GETGAMMA = iowr("d", 0xA4, CrtcLut)
SETGAMMA = iowr("d", 0xA5, CrtcLut)
GETENCODER = iowr("d", 0xA6, Encoder)
GETCONNECTOR = iowr("d", 0xA7, Connector)
GETPROPERTY = iowr("d", 0xAA, Property)
RMFB = iowr("d", 0xAF, Handle)
PAGE_FLIP = iowr("d", 0xB0, PageFlip)
CREATE_DUMB = iowr("d", 0xB2, CreateDumb)
MAP_DUMB = iowr("d", 0xB3, MapDumb)
DESTROY_DUMB = iowr("d", 0xB4, Handle)
GETPLANERESOURCES = iowr("d", 0xB5, PlaneResources)
GETPLANE = iowr("d", 0xB6, Plane)
SETPLANE = iowr("d", 0xB7, SetPlane)
ADDFB2 = iowr("d", 0xB8, FbCmd2)
OBJ_GETPROPERTIES = iowr("d", 0xB9, ObjectProperties)
OBJ_SETPROPERTY = iowr("d", 0xBA, SetProperty)
ATOMIC = iowr("d", 0xBC, Atomic)

# --- constants --------------------------------------------------------------------------------------------------

CAP_DUMB_BUFFER = 0x1
CAP_TIMESTAMP_MONOTONIC = 0x6
CLIENT_CAP_UNIVERSAL_PLANES = 2
CLIENT_CAP_ATOMIC = 3
CLIENT_CAP_WRITEBACK_CONNECTORS = 5

CONNECTED = 1
MODE_TYPE_PREFERRED = 1 << 3
MODE_FLAG_INTERLACE = 1 << 4
PAGE_FLIP_EVENT = 0x01
ATOMIC_ALLOW_MODESET = 0x0400
EVENT_FLIP_COMPLETE = 0x02

OBJECT_CRTC = 0xCCCCCCCC
OBJECT_CONNECTOR = 0xC0C0C0C0
OBJECT_PLANE = 0xEEEEEEEE
PLANE_TYPE_PRIMARY = 1

FORMAT_XRGB8888 = int.from_bytes(b"XR24", "little")

CONNECTOR_WRITEBACK = 18
CONNECTOR_NAMES = (
    *("Unknown", "VGA", "DVI-I", "DVI-D", "DVI-A", "Composite", "SVIDEO", "LVDS", "Component", "DIN", "DP"),
    *("HDMI-A", "HDMI-B", "TV", "eDP", "Virtual", "DSI", "DPI", "Writeback", "SPI", "USB"),
)
"""By type, as the kernel names them in /sys/class/drm"""


def text(field: bytes) -> str:
    """A fixed-size string of the kernel."""
    return field.split(b"\0", 1)[0].decode(errors="replace").strip()
