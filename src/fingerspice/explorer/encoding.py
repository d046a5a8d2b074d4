"""What the page gets: plain data and arrays as JSON, or as JSON followed by the arrays."""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np


def as_json(data: Any) -> bytes:
    """Data as JSON: arrays of numbers as base64 of little-endian doubles, and null for what is not finite."""
    return _dumped(data, lambda x: {"f64": base64.b64encode(_doubles(x)).decode("ascii")})


def framed(data: Any) -> bytes:
    """Data as the JSON's length and the number of doubles (four bytes each), the JSON, and the doubles of all arrays.

    All numbers are little-endian. In the JSON an array is its place among the doubles, and its size. The doubles begin
    at a multiple of eight bytes, so that the page need not copy them.
    """
    arrays: list[bytes] = []
    places: dict[int, list[int]] = {}
    end = 0

    def place(x: Any) -> dict[str, list[int]]:
        nonlocal end
        if id(x) not in places:
            arrays.append(_doubles(x))
            places[id(x)] = [end, x.size]
            end += x.size
        return {"f64": places[id(x)]}

    text = _dumped(data, place)
    text += b" " * (-len(text) % 8)
    return b"".join([struct.pack("<II", len(text), end), text, *arrays])


def _doubles(x: Any) -> bytes:
    assert isinstance(x, np.ndarray)
    return np.ascontiguousarray(x, "<f8").tobytes()


def _dumped(data: Any, array: Callable[[Any], Any]) -> bytes:
    """Data as JSON, with `array` for its arrays, and null for what is not finite."""

    def finite(x: Any) -> Any:
        if isinstance(x, dict):
            return {key: finite(value) for key, value in x.items()}
        if isinstance(x, list | tuple):
            return [finite(value) for value in x]
        return x if not isinstance(x, float) or math.isfinite(x) else None

    try:
        return json.dumps(data, allow_nan=False, default=array).encode()
    except ValueError:
        # Seldom, and all data have to be gone through.
        return json.dumps(finite(data), allow_nan=False, default=array).encode()
