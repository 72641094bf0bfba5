"""Modified Composite Pattern: one image to projector rows, by the default decoder.

The pattern is Casey's (*Enhancements to the Modified Composite Pattern Method of Structured Light 3D Capture*,
University of Kentucky 2011, sec. 2.1). The decoder follows the dissertation's chain, with each hard decision made
soft:

    stripes        pitch from the columns' spectrum; peaks and valleys in every fourth column      4.1
    linking        peaks chained along the stripes; evidence passed along them                     (5.4 grows regions)
    tracks         short chains joined where print breaks a stripe up                              (not in the source)
    signals        brightness along the tracks                                                     4.3
    carriers       the magnification at which all carriers stand out                               4.3
    magnification  the same at each peak, as a smooth field                                        (4.3 has one for all)
    emissions      amplitude of each carrier over local brightness; likelihood of each stripe      4.4, 4.5
    coherent       the same against the phases that each stripe would give, on a calibrated rig     (not in the source)
    hmm            one model over both kinds of stripe: Viterbi and forward-backward               5.2, 5.3
    subpixel       the profile averaged along the stripe, its odd part fitted                      (not in the source)
    dense          rows between the stripes; all maps                                              2.1, 3.7

`locate` says whether the pattern is there at all; `decision` which stripe each peak is; `maps` what a pixel gets;
`decoder` puts them in order, `door` turns images and maps; `fits` and `both_ways` are the inner sums of emissions and
hmm. What the dissertation's own decoder does is named in each module; it is not this one.
"""

from __future__ import annotations

from scanner.decode.mcp import carriers, coherent, local_field, signals, tracks
from scanner.decode.mcp.decoder import McpDecoder, decode_image
from scanner.patterns import CameraFormat, McpPattern, ProjectorSize

__all__ = ["McpDecoder", "decode_image", "warm_up"]


def warm_up() -> None:
    """Call every kernel once with the types that frames have, so that no scan waits for a compiler."""
    projector = ProjectorSize(160, 128)
    pattern = McpPattern(bits=2, carriers=(20.0, 34.0), codes=(0, 1, 2, 3))
    light = pattern.fringe(0, projector)
    for bits in (8, 12):
        camera = CameraFormat(projector.width, projector.height, bits)
        frame = (10 + light * (0.8 * camera.max_value)).astype(camera.dtype)
        decode_image(frame, pattern, projector, camera)
    carriers.warm_up()
    coherent.warm_up()
    local_field.warm_up()
    signals.warm_up()
    tracks.warm_up()
