"""`fringed calibrate target`: a calibration target as an SVG file to print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.calibrate_solve import TARGET_HELP, Replace
from service.commands.options import AsJson, output_path, require_free
from service.terminal import print_error, print_facts, print_json

if TYPE_CHECKING:
    from scanner.calibration.targets import Target

LEAST_CONTRAST = 0.5
"""Of black on white: a point is as unsure as contrast is small, and below 0.3 of it a ChArUco board loses markers at
a quarter of full light; half leaves room for both"""


def target(
    spec: Annotated[str, typer.Argument(metavar="TARGET", help=TARGET_HELP)],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", parser=output_path, help="SVG file to write.")
    ],
    grey: Annotated[
        float,
        typer.Option(
            metavar="SHARE", min=0, max=0.8, help="Lightness of the dark parts, 0 .. 0.8; fringes show on grey."
        ),
    ] = 0.0,
    force: Replace = False,
    as_json: AsJson = False,
) -> int:
    """Draw a target to print at 100 %, with a ruler that shows whether it was.

    The drawing is as large as the target, half a square of margin, and a ruler below: the answer names the page for it.

    Dark grey squares (--grey 0.35) keep the fringes visible on them, which helps the projector's half of the
    calibration; markers are found on black best.

    \b
    Examples:
      fringed calibrate target chessboard:9x6:30 -o scans/chessboard.svg --grey 0.35
      fringed calibrate target charuco:10x7:30 -o scans/charuco.svg         330 x 262 mm: A3
      fringed calibrate target charuco:10x7:22 -o scans/charuco-a4.svg      242 x 198 mm: A4
      fringed calibrate target acircles:4x11:20 -o scans/dots.svg
    """
    if output.suffix != ".svg":
        raise typer.BadParameter(f"-o: expected a name that ends in .svg, got {str(output)!r}")
    require_free(output, force=force)
    from scanner.calibration.target_svg import target_svg  # noqa: PLC0415
    from scanner.calibration.targets import parse_target  # noqa: PLC0415
    from scanner.storage import replace_file, storage_errors  # noqa: PLC0415

    chosen = parse_target(spec)
    drawing = target_svg(chosen, grey)
    with storage_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
    replace_file(output, drawing.text.encode())
    first, last = chosen.longest
    contrast = 1 - grey
    facts: dict[str, Any] = {
        "file": str(output),
        "paper_mm": [round(drawing.width_mm, 3), round(drawing.height_mm, 3)],
        "page": drawing.page,
        "ruler_mm": drawing.ruler_mm,
        "length_mm": chosen.longest_mm,
    }
    warnings = _of_grey(chosen, contrast)
    if as_json:
        print_json(
            {
                **facts,
                "points": len(chosen.points),
                "between": [first, last],
                "contrast": round(contrast, 4),
                "warnings": warnings,
            }
        )
        return 0
    print_facts(
        "target",
        [
            ("file", output),
            ("paper", f"{drawing.width_mm:g} x {drawing.height_mm:g} mm: {drawing.page or 'larger than A0'}"),
            ("print", "at 100 %, no fitting to the page"),
            ("check", f"the ruler must be {drawing.ruler_mm:g} mm long"),
            ("measure", f"first to last point of the longest row, nominally {chosen.longest_mm:g} mm (--length)"),
            *([] if grey == 0 else [("contrast", _contrast(contrast))]),
        ],
    )
    for said in warnings:
        print_error(said, label="warning")
    return 0


def _contrast(contrast: float) -> str:
    return (
        f"{contrast:.0%} of black on white: points in the camera are {1 / contrast:.1f} times as unsure, and fringes "
        "show on the dark parts; printers make grey of dots: look whether edges are straight"
    )


def _of_grey(target: Target, contrast: float) -> list[str]:
    """What a grey print is not good for."""
    found = []
    if contrast < LEAST_CONTRAST:
        found.append(
            f"dark parts of {1 - contrast:.0%} lightness leave {contrast:.0%} of the contrast: in poor light the "
            "target is not found; --grey 0.35 shows fringes as well"
        )
    if target.kind == "charuco" and contrast < 1:
        found.append(
            "the markers are grey, too, and the first to be lost in poor light: a chessboard has none "
            "(chessboard:COLUMNSxROWS:MM), and black ones (without --grey) are found best"
        )
    return found
