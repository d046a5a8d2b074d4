"""The libraries that define the layers for ngspice, one for each charge law, as shipped with this version."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from fingerspice.base.errors import InputError

LIBRARIES = {"local": "fingerspice.lib", "mobile": "fingerspice_mobile.lib"}


@cache
def library_text(law: str) -> str:
    """Text of a charge law's library, from the installed package or the source tree."""
    name = LIBRARIES[law]
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "lib", package.parents[1] / "circuits"):
        path = folder / name
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InputError(f"{name} is missing from this installation; reinstall fingerspice")
