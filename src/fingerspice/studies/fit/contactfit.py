"""Fit of a GAP's contact to measured areas and friction forces: alpha, m, beta, n, mu and c2 with their intervals."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.devices import DEVICES
from fingerspice.studies.fit.contactdata import ContactTask, Relation, relations_of, solved
from fingerspice.studies.fit.contactresult import ContactFit, contact_result
from fingerspice.studies.fit.measured import Given
from fingerspice.studies.fit.search import Unknown, bounds_of, profile_of, refuse_few
from fingerspice.waveforms.waveform import require

PARAMETERS = ("alpha", "m_exp", "beta", "n_exp", "mu", "c2")
# Misfit (rms, relative) of a relation from which on it is warned about.
_TOO_MUCH = 0.2
# The share of its value that a measured value without sigma is off by, at first.
_SHARE = 0.1


def fit_contact(
    circuit: Circuit,
    data: Given | Sequence[Given],
    parameters: Sequence[str] | None = None,
    *,
    finger: str | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    profiles: bool | Sequence[str] = False,
) -> ContactFit:
    """Fit the contact of a GAP (Eqs. 1 to 6) to measured ridge areas and friction forces.

    Parameters
    ----------
    circuit : Circuit
        With the values to start from, and those that are not fitted.
    data : mapping of str to array_like, shape (n,), or path, or a list of these
        Measured columns: ``area`` (m^2, at rest), ``area_sliding`` (m^2) and ``f_t`` (N, friction force); conditions:
        ``fn`` (N, normal load; the circuit's if missing), ``indentation`` (m) and ``u_gap`` (V, across the gap; 0 if
        missing). Standard deviations: ``sigma``, or ``area_sigma`` and so on where there are several measured columns;
        without, they are equal shares of the values, estimated from the residuals: one share for the areas under loads,
        one for those by indentation, one for the friction forces. A table (CSV) has the columns in a header, with
        units: ``fn (N), area (mm^2)``.
    parameters : sequence of str, optional
        Which of alpha, m_exp, beta, n_exp, mu and c2 to fit; by default all that the data depend on.
    finger : str, optional
        Name of the GAP, where there are several.
    bounds : mapping of str to tuple of float, optional
        Smallest and largest value by parameter, in the unit of the netlist.
    profiles : bool or sequence of str
        Parameters whose profile likelihood is wanted, or True for all.

    Returns
    -------
    ContactFit

    Raises
    ------
    InputError
        If a column, unit or parameter is unknown, or there are fewer data than parameters.

    Warns
    -----
    FingerspiceWarning
        If a relation misses its data by more than 20 % rms, or a value is unusual, and then probably in another unit.
    """
    require_circuit(circuit)
    gap = _gap(circuit, finger)
    own = circuit[gap].values
    relations = relations_of(data, own["fn"])
    largest = max(float(relation.fn.max()) for relation in relations)
    heavy = DEVICES["GAP"].parameter("fn").unusual("the data's largest", largest)
    if heavy is not None:
        warnings.warn(heavy, FingerspiceWarning, stacklevel=2)
    names = _wanted(parameters, relations)
    # What is fitted in its logarithm cannot start at 0.
    zero = {f"{gap}.{name}": DEVICES["GAP"].parameter(name).default for name in names if own[name] == 0.0}
    # The smallest load lets any contact be that is one under some load; at rest friction takes nothing off it.
    least = {f"{gap}.fn": min(float(relation.fn.min()) for relation in relations)}
    least |= {f"{gap}.c2": 0.0} if {one.kind for one in relations} <= {"area", "indentation"} else {}
    start = circuit.varied(least | {path: value for path, value in zero.items() if value is not None})
    paths = tuple(f"{gap}.{name}" for name in names)
    scale = np.concatenate([np.full(one.values.size, _SHARE) if one.sigma is None else one.sigma for one in relations])
    refuse_few(scale.size, paths)
    start, box = bounds_of(start, paths, {_named(gap, path): pair for path, pair in (bounds or {}).items()})
    task = ContactTask(start, tuple(map(Unknown, paths)), box, scale, gap, relations)
    wanted = task.profiled(profiles if isinstance(profiles, bool) else [_named(gap, path) for path in profiles])
    task, best, freedom = solved(task)
    if not best.found:
        raise InputError(
            f"the contact of {gap} cannot be started from: friction leaves no area under the loads of the data; "
            "allowed: values nearer to the data, such as a smaller c2 or a larger alpha"
        )
    # With the warnings that a user who writes these values would get.
    try:
        fitted = circuit.replace({path: float(value) for path, value in zip(paths, best.values, strict=True)})
    except InputError as refused:
        raise InputError(f"the fitted values do not go with the circuit's others: {refused.message}") from None
    found = contact_result(fitted, task, best, freedom)
    for relation, misfit in zip(relations, found.misfits, strict=True):
        if misfit > _TOO_MUCH:
            said = (
                f"the {relation.name} misses the data by {100.0 * misfit:.2g} % rms; its relation may not hold for them"
            )
            warnings.warn(f"{said}, or a column is in another unit", FingerspiceWarning, stacklevel=2)
    for path in wanted:
        one, limit = found.estimates[path], best.objective + found.reach[path] ** 2
        found.profiles[path] = profile_of(task, best, path, one.error / one.value, limit)
    return found


def _named(gap: str, name: str) -> str:
    """The path of a parameter that may be given without its GAP."""
    return name if "." in name else f"{gap}.{name}"


def _gap(circuit: Circuit, finger: str | None) -> str:
    gaps = {e.name.lower(): e.name for e in circuit.by_device("GAP")}
    if not gaps:
        raise InputError("this circuit has no GAP; allowed: a circuit with a finger, whose contact is fitted")
    if finger is None and len(gaps) > 1:
        raise InputError(f"this circuit has several GAPs; allowed: finger= one of {', '.join(gaps.values())}")
    name = next(iter(gaps.values())) if finger is None else gaps.get(finger.lower(), "")
    if not name:
        raise InputError(f"finger is {finger!r}; allowed: the name of a GAP, {', '.join(gaps.values())}")
    fixed = circuit[name].values["a_fix"]
    require(fixed == 0.0, f"{name}.a_fix", f"{fixed:g} mm^2", "0, as a given area follows no contact")
    return name


def _wanted(given: Sequence[str] | None, relations: Sequence[Relation]) -> tuple[str, ...]:
    """The parameters to fit, in the order of the netlist."""
    if given is None:
        kinds, voltage = {one.kind for one in relations}, any(np.any(one.u_gap != 0.0) for one in relations)
        areas = bool(kinds & {"area", "area_sliding"})
        needed = {
            "alpha": areas, "m_exp": areas, "beta": "indentation" in kinds or (areas and voltage),
            "mu": "f_t" in kinds, "c2": "area_sliding" in kinds,
        }  # fmt: skip
        needed["n_exp"] = needed["beta"]
        return tuple(name for name in PARAMETERS if needed[name])
    if isinstance(given, str) or not given:
        raise InputError(f"parameters is {given!r}; allowed: a sequence of {', '.join(PARAMETERS)}")
    bare = [name.rpartition(".")[2].lower() for name in given]
    for name in bare:
        require(name in PARAMETERS, "parameters", repr(name), ", ".join(PARAMETERS))
        require(bare.count(name) == 1, name, "named twice", "once")
    return tuple(name for name in PARAMETERS if name in bare)
