"""The commands `fit` and `fit-contact`, which fit parameters of a deck to measured data: table and picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fingerspice.base.errors import InputError
from fingerspice.cli import answers
from fingerspice.cli.answers import AsJson, ChargeLaw, Deck, Name, NoPlot, Out, Overwrite, Set
from fingerspice.cli.options import read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering


def fit(
    table: Annotated[Path, typer.Argument(metavar="DATA.csv", help="Conditions and a measured mean, with units.")],
    deck: Deck,
    free: Annotated[str, typer.Option(metavar="PATH,...", help="Parameters to fit: Xgap.d,Xgap.r.")],
    groups: Annotated[
        str | None, typer.Option(metavar="COLUMN:PATH,...", help="Free parameters of each group: finger:Xgap.d.")
    ] = None,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    average: Annotated[str, typer.Option(help="periodic (periodic state) or run (over the deck's run).")] = "periodic",
    skin: Annotated[str, typer.Option(help="own, or follow: a SKIN's f is the source's frequency.")] = "own",
    profile: Annotated[bool, typer.Option("--profile", help="Profile likelihood of every parameter.")] = False,
    charge_law: ChargeLaw = None,
    changes: Set = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Fit parameters of DECK to measured means or a signal over time: values with intervals, CSV and picture.

    Example:

      fingerspice fit circuits/measured.csv circuits/fingerpad.cir --free Xgap.d,Xgap.r --skin follow
    """
    with Answering("fit", as_json, charge_law=charge_law) as answer:
        from fingerspice.studies.fit.circuitfit import fit as find

        grouped = None
        if groups is not None:
            column, _, paths = groups.partition(":")
            if not (column.strip() and paths.strip()):
                allowed = "a column of the data and paths, such as finger:Xgap.d,Xgap.r"
                raise InputError(f"--groups is {groups!r}; allowed: {allowed}")
            grouped = {column.strip(): [path.strip() for path in paths.split(",")]}
        circuit = read_circuit(deck, changes, None)
        answer.update(**answers.of_circuit(circuit, charge_law))
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        results.will_write("_fit.csv", lambda file: found.to_csv(file))
        results.will_draw("_fit.png", lambda: found.plot(), unless=no_plot)
        found = find(
            circuit, table, [path.strip() for path in free.split(",")], groups=grouped, average=average, skin=skin,
            charge_law=charge_law, profiles=profile,
        )  # fmt: skip
        answer.update(**found.to_dict())
        answer.give(lambda: str(found), results.ready())


def fit_contact(
    tables: Annotated[
        list[Path], typer.Argument(metavar="DATA.csv ...", help="Areas and friction forces, with units.")
    ],
    deck: Deck,
    free: Annotated[
        str | None, typer.Option(metavar="NAME,...", help="alpha,m_exp,beta,n_exp,mu,c2; those that the data tell.")
    ] = None,
    finger: Annotated[str | None, typer.Option(metavar="GAP", help="Which of several GAPs.")] = None,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    profile: Annotated[bool, typer.Option("--profile", help="Profile likelihood of every parameter.")] = False,
    changes: Set = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Fit the contact of DECK's finger to measured ridge areas and friction forces: values with intervals.

    Example:

      fingerspice fit-contact circuits/contact.csv circuits/indentation.csv circuits/fingerpad.cir
    """
    with Answering("fit-contact", as_json) as answer:
        from fingerspice.studies.fit.contactfit import fit_contact as find

        circuit = read_circuit(deck, changes, None)
        answer.update(**answers.of_circuit(circuit, None))
        names = None if free is None else [one.strip() for one in free.split(",")]
        found = find(circuit, list(tables), names, finger=finger, profiles=profile)
        results = Results(deck, circuit, out, name, overwrite, None)
        results.will_write("_contact.csv", found.to_csv)
        results.will_draw("_contact.png", found.plot, unless=no_plot)
        answer.update(**found.to_dict())
        answer.give(lambda: str(found), results.ready())
