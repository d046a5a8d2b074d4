"""Functions and constants of the netlist's arithmetic; they mean the same as in ngspice's `.param`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e}


class Problem(Exception):
    """An error in an expression, with the position of the character at fault."""

    def __init__(self, message: str, position: int = 0) -> None:
        self.message = message
        self.position = position


def power(base: float, exponent: float) -> float:
    """`base ** exponent`; a negative base needs an even exponent, as ngspice takes the base's absolute value."""
    if base < 0.0 and not (exponent % 2.0 == 0.0):
        raise Problem(
            f"({base:g})^({exponent:g}) has a negative base, whose absolute value ngspice takes: "
            "write pow(x, y) or abs(x)^y"
        )
    return math.pow(base, exponent)


def _pwr(base: float, exponent: float) -> float:
    if base < 0.0:
        raise Problem("pwr of a negative base differs between simulators: write pow(x, y) or pow(abs(x), y)")
    return math.pow(base, exponent)


def _sgn(x: float) -> float:
    return float((x > 0.0) - (x < 0.0))


_AS_IN_MATH = (
    *("sqrt", "exp", "log10", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    *("asinh", "acosh", "atanh", "floor", "ceil"),
)
#: From a name to the function, and its smallest and largest number of arguments.
FUNCTIONS: Mapping[str, tuple[Callable[..., float], int, int]] = {
    **{name: (getattr(math, name), 1, 1) for name in _AS_IN_MATH},
    "ln": (math.log, 1, 1),
    "log": (math.log, 1, 1),
    "arctan": (math.atan, 1, 1),
    "abs": (abs, 1, 1),
    "sqr": (lambda x: x * x, 1, 1),
    "sgn": (_sgn, 1, 1),
    "int": (math.trunc, 1, 1),
    "nint": (round, 1, 1),
    "min": (min, 2, 99),
    "max": (max, 2, 99),
    "pow": (math.pow, 2, 2),
    "pwr": (_pwr, 2, 2),
    "atan2": (math.atan2, 2, 2),
    "hypot": (math.hypot, 2, 2),
    "ternary_fcn": (lambda condition, yes, no: yes if condition else no, 3, 3),
}
