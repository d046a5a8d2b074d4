"""The decks of example signals in `circuits/`: each runs without a warning, and their recording is reproducible."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from commands import Command
from fingerspice.explorer.gallery import EXAMPLES

CIRCUITS = Path(__file__).parents[1] / "circuits"


@pytest.mark.parametrize("name", ["texture_recording", "click", "am_bump", "chirp", "burst"])
def test_every_deck_of_a_signal_runs_to_its_end_without_a_warning(name: str, recwarn: pytest.WarningsRecorder) -> None:
    run = fs.simulate(fs.read_netlist(CIRCUITS / f"{name}.cir"), rtol=1e-4)
    assert not recwarn.list
    assert run.warnings == ()
    assert run.t[-1] == run.t_stop
    # It can be felt: a friction that changes by a tenth of itself, well below the breakdown of air.
    assert np.ptp(run.f_t) > 0.1 * run.f_t.min()
    assert np.abs(run.u_gap).max() < 300.0


def test_the_recording_is_what_its_script_makes() -> None:
    spec = importlib.util.spec_from_file_location("texture", CIRCUITS / "texture.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    path = CIRCUITS / "texture.wav"
    shipped = fs.Samples.from_wav(path, 2.0**15)
    assert shipped.rate == script.RATE
    # The sine of another machine may round differently.
    np.testing.assert_allclose(shipped.values, script.texture(), atol=1)
    assert path.stat().st_size < 100_000


def test_the_command_draws_the_decks_below_and_the_scenes(tmp_path: Path, command: Command) -> None:
    (tmp_path / "circuits").mkdir()
    shutil.copy(CIRCUITS / "click.cir", tmp_path / "circuits")
    result = command("figures", "--gallery", "--out", "out")
    assert result.code == 0
    drawn = {path.stem for path in (tmp_path / "out" / "gallery").glob("*.png")}
    assert drawn == {"click", *(f"scene-{one.name}" for one in EXAMPLES)}
    assert all(name in result.out for name in drawn)
    result = command("figures", "--gallery", "--only", "4")
    assert result.code == 2
    assert "--only and --gallery are both given" in result.err
