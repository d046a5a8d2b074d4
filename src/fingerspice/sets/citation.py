"""What to cite for a run, as text and as BibTeX."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from fingerspice.base.pages import Page, Shown
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.provenance import in_force
from fingerspice.sets.parameters import ParameterSet, parameters
from fingerspice.sets.reading import ELEMENTS, Reference, SetValue, keys_in, references

#: The paper whose model is simulated.
MODEL = "Forsbach2021"
#: Programs that integrated the run, by the part of the method's name before the colon.
_METHODS = {"scipy": "SciPy", "torchdiffeq": "torchdiffeq"}


@dataclass(frozen=True, repr=False)
class Citation(Shown):
    """What to cite for a run.

    Attributes
    ----------
    statements : tuple of str
        What was used, one sentence or more each, with keys of references in brackets.
    references : tuple of Reference
        The works named in the statements, and those from which the values of the sets come.
    """

    statements: tuple[str, ...]
    references: tuple[Reference, ...]

    @property
    def bibtex(self) -> str:
        """The references as BibTeX entries, in UTF-8."""
        return "\n\n".join(reference.bibtex() for reference in self.references)

    def _page(self) -> Page:
        cited = [f"[{r.key}] {r.text()}" for r in self.references]
        return Page([*self.statements, "", *cited, "", self.bibtex])


def cite(circuit: Circuit, method: str) -> Citation:
    """What to cite for a run of a circuit by a method."""
    from fingerspice import __version__

    known = references()
    program = dataclasses.replace(known["fingerspice"], where={"note": f"version {__version__}"})
    found: dict[str, Reference] = {MODEL: known[MODEL], program.key: program}
    said = [f"The model is that of [{MODEL}], simulated with fingerspice {__version__} [{program.key}]."]
    for name, (kept, changed) in in_force(circuit).items():
        one = parameters(name)
        given = {path: _given(one, circuit, path) for path in kept}
        said.append(_sentence(one, given, changed))
        # The works behind the values that were used; those that only say how far a value may vary are not cited.
        texts = [one.claims, *(value.source for values in given.values() for value in values)] if kept else []
        found |= {key: known[key] for text in texts for key in keys_in(text)}
    if not circuit.sets:
        said.append("No set of parameters was applied.")
    said.append(
        f"All other values are those of the deck “{circuit.title}” and of changes made to it; cite their sources, "
        "which the program does not know."
    )
    key = _METHODS.get(method.partition(":")[0])
    if key is not None:
        said.append(f"The method {method} is that of [{key}].")
        found[key] = known[key]
    return Citation(tuple(said), tuple(found.values()))


def _sentence(one: ParameterSet, given: dict[str, list[SetValue]], changed: tuple[str, ...]) -> str:
    """What a set gave to the circuit, what of it is assumed, and what was changed since."""
    if not given:
        return f"All values of the set {one.name} were changed since it was applied."
    said = [f"The set {one.name} ({one.title}) gave {', '.join(given)}"]
    assumed = [path for path, values in given.items() if any(value.assumed for value in values)]
    said += [f"assumed, not published: {', '.join(assumed)}"] if assumed else []
    said += [f"changed since: {', '.join(changed)}"] if changed else []
    return f"{'; '.join(said)}."


def _given(one: ParameterSet, circuit: Circuit, path: str) -> list[SetValue]:
    """The values of a set that a path of the circuit got: one, or those of a waveform."""
    name, _, parameter = path.rpartition(".")
    devices = {e.name: e.device for e in circuit.elements}
    if path in devices or not name:
        return [value for value in one.values.values() if value.element == "source"]
    fitting = [value for value in one.values.values() if value.parameter == parameter]
    # Where the elements are unknown, any value of the set with this parameter may be meant.
    return [value for value in fitting if name not in devices or devices[name] in ELEMENTS[value.element]]
