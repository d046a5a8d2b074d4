"""The compiler for graphics cards, which is an optional package: numba-cuda, or its successor numba-cuda-mlir."""

from __future__ import annotations

import importlib
import os
from functools import cache
from importlib.util import find_spec
from types import FunctionType
from typing import Any

from fingerspice.base.errors import InputError

# The package to look for, and the module to import; numba-cuda puts itself in the place of numba's own module.
_COMPILERS = (("numba_cuda", "numba.cuda"), ("numba_cuda_mlir", "numba_cuda_mlir.cuda"))
_HINT = "allowed: 'cpu', or 'cuda' on a machine with an NVIDIA card, its driver and `pip install 'fingerspice[gpu]'`"


@cache
def card_compiler() -> Any:
    """The module with `jit`, `grid`, `local` and `to_device`; numba's simulator where NUMBA_ENABLE_CUDASIM is 1."""
    simulated = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"
    for package, module in _COMPILERS:
        if simulated or find_spec(package):
            return importlib.import_module(module)
    raise InputError(f"device is 'cuda', and no compiler for graphics cards is installed; {_HINT}")


@cache
def for_card(compiled: Any) -> Any:
    """A function that `base.compiled` compiled for the processor, and all that it calls, as functions of the card."""
    # numba-cuda would do that by itself, but numba-cuda-mlir does not know numba's functions.
    function = compiled.py_func
    known = dict(function.__globals__)
    for name in function.__code__.co_names:
        if hasattr(known.get(name), "py_func"):
            known[name] = for_card(known[name])
    copied = FunctionType(function.__code__, known, function.__name__, function.__defaults__, function.__closure__)
    copied.__qualname__, copied.__module__ = function.__qualname__, function.__module__
    return card_compiler().jit(copied, device=True)


def require_card() -> None:
    """Raise `InputError` if there is no compiler for graphics cards, or no card that it can use."""
    if not card_compiler().is_available():
        raise InputError(f"device is 'cuda', and no card was found that its compiler can use; {_HINT}")
