"""`make test` without an installed ngspice."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent


def bare(folder: Path, *commands: str, **scripts: str) -> dict[str, str]:
    """An environment of those commands, and of scripts of shell."""
    for name in commands:
        found = shutil.which(name)
        assert found is not None
        (folder / name).symlink_to(found)
    for name, text in scripts.items():
        (folder / name.replace("_", "-")).write_text(f"#!/bin/sh\n{text}\n")
        (folder / name.replace("_", "-")).chmod(0o755)
    return {**{k: v for k, v in os.environ.items() if k not in ("CI", "PYTEST_XDIST_WORKER")}, "PATH": str(folder)}


def suite(folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """A test that takes ngspice, run as those of this folder."""
    (folder / "test_one.py").write_text("import ngspice_tools\n\ndef test_one(): ngspice_tools.call_ngspice('.')\n")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "conftest", str(folder / "test_one.py")]
    path = {"PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])}
    return subprocess.run(command, cwd=folder, env=environment | path, capture_output=True, text=True, timeout=120)


def test_without_ngspice_the_last_line_says_what_was_not_run(tmp_path: Path) -> None:
    environment = bare(tmp_path)
    done = suite(tmp_path, environment)
    assert done.returncode == 0, done.stdout
    last = done.stdout.splitlines()[-1]
    said = " comparisons with ngspice were not run, as it is not installed; to run them: apt-get install ngspice"
    assert said in last
    failed = suite(tmp_path, {**environment, "CI": "true"})
    assert failed.returncode == 1
    assert "ngspice is not installed, which CI asks for" in failed.stdout


ROOT = {"id": "echo 0"}
INSTALL = "echo $@ >> {{log}}; [ $1 = update ] || cp {{true}} {{here}}/{}"


@pytest.mark.parametrize(
    ("scripts", "said"),
    [
        (ROOT | {"apt_get": INSTALL.format("ngspice")}, "installing ngspice"),
        (ROOT | {"apt_get": "exit 100"}, "ngspice could not be installed; what needs it is left out"),
        (ROOT | {"apt_get": INSTALL.format("chromium"), "ngspice": "exit 0", "chromium": ""}, "installing chromium"),
        ({"id": "echo 1000"}, "ngspice is not installed, and installing it takes a password: sudo apt-get install"),
        ({"id": "echo 1000", "sudo": "exit 1"}, "takes a password"),
        ({"ngspice": "exit 0"}, ""),
    ],
)
def test_programs_are_installed_where_that_takes_no_question(tmp_path, scripts, said):
    log, true = tmp_path / "log", shutil.which("true")
    filled = {
        k: v.format(log=log, here=tmp_path, true=true) for k, v in ({"chromium": "exit 0"} | scripts).items() if v
    }
    environment = bare(tmp_path, "sh", "env", "cp", **filled)
    done = subprocess.run(
        ["sh", TESTS / "get_programs.sh"], env=environment, capture_output=True, text=True, timeout=20
    )
    assert done.returncode == 0
    assert said in done.stdout
    assert bool(done.stdout) is bool(said)
    if "log" in scripts.get("apt_get", ""):
        assert f"install -y -qq {said.split()[1]}" in log.read_text()
        assert "could not" not in done.stdout
