"""When a run that ended well is warned about: at the voltage, and at the area, that is said."""

from __future__ import annotations

import warnings

import pytest
from scipy.optimize import brentq

import analytic as ref
import fingerspice as fs
from scenes import deck, table1_deck

every_kind = pytest.mark.parametrize("beside", ["", "Rbeside drive 0 1meg"], ids=["stack", "network"])


def said(volt: float, beside: str) -> list[str]:
    """What is warned of when a voltage jumps to Table 1's finger, and the area follows it."""
    text = table1_deck(f"DC {volt!r}", tran="10u 1m uic", extra=beside)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", fs.FingerspiceWarning)
        run = fs.simulate(fs.parse_netlist(text), rtol=1e-6)
    assert list(run.warnings) == [str(w.message) for w in caught]
    return list(run.warnings)


def jumps_to(u_gap: float) -> float:
    """Source (V) of which the gap takes so much (V) at once; afterwards it has less, for the layers leak."""
    c = [layer.c for layer in ref.table1_layers(100.0)]
    return u_gap * c[ref.GAP] * sum(1.0 / x for x in c)


@every_kind
def test_a_contact_is_warned_about_where_a_fifth_of_it_is_left(beside: str) -> None:
    rest = float(ref.area(0.0))
    u_gap = brentq(lambda u: float(ref.area(u)) - 0.2 * rest, 300.0, 2000.0, xtol=1e-9)
    above, below = (
        [text for text in said(jumps_to(x * u_gap), beside) if "contact area" in text] for x in (0.999, 1.001)
    )
    assert above == []
    (text,) = below
    assert f"falls to {1e6 * float(ref.area(1.001 * u_gap)):.3g} mm^2, below 20 % of the 35 mm^2 at 0 V" in text


@every_kind
def test_the_breakdown_of_air_is_warned_about_from_300_v_on(beside: str) -> None:
    assert said(jumps_to(299.9), beside) == []
    (text,) = said(jumps_to(300.1), beside)
    assert "reaches 300.1 V; air breaks down above about 300 V" in text


def test_each_of_two_fingers_is_warned_about_by_its_name() -> None:
    lines = table1_deck("DC 1", tran="10u 1m uic").splitlines()[3:6]
    far = [line.replace("Xcoat", "Xcoat2").replace("Xgap", "Xfar").replace("Xskin", "Xskin2") for line in lines]
    far = [line.replace(" top", " top2").replace(" skin ", " skin2 ").replace(" area ", " area2 ") for line in far]
    near = [line.replace("drive top", "low top") for line in lines]
    circuit = deck(
        f"Vdrive drive 0 {jumps_to(320.0)!r}", f"Vlow low 0 {jumps_to(200.0)!r}", *near, *far, ".tran 10u 1m uic"
    )
    with pytest.warns(fs.FingerspiceWarning, match="the gap voltage of Xfar reaches 320 V") as caught:
        fs.simulate(circuit, rtol=1e-6)
    assert len(caught) == 1
