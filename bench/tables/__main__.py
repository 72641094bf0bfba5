"""Measure the tables and write their pages into docs/reference/tables.

python -m tables [5.1 5.2 gamma ...]     (in bench/; `make tables ARGS="5.1"` does it from anywhere)
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial

import cv2
import numba

from tables import codes, depth, interference, requirements, strips, threshold
from tables.page import FOLDER, Page, index, write

TABLES: dict[str, tuple[str, str, Callable[[], Page]]] = {
    **{t: (f"table-{t}", strips.TITLES[t], partial(strips.make, t)) for t in ("2.1", "2.2", "2.3")},
    "gamma": ("gamma", interference.GAMMA_TITLE, interference.gamma_page),
    "saturation": ("saturation", interference.SATURATION_TITLE, interference.saturation_page),
    "threshold": ("threshold", threshold.TITLE, threshold.make),
    **{t: (f"table-{t}", codes.TITLES[t], partial(codes.make, t)) for t in ("5.1", "5.2")},
    **{t: (f"table-{t}", depth.TITLES[t], partial(depth.make, t)) for t in ("5.3", "5.4", "5.5", "5.6", "5.7")},
    "requirements": ("requirements", requirements.TITLE, requirements.make),
}
"""By argument: file name, title, and what makes the page."""

ALSO = {"3.28": "gamma", "5.51": "threshold"}
"""Equations by number."""


def main() -> int:
    """Write the pages asked for, all by default."""
    parser = argparse.ArgumentParser(prog="make tables", description=(__doc__ or "").partition("\n")[0])
    known = ", ".join((*TABLES, *ALSO))
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"which, all by default: {known}")
    wanted = [ALSO.get(name, name) for name in parser.parse_args().tables] or list(TABLES)
    if unknown := [name for name in wanted if name not in TABLES]:
        parser.error(f"no table {', '.join(unknown)}; there are {known}")
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    began = time.monotonic()
    for k, name in enumerate(wanted):
        print(f"{k + 1:2d} of {len(wanted)}  {TABLES[name][1]} ...", end="", file=sys.stderr, flush=True)
        start = time.monotonic()
        path = write(TABLES[name][2]())
        spent = time.monotonic() - start
        print(f" {spent:.1f} s, {path.relative_to(FOLDER.parents[2])}", file=sys.stderr, flush=True)
    (FOLDER / "index.md").write_text(index_page(), encoding="utf-8")
    print(f"done in {time.monotonic() - began:.0f} s", file=sys.stderr)
    return 0


def index_page() -> str:
    """The list of all pages."""
    return index([(argument, name, title) for argument, (name, title, _) in TABLES.items()])


if __name__ == "__main__":
    sys.exit(main())
