"""The contestants: each file in this folder runs one library on the same problems, if the library is installed."""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module

from peers.contest import Contestant

MODULES = (
    "fingerspice_ours",
    "numbalsoda_peer",
    "diffrax_peer",
    "scipy_peer",
    "cvode_peer",
    "torchdiffeq_peer",
    "ngspice_peer",
)


def contestants(without: Collection[str] = ()) -> tuple[list[Contestant], dict[str, str]]:
    """All contestants of the installed libraries, without those in `without`; and all versions, or 'absent'."""
    present: list[Contestant] = []
    versions: dict[str, str] = {}
    for name in MODULES:
        module = import_module(f"peers.{name}")
        version = module.version()
        versions[module.LIBRARY] = version or "absent"
        if version is not None and module.LIBRARY not in without:
            present += module.contestants()
    return present, versions
