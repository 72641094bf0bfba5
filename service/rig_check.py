"""What of a rig file can be judged without opening a device, beyond its keys: options, modes, calibration, marks.

Each driver judges its own options, and the simulated ones their rigs and scenes too. What only a device can say (is it
there, does it have that pixel format) is `fringed doctor FILE`'s to find.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.registry import Kind, option_problems
from scanner.errors import CalibrationError, ConfigError, ScannerError
from service.config import KINDS, Problem, RigConfig, RigFile, load_rig, read_rig
from service.toml_lines import KeyPath

if TYPE_CHECKING:  # its kernels take a while to load, and few files that are checked name a calibration
    from scanner.geometry import Calibration

HALF_KNOWN = (
    "{known} without {unknown}: unless the driver declares the other, both are measured before the first scan and the "
    "one that is given is not used; fringed calibrate sync measures and writes both"
)


@dataclass(frozen=True)
class Examined:
    """A rig file, all that is wrong with it, and what is odd."""

    rig: RigConfig | None
    """None where there are problems"""
    problems: list[Problem]
    warnings: list[str]


def examine(path: Path) -> Examined:
    """Look at a rig file and at what it names; opens no device.

    Raises:
        ConfigError: the file cannot be read at all.
    """
    file = read_rig(path)
    calibration, found = _calibration(file)
    found += [*_marks(file), *_options(file), *_sizes(file, calibration)]
    problems = sorted([*file.problems, *found], key=lambda problem: problem.line or float("inf"))
    warnings = [f"{path}: {said}" for said in _odd(file, calibration)]
    return Examined(None if problems else file.rig, problems, warnings)


def examine_simulated(name: str) -> Examined:
    """Look at a built-in rig, `simulated[:DEVICE]`."""
    rig = load_rig(name)
    refused = [error for kind in KINDS[:2] for _, error in option_problems(kind, "simulated", rig.camera.device, {})]
    problems = [Problem(name, None, "", None, said) for said in dict.fromkeys(_said(error) for error in refused)]
    return Examined(None if problems else rig, problems, [])


def half_known(*, latency: bool, settle: bool) -> str | None:
    """What to say where one of a projector's two times is known and the other is not."""
    if latency == settle:
        return None
    names = ("latency_us", "settle_us") if latency else ("settle_us", "latency_us")
    return HALF_KNOWN.format(known=names[0], unknown=names[1])


def _calibration(file: RigFile) -> tuple[Calibration | None, list[Problem]]:
    named = file.sound("rig", "calibration")
    if named is None:
        return None, []
    from scanner.geometry import load_calibration  # noqa: PLC0415

    try:
        return load_calibration(_beside(file, named)), []
    except CalibrationError as error:
        return None, [file.problem(("rig", "calibration"), _said(error))]


def _marks(file: RigFile) -> Iterator[Problem]:
    named = file.sound("rig", "marks")
    if named is None:
        return
    from scanner.calibration.marks import load_marks  # noqa: PLC0415  (brings detection; few rigs have marks)

    try:
        load_marks(_beside(file, named))
    except CalibrationError as error:
        yield file.problem(("rig", "marks"), _said(error))


def _options(file: RigFile) -> Iterator[Problem]:
    """What drivers say of their device strings, options and modes."""
    for kind in KINDS:
        driver = file.sound(kind, "driver")
        if driver is None:
            continue
        device, options = file.sound(kind, "device"), dict(file.sound(kind, "options") or {})
        mode = file.sound("projector", "mode") if kind == "projector" else None
        if mode is not None:
            options["mode"] = mode
        try:
            refused = option_problems(kind, driver, device or "", options)
        except ConfigError as error:
            yield file.problem((kind, "driver"), _said(error))
            continue
        for option, refusal in refused:
            yield file.problem(_place(kind, option, of_mode=mode is not None), _said(refusal))


def _place(kind: Kind, option: str, *, of_mode: bool) -> KeyPath:
    if option == "":
        return (kind, "device")
    return (kind, "mode") if of_mode and option == "mode" else (kind, "options", option)


def _sizes(file: RigFile, calibration: Calibration | None) -> Iterator[Problem]:
    """A mode and a region that are not of the calibration's size."""
    if calibration is None:
        return
    mode, region = file.sound("projector", "mode"), file.sound("camera", "settings", "region")
    if mode is not None:
        size = tuple(int(part) for part in mode.partition("@")[0].split("x"))
        if size != calibration.projector.size:
            yield file.problem(("projector", "mode"), _other_size("projector", calibration.projector.size))
    if region is not None and tuple(region[2:]) != calibration.camera.size:
        yield file.problem(("camera", "settings", "region"), _other_size("camera", calibration.camera.size))


def _other_size(name: str, size: tuple[int, int]) -> str:
    return f"the calibration is for a {name} of {size[0]} x {size[1]}; calibrate anew, or write that size"


def _odd(file: RigFile, calibration: Calibration | None) -> Iterator[str]:
    """What works and is hardly meant."""
    yield from (f"rig.calibration: {said}" for said in (() if calibration is None else calibration.warnings))
    times = {name: file.sound("projector", f"{name}_us") is not None for name in ("latency", "settle")}
    if (said := half_known(**times)) is not None:
        yield f"projector: {said}"
    devices = [file.sound(kind, "device") for kind in KINDS if file.sound(kind, "driver") == "simulated"]
    if len({device or "" for device in devices}) > 1:
        shown = ", ".join(repr(device or "") for device in devices)
        yield f"simulated devices see one another only where their device strings mean the same; here: {shown}"


def _beside(file: RigFile, named: Any) -> Path:
    return file.path.absolute().parent / Path(str(named)).expanduser()


def _said(error: ScannerError) -> str:
    return f"{error}; {error.hint}" if error.hint else str(error)
