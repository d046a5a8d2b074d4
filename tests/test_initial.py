"""Start of a run: IC=, .ic and the operating point, against ngspice 39, closed forms and conservation of charge."""

import numpy as np
import pytest

import analytic
import fingerspice as fs
from network_reference import deck_of, random_network
from ngspice_tools import CIRCUITS, beside
from scenes import LAWS, cases, deck, every_law, finger, listed, refuses, table1

pytestmark = pytest.mark.filterwarnings("ignore:.* has no effect here")

DC_AMPLIFIER = (("1m uic", "1m"), ("SIN(0 200 5k)", "SIN(26 100 5k)"))
SLOW = ("c2=5000", "c2=5000 tau=50u")
STEP, STOP = 2e-9, 2e-6


def shipped(name: str, *changes: tuple[str, str], extra: str = "") -> fs.Circuit:
    """A deck of `circuits/`, changed."""
    text = (CIRCUITS / f"{name}.cir").read_text()
    for old, new in (*changes, ("\n.end\n", f"\n{extra}\n.end\n")):
        assert old in text
        text = text.replace(old, new)
    return fs.parse_netlist(text)


def start(circuit: fs.Circuit, law: str | None = None) -> dict[str, float]:
    """Node voltages at 0+."""
    assert circuit.tran is not None
    stop = min(circuit.tran.stop, 100 * circuit.tran.step)
    s = fs.simulate(circuit, charge_law=law, t_stop=stop, t_eval=np.zeros(1))
    return {node: float(v[0]) for node, v in s.node_voltages.items()}


def at_skin(top: float, skin: float, f: float = 100.0) -> float:
    """Voltage of a skin at rest under `top` V behind the gap's megohm, with the area that both voltages make."""
    r = analytic.table1_layers(f)[2].r_area / float(analytic.area(top - skin))
    return top * r / (1e6 + r)


def apart(circuit: fs.Circuit, law: str | None = None, text: str = "", max_step: float | None = None) -> float:
    """Largest difference of a node's voltage or an area from ngspice's, over the largest of a run, from 0+ on."""
    run, nodes, _, area = beside(circuit, text, law, max_step=max_step, edge=0.0, rtol=1e-8)
    assert run.t.size > 400
    assert run.success
    scale = max(1.0, *(float(np.abs(ours).max()) for ours, _ in nodes.values()))
    worst = max(float(np.abs(ours - theirs).max()) / scale for ours, theirs in nodes.values())
    return worst if area is None else max(worst, float(np.abs(1e6 * run.area / area - 1.0).max()))


@pytest.mark.parametrize("seed", range(cases(140, 40)))
def test_random_networks_start_and_go_on_as_their_charge_says(seed: int) -> None:
    network = random_network(seed, swinging=True)
    times = np.array([0.0, 1e-8, 3e-7, 1e-5, 1.3e-4, 2e-3])
    expected = network.response(times)
    s = fs.simulate(fs.parse_netlist(deck_of(network, 1e-8, 2e-3)), t_eval=times)
    assert s.plan.tier == "linear"
    got = np.column_stack([s.node_voltages[f"n{i}"] for i in range(1, network.nodes + 1)])
    assert np.abs(got - expected).max() <= 1e-10 * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("seed", range(1000, 1000 + cases(40, 8)))
def test_random_networks_start_as_in_ngspice(seed: int) -> None:
    text = deck_of(random_network(seed), STEP, STOP, (".options reltol=1e-6",))
    circuit = fs.parse_netlist(text)
    # Every other one as exported.
    assert apart(circuit, text="" if seed % 2 else text, max_step=STEP) <= 3e-4


# In 2008 next to nothing moves, and ngspice's step runs out.
@pytest.mark.parametrize("seed", [seed for seed in range(2000, 2000 + cases(25, 6)) if seed != 2008])
@pytest.mark.filterwarnings("ignore:the gap voltage reaches")
def test_random_networks_with_a_finger_start_as_in_ngspice(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gap = {"tau": "1u"} if rng.random() < 0.4 else {}
    initial = [
        f".ic v({n})={round(float(rng.uniform(-30.0, 30.0)), 2)!r}" for n in ("top", "skin") if rng.random() < 0.6
    ]
    if gap and rng.random() < 0.6:
        initial.append(f".ic v(area)={round(float(rng.uniform(20.0, 40.0)), 2)!r}")
    text = deck_of(random_network(seed), STEP, STOP, (*finger("n1", "n2", **gap), *initial))
    assert apart(fs.parse_netlist(text), LAWS[seed % 2], max_step=STEP) <= 1.01e-3


@every_law
@pytest.mark.parametrize("top", [0.0, 40.0, -100.0])
def test_a_charged_cable_shares_its_charge_with_the_finger(law: str, top: float) -> None:
    cable = 250.0
    v = start(shipped("amplifier", ("150p", f"1n IC={cable}"), extra=f".ic v(top)={top}"), law)
    c = np.array([layer.c for layer in analytic.table1_layers(5000.0)])
    before = np.array([-top, top, 0.0])
    after = np.array([v["drive"] - v["top"], v["top"] - v["skin"], v["skin"]])
    if law == "local":
        # All layers have one area: what flows through each is c times the integral of A(u_gap) du.
        moved = c * (after - before) * (analytic.area_primitive(after[1]) - analytic.area_primitive(before[1]))
        moved /= after[1] - before[1]
    else:
        moved = c * (float(analytic.area(after[1])) * after - float(analytic.area(before[1])) * before)
    assert moved == pytest.approx(np.full(3, 1e-9 * (cable - v["drive"])), rel=1e-10)


@every_law
def test_a_charged_cable_is_as_in_ngspice(law: str) -> None:
    # Its first step takes the area at the end of what settles, not on the way: 1.2e-4.
    assert apart(shipped("amplifier", ("150p", "150p IC=100")), law) <= 2e-4


@every_law
@pytest.mark.parametrize("initial", [(), (".ic v(skin)=3",)])
def test_a_capacitor_across_an_ideal_source_moves_nothing(law: str, initial: tuple[str, ...]) -> None:
    lines = ("V1 a 0 SIN(20 50 5k)", *finger("a", "0"), *initial, ".tran 1u 100u uic")
    with_it, without = (
        fs.simulate(circuit, charge_law=law, rtol=1e-9) for circuit in (deck(*lines, "C1 a 0 1u IC=-500"), deck(*lines))
    )
    assert with_it.u_gap is not None
    assert np.abs(with_it.u_gap - without.u_gap).max() <= 1e-7


def test_a_source_delivers_what_the_start_takes() -> None:
    s = fs.simulate(deck("V1 a 0 10", "C1 a 0 1n IC=4", "C2 a b 1n", "C3 b 0 1n IC=2", "R1 b 0 1g", ".tran 1n 10n uic"))
    # C1 by 6 V; C2 and C3 share what 10 V are above 2 V.
    assert s.node_voltages["b"][0] == pytest.approx(6.0, rel=1e-13)
    assert s.q_source[0] == pytest.approx(6e-9 + 4e-9, rel=1e-12)


@pytest.mark.filterwarnings("ignore:the gap voltage reaches")
def test_a_start_past_the_fold_is_refused() -> None:
    circuit = shipped("amplifier", ("150p", "1n IC=600"), extra=".ic v(top)=100")
    assert start(circuit, "local")["drive"] > 500.0
    with pytest.raises(fs.InputError, match=r"start voltages settle past the fold of the mobile law; allowed: less"):
        fs.simulate(circuit, charge_law="mobile")


def test_ic_of_capacitors_counts_with_uic_only() -> None:
    lines = ("V1 a 0 10", "R1 a b 1k", "R2 b 0 1k", "C1 b 0 1n IC=3")
    assert start(deck(*lines, ".tran 1n 10n uic"))["b"] == pytest.approx(3.0, rel=1e-13)
    circuit = deck(*lines, ".tran 1n 10n")
    assert start(circuit)["b"] == pytest.approx(5.0, rel=1e-13)
    assert circuit.unused == ("IC= of C1",)


@pytest.mark.parametrize(("lines", "expected"), [case for _, *case in listed("held")])
def test_an_operating_point_with_ic(lines: str, expected: dict[str, float]) -> None:
    assert start(deck(*lines.split("|"), ".tran 1n 10n")) == pytest.approx(expected, rel=1e-13)


@every_law
@pytest.mark.parametrize("which", ["amplifier", "stack"])
def test_a_held_node_is_met_and_the_others_follow(which: str, law: str) -> None:
    if which == "stack":
        v, f = start(table1("SIN(26 100 100)", tran="10u 50m", extra=".ic v(top)=30"), law), 100.0
        assert v["drive"] == pytest.approx(26.0, rel=1e-12)
    else:
        v, f = start(shipped("amplifier", *DC_AMPLIFIER, extra=".ic v(top)=30"), law), 5000.0
        assert v["amp"] == pytest.approx(26.0, rel=1e-12)
        # Through the coating into 47 k; through gap and skin to ground.
        assert v["drive"] == pytest.approx(26.0 + 4.0 * 47.0 / 247.0, rel=1e-12)
    assert v["top"] == pytest.approx(30.0, rel=1e-12)
    assert v["skin"] == pytest.approx(at_skin(30.0, v["skin"], f), rel=1e-12)


@pytest.mark.filterwarnings("ignore:the gap voltage reaches")
@pytest.mark.parametrize("top", [500.0, 1000.0, 2000.0])
def test_an_area_that_swings_far_finds_its_rest(top: float) -> None:
    # At 100 Hz the skin's leak falls with the area, and the gap's voltage with it.
    v = start(table1("SIN(26 100 100)", tran="1u 100u", extra=f".ic v(top)={top}"))
    assert v["skin"] == pytest.approx(at_skin(top, v["skin"]), rel=1e-12)


def test_the_difference_of_two_nodes_is_node_p_minus_node_n() -> None:
    v = start(table1(tran="10u 50m uic", extra=".ic v(drive)=50 v(top)=30 v(skin)=10"))
    # The source takes its 50 V back at once, shared as 1/C.
    coat, gap, skin = (1.0 / layer.c for layer in analytic.table1_layers(100.0))
    whole = coat + gap + skin
    assert v["skin"] == pytest.approx(10.0 - 50.0 * skin / whole, rel=1e-10)
    assert v["top"] == pytest.approx(30.0 - 50.0 * (skin + gap) / whole, rel=1e-10)


@every_law
@pytest.mark.parametrize("changes", [(), DC_AMPLIFIER], ids=["uic", "operating point"])
def test_ic_of_the_area_starts_one_with_dynamics_of_its_own(law: str, changes: tuple[tuple[str, str], ...]) -> None:
    circuit = shipped("amplifier", SLOW, *changes, extra=".ic v(area)=20")
    s = fs.simulate(circuit, charge_law=law, t_eval=np.zeros(1))
    assert s.area is not None
    assert s.area[0] == pytest.approx(20e-6, rel=1e-13)
    assert circuit.unused == ()
    assert apart(circuit, law) <= 5e-5


@every_law
def test_a_start_from_rest_has_the_area_at_rest_though_the_source_jumps(law: str) -> None:
    lines = ["V1 a 0 PWL(0 60 0 160)", *finger("a", "0", tau="1m"), ".tran 1u 100u"]
    s = fs.simulate(deck(*lines), charge_law=law, t_eval=np.array([0.0, 1e-9]))
    skin = 0.0
    for _ in range(50):
        at_rest = float(analytic.area(60.0 * 1e6 / (1.2e6 + skin)))
        skin = analytic.table1_layers(5000.0)[2].r_area / at_rest
    assert s.area is not None
    assert s.area[-1] == pytest.approx(at_rest, rel=1e-5)


@pytest.mark.parametrize(("line", "said"), listed("no_starts"))
def test_a_voltage_or_an_area_that_cannot_be_is_refused(line: str, said: str) -> None:
    refuses(said, table1, extra=line)


def test_start_values_without_effect_are_listed() -> None:
    lines = ["V1 a 0 1", "R1 a b 1k", "R2 b c 1k", "C1 c 0 1n", ".ic v(b)=3 v(c)=1"]
    assert deck(*lines, ".tran 1n 10n uic").unused == (".ic v(b)",)
    assert deck(*lines, ".tran 1n 10n").unused == ()
    assert table1(extra=".ic v(area)=34").unused == (".ic v(area)",)
    assert table1(extra=".ic v(area)=34", tran="10u 10m").unused == ()


# The laws in turn: each deck is run under both.
@pytest.mark.parametrize("case", range(cases(2, 1) * len(listed("starts"))))
@pytest.mark.filterwarnings("ignore:of the source's energy")
def test_an_export_starts_where_the_deck_does(case: int) -> None:
    exported = listed("starts")
    name, changes, initial = exported[case % len(exported)]
    circuit = shipped(name, *changes, extra=f".ic {initial}")
    for law in LAWS if name == "two_fingers" else (LAWS[(case + case // len(exported)) % 2],):
        assert apart(circuit, law) <= 1.2e-4


def test_the_other_reading_of_eq_7_starts_the_same_there() -> None:
    circuit = table1(extra=".options work=total\n.ic v(top)=30 v(skin)=10", tran="10u 10m uic")
    for law in LAWS:
        assert apart(circuit, law) <= 1e-4
