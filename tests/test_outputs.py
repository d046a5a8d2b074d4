"""Output rows of a run: two at a jump, left and right, and no additional rows at the corners of a finite edge."""

from __future__ import annotations

import numpy as np
import pytest

import fingerspice as fs
from scenes import deck, table1


def rows(source, stop, step, **more):
    circuit = table1(tran=f"{step!r} {stop!r} uic")
    return fs.simulate(circuit, sources={"Vdrive": source}, rtol=1e-5, charge=False, **more)


@pytest.mark.parametrize("edge", [1e-6, 1e-9, 1e-11])
@pytest.mark.parametrize("stop", [5e-2, 5.0])
def test_corners_of_edges_that_take_time_are_no_jumps(edge, stop):
    source = fs.Pulse(-200.0, 200.0, 0.0, edge, edge, 5e-3 - edge, 10e-3)
    solution = rows(source, stop, stop / 10)
    assert solution.t.size == 11
    assert np.all(np.diff(solution.t) > 0.0)


def test_a_source_of_1_mhz_with_edges_of_10_ns_writes_the_outputs_asked_for():
    # 3,751 rows with 1,870 repeated times for 11 outputs.
    assert rows(fs.Pulse(0.0, 200.0, 0.0, 1e-8, 1e-8, 4.9e-7, 1e-6), 1e-4, 1e-5).t.size == 11


@pytest.mark.parametrize(
    ("source", "jumps"),
    [
        (fs.Square(200.0, 100.0), np.arange(1, 11) * 5e-3),
        (fs.Sawtooth(200.0, 100.0), np.arange(1, 6) * 1e-2),
        (fs.PWL((0.0, 0.01, 0.01, 0.05), (0.0, 1.0, 1.0 + 1e-9, 2.0)), [0.01]),
        (fs.Sine(200.0, 100.0) + fs.PWL((0.0, 0.02, 0.02, 0.05), (0.0, 0.0, 1e-6, 1e-6)), [0.02]),
        (fs.PWL((0.0, 0.02, 0.02, 0.02 + 1e-9, 0.05), (0.0, 0.0, 5.0, 200.0, 200.0)), [0.02]),
    ],
    ids=["square", "sawtooth", "a billionth", "below a sine", "before a steep edge"],
)
def test_a_jump_has_two_rows_with_both_values(source, jumps):
    solution = rows(source, 0.05, 1e-3)
    twice = solution.t[:-1][np.diff(solution.t) == 0.0]
    np.testing.assert_allclose(twice, jumps, rtol=1e-15)
    at = np.flatnonzero(np.diff(solution.t) == 0.0)
    np.testing.assert_array_equal(solution.u_source[at], source.value(solution.t[at], "left"))
    np.testing.assert_array_equal(solution.u_source[at + 1], source.value(solution.t[at]))


def test_rows_at_jumps_can_be_left_out():
    both, none = (rows(fs.Square(200.0, 100.0), 0.05, 1e-3, jumps=jumps) for jumps in ("both", "none"))
    np.testing.assert_allclose(none.t, np.arange(51) * 1e-3, rtol=1e-14)
    assert np.all(np.diff(none.t) > 0.0)
    right = np.append(np.diff(both.t) > 0.0, True)
    np.testing.assert_array_equal(none.u_gap, both.u_gap[right])


def test_a_jump_of_one_source_is_not_hidden_by_that_of_another():
    circuit = deck(
        "V1 a 0 PWL(0 0 1m 0 1m 2 5m 2)", "I1 0 b PWL(0 0 1m 0 1m -2 5m -2)", "R1 a b 1k", "C1 b 0 1u",
        ".tran 1m 5m uic",
    )  # fmt: skip
    solution = fs.simulate(circuit)
    assert np.count_nonzero(np.diff(solution.t) == 0.0) == 1


def test_another_word_for_jumps_is_refused():
    with pytest.raises(fs.InputError, match=r"jumps is 'right'; allowed: 'both' or 'none'"):
        fs.simulate(table1(), jumps="right")
