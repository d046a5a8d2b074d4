"""Runs the command in a process of its own, also with limits such as a full disk or too little memory."""

import atexit
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

ENTRY = [sys.executable, "-m", "fingerspice"]


@lru_cache(1)
def fonts() -> str:
    """A folder with matplotlib's list of fonts: made on a full disk, it would be broken for everyone after."""
    folder = tempfile.mkdtemp(prefix="fonts-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    subprocess.run(
        [sys.executable, "-c", "import matplotlib.font_manager"], check=True, capture_output=True,
        env={**os.environ, "MPLCONFIGDIR": folder},
    )  # fmt: skip
    return folder


def hears_ctrl_c() -> None:
    """Tests run in the background of a shell would hand on that Ctrl-C is to be ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def start(folder: Path, *arguments: str, entry: list[str] | None = None, **options: Any) -> subprocess.Popen[str]:
    options["env"] = {**options.get("env", os.environ), "MPLCONFIGDIR": fonts()}
    standard = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "preexec_fn": hears_ctrl_c}
    options = standard | {"cwd": folder} | options
    return subprocess.Popen([*(entry or ENTRY), *arguments], **options)


def ended(process: subprocess.Popen[str]) -> tuple[int, list[str], str]:
    """Exit code, lines on stderr without notes, and stdout."""
    out, err = process.communicate(timeout=120)
    lines = [
        line for line in (err or "").splitlines() if not line.startswith(("fingerspice: warning", "fingerspice: note"))
    ]
    return process.returncode, lines, out or ""


def no_room(size: int) -> Callable[[], None]:
    """No file may grow beyond `size` bytes; the write that would is refused, as on a full disk."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


@contextmanager
def no_room_here(size: int) -> Iterator[None]:
    """As `no_room`, for this process, where Python ignores the signal, and for a while."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def forked(run: Callable[[], object]) -> BaseProcess:
    """A process of its own that runs a function, with all that this one has loaded; it can be killed at any time."""
    process = multiprocessing.get_context("fork").Process(target=run)
    with warnings.catch_warnings():
        # From Python 3.12 on of threads, none of which the function needs.
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()
    return process
