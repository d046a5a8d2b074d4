"""Memory that a worker of Dask keeps between chunks."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import numpy as np
from fingerspice.base.arrays import keep_freed_memory
if "keep" in sys.argv:
    keep_freed_memory()
for _ in range(3):
    np.ones(1 << 17)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(100):
    np.ones(1 << 17)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the parameters are those of glibc's malloc")
def test_freed_memory_is_kept_where_the_environment_asks_to_give_it_back() -> None:
    def faults(*arguments: str) -> int:
        environment = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
        command = [sys.executable, "-c", FAULTS, *arguments]
        return int(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)

    # A megabyte is 256 pages, and a hundred of them are used one after another.
    assert faults() > 20_000
    assert faults("keep") < 500
