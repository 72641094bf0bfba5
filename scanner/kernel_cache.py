"""Where compiled kernels are kept: beside their sources, or, where that cannot be written, in a folder of this user's.

Numba loads what it finds there as code. A folder outside the sources is therefore taken only if it belongs to this
user and nobody else can write it. Knows nothing of Numba but the variable that names the folder.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterator, MutableMapping
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def choose_cache(sources: Path, environment: MutableMapping[str, str]) -> bool:
    """Set NUMBA_CACHE_DIR where the sources' folder does not serve; False where nothing does. Before Numba is imported.

    Args:
        sources: a folder of sources with kernels; the cache beside them is its `__pycache__`.
        environment: the process's, or a test's.
    """
    if environment.get(VARIABLE) or _writable(sources):
        return True
    for folder in _candidates(environment):
        if _made(folder):
            environment[VARIABLE] = str(folder)
            return True
    return False


def _writable(sources: Path) -> bool:
    cache = sources / "__pycache__"
    return os.access(cache if cache.is_dir() else sources, os.W_OK | os.X_OK)


def _candidates(environment: MutableMapping[str, str]) -> Iterator[Path]:
    if Path(environment.get("XDG_CACHE_HOME", "")).is_absolute():
        yield Path(environment["XDG_CACHE_HOME"]) / "fringed"
    elif Path(environment.get("HOME", "")).is_absolute():
        yield Path(environment["HOME"]) / ".cache" / "fringed"
    yield Path(tempfile.gettempdir()) / f"fringed-kernels-{os.geteuid()}"


def _made(folder: Path) -> bool:
    """Whether there is now such a folder that this user alone can write. A link is none: lstat."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022
    return ours and os.access(folder, os.W_OK | os.X_OK)
