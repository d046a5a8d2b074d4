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
#: From a name to the function, and its number of arguments.
FUNCTIONS: Mapping[str, tuple[Callable[..., float], int]] = {
    **{name: (getattr(math, name), 1) for name in _AS_IN_MATH},
    "ln": (math.log, 1),
    "log": (math.log, 1),
    "arctan": (math.atan, 1),
    "abs": (abs, 1),
    "sqr": (lambda x: x * x, 1),
    "sgn": (_sgn, 1),
    "int": (math.trunc, 1),
    "nint": (round, 1),
    "min": (min, 2),
    "max": (max, 2),
    "pow": (math.pow, 2),
    "pwr": (_pwr, 2),
    "atan2": (math.atan2, 2),
    "hypot": (math.hypot, 2),
    "ternary_fcn": (lambda condition, yes, no: yes if condition else no, 3),
}
#: Names of functions in ngspice 39, where a parameter of such a name is not read: `{max + 1}` is 1.
RESERVED = frozenset((*FUNCTIONS, "agauss", "aunif", "gauss", "limit", "unif"))
