"""The words of a scan or live run before its job is taken: nonsense is refused by name, the same is the same job."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import msgpack
import pytest

from scanner.errors import ConfigError
from scanner.wire import LiveStart, Request, ScanStart, params_as
from service.door import refuse_endless, refuse_nonsense
from service.jobs import parameters_digest

ID = "0b3e3a52-9f0e-4c52-8a55-3f1d8f3b6a11"
SIZE = (1152, 864)


def asked(kind: type[ScanStart | LiveStart] = ScanStart, **params: Any) -> Any:
    """Parameters as they come off the wire."""
    words = msgpack.unpackb(msgpack.packb({"job_id": ID, **params}))
    return params_as(kind, Request(id=1, method="scan.start", params=words))


@pytest.mark.parametrize(
    ("params", "named"),
    [
        ({"method": "laser"}, "'laser'"),
        ({"decoder": "magic"}, "'magic'"),
        ({"method": "pmp", "decoder": "casey2011"}, "'casey2011'"),
        ({"exposure": -1.0}, "exposure -1"),
        ({"exposure": 0}, "exposure 0"),
        ({"exposure": float("nan")}, "exposure nan"),
        ({"exposure": 1e9}, "exposure 1e"),
        ({"repeat": 0}, "repeat"),
        ({"repeat": 1 << 40}, "repetitions"),
        ({"filters": {"depth": [9.0, 1.0]}}, "depth"),
        ({"filters": {"min_confidence": 2.0}}, "min_confidence"),
        ({"pattern": {"shifts": [2, 8, 8]}}, "shifts"),
        ({"pattern": {"shifts": [8]}}, "shifts"),
        ({"pattern": {"frequencies": [1, 500], "shifts": [4, 4]}}, "period"),
        ({"pattern": {"frequencies": [0.0]}}, "frequencies"),
        ({"pattern": {"frequencies": 8}}, "frequencies"),
        ({"pattern": {"frequencys": [8]}}, "frequencys"),
        ({"pattern": {"axes": ["z"]}}, "axes"),
        ({"pattern": {"method": "mcp"}}, "mcp"),
        ({"pattern": {"precorrection": {"gamma": 1e308}}}, "gamma"),
        ({"pattern": {"precorrection": {"gamma": 0}}}, "gamma"),
        ({"pattern": {"precorrection": {"table": [0, 1]}}}, "table"),
        ({"method": "mcp", "pattern": {"bits": 40}}, "bits"),
        ({"method": "mcp", "pattern": {"carriers": [1, 1e6]}}, "carriers|bits"),
        ({"method": "gray", "pattern": {"bits": 0}}, "bits"),
        ({"method": "gray+pmp", "pattern": {"frequencies": [4, 8]}}, "frequenc"),
    ],
)
def test_nonsense_is_refused_by_name(params: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        refuse_nonsense(asked(**params), SIZE)


def test_endless_patterns_are_refused_before_anybody_looks_closely() -> None:
    longest = {"frequencies": [1.5] * 341, "shifts": [3] * 341, "precorrection": {"table": [0.5] * 256}}
    refuse_endless(asked(pattern=longest))
    refuse_endless(asked())
    for endless in ([1] * 2048, [[1] * 30] * 80, {"a": [0] * 2048}, {str(k): k for k in range(2048)}):
        with pytest.raises(ConfigError, match="2048"):
            refuse_endless(asked(LiveStart, pattern={"codes": endless}))


def refusal(*params: Any) -> str:
    """What `refuse_nonsense` says, "" where it lets them pass."""
    try:
        refuse_nonsense(*params)
    except ConfigError as refused:
        return str(refused)
    return ""


@pytest.mark.parametrize("size", [None, SIZE])
@pytest.mark.parametrize("method", ["pmp", "mcp", "gray", "gray+pmp", "cp"])
def test_every_default_passes(method: str, size: tuple[int, int] | None) -> None:
    assert refusal(asked(method=method), size) == ""
    assert refusal(asked(method=method, exposure="auto", repeat=3), size, "x") == ""


def test_what_only_the_rig_can_tell_is_left_to_it() -> None:
    """A frequency that fits the projector's width and not its height, on a rig whose axis is not known here."""
    wide = asked(pattern={"frequencies": [1, 8, 120]})
    refuse_nonsense(wide, (640, 240))
    refuse_nonsense(wide)
    with pytest.raises(ConfigError, match="period"):
        refuse_nonsense(wide, (640, 240), "y")


def test_live_runs_are_asked_the_same() -> None:
    refuse_nonsense(asked(LiveStart), SIZE)
    with pytest.raises(ConfigError, match="bits"):
        refuse_nonsense(asked(LiveStart, pattern={"bits": 40}), SIZE)


DEFAULTS: dict[str, Any] = {
    "method": "pmp",
    "pattern": {"method": "pmp", "sign": -1.0, "offset": 0, "origin": 0.5, "precorrection": None},
    "exposure": None,
    "decoder": "default",
    "filters": {"edges": True, "max_angle_deg": 80, "min_fragment": 30, "depth": None, "min_confidence": 0},
    "compare_truth": False,
    "repeat": 1,
}


@pytest.mark.parametrize("member", [*DEFAULTS, None])
def test_defaults_spelled_out_are_the_same_job(member: str | None) -> None:
    said = DEFAULTS if member is None else {member: DEFAULTS[member]}
    assert parameters_digest(asked(**said)) == parameters_digest(asked())


def test_equal_numbers_are_the_same_job() -> None:
    one, other = ({"pattern": {"frequencies": f}, "exposure": e} for f, e in (([1, 8], 5000), ([1.0, 8.0], 5000.0)))
    assert parameters_digest(asked(**one)) == parameters_digest(asked(**other))


@pytest.mark.parametrize(
    "params",
    [
        {"method": "mcp"},
        {"pattern": {"sign": 1}},
        {"pattern": {"shifts": [4, 4, 4]}},
        {"exposure": 5000.0},
        {"filters": {"edges": False}},
        {"filters": {"min_fragment": 31}},
        {"compare_truth": True},
        {"repeat": 2},
    ],
)
def test_anything_else_is_another_job(params: dict[str, Any]) -> None:
    assert parameters_digest(asked(**params)) != parameters_digest(asked())


def test_a_live_run_is_never_a_scan() -> None:
    words = {"method": "mcp"}
    assert parameters_digest(asked(**words)) != parameters_digest(asked(LiveStart, **words))
    assert parameters_digest(asked(LiveStart, **words)) == parameters_digest(asked(LiveStart, stride=1, ring_s=10))


def test_the_daemon_loads_neither_kernels_nor_opencv_for_it() -> None:
    code = "import service.daemon, service.door, sys; print([m for m in ('cv2', 'numba', 'scipy') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert found.stdout.strip() == "[]"
