"""The published MCP decoder as a reference: C. J. Casey, University of Kentucky 2011, chapters 4 and 5.

    refusals           what is no pattern, or another one
    stripe_detection   adaptive threshold in two passes, peaks to the pixel      4.1
    inclination        slope of the stripes, segments, rotation                  4.2
    carrier_search     analysis by synthesis                                     4.3
    channels           band-pass without demodulation, two-sigma threshold       4.4, 4.5
    hidden_markov      states with errors and misses, Viterbi                    5.2, 5.3
    growth             mode, blobs, growth, stripes between                      5.4, 2.1
    code_to_phase      projector rows of stripes, by the calibration's fit       3.7

It is a yardstick, by name ("casey2011"): one decision after another, each hard, rows at stripe peaks only. Where the
dissertation leaves a value to the user, or its text is lost, the function that needs it says what was taken and why.
"""

from __future__ import annotations

from scanner.decode.mcp.casey2011.decoder import CaseyDecoder, decode_image, load_kernels

__all__ = ["CaseyDecoder", "decode_image", "warm_up"]


def warm_up() -> None:
    """Call every kernel once with the types that frames have, so that no scan waits for a compiler."""
    load_kernels()
