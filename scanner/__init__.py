"""What structured light is: patterns, decoding, geometry, sequencing, formats and messages.

This package knows no particular device, no socket server and no process.
"""
