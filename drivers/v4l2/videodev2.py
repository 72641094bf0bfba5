"""The kernel's Video4Linux2 interface as ctypes: structures, request numbers and constants of `linux/videodev2.h`.

For 64-bit kernels. Only what this package uses; names are the header's, without the prefixes where a class says them.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char, c_int32, c_int64, c_uint8, c_uint16, c_uint32, c_uint64

from drivers.ioctl import ior, iow, iowr

# --- structures -------------------------------------------------------------------------------------------------


class Capability(ctypes.Structure):
    """v4l2_capability"""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    """v4l2_fmtdesc"""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """v4l2_pix_format"""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class PlanePixFormat(ctypes.Structure):
    """v4l2_plane_pix_format"""

    _pack_ = 1
    _fields_ = (("sizeimage", c_uint32), ("bytesperline", c_uint32), ("reserved", c_uint16 * 6))


class PixFormatMplane(ctypes.Structure):
    """v4l2_pix_format_mplane"""

    _pack_ = 1
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("colorspace", c_uint32),
        ("plane_fmt", PlanePixFormat * 8),
        ("num_planes", c_uint8),
        ("flags", c_uint8),
        ("ycbcr_enc", c_uint8),
        ("quantization", c_uint8),
        ("xfer_func", c_uint8),
        ("reserved", c_uint8 * 7),
    )


class _FormatUnion(ctypes.Union):
    _fields_ = (("pix", PixFormat), ("pix_mp", PixFormatMplane), ("raw", c_uint8 * 200), ("align", c_uint64))


class Format(ctypes.Structure):
    """v4l2_format"""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class RequestBuffers(ctypes.Structure):
    """v4l2_requestbuffers"""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class _PlaneMemory(ctypes.Union):
    _fields_ = (("mem_offset", c_uint32), ("userptr", c_uint64), ("fd", c_int32))


class Plane(ctypes.Structure):
    """v4l2_plane"""

    _fields_ = (
        ("bytesused", c_uint32),
        ("length", c_uint32),
        ("m", _PlaneMemory),
        ("data_offset", c_uint32),
        ("reserved", c_uint32 * 11),
    )


class _BufferMemory(ctypes.Union):
    _fields_ = (
        ("offset", c_uint32),
        ("userptr", c_uint64),
        ("planes", ctypes.POINTER(Plane)),
        ("fd", c_int32),
    )


class Buffer(ctypes.Structure):
    """v4l2_buffer"""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("tv_sec", c_int64),
        ("tv_usec", c_int64),
        ("timecode", c_uint8 * 16),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferMemory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class Fraction(ctypes.Structure):
    """v4l2_fract"""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class _FrameParameters(ctypes.Structure):
    """v4l2_captureparm and v4l2_outputparm, which are alike"""

    _fields_ = (
        ("capability", c_uint32),
        ("mode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("buffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _StreamUnion(ctypes.Union):
    _fields_ = (("frame", _FrameParameters), ("raw", c_uint8 * 200))


class StreamParameters(ctypes.Structure):
    """v4l2_streamparm"""

    _fields_ = (("type", c_uint32), ("parm", _StreamUnion))


class QueryExtControl(ctypes.Structure):
    """v4l2_query_ext_ctrl"""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int64),
        ("maximum", c_int64),
        ("step", c_uint64),
        ("default_value", c_int64),
        ("flags", c_uint32),
        ("elem_size", c_uint32),
        ("elems", c_uint32),
        ("nr_of_dims", c_uint32),
        ("dims", c_uint32 * 4),
        ("reserved", c_uint32 * 32),
    )


class _MenuUnion(ctypes.Union):
    _pack_ = 1
    _fields_ = (("name", c_char * 32), ("value", c_int64))


class QueryMenu(ctypes.Structure):
    """v4l2_querymenu"""

    _pack_ = 1
    _fields_ = (("id", c_uint32), ("index", c_uint32), ("m", _MenuUnion), ("reserved", c_uint32))


class _ControlValue(ctypes.Union):
    _pack_ = 1
    _fields_ = (("value", c_int32), ("value64", c_int64), ("pointer", c_uint64))


class ExtControl(ctypes.Structure):
    """v4l2_ext_control"""

    _pack_ = 1
    _fields_ = (("id", c_uint32), ("size", c_uint32), ("reserved2", c_uint32), ("v", _ControlValue))


class ExtControls(ctypes.Structure):
    """v4l2_ext_controls"""

    _fields_ = (
        ("which", c_uint32),
        ("count", c_uint32),
        ("error_idx", c_uint32),
        ("request_fd", c_int32),
        ("reserved", c_uint32),
        ("controls", ctypes.POINTER(ExtControl)),
    )


class _SizeUnion(ctypes.Union):
    _fields_ = (("discrete", c_uint32 * 2), ("stepwise", c_uint32 * 6))


class FrameSize(ctypes.Structure):
    """v4l2_frmsizeenum; stepwise is min, max, step of the width, then of the height"""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("size", _SizeUnion),
        ("reserved", c_uint32 * 2),
    )


class BtTimings(ctypes.Structure):
    """v4l2_bt_timings"""

    _pack_ = 1
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("interlaced", c_uint32),
        ("polarities", c_uint32),
        ("pixelclock", c_uint64),
        ("hfrontporch", c_uint32),
        ("hsync", c_uint32),
        ("hbackporch", c_uint32),
        ("vfrontporch", c_uint32),
        ("vsync", c_uint32),
        ("vbackporch", c_uint32),
        ("il_vfrontporch", c_uint32),
        ("il_vsync", c_uint32),
        ("il_vbackporch", c_uint32),
        ("standards", c_uint32),
        ("flags", c_uint32),
        ("picture_aspect", Fraction),
        ("cea861_vic", c_uint8),
        ("hdmi_vic", c_uint8),
        ("reserved", c_uint8 * 46),
    )


class _TimingsUnion(ctypes.Union):
    _pack_ = 1
    _fields_ = (("bt", BtTimings), ("reserved", c_uint32 * 32))


class DvTimings(ctypes.Structure):
    """v4l2_dv_timings"""

    _pack_ = 1
    _fields_ = (("type", c_uint32), ("timings", _TimingsUnion))


class EnumDvTimings(ctypes.Structure):
    """v4l2_enum_dv_timings"""

    _fields_ = (("index", c_uint32), ("pad", c_uint32), ("reserved", c_uint32 * 2), ("timings", DvTimings))


# --- requests ---------------------------------------------------------------------------------------------------

QUERYCAP = ior("V", 0, Capability)
ENUM_FMT = iowr("V", 2, FormatDescription)
G_FMT = iowr("V", 4, Format)
S_FMT = iowr("V", 5, Format)
REQBUFS = iowr("V", 8, RequestBuffers)
QUERYBUF = iowr("V", 9, Buffer)
QBUF = iowr("V", 15, Buffer)
DQBUF = iowr("V", 17, Buffer)
STREAMON = iow("V", 18, c_int32)
STREAMOFF = iow("V", 19, c_int32)
G_PARM = iowr("V", 21, StreamParameters)
S_PARM = iowr("V", 22, StreamParameters)
QUERYMENU = iowr("V", 37, QueryMenu)
G_EXT_CTRLS = iowr("V", 71, ExtControls)
S_EXT_CTRLS = iowr("V", 72, ExtControls)
ENUM_FRAMESIZES = iowr("V", 74, FrameSize)
S_DV_TIMINGS = iowr("V", 87, DvTimings)
G_DV_TIMINGS = iowr("V", 88, DvTimings)
ENUM_DV_TIMINGS = iowr("V", 98, EnumDvTimings)
QUERY_DV_TIMINGS = ior("V", 99, DvTimings)
QUERY_EXT_CTRL = iowr("V", 103, QueryExtControl)

# --- constants --------------------------------------------------------------------------------------------------

CAP_VIDEO_CAPTURE = 0x00000001
CAP_VIDEO_OUTPUT = 0x00000002
CAP_VIDEO_CAPTURE_MPLANE = 0x00001000
CAP_VIDEO_OUTPUT_MPLANE = 0x00002000
CAP_STREAMING = 0x04000000

TYPE_VIDEO_CAPTURE = 1
TYPE_VIDEO_OUTPUT = 2
TYPE_VIDEO_CAPTURE_MPLANE = 9
TYPE_VIDEO_OUTPUT_MPLANE = 10
MULTIPLANAR = frozenset({TYPE_VIDEO_CAPTURE_MPLANE, TYPE_VIDEO_OUTPUT_MPLANE})

MEMORY_MMAP = 1
FIELD_ANY, FIELD_NONE = 0, 1
QUANTIZATION_FULL_RANGE = 1
CAP_TIMEPERFRAME = 0x1000
FRMSIZE_DISCRETE = 1

BUF_FLAG_ERROR = 0x00000040
BUF_FLAG_TIMESTAMP_MASK = 0x0000E000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x00002000
BUF_FLAG_TSTAMP_SRC_MASK = 0x00070000
BUF_FLAG_TSTAMP_SRC_SOE = 0x00010000

CTRL_FLAG_DISABLED = 0x0001
CTRL_FLAG_GRABBED = 0x0002
CTRL_FLAG_READ_ONLY = 0x0004
CTRL_FLAG_INACTIVE = 0x0010
CTRL_FLAG_WRITE_ONLY = 0x0040
CTRL_FLAG_NEXT_CTRL = 0x80000000
CTRL_WHICH_CUR_VAL = 0
"""value of `which` in ExtControls: the controls may be of any class"""


def fourcc(code: str) -> int:
    """The number of a four-character code; shorter ones are filled up with blanks."""
    return int.from_bytes(code.ljust(4).encode("ascii"), "little")


def fourcc_text(number: int) -> str:
    """The four characters of a pixel format's number, without blanks; bit 31 marks big-endian formats."""
    text = (number & 0x7FFFFFFF).to_bytes(4, "little").decode("latin-1").strip()
    return text + "-BE" if number >> 31 else text


def text(field: bytes) -> str:
    """A fixed-size string of the kernel."""
    return field.split(b"\0", 1)[0].decode(errors="replace").strip()
