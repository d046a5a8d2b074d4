"""Contact laws: each gives the ridge area at a gap voltage, and has parameters of its own beside those of every GAP."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, Remembering, real_number, real_numbers
from fingerspice.circuit.devices import DEVICES, OF_EVERY_LAW, DeviceSpec, ParameterSpec
from fingerspice.physics import laws
from fingerspice.waveforms.waveform import refuse, require

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Element
    from fingerspice.physics.contact import LawContact

#: Name of the paper's law, which a GAP has by default; and every other law by its name.
PAPER, LAWS = "jkr", dict[str, "ContactLaw"]()


@dataclass(frozen=True, eq=False)
class ContactLaw(Remembering):
    """A relation between gap voltage and ridge contact area, for ``law=`` of a GAP (docs/howto/contact-law.md).

    Decks that are read after it was made find it by its name. The area is independent of the charge law; of results,
    only the area itself depends on the law: friction is mu (F_N + F_el), or with `p_sat` follows from both.

    Parameters
    ----------
    name : str
    area : callable
        ``area(u, p)``: ridge area, m^2, shape (n,), at gap voltages `u` of 0 V or more, shape (n,). The mapping `p` has
        `d` (m), `eps_r`, `fn` (N), `mu` and `p_sat` (Pa) of the GAP, and the law's own parameters. The areas may end at
        a voltage: NaN, 0 or less stands for none.
    parameters : mapping of str to float, optional
        Own parameters with their defaults. Those of the paper's law (alpha, m_exp, beta, n_exp, c2) keep their units in
        decks, and are in SI units in `p`.
    gap : callable, optional
        ``gap(u, p)``: height of the gap, m, likewise; `d` by default. A gap whose height follows its voltage is run by
        implicit steps.

    Raises
    ------
    InputError
        For a name that is no word or that of a law of this package, an area that is no function, or a parameter that
        has the name of a parameter of every GAP or no number.
    """

    name: str
    area: Callable[[FloatArray, Mapping[str, float]], ArrayLike]
    parameters: Mapping[str, float | ParameterSpec] = field(default_factory=dict)
    gap: Callable[[FloatArray, Mapping[str, float]], ArrayLike] | None = None

    def __post_init__(self) -> None:
        require(isinstance(self.name, str), "the name of a contact law", repr(self.name), "a word")
        what, name = f"contact law {self.name}", self.name.lower()
        allowed = f"a word but {', '.join(_OWN)}"
        require(name.isidentifier() and name not in _OWN, "contact law", repr(self.name), allowed)
        require(callable(self.area), f"the area of {what}", repr(self.area), "a function area(u, p)")
        require(self.gap is None or callable(self.gap), f"the gap of {what}", repr(self.gap), "a function gap(u, p)")
        mapping = isinstance(self.parameters, Mapping) and all(isinstance(own, str) for own in self.parameters)
        require(mapping, f"the parameters of {what}", repr(self.parameters), "a mapping such as {'k': 1.0}")
        object.__setattr__(self, "parameters", dict(self.parameters))
        for own, default in self.parameters.items():
            if not isinstance(default, ParameterSpec):
                number = real_number(f"{what}: {own}", default, "a number")
                require(math.isfinite(number), f"{what}: {own}", f"{number}", "a finite number")
            known = own.isidentifier() and own.islower() and own not in (*OF_EVERY_LAW, "law")
            require(known, f"a parameter of {what}", repr(own), f"a word in lower case but {', '.join(OF_EVERY_LAW)}")
        LAWS[name] = self

    @classmethod
    def from_table(cls, name: str, u_gap: ArrayLike, area: ArrayLike) -> ContactLaw:
        """The law of measured areas (m^2) at ascending gap voltages (V) from 0 V on, both of shape (n,).

        Between them it is a monotone cubic (Fritsch and Carlson 1980), and beyond the last one there is no area.

        Raises
        ------
        InputError
            For fewer than 3 values, voltages that do not ascend from 0 V, or areas that are not positive.
        """
        from scipy.interpolate import PchipInterpolator

        what, allowed = f"contact law {name}", "numbers, shape (n,)"
        u, areas = real_numbers(f"{what}: u_gap", u_gap, allowed), real_numbers(f"{what}: area", area, allowed)
        shapes = f"{what} has u_gap of shape {u.shape} and area of shape {areas.shape}"
        refuse(u.ndim != 1 or u.shape != areas.shape or u.size < 3, f"{shapes}; allowed: two rows of 3 or more")
        single = f"{what} is no function: its gap voltages have to ascend from 0 V, each of them once"
        refuse(u[0] != 0.0 or not np.all(np.diff(u) > 0.0), single)
        refuse(not np.all((areas > 0.0) & (areas < np.inf)), f"{what} has an area that is not above 0")
        table = PchipInterpolator(u, areas, extrapolate=False)
        return cls(name, partial(_of_table, table))

    @cached_property
    def spec(self) -> DeviceSpec:
        """The entry of a GAP with this law."""
        gap = DEVICES["GAP"]
        known: dict[str, Any] = {p.name: p for p in gap.parameters}
        any_number = ParameterSpec("", may_be_zero=True, least=-1e30)
        own = (x if isinstance(x, ParameterSpec) else
               dataclasses.replace(known.get(name, any_number), name=name, default=float(x))
               for name, x in self.parameters.items())  # fmt: skip
        return dataclasses.replace(gap, parameters=(*(known[name] for name in OF_EVERY_LAW), *own))

    def contact(self, v: Mapping[str, Any]) -> LawContact:
        """The contact of a GAP with this law and these values, SI; arrays (n,) stand for one at each gap voltage."""
        from fingerspice.physics.contact import LawContact

        own = {name: v[name] for name in ("d", "eps_r", "fn", "mu", "p_sat", *self.parameters)}
        return LawContact(v["d"], v["eps_r"], v["fn"], v["mu"], self.name, self.area, own, self.gap, p_sat=v["p_sat"])


def _of_table(table: Callable[[FloatArray], FloatArray], u: FloatArray, p: Mapping[str, float]) -> FloatArray:
    return np.asarray(table(u))


def acting_law(gap: Element) -> ContactLaw | None:
    """The law of a GAP's area; None for the paper's where it is in closed form, as it is without `p_sat`."""
    return gap.law or (None if math.isinf(gap.values["p_sat"]) else _TWO_SCALES)


def law_of(given: object) -> ContactLaw | None:
    """A law, or that of a name; None for the paper's."""
    if isinstance(given, ContactLaw):
        return given
    known = {PAPER: None, **LAWS}
    require(str(given).lower() in known, "contact law", repr(given), f"{', '.join(known)}, or one made by ContactLaw")
    return known[str(given).lower()]


_OWN: tuple[str, ...] = ()
_PAPERS = (p.name for p in DEVICES["GAP"].parameters if p.name not in OF_EVERY_LAW)
# From m_exp = 1 on there is no area, or two.
_BELOW_1 = dataclasses.replace(DEVICES["GAP"].parameter("m_exp"), most=0.999)
ContactLaw("dmt", laws.dmt, {"alpha": 54.4, "m_exp": _BELOW_1})
_SLOPE = ParameterSpec("slope", "mm^2/N", 72.5, meaning="area per load")
ContactLaw("linear", laws.linear, {"slope": _SLOPE, "a_max": ParameterSpec("a_max", "mm^2", 100.0, meaning="largest")})
_GIVEN = ((name, DEVICES["GAP"].parameter(name)) for name in ("alpha", "m_exp", "beta", "n_exp", "c2"))
_CLOSES = {
    "u0": ParameterSpec("u0", "m", 0.5e-6, meaning="softness", least=1e-8),
    "p_ref": ParameterSpec("p_ref", "Pa", 14.3e3, meaning="pressure at d"),
}
ContactLaw("pullin", laws.pullin, {**dict(_GIVEN), **_CLOSES}, laws.closing_gap)
# Not by a name, but wherever the paper's law has a p_sat.
_TWO_SCALES = ContactLaw("two_scales", laws.two_scales, dict.fromkeys(_PAPERS, 1.0))
del LAWS["two_scales"]
_OWN = (PAPER, *LAWS)
