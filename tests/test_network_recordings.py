"""Recordings on one finger in a network, against hand-written equations and the `exponential` method."""

import numpy as np
import pytest

import fingerspice as fs
import recording_errors
from fingerspice.solve.recordings import block
from network_reference import Floating
from scenes import cases, floating, shipped

RATE = 48e3
pytestmark = pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")


def recording(count: int, high: float = 4000.0, volts: float = 150.0) -> fs.Samples:
    return fs.Samples(volts * recording_errors.noise(11, count, RATE, 50.0, high), RATE)


def driven(name: str, wave: fs.Waveform) -> fs.Circuit:
    """A shipped deck with this waveform in its first source, and 0 in all others."""
    circuit = shipped(name)
    first = next(e.name for e in circuit.elements if e.name[0] in "VI")
    return circuit.replace({e.name: wave if e.name == first else 0.0 for e in circuit.elements if e.waveform})


def by_hand(samples: fs.Samples, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, gap voltage and charge in the middle and at the end of the first intervals, each integrated by itself."""
    reference, h = Floating(5000.0, 47e3, 150e-12, mobile=False), 1.0 / samples.rate
    state, charge, rows = np.zeros(4), 0.0, []
    for i, (a, b) in enumerate(zip(samples.values[:count], samples.values[1:], strict=False)):
        found = reference.response(lambda t, a=a, b=b: a + t / h * (b - a), [0.5 * h, h], start=state)
        for k in range(2):
            rows.append(((i + 0.5 * (k + 1)) * h, found["u_gap"][k], charge + found["charge"][k]))
        state, charge = found["state"][:, -1], charge + found["charge"][-1]
    t, u_gap, q = np.array(rows).T
    return t, u_gap, q


def test_a_finger_in_a_network_follows_the_hand_written_equations() -> None:
    samples = recording(140)
    t, u_gap, q = by_hand(samples, cases(100, 40))
    for rtol in (1e-4, 1e-8):
        run = fs.simulate(floating(), sources=samples, t_eval=t, t_stop=130.0 / RATE, charge_law="local", rtol=rtol)
        assert run.method == "relaxation"
        assert np.abs(run.u_gap - u_gap).max() <= min(rtol * np.abs(u_gap).max(), run.error.u_gap)
        assert np.abs(run.q_source - q).max() <= min(10.0 * rtol * np.abs(q).max(), run.error.q_source)


def test_stated_errors_cover_the_true_ones_and_what_was_asked_is_met() -> None:
    # Of the first, those that are followed sample by sample; with 213 in place of 202, whose reference takes seconds.
    numbers = cases([*range(200, 300)], [200, 204, 206, 207, 208, 213])
    found = [x for n in numbers for x in recording_errors.judge(recording_errors.draw(n, 300, network=True))]
    assert len(found) > 4 * len(numbers)
    recording_errors.assert_that_stated_errors_hold(found)


@pytest.mark.parametrize("name", ["amplifier", "ungrounded_user", "current_drive"])
def test_decays_within_a_sample_are_shown_as_they_are(name: str) -> None:
    wave = recording(600)
    if name == "current_drive":
        wave = fs.Samples(1e-6 * wave.values, RATE)
    # Right after samples, where the slope of the source has jumped, and anywhere else.
    after = np.arange(40, 400, 9)[:, None] / RATE + np.array([3e-8, 2e-7, 1e-6, 5e-6])
    how = {"t_eval": np.sort(after.ravel()), "t_stop": 560.0 / RATE, "charge_law": "local"}
    exact = fs.simulate(driven(name, wave), rtol=1e-10, method="exponential", **how)
    for rtol in (1e-4, 1e-6):
        run = fs.simulate(driven(name, wave), rtol=rtol, **how)
        assert run.method == "relaxation"
        for quantity in ("u_gap", "q_source"):
            off = np.abs(getattr(run, quantity) - getattr(exact, quantity)).max()
            assert off <= getattr(run.error, quantity) + getattr(exact.error, quantity)
        # No error is stated for the current; within such a decay it is right to some 1e-5 of its peak.
        peak = np.abs(exact.i_source).max()
        assert np.abs(run.i_source - exact.i_source).max() <= (20.0 * rtol + 1e-4) * peak


def test_chunks_are_the_whole_and_a_run_goes_on_where_another_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block, "PIECE", 512)
    wave = recording(1500)
    circuit, how = driven("amplifier", wave), {"t_stop": 1400.0 / RATE, "rtol": 1e-6, "charge_law": "local"}
    whole = fs.simulate(circuit, t_eval=np.arange(1401) / RATE, **how)
    assert whole.method == "relaxation"
    for count in (300, 10**6):
        chunks = list(fs.stream(circuit, count=count, **how))
        for name in ("u_gap", "q_source", "i_source"):
            found = np.concatenate([getattr(chunk, name) for chunk in chunks])
            np.testing.assert_array_equal(found, getattr(whole, name)[: found.size])
    first = fs.simulate(circuit, t_eval=[0.0], **how | {"t_stop": 700.3 / RATE})
    t = np.arange(705, 1400) / RATE
    second = fs.simulate(circuit, t_eval=t, start=first, **how)
    assert (first.method, second.method) == ("relaxation", "relaxation")
    for name in ("u_gap", "q_source"):
        expected = getattr(whole, name)[705:1400]
        assert np.abs(getattr(second, name) - expected).max() <= 3e-6 * np.abs(expected).max()


def test_what_this_form_does_not_cover_is_stepped_as_ever() -> None:
    wave, how = recording(150), {"t_stop": 120.0 / RATE, "rtol": 1e-5}
    # An element between the layers, the other charge law, a second finger.
    bridged = floating("0", "Rleak top 0 1e9").replace({"Vdrive": wave})
    fingers = driven("two_fingers", wave)
    assert fs.simulate(bridged, charge_law="local", **how).method == "exponential"
    assert fs.simulate(floating().replace({"Vdrive": wave}), charge_law="mobile", **how).method == "exponential"
    assert fs.simulate(fingers, charge_law="local", **how).method == "exponential"
    near = fs.simulate(floating("0", "Rleak top 0 1e15").replace({"Vdrive": wave}), charge_law="local", **how)
    same = fs.simulate(floating().replace({"Vdrive": wave}), charge_law="local", **how, t_eval=near.t)
    assert (near.method, same.method) == ("exponential", "relaxation")
    assert np.abs(near.u_gap - same.u_gap).max() <= near.error.u_gap + same.error.u_gap
