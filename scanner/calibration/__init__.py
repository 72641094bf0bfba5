"""Calibration: targets, their detection, the solvers, and what makes a result trusted.

From the words of a command line to a calibration file: `targets.parse_target`, `observe.find_captures` and `observe`,
`solve.solve`, `calibration_file.calibration_dict`. Nothing is imported here: decoding takes `response` from this
package and shall not load solvers with it.
"""
