"""The printed numbers of a run, against closed forms and the independent reference."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.results.report import summary_table
from scenes import table1

F = 100.0
COLUMNS = ("min", "max", "mean", "last period", "rms", "ripple")
PREFIX = {"": 1.0, "k": 1e3, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "n": 1e-9}


def number(text: str) -> float:
    """A printed value in the unit without its prefix, mm^2 as m^2."""
    value, _, unit = text.strip().partition(" ")
    if unit == "mm^2":
        return 1e-6 * float(value)
    assert re.fullmatch(r"([kmuµn]?)[VN]|", unit), text
    return float(value) * PREFIX[unit[:-1]]


def printed(run: fs.Solution) -> dict[str, dict[str, float]]:
    """The rows of the table by name, what is not told left out."""
    rows = {}
    for line in summary_table(run).splitlines():
        name, *cells = re.split(r"  +", line.strip())
        if len(cells) == len(COLUMNS) and cells[0] != COLUMNS[0]:
            rows[name] = {c: number(x) for c, x in zip(COLUMNS, cells, strict=True) if x != "-"}
    return rows


def digits(value: float) -> object:
    """Four digits of a value."""
    return pytest.approx(value, rel=6e-4)


@pytest.fixture(scope="module")
def state() -> ref.Transient:
    """Table 1's periodic state at 200 V and 100 Hz."""
    t = np.arange(4000) / 4000.0 / F
    return ref.periodic_state(ref.sine_segments(200.0, F, 1.0 / F), freq=F, t_out=t)


@pytest.fixture(scope="module")
def rows() -> dict[str, dict[str, float]]:
    return printed(fs.simulate(table1(), start="periodic", t_stop=1.0 / F, rtol=1e-8))


def test_the_printed_area_and_friction_are_the_reference_s(
    rows: dict[str, dict[str, float]], state: ref.Transient
) -> None:
    # Eq. 1: F_T = mu (F_N + F_el), of which the coefficient is F_T / F_N. The area is printed in mm^2.
    friction = 0.3 * (0.5 + state.force)
    wanted = {"ridge contact area": state.area, "friction force": friction, "friction coefficient": friction / 0.5}
    for name, want in wanted.items():
        row = rows[name]
        assert row["min"] == digits(want.min())
        assert row["max"] == digits(want.max())
        assert row["mean"] == row["last period"] == digits(want.mean())
        assert row["ripple"] == digits(np.ptp(want))
        assert "rms" not in row
    assert rows["electroadhesive force"]["mean"] == digits(state.force.mean())
    assert rows["electroadhesive force"]["max"] == digits(state.force.max())


def test_the_printed_voltages_are_the_reference_s(rows: dict[str, dict[str, float]], state: ref.Transient) -> None:
    assert rows["gap voltage"]["max"] == digits(state.u_gap.max())
    assert rows["gap voltage"]["min"] == digits(state.u_gap.min())
    assert rows["gap voltage"]["rms"] == digits(math.sqrt(np.mean(state.u_gap**2)))
    assert rows["source voltage"]["rms"] == digits(200.0 / math.sqrt(2.0))
    # The mean of a sine is nothing, not its rounding.
    assert rows["source voltage"]["mean"] == 0.0


@pytest.mark.parametrize("phase", [0.0, 33.0, 175.0, -120.0])
@pytest.mark.parametrize("f", [100.0, 5000.0])
def test_the_printed_lead_is_that_of_the_gap_over_the_source(f: float, phase: float) -> None:
    # A source that starts elsewhere in its period leads and lags by the same; past half a turn too.
    source = fs.Sine(200.0, f, phase_deg=phase)
    area = 35e-6
    run = fs.simulate(table1(f=f).replace({"Vdrive": source}), area=area, start="periodic", t_stop=1.0 / f)
    gain = ref.phasor_gains(f, area, ref.table1_layers(f))[ref.GAP]
    said = re.search(
        r"at (\S+ k?Hz): gap voltage (\S+ V), (\S+) % of the source, leading by (\S+) deg", summary_table(run)
    )
    assert said[1] == {100.0: "100 Hz", 5000.0: "5 kHz"}[f]
    assert number(said[2]) == digits(200.0 * abs(gain))
    assert float(said[3]) == pytest.approx(100.0 * abs(gain), abs=5.1e-3)
    assert float(said[4]) == pytest.approx(math.degrees(np.angle(gain)), abs=5.1e-3)
