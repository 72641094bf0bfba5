"""`fringed audit`: verifies from a capture's folder alone which frame saw which pattern, and draws the timing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands.calibrate_solve import Replace
from service.commands.options import AsJson, output_path, require_free
from service.terminal import print_error, print_facts, print_json, print_table, progress_lines

if TYPE_CHECKING:
    from scanner.sequencer import CaptureCheck
    from scanner.sequencer.findings import Witness

BLIND, SEES = "this sequence cannot reveal", "this sequence can reveal"
ALL = "all that its witnesses look for: frames swapped, doubled, late or left out"


def audit(
    capture: Annotated[
        Path, typer.Argument(metavar="CAPTURE", help="A capture's or a scan's folder, or capture.json.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", parser=output_path, help="Draw the timing diagram: .svg or .png."
        ),
    ] = None,
    force: Replace = False,
    as_json: AsJson = False,
) -> int:
    """Verify a capture again: stamps and content of every frame against the plan.

    A verdict for each frame, by its time stamps; one for each witness, which looks at the pictures (black and white
    frames, fringes, order bars); and what this sequence could not have revealed. Exit status 1 if anything speaks
    against a frame; the message names it.

    \b
    Examples:
      fringed audit scan
      fringed audit scan -o scans/timing.svg
    """
    if output is not None and output.suffix not in (".svg", ".png"):
        raise typer.BadParameter(f"-o: expected a name that ends in .svg or .png, got {str(output)!r}")
    require_free(output, force=force)
    with progress_lines() as lines:
        lines.stage("reading frames")
        from scanner.capture import Capture  # noqa: PLC0415
        from scanner.sequencer import check_capture, timing_diagram  # noqa: PLC0415
        from scanner.storage import replace_file  # noqa: PLC0415

        check = check_capture(Capture.open(capture))
        if output is not None:
            lines.stage("drawing")
            replace_file(output, timing_diagram(check, output.suffix.removeprefix(".")))
    if as_json:
        print_json({"capture": str(capture), "diagram": output and str(output), **check.as_dict()})
    else:
        _show(check, output)
    if not check.passed:
        print_error(f"frames and patterns are out of step; concerned: {check.concerned or 'no frame in particular'}")
    return 0 if check.passed else 1


def _show(check: CaptureCheck, diagram: Path | None) -> None:
    sequence = check.capture.header.sequence
    count = len(sequence)
    print_table(
        "frames",
        ("pattern", "shows", "by time stamps", "by pictures", "reasons"),
        (
            (
                v.pattern,
                sequence.role(p := v.pattern % count).value,
                v.verdict,
                _picture(check, p),
                "; ".join(v.reasons),
            )
            for v in check.verdicts
        ),
    )
    print()
    if witnesses := check.witnesses.items:
        print_table("witnesses", ("witness", "verdict", "says"), ((w.name, _verdict(w), w.says) for w in witnesses))
        print()
    facts = [("capture", str(check.capture.path))]
    facts += [("frames", f"{len(check.capture.records)} of {check.capture.header.frame_count}")]
    facts += [("by time stamps", ", ".join(f"{number} {verdict}" for verdict, number in check.summary().items()))]
    if check.witnesses.items:
        against = check.witnesses.suspects
        facts += [("by pictures", f"{len(against)} of {count} contradicted" if against else "none contradicted")]
    facts += [(BLIND, text) for text in check.witnesses.cannot_reveal] or [(SEES, ALL)]
    if diagram is not None:
        facts.append(("diagram", str(diagram)))
    print_facts("audit", facts)


def _picture(check: CaptureCheck, position: int) -> str:
    """What the pictures say of one frame, in a word or two."""
    witnesses = check.witnesses
    if against := check.against(position):
        return f"against: {', '.join(against)}"
    if not witnesses.items:
        return "not asked"
    return "order in doubt" if witnesses.whole else "nothing against"


def _verdict(witness: Witness) -> str:
    """What one witness says, in a word or two."""
    from scanner.sequencer.findings import listed  # noqa: PLC0415

    if witness.passed:
        return "agrees"
    return f"against frames {listed(witness.frames)}" if witness.frames else "against all"
