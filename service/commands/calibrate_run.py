"""`fringed calibrate run`: from a rig to its calibration, guided at the terminal, pose by pose.

What to say and when to capture is `scanner.calibration.guide`'s; here are keys, lines and files.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.calibrate_solve import (
    TARGET_HELP,
    Baseline,
    Distance,
    Length,
    Rigid,
    WarmUp,
    length_given,
    report,
)
from service.commands.options import AsJson, Connect, output_path, require_picture
from service.terminal import progress_lines

if TYPE_CHECKING:
    from scanner.calibration.grey_levels import LevelResponse
    from scanner.calibration.guide import Guide
    from scanner.calibration.solve import Solution, SolveOptions
    from scanner.calibration.targets import Target
    from service.config import RigConfig
    from service.guided_calibration import GuidedCalibration
    from service.keys import Keys

CALIBRATION_FILE = "calibration.json"
RESULT_PICTURE = "calibration.png"
LIVE_PICTURE = "calibrate.png"
SAID_EVERY_S = 10.0
"""With nobody at a terminal: what is waited for."""
PATIENCE_S = 60.0
"""With nobody at a terminal: without a new pose for so long the run ends with what there is."""
SEE_S = 0.2
"""A key is looked for this often."""


def run(
    target: Annotated[str, typer.Option(metavar="TARGET", help=TARGET_HELP)],
    rig: Annotated[str | None, typer.Argument(metavar="RIG", help="A rig file, or simulated[:SCENE].")] = None,
    connect: Connect = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            parser=output_path,
            help="Folder; poses in it are taken up again. Default: calibration-DATE-TIME.",
        ),
    ] = None,
    auto: Annotated[
        bool, typer.Option("--auto", help="Capture by itself, when the target stands still in a new pose.")
    ] = False,
    poses: Annotated[int, typer.Option(metavar="N", min=3, max=40, help="Poses after which the run ends.")] = 12,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", parser=output_path, help="Live picture (png, jpg); else calibrate.png in DIR."),
    ] = None,
    length: Length = None,
    rigid: Rigid = False,
    baseline: Baseline = None,
    distance: Distance = None,
    warm_up: WarmUp = None,
    write: Annotated[
        bool, typer.Option("--write", help="Name the calibration in the rig file (a copy is kept beside it).")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the calibration of an earlier run in DIR.")] = False,
    as_json: AsJson = False,
) -> int:
    """Calibrate a rig, guided: where to hold the target next, and how good each pose was.

    Latency is measured first. Then, for each pose: Enter captures (or --auto), u takes the last pose back, q ends. Look
    at the live picture in a viewer that reloads it. Without a terminal it captures by itself.

    \b
    Examples:
      fringed calibrate run "simulated:charuco_poses?walk=true&seed=198" --target charuco:10x7:30 --auto -o scans/rig
      fringed calibrate run bench.toml --target charuco:10x7:30 --length 240.1:0.05 -o calibrations/bench
      fringed calibrate run bench.toml --target charuco:10x7:30 --auto --write
    """
    from scanner.calibration.solve import SolveOptions  # noqa: PLC0415
    from scanner.calibration.targets import parse_target  # noqa: PLC0415
    from scanner.errors import ConfigError  # noqa: PLC0415
    from scanner.storage import storage_errors, try_file  # noqa: PLC0415
    from service.config import is_simulated  # noqa: PLC0415
    from service.guided_calibration import alone_in, require_own  # noqa: PLC0415

    if (rig is None) == (connect is None):
        raise typer.BadParameter("give RIG, or --connect to a running daemon, which has a rig of its own")
    if picture is not None:
        require_picture(picture)
    if write and (rig is None or is_simulated(rig)):
        raise ConfigError("there is no rig file to write to", hint="leave --write out")
    options = SolveOptions(None if length is None else length_given(length), rigid, baseline, distance, warm_up)
    looked_for = parse_target(target)
    if not looked_for.flat:
        raise ConfigError(
            "a target in space is not moved from pose to pose",
            hint="fringed scan --axis xy -o wedge, then fringed calibrate solve wedge --model hall",
        )
    folder = output or Path(datetime.now().astimezone().strftime("calibration-%Y%m%d-%H%M%S"))
    result = folder / CALIBRATION_FILE
    if result.exists() and not force:
        raise typer.BadParameter(f"-o: {result} exists; --force goes on with its poses and replaces it")
    require_own(folder, LIVE_PICTURE, CALIBRATION_FILE)
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for path in (result, picture or folder / LIVE_PICTURE, *((Path(rig),) if write and rig is not None else ())):
        try_file(path)
    asked = _Asked(folder, picture or folder / LIVE_PICTURE, poses, auto)
    with alone_in(folder):
        solution, response = _guided(rig, connect, looked_for, options, asked)
        content, drawing = _written(solution, response, result, folder / RESULT_PICTURE)
    report(solution, content, result, drawing, as_json=as_json, response=response)
    _named_in_rig(rig, result, write=write)
    return 0


@dataclass(frozen=True)
class _Asked:
    """What the command line asked of the loop."""

    folder: Path
    picture: Path
    poses: int
    auto: bool


def _guided(
    rig: str | None, connect: str | None, target: Target, options: SolveOptions, asked: _Asked
) -> tuple[Solution, dict[str, Any] | None]:
    """Measure, guide, solve: the rig, and the projector's response where it was told."""
    from scanner.client import Client  # noqa: PLC0415
    from scanner.errors import CalibrationError, ScannerError  # noqa: PLC0415
    from service.config import is_simulated  # noqa: PLC0415
    from service.guided_calibration import GuidedCalibration  # noqa: PLC0415
    from service.keys import keys  # noqa: PLC0415

    simulated = rig is not None and is_simulated(rig)
    with _daemon(rig, connect) as (endpoint, levels), Client(endpoint, name="fringed calibrate run") as client:
        session = GuidedCalibration(client, target, asked.folder, options)
        try:
            if taken_up := session.take_up():
                session.require_this_rig()
                say(f"{taken_up} poses of {asked.folder} are taken up")
                if simulated:
                    say(f"a simulated target begins in its first pose again: &pose={taken_up} in its name goes on")
            with keys() as pressed:
                loop = _Loop(session, asked, pressed, levels)
                loop.run()
            if not session.observations and not session.left_out:
                raise CalibrationError("no pose was captured", hint=f"at the end: {loop.last_line()}")
            try:
                with progress_lines() as lines:
                    return session.solved(leave_out=True, progress=lines.stage), loop.response
            except ScannerError:  # else its warnings say so
                _say_lacking(session.guide, simulated=simulated)
                raise
        except (KeyboardInterrupt, SystemExit, ScannerError):
            if session.observations:
                say(f"the poses are kept: the same command with -o {asked.folder} goes on with them")
            raise
        finally:
            session.close()


@contextmanager
def _daemon(rig: str | None, connect: str | None) -> Iterator[tuple[str, LevelResponse | None]]:
    """The daemon named, or a private one with this rig; its latency and its response are measured before."""
    from scanner.clock import MonotonicClock  # noqa: PLC0415
    from service.config import load_rig  # noqa: PLC0415
    from service.private import private_daemon  # noqa: PLC0415
    from service.response_measure import first_response  # noqa: PLC0415

    if rig is None:
        say("latency: as the daemon knows or measures it")
        yield str(connect), None
        return
    config = _in_step(load_rig(rig))
    with progress_lines() as lines:
        levels, words = first_response(config, MonotonicClock(), lines.stage)
    say(words)
    with private_daemon(config) as endpoint:
        yield endpoint, levels


def _in_step(config: RigConfig) -> RigConfig:
    """The rig with latency and settling: from its file, or measured now."""
    from scanner.clock import MonotonicClock  # noqa: PLC0415
    from scanner.errors import ConfigError  # noqa: PLC0415
    from service.sync_measure import measure_sync  # noqa: PLC0415

    projector = config.projector
    if projector.latency_us is not None and projector.settle_us is not None:
        say("latency and settling: taken from the rig file")
        return config
    with progress_lines() as lines:
        found = measure_sync(config, MonotonicClock(), lines.stage)
    measured = found.rig_lines()
    words = ", ".join(f"{key} = {value}" for key, value in measured.items())
    say(f"measured: {words} (fringed calibrate sync --write keeps them in the rig file)")
    if found.refused:
        raise ConfigError(f"no scan can work: {found.refused}")
    part = {key: tuple(value) for key, value in measured.items()}
    return config.model_copy(update={"projector": projector.model_copy(update=part)})


class _Loop:
    """Preview, keys, captures, until there are enough poses or somebody ends it."""

    def __init__(
        self, session: GuidedCalibration, asked: _Asked, keys: Keys, levels: LevelResponse | None = None
    ) -> None:
        from scanner.calibration.guide import Stillness  # noqa: PLC0415

        self._session, self._asked, self._keys = session, asked, keys
        self._auto = asked.auto or not keys.there
        self._still: Stillness | None = None
        self._new = Stillness
        self._seen: Any = "no picture of the camera yet"
        self._progress_s = time.monotonic()
        self._said_after_s = SAID_EVERY_S
        self._told = False
        self._advice = ""
        self._not_kept = ""
        self._levels = levels
        self.response: dict[str, Any] | None = None if levels is None else levels.response
        """the projector's, where scans should undo it"""

    def run(self) -> None:
        """Until the end."""
        how = "captures by itself when the target stands still" if self._auto else "Enter captures"
        say(f"{how}; u takes the last pose back, q ends. Live picture: {self._asked.picture}")
        self._tell_response()
        self._say_next()
        while len(self._session.observations) < self._asked.poses:
            key = self._keys.pressed()
            if key == "q":
                break
            if key == "u":
                self._undo()
            ready = self._look()
            if (key in "\r\n" and key) or (self._auto and ready):
                self._capture()
            if not self._keys.there and self._waited_out():
                break
        clear_line()

    def _waited_out(self) -> bool:
        """Whether no new pose came for long; what it waits for is said now and then: nobody sees a drawn line."""
        waits_s = time.monotonic() - self._progress_s
        if waits_s > PATIENCE_S:
            say(f"no new pose for {PATIENCE_S:.0f} s: {self.last_line()}")
            return True
        if waits_s > self._said_after_s:
            self._said_after_s += SAID_EVERY_S
            say(f"no new pose for {waits_s:.0f} s (ends after {PATIENCE_S:.0f}): {self.last_line()}")
        return False

    def _look(self) -> bool:
        """Look at the newest picture; whether the target has stood still in a new pose."""
        from scanner.calibration.guide import status  # noqa: PLC0415

        found = self._session.see(SEE_S)
        guide = self._session.guide
        if found is None or guide is None:
            return False
        pixels, self._seen, t_s = found
        line = status(self._seen, guide)
        draw_line(f"[{len(self._session.observations)}/{self._asked.poses}] {line}")
        self._draw(pixels, line)
        if self._still is None:
            self._still = self._new(guide.size[0])
        if isinstance(self._seen, str) or self._seen.trouble is not None or not guide.is_new(self._seen):
            self._still.forget()
            return False
        return self._still.see(t_s, self._seen)

    def _capture(self) -> None:
        if isinstance(self._seen, str):
            say(f"not captured: {self._seen}")
            return
        draw_line("capturing: hold it still")
        good, words = self._session.capture(_frames)
        number = len(self._session.observations)
        say(f"pose {number}: {words}" if good else f"not kept: {words}")
        self._not_kept = "" if good else words
        if self._still is not None:
            self._still.forget()
        if good:
            self._progress_s, self._said_after_s = time.monotonic(), SAID_EVERY_S
            self._tell_response()
            self._say_next()

    def _tell_response(self) -> None:
        """Once, from the first pose; where grey levels told it before, the fringes are a check."""
        if self._session.observations and not self._told:
            told, self._told = _response(self._session, self._levels), True
            if self._levels is None:
                self.response = told

    def _undo(self) -> None:
        name = self._session.undo()
        say("there is no pose to take back" if name is None else f"pose {name} is taken back")
        if not self._session.observations and self._told:
            # What fringes told was that pose's: the next one tells it.
            self._told, self.response = False, None if self._levels is None else self._levels.response

    def _say_next(self) -> None:
        guide = self._session.guide
        if guide is not None and len(guide.poses) < self._asked.poses:
            advice = guide.advice()
            say("next: as before" if advice == self._advice else f"next: {advice}")
            self._advice = advice

    def last_line(self) -> str:
        """What keeps the pose that is seen now from being captured."""
        waits = "it is captured when it stands still" if self._auto else "Enter captures"
        seen = "the target stands as before" if self._session.observations else f"the target is seen: {waits}"
        if self._not_kept:
            return f"the last capture was not kept: {self._not_kept}"
        return self._seen if isinstance(self._seen, str) else self._seen.trouble or seen

    def _draw(self, pixels: Any, line: str) -> None:
        from scanner.calibration.guide_picture import guide_picture  # noqa: PLC0415
        from scanner.live_picture import encoded  # noqa: PLC0415
        from scanner.storage import replace_file  # noqa: PLC0415

        guide, path = self._session.guide, self._asked.picture
        if guide is not None:
            replace_file(path, encoded(guide_picture(pixels, self._seen, guide, line, guide.advice()), path.suffix))


def _frames(event: Any) -> None:
    if event.kind == "frame":
        draw_line(f"capturing: hold it still ({event.fields.get('captured', 0)} of {event.fields.get('total', '?')})")
    elif event.kind == "retake":
        draw_line("frames were out of step and are taken again: hold it still")
    elif event.kind == "acquired":
        draw_line("captured; decoding")


def _response(session: GuidedCalibration, levels: LevelResponse | None) -> dict[str, Any] | None:
    """What the fringes tell of the projector's gamma, in words; as the calibration file has it where only they do."""
    from scanner.calibration.response import Response  # noqa: PLC0415
    from service.response_check import checked  # noqa: PLC0415

    found = session.response()
    if not isinstance(found, Response):
        say(f"response: not told{'' if levels is None else ' a second time'} ({found})")
        return None
    response, lines = checked(found, levels)
    for line in lines:
        say(line)
    return response


def _say_lacking(guide: Guide | None, *, simulated: bool = False) -> None:
    """Which of the how-to's conditions the poses do not meet, in one line."""
    from scanner.calibration.coverage import NOT_MET  # noqa: PLC0415

    if guide is not None and (lacking := guide.lacking()):
        why = "; a simulated target's poses are drawn from its seed: other ones with seed=N" if simulated else ""
        say(f"{NOT_MET}{lacking}{why}")


def _written(
    solution: Solution, response: dict[str, Any] | None, result: Path, drawing: Path
) -> tuple[dict[str, Any], Path]:
    from scanner.calibration.calibration_file import as_text, calibration_dict  # noqa: PLC0415
    from scanner.calibration.pictures import draw  # noqa: PLC0415
    from scanner.storage import replace_file  # noqa: PLC0415

    if response is not None:
        solution = replace(solution, response=response)
    content = calibration_dict(solution)
    replace_file(drawing, draw(solution))
    replace_file(result, as_text(content).encode())
    return content, drawing


def _named_in_rig(rig: str | None, result: Path, *, write: bool) -> None:
    from service.rig_file_edit import set_values  # noqa: PLC0415

    if write and rig is not None:
        kept = set_values(Path(rig), "rig", {"calibration": str(result.absolute())})
        say(f"{rig} names this calibration now; what it was before is in {kept}")
    else:
        say(f'to use it, in the rig file:\n[rig]\ncalibration = "{result.absolute()}"')


# --- the terminal -------------------------------------------------------------------------------------------------


def say(words: str) -> None:
    """A line that stays, on standard error."""
    clear_line()
    print(words, file=sys.stderr, flush=True)


def draw_line(words: str) -> None:
    """The line that is drawn in place of the one before; nothing where standard error is no terminal."""
    if sys.stderr.isatty():
        print(f"\r\x1b[2K{words[: shutil.get_terminal_size().columns - 1]}", end="", file=sys.stderr, flush=True)


def clear_line() -> None:
    """Take the drawn line away."""
    if sys.stderr.isatty():
        print("\r\x1b[2K", end="", file=sys.stderr, flush=True)
