"""The compiler's decorator, with a cache on disk that no change of the sources outlives.

numba keys its cache by the one file a function stands in, while the compiled code holds every function it calls: after
a change of one file it would go on running the old code of the others. So the key holds a stamp of all files that
compiled code may call: those of the folders below, as compiled functions elsewhere are private to their own file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numba.core import cgutils
from numba.core.caching import FunctionCache
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

Array = TypeVar("Array", bound=np.ndarray)
Function = TypeVar("Function", bound=Callable[..., Any])
_PACKAGE = Path(__file__).resolve().parent
#: Where functions stand that compiled code of other files may call.
SHARED_FOLDERS = ("engine", "numerics", "physics")
_SOURCES = [Path(__file__).resolve(), *sorted(p for name in SHARED_FOLDERS for p in (_PACKAGE / name).rglob("*.py"))]
_STAMP = "\n".join(f"{p.name} {p.stat().st_mtime_ns} {p.stat().st_size}" for p in _SOURCES)


def _drop_stale_cache() -> None:
    """Delete what no key leads to any more, where it stands in the package."""
    record = _PACKAGE / "__pycache__" / "compiled.stamp"
    try:
        if record.is_file() and record.read_text() == _STAMP:
            return
        for kind in ("*.nbi", "*.nbc"):
            for file in _PACKAGE.rglob(kind):
                file.unlink(missing_ok=True)
        record.parent.mkdir(exist_ok=True)
        record.write_text(_STAMP)
    except OSError:
        # A package that cannot be written has its cache elsewhere, and is replaced as a whole.
        return


class _Cache(FunctionCache):
    """numba's, for this state of the shared folders; a disk that is full means that the next process compiles again."""

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return (*cast(Any, super())._index_key(sig, codegen), _STAMP)

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            cast(Any, super()).save_overload(sig, data)


def _cached(**options: Any) -> Callable[[Function], Function]:
    """`njit` with a cache, or without where no folder can be written."""

    def compile_when_called(function: Function) -> Function:
        compiled = njit(error_model="numpy", **options)(function)
        with suppress(RuntimeError):
            compiled._cache = cast(Any, _Cache)(function)
        return cast(Function, compiled)

    return compile_when_called


_drop_stale_cache()
# A division by zero is an infinity that the step control refuses, not an exception out of compiled code.
jit = _cached()
# For loops over the rows of a step: fused, so that they vectorise; and where sums may be reordered (always alike).
jit_fused = _cached(fastmath={"contract"})
jit_rows = _cached(fastmath={"contract", "reassoc"})
# Put into its caller before compilation: handing over twenty arrays would cost as much as the work.
jit_inline = _cached(inline="always")


@intrinsic
def _borrow(typing: Any, array: Any) -> Any:
    """The same array without a count of its users, which would be an atomic operation at every view.

    The array given must outlive the one returned: borrow only arguments of the function, never what it allocates,
    for that is freed after its last use by name.
    """

    make: Any = make_array
    null: Any = cgutils.get_null_value

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        view = make(signature.args[0])(context, builder, values[0])
        view.meminfo, view.parent = null(view.meminfo.type), null(view.parent.type)
        return view._getvalue()

    return array(array), generate


borrow: Callable[[Array], Array] = cast(Any, _borrow)


def is_first_use() -> bool:
    """Whether nothing has been compiled here yet: the first run then takes about 20 s longer."""
    return os.access(_PACKAGE, os.W_OK) and not any((_PACKAGE / "engine").rglob("*.nbc"))
