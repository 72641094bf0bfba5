"""The terminal's side of `fringed calibrate run`, with no device: keys, lines, and when the loop ends."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scanner import client as client_module
from scanner.calibration.grey_levels import LevelResponse
from scanner.calibration.guide import Guide, Seen
from scanner.calibration.response import Response
from scanner.calibration.sight import Sight, Standing
from scanner.calibration.targets import parse_target
from scanner.client import Client
from scanner.clock import VirtualClock
from scanner.errors import StorageError, Unreachable
from scanner.patterns.sequence import Precorrection
from service.commands import calibrate_run
from service.config import load_rig
from service.guided_calibration import require_own
from service.keys import Keys, keys
from service.response_check import checked
from service.response_measure import first_response
from service.rig_file_edit import set_values
from tests.unit.simulated_bench import Bench

TARGET = parse_target("chessboard:9x6:19")
SIZE = (320, 240)


@pytest.mark.parametrize(
    ("there", "taken"), [("mcp.py", False), ("calibrate.png", True), ("poses", True), (None, True)]
)
def test_a_run_goes_into_an_empty_folder_or_one_of_its_own(tmp_path: Path, there: str | None, taken: bool) -> None:
    if there is not None:
        (tmp_path / there).touch()
    if taken:
        require_own(tmp_path, "calibrate.png")
        return
    with pytest.raises(StorageError, match="is not empty") as refused:
        require_own(tmp_path, "calibrate.png")
    assert "another -o DIR" in str(refused.value.hint)


class Pressed(Keys):
    """Somebody who presses these keys, one each time one is looked for."""

    def __init__(self, pressed: str) -> None:
        super().__init__(0)
        self._coming = list(pressed)

    def pressed(self) -> str:
        return self._coming.pop(0).strip(" ") if self._coming else ""


class Session:
    """A guided calibration whose camera sees what it is told to, twice a second."""

    def __init__(self, *sights: Sight | str, guide: Guide | None = None) -> None:
        self.observations: list[Any] = []
        self.guide = guide or Guide(TARGET, SIZE)
        self._sights = list(sights)
        self._t_s = 0.0

    def see(self, timeout_s: float) -> tuple[np.ndarray, Sight | str, float]:
        self._t_s += 0.5
        seen = self._sights.pop(0) if len(self._sights) > 1 else self._sights[0]
        return np.zeros(SIZE[::-1], np.uint8), seen, self._t_s

    def capture(self, on_event: Any) -> tuple[bool, str]:
        self.observations.append(self._t_s)
        return True, f"captured at {self._t_s}"

    def undo(self) -> str | None:
        return f"{self.observations.pop()}" if self.observations else None

    def response(self) -> str:
        return "no fringes here"


def sight_at(x: float, trouble: str | None = None) -> Sight:
    points = TARGET.points[:, :2] + np.array([100.0 + x, 100.0])
    return Sight(np.arange(len(points)), points, Standing(10.0, "left", 700.0), trouble)


def loop(session: Session, folder: Path, pressed: Keys, *, auto: bool = False, poses: int = 3) -> None:
    asked = calibrate_run._Asked(folder, folder / "live.png", poses, auto)
    calibrate_run._Loop(session, asked, pressed).run()  # type: ignore[arg-type]  a session as far as the loop asks


def test_keys_capture_take_back_and_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = Session(sight_at(0))
    loop(session, tmp_path, Pressed("u \n\nu\nq\n"))
    assert len(session.observations) == 2
    said = capsys.readouterr().err
    assert "no pose to take back" in said
    assert "pose 2: captured" in said
    assert "is taken back" in said
    assert "response: not told (no fringes here)" in said
    assert (tmp_path / "live.png").stat().st_size > 1000


def test_what_is_not_seen_is_not_captured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = Session("no chessboard in the picture")
    loop(session, tmp_path, Pressed(" \nq"))
    assert session.observations == []
    assert "not captured: no chessboard in the picture" in capsys.readouterr().err


def test_by_itself_it_waits_until_the_target_stands_still_in_a_good_new_pose(tmp_path: Path) -> None:
    earlier = sight_at(0)
    guide = Guide(TARGET, SIZE, (Seen("01", earlier.ids, earlier.points),))
    moving = [sight_at(20.0 + 5 * k) for k in range(4)]
    session = Session(
        *[earlier] * 4, *[sight_at(90, "too tilted")] * 4, "not seen", *moving, *[sight_at(60)] * 20, guide=guide
    )
    loop(session, tmp_path, Keys(None), poses=1)
    # Thirteen looks in vain, then one that begins a second and two that complete it.
    assert session.observations == [0.5 * 16]


def test_with_nobody_there_it_ends_when_nothing_new_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(calibrate_run, "PATIENCE_S", -1.0)
    session = Session("the picture is dark")
    loop(session, tmp_path, Keys(None))
    assert "the picture is dark" in capsys.readouterr().err


def test_with_nobody_there_it_says_now_and_then_what_it_waits_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = itertools.count()
    monkeypatch.setattr(calibrate_run.time, "monotonic", lambda: float(next(now_s)))
    loop(Session("the picture is dark"), tmp_path, Keys(None))
    said = [line for line in capsys.readouterr().err.splitlines() if "no new pose" in line]
    assert said[0] == "no new pose for 11 s (ends after 60): the picture is dark"
    assert len(said) == 6
    assert said[-1] == "no new pose for 60 s: the picture is dark"


def test_keys_come_one_by_one_from_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    host, terminal = os.openpty()
    try:
        with os.fdopen(terminal, "r") as stdin:
            monkeypatch.setattr(sys, "stdin", stdin)
            with keys() as pressed:
                assert pressed.there
                assert pressed.pressed() == ""
                os.write(host, b"U\n")
                assert [pressed.pressed(), pressed.pressed(), pressed.pressed()] == ["u", "\n", ""]
    finally:
        os.close(host)


def test_a_calibration_is_named_in_the_rig_file(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text('[rig]\nname = "bench"  # ours\n[camera]\ndriver = "simulated"\n[projector]\ndriver = "simulated"\n')
    named = tmp_path / 'a "quoted" name.json'
    named.write_text("{}")
    set_values(rig, "rig", {"calibration": str(named)})
    assert rig.read_text().splitlines()[:3] == [
        "[rig]",
        f'calibration = "{tmp_path}/a \\"quoted\\" name.json"',
        'name = "bench"  # ours',
    ]


@pytest.mark.parametrize(("walk", "moves"), [("true", True), ("false", False)])
def test_a_simulated_target_walks_once_a_sequence_was_shown(walk: str, moves: bool) -> None:
    bench = Bench(f"quick/chessboard_poses?walk={walk}&pose=11")
    world = bench.camera._world
    before = world.view
    for images in (9, 1):
        bench.greys(*range(10, 10 + images))
        assert world.view is before  # what was shown before was one image, or nothing
        for index in range(images):
            bench.steady(index)
        if images == 9:
            bench.greys(255)
            assert (world.view is not before) == moves
            before = world.view


def test_a_capture_of_which_nothing_is_heard_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon that answers and has no news, for ever."""
    client = Client.__new__(Client)
    now = iter(float(second) for second in range(1000))
    asked: list[str] = []

    def answer(method: str, **_: Any) -> dict[str, Any]:
        asked.append(method)
        return {"number": len(asked), "state": "decoding"}

    monkeypatch.setattr(client_module, "time", SimpleNamespace(monotonic=lambda: next(now)))
    monkeypatch.setattr(client, "_subscribe", lambda: None)
    monkeypatch.setattr(client, "_next_event", lambda _: None)
    monkeypatch.setattr(client, "call", answer)
    heard: list[str] = []
    with pytest.raises(Unreachable, match="no news of scan one for 20 s"):
        client.wait("one", lambda event: heard.append(event.kind), patience_s=20.0)
    assert heard == ["decoding"]
    assert len(asked) > 3


def levels_of(gamma: float, sigma: float = 0.002) -> LevelResponse:
    return LevelResponse(gamma, sigma, 0.002, (0.0, 1.0), (0, 128, 255), (0.0, 0.2, 1.0), 500)


def test_what_grey_levels_told_stays_and_the_first_pose_checks_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Told(Session):
        def response(self) -> Response:
            return Response(1.6, 0.01, 1.6, 0.4, 0.1, 0.01, 900)

    asked = calibrate_run._Asked(tmp_path, tmp_path / "live.png", 3, False)
    looped = calibrate_run._Loop(Told(sight_at(0)), asked, Pressed("  \nq"), levels_of(2.2))  # type: ignore[arg-type]
    assert looped.response == {"gamma": 2.2}
    looped.run()
    assert looped.response == {"gamma": 2.2}
    said = capsys.readouterr().err
    assert "to the power of 1.600 +- 0.036 (k = 2); the file has what grey levels told" in said
    assert "fringes contradict grey levels: they should have told 2.200, and 0.600 is more" in said


def test_a_pose_that_is_taken_back_takes_its_response_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Told(Session):
        exponents: Sequence[float] = (1.6, 1.9, 1.6)

        def response(self) -> Response:
            exponent, *Told.exponents = Told.exponents
            return Response(exponent, 0.002, exponent, 0.4, 0.1, 0.01, 900)

    asked = calibrate_run._Asked(tmp_path, tmp_path / "live.png", 3, False)
    looped = calibrate_run._Loop(Told(sight_at(0)), asked, Pressed(" \nu\nq"), None)  # type: ignore[arg-type]
    looped.run()
    assert looped.response == {"gamma": 1.9, "table": None}
    looped = calibrate_run._Loop(Told(sight_at(0)), asked, Pressed(" \nuq"), None)  # type: ignore[arg-type]
    looped.run()
    assert looped.response is None


def test_why_a_capture_was_not_kept_is_the_last_word(tmp_path: Path) -> None:
    class Refusing(Session):
        def capture(self, on_event: Any) -> tuple[bool, str]:
            return False, "out of step"

    asked = calibrate_run._Asked(tmp_path, tmp_path / "live.png", 3, False)
    looped = calibrate_run._Loop(Refusing(sight_at(0)), asked, Pressed(" \nq"))  # type: ignore[arg-type]
    assert looped.last_line() == "no picture of the camera yet"
    looped.run()
    assert looped.last_line() == "the last capture was not kept: out of step"


@pytest.mark.parametrize(
    ("exponent", "given", "levels", "contradicted"),
    [
        (1.885, 1.0, 1.9, False),
        (0.99, 1.9, 1.9, False),
        (0.99, None, 1.9, False),  # projected through a table
        (0.818, 2.3, 1.9, False),  # the rig claimed 2.3, it is 1.9
        (1.1, 1.9, 1.9, True),
        (1.1, None, 1.9, True),
        (1.7, 1.0, 1.9, True),
    ],
)
def test_fringes_are_held_against_what_levels_leave_for_them(
    exponent: float, given: float | None, levels: float, contradicted: bool
) -> None:
    found = Response(exponent, 0.003, None if given is None else given * exponent, 0.1, 0.1, 0.01, 900)
    response, lines = checked(found, levels_of(levels))
    assert response is None
    assert ["contradict" in line for line in lines[1:]] == [True] * contradicted


@pytest.mark.parametrize(
    ("exponent", "given", "response", "said"),
    [
        (0.99, 1.0, None, "nothing to correct"),
        (2.25, 1.0, {"gamma": 2.25, "table": None}, "as nothing tells it better"),
        (0.99, 1.9, None, "gamma 1.900, which stays"),
        (0.807, 2.3, None, "fringes contradict gamma 2.300 by 0.193: measure grey levels"),
        (0.807, None, None, "fringes contradict a table by 0.193"),
    ],
)
def test_without_levels_fringes_never_overrule_what_the_rig_claims(
    exponent: float, given: float | None, response: dict[str, Any] | None, said: str
) -> None:
    found = Response(exponent, 0.003, None if given is None else given * exponent, 0.1, 0.1, 0.01, 900)
    told, lines = checked(found, None)
    assert told == response
    assert said in lines[-1]


def test_what_the_poses_lack_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = sight_at(0)
    guide = Guide(TARGET, SIZE, (Seen("01", one.ids, one.points),))
    calibrate_run._say_lacking(guide)
    said = capsys.readouterr().err
    assert said.startswith("not met of what a calibration asks for: ")
    assert "depths of the target's middle span 0.0% of the first pose's (15% are asked)" in said
    assert f"no points in {9 - int(guide.fields().sum())} of 9 fields" in said
    calibrate_run._say_lacking(guide, simulated=True)
    assert "other ones with seed=N" in capsys.readouterr().err
    calibrate_run._say_lacking(None)
    assert capsys.readouterr().err == ""


def test_the_response_is_measured_before_the_first_pose(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(
        '[camera]\ndriver = "simulated"\ndevice = "quick/board"\n[projector]\ndriver = "simulated"\n'
        'device = "quick/board"\n'
    )
    config, stages = load_rig(str(file)), list[str]()
    words = first_response(config, VirtualClock(), stages.append)[1]
    assert "which agrees with the rig's calibration (gamma 2.3000)" in words
    assert " (k = 2), by " in words
    claims = SimpleNamespace(precorrection=Precorrection(gamma=1.8))
    monkeypatch.setattr("service.scan_setup.OpenRig.known", claims)
    found, words = first_response(config, VirtualClock(), stages.append)
    assert found is not None
    assert found.gamma == pytest.approx(2.3, abs=0.03)
    assert words.endswith("scans will undo it: the rig's calibration is wrong, it has gamma 1.8000")
    unknown = SimpleNamespace(precorrection=None)
    monkeypatch.setattr("service.scan_setup.OpenRig.known", unknown)
    found, words = first_response(config, VirtualClock(), stages.append)
    assert found is not None
    assert found.gamma == pytest.approx(2.3, abs=0.03)
    assert words.endswith("grey levels on what is in view; scans will undo it")
    assert stages[-1] == "measuring levels"
    monkeypatch.setattr("service.response_measure.LEVELS", (0, 255))
    words = first_response(config, VirtualClock(), stages.append)[1]
    assert words.startswith("response: not told by grey levels (")
    assert words.endswith("the first pose's fringes will")
    monkeypatch.setattr("service.scan_setup.OpenRig.known", claims)
    assert first_response(config, VirtualClock(), stages.append)[1].endswith("what the rig's calibration has stays")
