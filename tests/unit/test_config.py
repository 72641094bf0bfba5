"""Rig files: what is accepted, and how everything else is named with its file, line, key, value and expectation."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from textwrap import dedent
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulated.options import read_settings, setting_problems
from scanner.errors import ConfigError
from service.config import RigConfig, check_rig, load_rig
from service.rig_file_edit import set_values
from service.rig_model import (
    CameraConfig,
    CameraSettingsConfig,
    DaemonConfig,
    ProjectorConfig,
    RetentionConfig,
    RigSettings,
    TriggerConfig,
)
from service.toml_lines import key_lines
from service.toml_text import to_toml

WHOLE = """
[rig]
name = "bench"
calibration = "calibration.json"
phase_axis = "x"

[camera]
driver = "simulated"
device = "bench2026/bust"
settings = { exposure_us = 16667, gain_db = 3, region = [0, 0, 640, 480], trigger_mode = "free" }
options.seed = 4

[projector]
driver = "simulated"
device = "bench2026/bust"
mode = "1920x1080@60"
latency_us = [3000, 5000]
settle_us = 800.5
dwell = 2
mirror = true
rotate = 180

[projector.options.nested]
deep = ["a", { b = 1.5 }]

[trigger]
driver = "simulated"

[daemon]
endpoint = "ipc:///tmp/here.ipc"
spool = "spool"
spool_limit_gb = 20
client_keys = "keys"
workers = 0

[daemon.retention]
max_age_days = 7
min_free_gb = 0
"""


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    (tmp_path / "calibration.json").write_text("{}")
    return tmp_path / "rig.toml"


def refusal(path: Path, text: str) -> str:
    path.write_text(dedent(text).lstrip())
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    return str(caught.value)


def test_every_key_is_read(rig_file: Path) -> None:
    rig_file.write_text(WHOLE.replace('[trigger]\ndriver = "simulated"\n', ""))
    rig = load_rig(rig_file)
    assert rig.rig.calibration == rig_file.parent / "calibration.json"
    assert rig.camera.settings.exposure_us == 16667
    assert rig.camera.settings.region == (0, 0, 640, 480)
    assert rig.camera.options == {"seed": 4}
    assert rig.projector.latency_us == (3000, 5000)
    assert rig.projector.settle_us == (800.5, 800.5)
    assert rig.projector.options == {"nested": {"deep": ["a", {"b": 1.5}]}}
    assert rig.daemon.spool == rig_file.parent / "spool"
    assert (rig.daemon.workers, rig.daemon.retention.max_age_days) == (0, 7)


def test_a_rig_written_out_reads_back_the_same(rig_file: Path, tmp_path: Path) -> None:
    rig_file.write_text(WHOLE.replace('[trigger]\ndriver = "simulated"\n', ""))
    rig = load_rig(rig_file)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "copy.toml").write_text(rig.as_toml())
    assert load_rig(elsewhere / "copy.toml") == rig


def test_the_least_that_a_rig_file_needs(rig_file: Path) -> None:
    rig_file.write_text('camera.driver = "simulated"\nprojector.driver = "simulated"\n')
    rig = load_rig(str(rig_file))
    assert rig.rig.name == "rig"
    assert rig.camera.settings.exposure_us is None
    assert rig.daemon.workers == 1


@pytest.mark.parametrize(
    ("name", "device"),
    [
        ("simulated", "casey2011/bust"),
        ("simulated:", "casey2011/bust"),
        ("simulated:quick/board?seed=3", "quick/board?seed=3"),
    ],
)
def test_the_built_in_rig(name: str, device: str) -> None:
    rig = load_rig(name)
    assert (rig.camera.driver, rig.camera.device, rig.projector.device) == ("simulated", device, device)


def test_all_errors_come_at_once_in_order_of_lines(rig_file: Path) -> None:
    said = refusal(
        rig_file,
        """
        [rig]
        calibratoin = "c.json"
        phase_axis = "z"
        [camera]
        device = 5
        exposure_us = 3
        settings = { exposure_us = -5, "gain_db" = "hi" }
        [projector]
        driver = "simulated"
        latency_us = [
            5,
            3,
        ]
        [oven]
        heat = true
        """,
    )
    lines = said.splitlines()
    assert [line.split(": ")[0].rpartition(":")[2] for line in lines] == ["2", "3", "4", "5", "6", "7", "7", "10", "14"]
    assert all(line.startswith(str(rig_file)) for line in lines)
    assert "rig.calibratoin: unknown key; did you mean 'calibration'?" in lines[0]
    assert 'rig.phase_axis = "z": expected "x"' in lines[1]
    assert "camera.driver: is missing" in lines[2]
    assert "camera.exposure_us: unknown key; it belongs into [camera.settings]" in lines[4]
    assert "camera.settings.exposure_us = -5: expected exposure time in microseconds" in lines[5]
    assert 'camera.settings.gain_db = "hi": expected gain in dB, 0 .. 48' in lines[6]
    assert "projector.latency_us = [5, 3]" in lines[7]
    assert "oven: unknown key; known here: rig, camera" in lines[8]


@pytest.mark.parametrize(
    ("table", "line", "expected"),
    [
        ("camera.settings", "exposure_us = true", "exposure time in microseconds"),
        ("camera.settings", "exposure_us = nan", "exposure time in microseconds"),
        ("camera.settings", 'exposure_us = "automatic"', '"auto"'),
        ("camera.settings", "region = [0, 0, 640]", "[x, y, width, height]"),
        ("camera.settings", "region = [0, 0, 640, -1]", "[x, y, width, height]"),
        ("camera.settings", 'trigger_mode = "hard"', '"software" or "free"'),
        ("projector", 'mode = "big"', "1920x1080@60"),
        ("projector", "settle_us = inf", "microseconds"),
        ("projector", "settle_us = [24000, 20000]", "the wrong way round: a range is [low, high]"),
        ("projector", "dwell = 1.5", "refreshes"),
        ("projector", "rotate = 90", "upside down"),
        ("projector", "options = 3", "driver's own options"),
        ("daemon", 'endpoint = "tcp://127.0.0.1:5000"', "no TCP"),
        ("daemon", f'endpoint = "ipc:///{"x" * 100}"', "100 bytes"),
        ("daemon", f'endpoint = "ipc:///{"ä" * 50}"', "100 bytes"),
        ("daemon", 'endpoint = "ipc://x"', "absolute path"),
        ("daemon", 'spool = "~nobodyx/x"', "path of the folder"),
        ("daemon", 'spool = "/dev/null"', "is not a folder"),
        ("rig", 'calibration = "~nobodyx/x"', "path of a calibration"),
        ("rig", f'calibration = "{"x" * 5000}"', "File name too long"),
        ("camera", "settings.region = [0, 0, 0, 0]", "1 or more"),
        ("daemon", "workers = -1", "0 .. 64"),
        ("daemon", "spool_limit_gb = 0", "more than 0"),
        ("daemon", "retention = 5", "[daemon.retention]"),
    ],
)
def test_values_out_of_bounds_say_what_was_expected(rig_file: Path, table: str, line: str, expected: str) -> None:
    head = 'camera.driver = "simulated"\nprojector.driver = "simulated"\n'
    said = refusal(rig_file, f"{head}{table}.{line}\n")
    assert said.startswith(f"{rig_file}:3: {table}.{line.split(' = ', maxsplit=1)[0]} = ")
    assert expected in said
    assert len(said.splitlines()) == 1


def test_what_a_rig_names_must_be_there(rig_file: Path) -> None:
    said = refusal(
        rig_file,
        """
        rig.calibration = "lost.json"
        camera.driver = "simulatd"
        projector.driver = "simulated"
        """,
    )
    assert f"{rig_file}:1: rig.calibration" in said
    assert f"{rig_file}:2: camera.driver = \"simulatd\": no camera driver named 'simulatd'; did you mean" in said


def test_files_that_are_no_rig_files(rig_file: Path, tmp_path: Path) -> None:
    assert f"{rig_file}:2:8: TOML:" in refusal(rig_file, "[rig]\nname = \n")
    assert "nested too deeply" in refusal(rig_file, "a = " + 3000 * "[" + 3000 * "]")
    assert "nested too deeply" in refusal(rig_file, "a = " + 3000 * "[")
    for content, expected in ((b"\xff\xfe\x00", "UTF-8"), (b"#" * (1 << 21), "larger")):
        rig_file.write_bytes(content)
        with pytest.raises(ConfigError, match=expected):
            load_rig(rig_file)
    with pytest.raises(ConfigError, match="no rig file"):
        load_rig(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="directory"):
        load_rig(tmp_path)


def test_a_byte_order_mark_is_no_text(rig_file: Path) -> None:
    rig_file.write_bytes(b"\xef\xbb\xbf" + b'[camera]\ndriver = "simulated"\n[projector]\ndriver = "simulated"\n')
    assert load_rig(rig_file).camera.driver == "simulated"
    set_values(rig_file, "camera", {"device": "quick/board"})
    assert load_rig(rig_file).camera.device == "quick/board"


def test_problems_are_plain_data(rig_file: Path) -> None:
    rig_file.write_text("camera.driver = 4\n")
    rig, problems = check_rig(rig_file)
    assert rig is None
    assert [(problem.line, problem.key, problem.value) for problem in problems] == [
        (1, "camera.driver", 4),
        (None, "projector", None),
    ]


def test_the_example_rig_file_is_a_good_one() -> None:
    example = Path(__file__).parents[2] / "docs" / "examples" / "rig.toml"
    assert load_rig(example).projector.driver == "simulated"
    words = set(re.findall(r"^(?:# )?(\w+) = ", example.read_text(), flags=re.MULTILINE))
    models = (
        RigSettings,
        CameraConfig,
        CameraSettingsConfig,
        ProjectorConfig,
        TriggerConfig,
        DaemonConfig,
        RetentionConfig,
    )
    assert {key for model in models for key in model.model_fields} - words == {"settings", "options", "retention"}


def test_processes_start_without_array_libraries() -> None:
    heavy = "import sys, service.config; print(sorted({'numpy', 'numba', 'cv2', 'scipy'} & set(sys.modules)))"
    ran = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


# --- lines of keys ------------------------------------------------------------------------------------------------


def test_lines_of_keys_in_every_notation() -> None:
    text = dedent(
        '''
        top = """
        [not.a.table]
        x = 1 \\
        """  # comment [no]
        'quo.ted' . "key" = [ # first
            1, "]", [2,
            3], { a = "}", b.c = \'\'\'
        x''\'\'\' },
        ]
        [ "a" . b ]  # = x
        c = 2026-01-01T00:00:00Z
        [[list]]
        n = 1
        [[list]]
        n = 2
        [list.sub]
        m = \'it\\'
        '''
    ).lstrip()
    tomllib.loads(text)
    lines = key_lines(text)
    assert lines[("top",)] == 1
    assert lines[("quo.ted", "key")] == 5
    assert lines[("quo.ted", "key", 0)] == 6
    assert lines[("quo.ted", "key", 2, 1)] == 7
    assert lines[("quo.ted", "key", 3, "b", "c")] == 7
    assert lines[("a", "b", "c")] == 11
    assert lines[("list", 1, "n")] == 15
    assert lines[("list", 1, "sub", "m")] == 17
    assert len([path for path in lines if path[0] == "top"]) == 1


scalars = st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
values = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3), max_leaves=10
)


def paths(value: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, inner in items for found in ((*path, key), *paths(inner, (*path, key)))]


@given(st.dictionaries(st.text(), values, max_size=4))
def test_written_tables_read_back_and_every_key_has_a_line(content: dict[str, Any]) -> None:
    text = to_toml(content)
    assert tomllib.loads(text) == content
    lines = key_lines(text)
    assert set(paths(content)) <= set(lines)
    assert set(lines.values()) <= set(range(1, text.count("\n") + 2))


def test_the_model_describes_every_field() -> None:
    def undescribed(model: type[Any]) -> list[str]:
        return [name for name, field in model.model_fields.items() if not field.description]

    assert undescribed(RigConfig) == []


@pytest.mark.parametrize("side", ["camera", "projector"])
def test_a_device_string_with_endless_options_is_refused_at_once(side: Literal["camera", "projector"]) -> None:
    device = "quick/board?" + "&".join(["a=1"] * 20_000)
    for problem in [error for _, error in setting_problems(device, {}, side)]:
        assert "more than 200" in problem.message
    with pytest.raises(ConfigError, match="more than 200"):
        read_settings(device, {}, side)
