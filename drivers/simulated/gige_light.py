"""Light over a socket: a simulated projector tells a simulated camera in another process what shines when.

Both processes read the same CLOCK_MONOTONIC, so a change of light is told by its time and may be told early; a
projector does, by its latency. Images are sent once each, as a line where they are constant along an axis. The edges
of the projector's and the trigger board's lines are told when they are past. The camera listens; a projector whose
camera is gone shines on, and connects again at its next flip.

Messages: four bytes of length, one of kind, content. H hello (JSON), answered by one of kind A (JSON, `error`);
I image (slot, axis, shape, pixels); S show (time, slot or -1); E edge (time, name of the line).
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import cast

import numpy as np

from drivers.simulated.lines import LineName, Recorded
from drivers.simulated.timeline import LoadedImage, Manner
from drivers.simulated.world import World
from scanner.errors import ConfigError, DeviceNotFound

SLOTS = 128
"""Images that both sides remember"""

LINE_LOOK_S = 0.001
LONGEST_MESSAGE = 1 << 26
PATIENCE_S = 5.0
_TOLD_LINES: tuple[LineName, ...] = ("trigger", "frame", "exposure")
_log = logging.getLogger(__name__)


class LightRelay:
    """The projector's side: hears every change on its world's timeline and passes it on."""

    def __init__(self, world: World, path: str, name: str) -> None:
        """Connect.

        Raises:
            DeviceNotFound: nobody listens at `path`.
            ConfigError: the camera there stands in another rig.
        """
        self._world, self._path, self._name = world, path, name
        self._socket: socket.socket | None = None
        self._slots: OrderedDict[int, LoadedImage] = OrderedDict()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        try:
            self._connect()
        except OSError as error:
            raise DeviceNotFound(
                f"no simulated camera listens at {path}: {error.strerror}",
                device=name,
                hint="start `fringed simulate gige` first: it prints the path",
            ) from error
        world.timeline.told = self._tell
        self._thread = threading.Thread(target=self._watch_lines, name="simulated light", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Tell nothing more."""
        self._world.timeline.told = None
        self._ended.set()
        self._thread.join(timeout=PATIENCE_S)
        with self._lock:
            self._drop()

    def _connect(self) -> None:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            link.settimeout(PATIENCE_S)
            link.connect(self._path)
            rig = self._world.settings.rig
            _send(link, b"H", json.dumps({"rig": rig, "manner": asdict(self._world.timeline.manner)}).encode())
            self._check(json.loads(_receive(link)[1]))
        except BaseException:
            link.close()
            raise
        self._socket, self._slots = link, OrderedDict()

    def _check(self, answer: dict[str, str]) -> None:
        if "error" in answer:
            raise ConfigError(answer["error"], device=self._name, hint="name the same rig for camera and projector")

    def _tell(self, t_ns: float, image: LoadedImage | None) -> None:
        with self._connected():
            if self._socket is None:
                self._connect()
            link = cast("socket.socket", self._socket)
            slot = -1 if image is None else self._slot(link, image)
            _send(link, b"S", struct.pack(">qi", round(t_ns), slot))

    @contextlib.contextmanager
    def _connected(self) -> Iterator[None]:
        """One thread at a time sends. What fails may have sent half a message: the next flip connects again."""
        with self._lock:
            try:
                yield
            except OSError as error:
                _log.debug("%s: its camera does not listen: %s", self._name, error)
                self._drop()

    def _slot(self, link: socket.socket, image: LoadedImage) -> int:
        """The number that the camera knows the image by; sends it where it does not."""
        for slot, known in self._slots.items():
            if known is image:
                self._slots.move_to_end(slot)
                return slot
        free = len(self._slots)
        slot = free if free < SLOTS else self._slots.popitem(last=False)[0]
        self._slots[slot] = image
        axis, pixels = image.content()
        head = json.dumps({"slot": slot, "axis": axis, "shape": pixels.shape}).encode()
        _send(link, b"I", struct.pack(">I", len(head)) + head + pixels.tobytes())
        return slot

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _watch_lines(self) -> None:
        seen = time.monotonic_ns()
        while not self._ended.wait(LINE_LOOK_S):
            now = time.monotonic_ns()
            edges = sorted((edge, name) for name in _TOLD_LINES for edge in self._edges(name, seen, now))
            seen = now
            for edge, name in edges:
                with self._connected():
                    if self._socket is not None:
                        _send(self._socket, b"E", struct.pack(">q", edge) + name.encode())

    def _edges(self, name: LineName, after_ns: int, until_ns: int) -> list[int]:
        line, found = self._world.lines.get(name), []
        while line is not None and (edge := line.next_edge(after_ns)) is not None and edge <= until_ns:
            found.append(edge)
            after_ns = edge
        return found


class LightReceiver:
    """The camera's side: what it is told goes onto its world's timeline and lines."""

    def __init__(self, world: World, path: Path) -> None:
        """Listen at `path`; a socket left there by a process that is gone is replaced.

        Raises:
            ConfigError: there is something else at `path`, or no folder for it.
        """
        if path.exists() and not path.is_socket():
            raise ConfigError(
                f"{path} is no socket, and the camera needs that name for one", hint="give another --light"
            )
        if not path.parent.is_dir():
            raise ConfigError(f"{path.parent} is no folder", hint="give a --light in a folder that is there")
        self._world, self._path = world, path
        self._ended = threading.Event()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        before = os.umask(0o177)
        try:
            self._listener.bind(str(path))
        except OSError as error:  # longer than the kernel allows, or in a folder of somebody else's
            self._listener.close()
            raise ConfigError(f"no socket can be made at {path}: {error}", hint="give another --light") from error
        finally:
            os.umask(before)
        self._listener.listen(1)
        self._listener.settimeout(0.1)
        self._thread = threading.Thread(target=self._serve, name="simulated light", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening, and remove the socket."""
        self._ended.set()
        self._thread.join(timeout=PATIENCE_S)
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _serve(self) -> None:
        while not self._ended.is_set():
            try:
                link, _ = self._listener.accept()
            except TimeoutError:
                continue
            with contextlib.closing(link):
                try:
                    self._hear(link)
                except (OSError, EOFError, ValueError, KeyError, TypeError, struct.error) as error:
                    _log.info("the projector is gone: %s", error)
            self._world.timeline.show(time.monotonic_ns(), None)

    def _hear(self, link: socket.socket) -> None:
        link.settimeout(0.1)
        images: dict[int, LoadedImage] = {}
        while not self._ended.is_set():
            message = _receive_or_none(link)
            if message is None:
                continue
            kind, content = message
            if kind == b"H":
                _send(link, b"A", json.dumps(self._greet(json.loads(content))).encode())
            elif kind == b"I":
                slot, image = _read_image(content)
                images[slot] = image
            elif kind == b"S":
                t_ns, slot = struct.unpack(">qi", content)
                self._world.timeline.show(t_ns, None if slot < 0 else images[slot])
            elif kind == b"E":
                self._edge(struct.unpack_from(">q", content)[0], content[8:].decode())

    def _greet(self, hello: dict[str, object]) -> dict[str, str]:
        mine = self._world.settings.rig
        if hello.get("rig") != mine:
            return {"error": f"the simulated camera stands in rig {mine}, the projector in {hello.get('rig')}"}
        manner = cast("dict[str, float]", hello["manner"])
        self._world.timeline.manner = Manner(**manner)  # type: ignore[arg-type]  # JSON keeps whole numbers whole
        return {}

    def _edge(self, t_ns: int, name: str) -> None:
        line = self._world.lines.setdefault(cast("LineName", name), Recorded())
        if isinstance(line, Recorded):
            line.add(t_ns)


def _read_image(content: bytes) -> tuple[int, LoadedImage]:
    (length,) = struct.unpack_from(">I", content)
    head = json.loads(content[4 : 4 + length])
    pixels = np.frombuffer(content, dtype=np.uint8, offset=4 + length).reshape(head["shape"])
    return int(head["slot"]), LoadedImage.of(head["axis"], pixels)


def _send(link: socket.socket, kind: bytes, content: bytes) -> None:
    link.sendall(struct.pack(">I", len(content)) + kind + content)


def _receive(link: socket.socket) -> tuple[bytes, bytes]:
    head = _exactly(link, 5)
    (length,) = struct.unpack_from(">I", head)
    if length > LONGEST_MESSAGE:
        raise ValueError(f"a message of {length} bytes")
    return head[4:], _exactly(link, length)


def _receive_or_none(link: socket.socket) -> tuple[bytes, bytes] | None:
    """A message; None if none began within the socket's time-out."""
    try:
        link.recv(1, socket.MSG_PEEK)
    except TimeoutError:
        return None
    return _receive(link)


def _exactly(link: socket.socket, size: int) -> bytes:
    parts = bytearray()
    deadline = time.monotonic() + PATIENCE_S
    while len(parts) < size:
        try:
            part = link.recv(min(1 << 20, size - len(parts)))
        except TimeoutError:
            if time.monotonic() > deadline:
                raise
            continue
        if not part:
            raise EOFError("closed")
        parts += part
    return bytes(parts)
