"""The map of the friction that a screen can produce: its limits against other methods, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from commands import Command
from scenes import table1

pytestmark = pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")


def test_an_amplitude_is_reached_and_a_larger_one_is_not() -> None:
    found = fs.capability(table1(), 150.0, frequency=[60.0], means=5)
    mean, largest = float(found.best_mean[0]), float(found.largest[0])
    for factor, held in ((0.998, False), (1.01, True)):
        wanted = fs.Sum((fs.DC(mean), fs.Sine(factor * largest, 60.0)))
        if factor > 1.0 and factor * largest > mean - 0.15:
            continue
        drive = fs.inverse_drive(table1(), friction=wanted, duration=0.05, rate=8000.0, limit=150.0)
        assert (drive.at_limit > 0.0) is held


def test_the_largest_mean_is_that_of_the_limit_held() -> None:
    found = fs.capability(table1(), 150.0, frequency=[60.0], means=3)
    run = fs.simulate(table1(), sources=fs.DC(150.0), t_stop=0.05, start="uncharged")
    assert found.smallest_mean == 0.15
    assert found.largest_mean == pytest.approx(0.3 * (0.5 + float(run.f_el[-1])), rel=2e-3)


def test_more_voltage_makes_more() -> None:
    low, high = (fs.capability(table1(), v, frequency=[20.0, 200.0], means=5) for v in (100.0, 200.0))
    assert np.all(high.largest > 2.0 * low.largest)
    assert high.largest_mean > low.largest_mean
    with_carrier = fs.capability(table1(), 150.0, frequency=[50.0], means=3, carrier=2000.0)
    assert 0.0 < with_carrier.largest[0] <= 0.5 * (with_carrier.largest_mean - 0.15) * 1.001


def test_it_is_refused_in_one_sentence() -> None:
    circuits = Path(__file__).parents[1] / "circuits"
    with pytest.raises(fs.InputError, match="has Rout, Ccable beside it"):
        fs.capability(fs.read_netlist(circuits / "amplifier.cir"), 150.0)
    with pytest.raises(fs.InputError, match="one finger"):
        fs.capability(fs.read_netlist(circuits / "two_fingers.cir"), 150.0)
    with pytest.raises(fs.InputError, match="limit is -1 V"):
        fs.capability(table1(), -1.0)
    with pytest.raises(fs.InputError, match="a quarter of the carrier"):
        fs.capability(table1(), 100.0, carrier=1000.0, frequency=[500.0])


def test_the_picture_is_a_map_and_a_curve() -> None:
    figure = fs.capability(table1(), 150.0, frequency=[20.0, 60.0, 200.0], means=5).plot()
    left, right = figure.axes[:2]
    assert (left.get_xlabel(), left.get_ylabel()) == ("Modulation frequency [Hz]", "Mean friction [mN]")
    assert right.get_ylabel() == "Largest amplitude, best mean [mN]"
    assert right.get_lines()[0].get_xdata().size == 3


def test_the_command_writes_table_and_picture(command: Command) -> None:
    result = command("limits", "pad.cir", "--capability", "--limit", "120", "--out", "maps", "--json")
    answer = json.loads(result.out)
    assert result.code == 0, result.err
    assert answer["capability"]["limit"] == 120.0
    assert Path("maps/pad_capability.png").read_bytes().startswith(b"\x89PNG")
    head = Path("maps/pad_capability.csv").read_text().splitlines()[0]
    assert head == "frequency (Hz),mean friction (N),largest amplitude (N)"
    assert command("limits", "pad.cir", "--limit", "120").code == 2
