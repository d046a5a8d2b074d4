"""Fixtures that more than one test file uses."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import fingerspice as fs
from commands import QUICK, Command, run_here
from deck_edits import edited
from ngspice_tools import WITHOUT
from scenes import shipped, table1


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Iterator[Command]:
    """`fingerspice ARGUMENTS` in an empty folder with the deck `pad.cir`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    Path("pad.cir").write_text(edited(QUICK))
    threshold = gc.get_threshold()
    yield lambda *arguments: run_here(monkeypatch, capsys, *arguments)
    gc.set_threshold(*threshold)


@pytest.fixture(scope="module")
def circuit() -> fs.Circuit:
    """Table 1's deck as it is shipped."""
    return shipped("fingerpad")


@pytest.fixture(scope="module")
def explorer() -> Iterator[fs.Explorer]:
    running = fs.explore(browser=False)
    yield running
    running.stop()


@pytest.fixture(scope="module")
def forked_workers() -> Iterator[None]:
    """Workers are forks of one process that has imported what they need; others start as a user's do."""
    utils = pytest.importorskip("distributed.utils")
    with pytest.importorskip("dask").config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        # Dask's own list, which it sets first, is without this package.
        utils.get_mp_context().set_forkserver_preload(
            ["distributed", "scipy.stats", "xarray", "fingerspice.studies.sweep.chunks"]
        )
        yield


def pytest_configure() -> None:
    """Of several workers one compiles what steps stacks, and one what steps networks, which else all would at once."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker == "gw0":
        for method in ("exponential", "radau"):
            fs.simulate(table1(), t_stop=1e-3, method=method)
    elif worker == "gw1":
        fs.simulate(shipped("amplifier"), t_stop=1e-4, method="exponential")


def pytest_unconfigure(config: pytest.Config) -> None:
    """The last line says what was not run for want of ngspice."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    skipped = [] if reporter is None else reporter.stats.get("skipped", [])
    without = sum(WITHOUT in str(report.longrepr) for report in skipped)
    if without:
        reporter.write_line(
            f"{without} comparisons with ngspice were not run, as it is not installed; to run them: apt-get install "
            "ngspice (or your system's way), then make test again"
        )
