"""The kernel's vivid as a bench: an HDMI output looped to an HDMI input, pulled out and put back at will."""

from __future__ import annotations

import time
from pathlib import Path

from drivers.v4l2 import controls
from drivers.v4l2.node import open_node

CAMERA, PROJECTOR = "/dev/video10", "/dev/video11"
MODE = "640x480@59.94"
WIDTH, HEIGHT = 640, 480

_DRIVER = Path("/sys/bus/platform/drivers/vivid")


def join() -> None:
    """Loop the output to the input, without text over the picture."""
    node, _ = open_node(CAMERA, "camera")
    try:
        for name, value in (("loop_video", 1), ("osd_text_mode", 2)):
            controls.write_named(node, name, value)
    finally:
        node.close()


def unplug() -> None:
    (_DRIVER / "unbind").write_text("vivid.0")


def bind() -> None:
    (_DRIVER / "bind").write_text("vivid.0")


def plug_in() -> None:
    """Bind again unless it is, and wait for the nodes."""
    if not (_DRIVER / "vivid.0").exists():
        bind()
    deadline = time.monotonic() + 10
    while not all(Path(node).exists() for node in (CAMERA, PROJECTOR)):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    join()
