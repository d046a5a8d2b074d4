"""Circuits as modules of PyTorch; this package is loaded only where it is asked for, and needs torch."""

from __future__ import annotations

from fingerspice.base.errors import InputError

try:
    import torch as _torch  # noqa: F401
except ImportError:
    raise InputError(
        "fingerspice.torch needs torch, which is not installed; pip install 'fingerspice[torch]'"
    ) from None

from fingerspice.torch.simulator import Drive as Drive
from fingerspice.torch.simulator import Simulator as Simulator

__all__ = ["Drive", "Simulator"]
