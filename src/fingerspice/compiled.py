"""The compiler's decorator, with a cache on disk that no change of the sources outlives.

numba keys its cache by the one file a function stands in, while the compiled code holds every function it calls: after
a change of one file it would go on running the old code of the others.
"""

from __future__ import annotations

import os
from pathlib import Path

from numba import njit

_PACKAGE = Path(__file__).resolve().parent


def _drop_stale_cache() -> None:
    sources = sorted(_PACKAGE.rglob("*.py"))
    stamp = "\n".join(f"{p.name} {p.stat().st_mtime_ns} {p.stat().st_size}" for p in sources)
    record = _PACKAGE / "__pycache__" / "compiled.stamp"
    try:
        if record.is_file() and record.read_text() == stamp:
            return
        for kind in ("*.nbi", "*.nbc"):
            for file in _PACKAGE.rglob(kind):
                file.unlink(missing_ok=True)
        record.parent.mkdir(exist_ok=True)
        record.write_text(stamp)
    except OSError:
        # A package that cannot be written has its cache elsewhere, and is replaced as a whole.
        return


_drop_stale_cache()
# A division by zero is an infinity that the step control refuses, not an exception out of compiled code.
jit = njit(cache=True, error_model="numpy")


def is_first_use() -> bool:
    """Whether nothing has been compiled here yet: the first run then takes about 20 s longer."""
    return os.access(_PACKAGE, os.W_OK) and not any((_PACKAGE / "engine").rglob("*.nbc"))
