"""Every device of the registry: its subcircuit in both ngspice libraries describes the same circuit as the entry."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.base.units import parse_number
from fingerspice.circuit.devices import DEVICES, DeviceSpec, ParameterSpec, Usual, called_devices
from fingerspice.netlist.reader import LIBRARIES, shipped_text
from fingerspice.physics.materials import EPS0
from ngspice_tools import beside
from scenes import warns

#: Parameters of the bodies that say how a run starts, and the reading of Eq. 7: the export writes them.
OF_THE_EXPORT = {"ic", "a_ic", "wk"}
#: Values for the devices' required parameters; a new device with others needs them here.
VALUES = {"d": 350e-6, "eps_r": 400.0, "rho": 1e4, "f": 1e3, "q": 5e-5, "n_cpe": 0.7}
every_layer = pytest.mark.parametrize("name", called_devices())


def bodies(law: str) -> dict[str, tuple[list[str], dict[str, str]]]:
    """Nodes and parameters with their defaults of each .subckt of a library."""
    text = re.sub(r"\n\+", " ", shipped_text(law))
    out = {}
    for line in re.findall(r"^\.subckt (.*)$", text, re.MULTILINE):
        head, _, parameters = line.partition("params:")
        name, *nodes = head.split()
        out[name] = nodes, dict(pair.split("=") for pair in parameters.split())
    return out


def line_of(name: str) -> str:
    """An X line of a device from nodes p to 0 with the values it needs."""
    required = [p.name for p in DEVICES[name].parameters if p.default is None]
    missing = [key for key in required if key not in VALUES]
    assert not missing, f"{name} requires {missing}: add values for them to VALUES in {Path(__file__).name}"
    area = " area" if DEVICES[name].is_layer else ""
    # That of a layer of 40 mm^2.
    values = VALUES if area else {**VALUES, "q": 2e-9}
    return f"X1 p 0{area} {name} " + " ".join(f"{key}={values[key]!r}" for key in required)


@pytest.mark.parametrize("law", LIBRARIES)
@every_layer
def test_a_layer_has_its_body_in_the_library_with_the_same_nodes_parameters_and_defaults(name: str, law: str) -> None:
    found = bodies(law)
    file = f"circuits/{LIBRARIES[law]}"
    assert name in found, f"{file} has no .subckt {name}: ngspice would refuse a deck that uses it"
    nodes, defaults = found[name]
    assert tuple(nodes) == DEVICES[name].nodes, f"{file}: the nodes of {name} differ from its entry"
    own = {p.name: p.default for p in DEVICES[name].parameters}
    assert set(defaults) - OF_THE_EXPORT == set(own), f"{file}: the parameters of {name} differ from its entry"
    for key, default in own.items():
        if default is not None:
            there = math.inf if defaults[key] == "inf" else parse_number(defaults[key])
            assert there == default, f"{file}: the default of {name} {key} differs from its entry"


@pytest.mark.parametrize("law", LIBRARIES)
@every_layer
def test_a_layer_is_the_same_here_and_in_ngspice(name: str, law: str) -> None:
    # Behind a capacitor that takes a good part of the voltage, so that the layer's impedance counts.
    area = "" if name in ("GAP", "CPE") else "Va area 0 35\n"
    text = (
        f"t\n.include {LIBRARIES[law]}\nV1 a 0 SIN(0 20 1k)\nC1 a p 100p\n{line_of(name)}\n{area}"
        ".tran 1u 2m 0 0.5u uic\n.nodeset v(area)=34.97\n.end\n"
    )
    text = text if DEVICES[name].is_layer else text.replace(".nodeset v(area)=34.97\n", "")
    circuit = fs.parse_netlist(text)
    assert circuit.warnings == ()
    run, nodes, _, theirs = beside(circuit, text, after=1e-5)
    ours, there = nodes["p"]
    peak = np.abs(ours).max()
    assert 0.5 < peak < 19.5
    assert np.abs(ours - there).max() <= 1e-5 * peak
    if DEVICES[name].is_layer:
        assert np.abs(1e6 * run.area - theirs).max() <= 5e-3


def test_a_new_device_is_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gel of two slabs in series: reader, run, phasor and export have it from its entry."""
    usual = Usual(1e-6, 1e-2, "made up for this test")

    def cells(v: object, at: float | None) -> np.ndarray:
        d, rho = v["d"], v["rho"]  # type: ignore[index]
        return np.array([[EPS0 * 10.0 / d, 0.0, 1.0 / (rho * d)], [EPS0 * 20.0 / d, 0.0, 0.0]])

    parameters = ParameterSpec("d", "m", usual=usual), ParameterSpec("rho", "ohm m", 1e4, usual)
    monkeypatch.setitem(DEVICES, "GEL", DeviceSpec("GEL", ("p", "n", "area"), parameters, cells))
    head = "t\nV1 a 0 SIN(0 20 1k)\nVa area 0 35\n.tran 10u 5m uic\n"
    gel = fs.parse_netlist(head + "X1 a 0 area gel d=100u\n")
    slabs = "X1 a b area SLAB d=100u eps_r=10 rho=1e4\nX2 b 0 area SLAB d=100u eps_r=20 rho=inf\n"
    two = fs.parse_netlist(head + slabs)
    one, other = fs.simulate(gel), fs.simulate(two)
    np.testing.assert_allclose(one.i_source, other.i_source, rtol=0, atol=1e-12 * np.abs(other.i_source).max())
    assert gel["X1"].values == {"d": 1e-4, "rho": 1e4}
    assert "X1 a 0 area GEL d=0.0001 rho=10000.0" in fs.export_netlist(gel)
    with pytest.raises(fs.InputError, match=r"devices are LAYER SLAB SKIN SKIN_DISPERSIVE GAP CPE CPE_LAYER GEL"):
        fs.parse_netlist(head + "X1 a 0 area QQQQ d=100u\n")
    warns("X1 d is 100 nm, outside 1 um to 10 mm", gel.replace, {"X1.d": "100n"})
    # An entry without its cells is refused when it is written.
    with pytest.raises(TypeError, match="device GEL: an area node and cells belong together; give both, or neither"):
        DeviceSpec("GEL", ("p", "n", "area"), ())
