"""Scenes: a circuit under one charge law and area mode, as arrays for its equations, areas and sources' peak."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray, Remembering
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.describe import COUPLING, freezing_error
from fingerspice.circuit.network import Modes, Network, loop_network, mean_areas, network_modes, network_of
from fingerspice.circuit.statespace import Stack, build_stack, loop_of
from fingerspice.engine.network import Net
from fingerspice.engine.one_area.model import Model
from fingerspice.engine.one_area.system import build_system
from fingerspice.numerics.modes import modes
from fingerspice.physics.contact import fixed_area_curve
from fingerspice.waveforms.waveform import Waveform, require

# Error allowed for taking a dispersive skin's data at one frequency, relative to the error asked for.
FREEZING_SHARE = 0.3
# Smallest peak of a source other than 0, V; below it, forces and errors are denormal numbers with too few digits.
LEAST_PEAK = 1e-300
# Range of an area's curve over the source's peak, as the voltage of discharging layers adds to the gap's share of a
# jump; gap voltages (V) that it covers under current sources, which do not bound it, and if the peak is unknown.
BEYOND_PEAK, DRIVEN_BY_CURRENT, PEAK_UNKNOWN = 1.3, 300.0, 1.0


@dataclass(frozen=True, eq=False)
class Scene(Remembering):
    """A circuit under one charge law and area mode, as arrays; the circuit caches it from run to run."""

    network: Network  # The circuit's network; for a series stack that of its loop
    charge_law: str
    area_mode: str
    fixed: tuple[float | None, ...]  # Each area if it is fixed, m^2; None if it follows its gap
    u_peak: float  # Sum of the largest |U| of the voltage sources, V; 0 where it is not known
    u_size: float  # The larger one of `u_peak` and the sum of the peaks of all parts that may cancel in the sources, V
    u_top: float  # Largest gap voltage that the areas' curves cover, V
    model: Model | None = None  # Model of a series stack, whose modes follow from a secular equation
    # Frequency (Hz) at which a dispersive skin's data are taken, if one is accurate enough for the error asked for, and
    # the error of the gap voltage of doing so, relative to its peak
    skin: tuple[float, float] | None = None

    @cached_property
    def coupled(self) -> bool:
        """Whether some area follows its gap's voltage."""
        return any(area is None for area in self.fixed)

    @cached_property
    def net(self) -> Net:
        """The network with its area curves, for compiled code."""
        network, model, count = self.network, self.model, len(self.fixed)
        gap, tau, curves = np.full(count, -1), np.zeros(count), [np.zeros(1)] * count
        area0 = np.array(self.fixed, float)
        parts = zip(self.fixed, network.contacts, network.gaps, network.areas, strict=True)
        for i, (fixed, contact, cell, area) in enumerate(parts):
            if fixed is None and contact is not None and cell is not None and area.gap is not None:
                gap[i], tau[i] = cell, area.gap.values["tau"]
                area0[i] = contact.area_at_rest if model is None else model.area0
                curves[i] = contact.curve(self.u_top) if model is None else model.curve
        padded = np.zeros((count, max((c.size for c in curves), default=1)))
        for row, curve in zip(padded, curves, strict=True):
            row[: curve.size] = curve
        slow = np.where(tau > 0.0, np.cumsum(tau > 0.0) - 1, -1)
        return Net._make((self.charge_law == "mobile", *network.arrays, gap, area0, tau, slow, padded))

    def switched(self, on: tuple[bool, ...]) -> Net:
        """The equations with these switches on."""
        k, b, through, delivered, _ = self.network.switched(on).arrays[6:]
        return self.net._replace(k=k, b=b, through=through, delivered=delivered)

    @property
    def shown(self) -> Scene:
        """The scene in whose form exponential steps record a stack: a voltage for each layer, not for each cell."""
        # Not cached where it is this one: an object that holds itself is freed by garbage collection only.
        stack = self.network.stack
        if stack is None or (whole := stack.by_layer) is stack:
            return self
        return self.remember(("shown",), lambda: replace(self, network=loop_network(whole)))

    @cached_property
    def modes(self) -> Modes:
        """Modes of the circuit with its fixed areas, and those at 0 V of areas that follow their gap."""
        return self.modes_at(self.net.area0)

    @cached_property
    def decay(self) -> ComplexArray:
        """As `Network.decay`, at the same areas."""
        return self.network.decay(self.net.area0)

    @cached_property
    def rates(self) -> FloatArray:
        """Decay rates of these modes, 1/s; of modes that may oscillate, the real parts."""
        if self.network.active:
            return np.asarray(self.decay.real)
        if self.model is None:
            return self.modes.rates
        rates, _, _, _ = modes(self.model.rate + self.model.rate0 / self.model.area0, self.model.k)
        return np.asarray(rates)

    def modes_at(self, area: FloatArray) -> Modes:
        """Modes of the circuit at areas (n_area,) in m^2."""
        if self.model is None:
            return network_modes(self.network, area)
        fixed, turn, n = float(area[0]), self.turn, self.model.gap.size
        model = self.model._replace(coupled=False, mobile=False, area0=fixed, curve=fixed_area_curve(fixed))
        system = build_system(model, 1e-13, (1.0 / fixed, 1.0 / fixed), np.eye(n), np.zeros((0, n + 1)))
        return Modes(
            system.rates[0], system.gain[0][:, None], turn[:, None] * system.live[0], system.project[0] * turn,
            -(turn * self.model.k[:-1])[:, None], np.zeros((turn.size, turn.size + 1)),
        )  # fmt: skip

    @cached_property
    def turn(self) -> FloatArray:
        """For a stack: sign of every live voltage relative to the direction of the loop, shape (n,)."""
        stack = self.network.stack
        assert stack is not None
        return stack.sign[list(stack.state_order[:-1])]

    @cached_property
    def measured(self) -> tuple[int, ...]:
        """Cells for whose voltages errors are stated: the gaps, or without gaps the cell of smallest capacitance."""
        if (gaps := self.network.finger_cells) or not self.network.cells:
            return gaps
        return (int(np.argmin(self.network.capacitance(self.net.area0))),)


def scene_of(
    circuit: Circuit, charge_law: str | None, area: str | float, t_stop: float | None, rtol: float = 0.0
) -> Scene:
    """The circuit's scene, made on first use; `rtol` decides whether a dispersive skin may be held at one frequency."""
    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    stop = t_stop or (circuit.tran.stop if circuit.tran else 1.0)
    skin = _freezing(circuit, stop, rtol)

    def make() -> Scene:
        network = network_of(circuit, None if skin is None else skin[0])
        # Each area (m^2), None for one that follows its gap, and the name of the area mode.
        fixed, mode = tuple(a.given for a in network.areas), str(area)
        if not isinstance(area, str):
            fixed, mode = tuple(map(float, network.held(area))), f"{area:g} m^2"
        elif None not in fixed:
            mode = f"{fixed[0]:g} m^2 (from the deck)" if len(fixed) == 1 else "given by the deck" if fixed else "none"
        elif area != "coupled":
            fixed = tuple(map(float, mean_areas(network) if area == "mean" else network.areas_at_rest))
        waves = [*zip(network.waveforms[: network.n_voltage], network.lift or itertools.repeat(1.0), strict=False)]
        u_peak = sum(lift * _largest_voltage(wave, stop, network.stack is not None) for wave, lift in waves)
        u_size = max(u_peak, sum(lift * wave.cancelling(0.0, stop) for wave, lift in waves))
        by_current = DRIVEN_BY_CURRENT if len(network.sources) > network.n_voltage or network.active else 0.0
        top = BEYOND_PEAK * u_peak + by_current or PEAK_UNKNOWN
        model = None if network.stack is None else _model(network.stack, law, fixed[0], top)
        return Scene(network, law, mode, fixed, u_peak, u_size, top, model, skin)

    return circuit.remember(("scene", law, area, stop, skin), make)


def _freezing(circuit: Circuit, stop: float, rtol: float) -> tuple[float, float] | None:
    """`Scene.skin`, if the error is small compared with `rtol`."""
    if not circuit.by_device("SKIN_DISPERSIVE") or loop_of(circuit) is None:
        return None
    stack, allowed = build_stack(circuit), FREEZING_SHARE * rtol
    if stack.contact is None or not (math.isfinite(stop) and stop > 0.0):
        return None
    areas = stack.contact.area(np.linspace(0.0, _largest_voltage(stack.waveform, stop), 65))
    area = stack.area_given or float(np.median(areas))
    change = 0.0 if stack.area_given else float(np.ptp(areas)) / area
    # Where this part of the error alone is too large, the expensive part need not be computed.
    fundamental = None if COUPLING * change > allowed else stack.waveform.fundamental
    if fundamental is None:
        return None
    f = fundamental.frequency
    error = circuit.remember(("freezing", stop), lambda: freezing_error(circuit, f, area, change, stop))
    return (f, error) if error <= allowed else None


def _largest_voltage(waveform: Waveform, stop: float, whole: bool = True) -> float:
    """Largest |U| (V) up to time `stop` (s), or with `whole` over a whole period; 0 where it is not finite."""
    if not (math.isfinite(stop) and stop > 0.0):
        return 0.0
    if whole and waveform.period is not None:
        stop = waveform.settled + waveform.period
    # Key and value are one entry, because another thread may replace it at any time.
    kept, peak = waveform.kept.get("peak", (None, 0.0))
    if kept != stop:
        _, peak = waveform.kept["peak"] = stop, waveform.peak(0.0, stop)
    require(not 0.0 < peak < LEAST_PEAK, "the source's peak", f"{peak:g} V", f"0, or {LEAST_PEAK:g} V or more")
    return peak if math.isfinite(peak) else 0.0


def _model(stack: Stack, law: str, fixed: float | None, u_top: float) -> Model:
    """The model of a stack for compiled code; only the range of the area's curve depends on the source."""
    if fixed is not None:
        area0, curve = fixed, fixed_area_curve(fixed)
    else:
        assert stack.contact is not None
        area0, curve = stack.contact.area_at_rest, stack.contact.curve(u_top)

    def make() -> Model:
        order, n = list(stack.state_order), stack.c.size - 1
        probe = int(np.argmin(stack.c)) if stack.gap is None else stack.gap
        k, leaks = stack.k[order], stack.leak_rates(area0)
        slow = int(np.argmin(leaks))
        rates, _, _, _ = modes(leaks[order], k)
        fastest = float(rates.max(initial=0.0))
        # Weights of the states in each cell's voltage beyond its share k U.
        of_probe, of_slow = np.vstack([np.eye(n), np.full(n, -1.0)])[[order.index(probe), order.index(slow)]]
        return Model(
            mobile=law == "mobile", coupled=fixed is None, k=k, rate=(stack.g_area / stack.c)[order],
            rate0=(stack.g_total / stack.c)[order], k_gap=float(stack.k[probe]), gap=of_probe, s=stack.s,
            slow=np.append(of_slow, [stack.k[slow], stack.c[slow], stack.g_area[slow], stack.g_total[slow]]),
            area0=area0, tau=1.0 / fastest if fastest > 0.0 else math.inf, curve=curve,
        )  # fmt: skip

    return stack.remember(("model", law, fixed), make, 2)._replace(curve=curve)
