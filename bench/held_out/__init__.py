"""Scenes and rigs that nobody tuned for: a small physically based renderer, and what decoding makes of its pictures.

It shares nothing with the simulated devices of this project: rays, lenses, light and sensor are written a second time,
so that an error of the one is none of the other's. Rigs have roll, pixels that are not square, lenses with tangential
distortion, vignetting; surfaces have gloss, translucency and light that comes back from other surfaces.

    cd bench && python -m held_out [--rigs roll,diamond,diagonal] [--scenes ...] [--methods ...]
    cd bench && python -m held_out --relit      real captures, relit by the MCP pattern
"""
