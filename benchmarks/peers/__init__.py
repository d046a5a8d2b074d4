"""The contestants: each file here is one library on the same problems, and says itself whether it is installed."""

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
    """All contestants of the libraries present, less those named; and all versions, 'absent' for the missing ones."""
    present: list[Contestant] = []
    versions: dict[str, str] = {}
    for name in MODULES:
        module = import_module(f"peers.{name}")
        version = module.version()
        versions[module.LIBRARY] = version or "absent"
        if version is not None and module.LIBRARY not in without:
            present += module.contestants()
    return present, versions
