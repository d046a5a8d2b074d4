"""fingerspice: SPICE for the sliding fingertip.

    import fingerspice as fs
    circuit = fs.read_netlist("circuits/fingerpad.cir")
    solution = fs.simulate(circuit)
    solution.plot()

Each name is loaded when it is first used, so that importing the package takes next to no time.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# Its names, each with its module, are those that the stub imports for type checkers and editors.
with open(f"{__path__[0]}/__init__.pyi", encoding="utf-8") as _stub:
    _WORDS = [line.split() for line in _stub if "from fingerspice." in line]
_HOME = {words[-1]: words[1] for words in _WORDS}
__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name == "torch":
        # Not among the names of the package, which all load without torch.
        return import_module("fingerspice.torch")
    if name not in _HOME:
        raise AttributeError(f"module 'fingerspice' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
