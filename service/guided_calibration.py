"""A guided calibration between daemon and words: preview pictures in, captures kept in folders, a running solve.

No terminal here: `commands.calibrate_run` asks and prints. Each pose is a capture folder `poses/NN`, so that a run
that was interrupted goes on, and `fringed calibrate solve` takes what there is.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from scanner.calibration.calibration_file import rms
from scanner.calibration.copies import again
from scanner.calibration.guide import Guide, Seen
from scanner.calibration.observe import LeftOut, Observation, find_captures, observe_capture
from scanner.calibration.response import Response, response_of_frames
from scanner.calibration.sight import Sight, look
from scanner.calibration.solve import Solution, SolveOptions, solve
from scanner.calibration.start import FEWEST_VIEWS
from scanner.calibration.targets import Target
from scanner.capture import Capture
from scanner.client import Client
from scanner.client_sockets import conflated
from scanner.errors import CalibrationError, DecodeError, ScannerError, StorageError, SyncError, Unreachable
from scanner.session import raise_unless_done
from scanner.storage import storage_errors
from scanner.wire import Event
from scanner.wire_images import decode_preview

POSES = "poses"
INCOMING = ".incoming"
PREVIEW_HZ = 2.0
PREVIEW_WIDTH = 2048
"""The widest the daemon sends: corners are looked for in the camera's own pixels wherever that goes."""
LATE_S = 10.0
"""Without a picture for so long the daemon is asked for them again."""

PATIENCE_S = 120.0
"""Without news of a capture for so long it is given up: four times the silence after which the daemon itself gives its
devices up."""

OnEvent = Callable[[Event], None]


def require_own(folder: Path, *names: str) -> None:
    """A run goes on in its own folder, or in an empty one. names: of files that a run leaves there, beside its poses.

    Raises:
        StorageError: the folder holds what no run has left there.
    """
    with storage_errors(folder):
        there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if there and not there & {POSES, INCOMING, *names}:
        raise StorageError(
            f"{folder} is not empty, and nothing in it is a calibration run's",
            hint="give another -o DIR: a new one, or one of an earlier run, which then goes on",
        )


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Nobody else runs a calibration in a folder, which is there, while the block runs.

    Raises:
        StorageError: somebody does.
    """
    with storage_errors(folder):
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StorageError(
                f"another calibration runs in {folder}", hint="wait for it, or give another -o"
            ) from error
        yield
    finally:
        os.close(held)


class GuidedCalibration:
    """One run. Poses that are in the folder already are taken up."""

    def __init__(self, client: Client, target: Target, folder: Path, options: SolveOptions) -> None:
        self.target = target
        self.options = options
        self.observations: list[Observation] = []
        self.left_out: list[LeftOut] = []
        self._client = client
        self._folder = folder
        self._guide: Guide | None = None
        self._context = zmq.Context()
        self._preview: zmq.Socket[bytes] | None = None
        self._after_ns = 0
        self._heard_s = time.monotonic()
        shutil.rmtree(folder / INCOMING, ignore_errors=True)  # of a run that was interrupted

    def close(self) -> None:
        """End the preview."""
        self._context.destroy(linger=0)
        if self._preview is not None:
            self._preview = None
            with suppress(ScannerError):  # a daemon that is gone shows none, and that it is gone was said
                self._client.preview_stop()

    # --- poses -----------------------------------------------------------------------------------------------------

    @property
    def captures(self) -> list[Path]:
        """The folders of the poses that were captured."""
        poses = self._folder / POSES
        return find_captures([poses]) if poses.is_dir() and any(poses.iterdir()) else []

    def take_up(self) -> int:
        """Look at the poses that the folder holds; how many serve. Copies of one do not."""
        poses, seen = self._folder / POSES, dict[Hashable, tuple[Path, str]]()
        for path in self.captures:
            name = path.relative_to(poses).as_posix()
            outcome = observe_capture(path, name, self.target)
            if isinstance(outcome, Observation):
                how = again(path, (outcome.key,), seen)
                seen.setdefault(outcome.key, (path, name))
                outcome = outcome if how is None else LeftOut(name, f"it {how}, and tells nothing new")
            self._keep(outcome)
        return len(self.observations)

    def require_this_rig(self) -> None:
        """Raise CalibrationError where poses are of a rig with other devices than are here."""
        self._client.preview_start(rate_hz=PREVIEW_HZ, max_width=PREVIEW_WIDTH)  # opens the devices
        devices = self._client.status()["devices"]
        self._client.preview_stop()
        if devices is None:
            return
        here = tuple((devices[side]["width"], devices[side]["height"]) for side in ("camera", "projector"))
        for one in self.observations:
            there = (one.camera_size, one.projector_size)
            if there != here:
                sizes = [f"camera {c[0]} x {c[1]}, projector {p[0]} x {p[1]}" for c, p in (there, here)]
                raise CalibrationError(
                    f"pose {one.view.name} of {self._folder} is another rig's: {sizes[0]}, and this one has {sizes[1]}",
                    hint="give another -o DIR: a new one, or that of this rig's earlier run",
                )

    def capture(self, on_event: OnEvent | None = None) -> tuple[bool, str]:
        """Capture the pose that stands there: whether it serves, and in words how good it is or why it does not.

        Raises:
            ScannerError: the scan failed, otherwise than by the pose.
        """
        place, incoming = self._free_place(), self._folder / INCOMING
        try:
            job = self._client.start_scan("pmp", pattern={"axes": ["x", "y"]})
            try:
                raise_unless_done(self._client.wait(job, on_event, patience_s=PATIENCE_S))
            except (KeyboardInterrupt, SystemExit, Unreachable):
                self._client.cancel(job)
                raise
            self._client.fetch(job, incoming)
            place.parent.mkdir(exist_ok=True)
            (incoming / "capture").replace(place)
        except (SyncError, DecodeError) as error:
            return False, f"{error}"
        finally:
            shutil.rmtree(incoming, ignore_errors=True)
            self._after_ns = time.monotonic_ns()
        outcome = observe_capture(place, place.name, self.target)
        if isinstance(outcome, LeftOut):
            shutil.rmtree(place)
            return False, outcome.reason
        self._keep(outcome)
        return True, self._quality()

    def _free_place(self) -> Path:
        """Of the next pose: behind all that stands there, whatever it is."""
        poses = self._folder / POSES
        taken = [int(path.name) for path in poses.iterdir() if path.name.isdecimal()] if poses.is_dir() else []
        return poses / f"{max(taken, default=0) + 1:02d}"

    def undo(self) -> str | None:
        """Take the last pose back, with its folder; its name, or None where there is none."""
        if not self.observations:
            return None
        last = self.observations.pop()
        if self._guide is not None:
            self._guide = self._guide.undone()
        shutil.rmtree(self._folder / POSES / last.view.name, ignore_errors=True)
        return last.view.name

    def _keep(self, outcome: Observation | LeftOut) -> None:
        if isinstance(outcome, LeftOut):
            self.left_out.append(outcome)
            return
        self.observations.append(outcome)
        guide = self._guide or Guide(self.target, outcome.camera_size)
        view = outcome.view
        self._guide = guide.with_pose(Seen(view.name, view.ids, view.camera))

    # --- what there is to say --------------------------------------------------------------------------------------

    @property
    def guide(self) -> Guide | None:
        """What is known of the poses; None until the first picture or pose."""
        return self._guide

    def solved(self, *, leave_out: bool = False, progress: Callable[[str], None] | None = None) -> Solution:
        """The rig from the poses so far.

        Raises:
            CalibrationError: they do not make one; with the likely cause.
        """
        return solve(self.target, self.observations, self.options, self.left_out, progress, leave_out=leave_out)

    def _quality(self) -> str:
        guide, view = self._guide, self.observations[-1].view
        assert guide is not None  # noqa: S101  a pose was kept
        words = [f"{len(view.ids)} points", *self.observations[-1].warnings]
        if len(self.observations) >= FEWEST_VIEWS:
            words.append(self._residual())
        return "; ".join([*words, self._guide.gain() if self._guide else ""])

    def _residual(self) -> str:
        """Of the last pose against the running solve."""
        try:
            solution = self.solved()
        except CalibrationError as error:
            return f"no rig yet: {error}"
        name = self.observations[-1].view.name
        if self._guide is not None:
            self._guide = replace(self._guide, matrix=solution.state.camera.matrix)
        for one in solution.left_out:
            if one.name == name:
                return f"{one.reason} (u takes it back)"
        k = next(i for i, view in enumerate(solution.problem.views) if view.name == name)
        adjusted = solution.adjusted
        kept = adjusted.kept[k]
        camera, projector = (rms(each[k][kept]) for each in (adjusted.camera_residuals, adjusted.projector_residuals))
        dropped = f" ({int((~kept).sum())} points dropped)" if not kept.all() else ""
        return f"residual {camera:.3f} px in the camera, {projector:.3f} px in the projector{dropped}"

    def response(self) -> Response | str:
        """The projector's response as the first pose's frames tell it, or why they do not."""
        capture = Capture.open(self._folder / POSES / self.observations[0].view.name)
        sequence = capture.header.sequence
        if capture.missing:
            return "frames of the first pose are missing"
        try:
            frames = [capture.frame(position) for position in range(len(sequence))]
            return response_of_frames(sequence, capture.header.camera, frames)
        except CalibrationError as error:
            return str(error)

    # --- preview ---------------------------------------------------------------------------------------------------

    def see(self, timeout_s: float) -> tuple[NDArray[Any], Sight | str, float] | None:
        """The newest preview picture, what is seen in it, and when it was taken, s; None where none came in time.

        Raises:
            Unreachable: the daemon is gone.
        """
        if self._preview is None:
            endpoint = self._client.preview_start(rate_hz=PREVIEW_HZ, max_width=PREVIEW_WIDTH)
            self._preview = conflated(self._context.socket(zmq.SUB), endpoint)
        if not self._preview.poll(int(1e3 * timeout_s)):
            if time.monotonic() - self._heard_s > LATE_S:
                self._heard_s = time.monotonic()
                self._client.preview_start(rate_hz=PREVIEW_HZ, max_width=PREVIEW_WIDTH)  # or it says why not
            return None
        self._heard_s = time.monotonic()
        header, pixels = decode_preview(self._preview.recv())
        if header.t_ns < self._after_ns:
            return None  # from before the last capture
        picture = np.frombuffer(pixels, dtype=header.dtype).reshape(header.height, header.width)
        if self._guide is None:
            self._guide = Guide(self.target, (header.width * header.stride, header.height * header.stride))
        sight = look(picture, self.target, self._guide.lens, header.stride)
        return picture, sight, header.t_ns / 1e9
