"""Arguments that commands share, and the answers of `--json`, with the same keys for every outcome (docs/json.md)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fingerspice import __version__

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.solution import Solution

Answer = dict[str, Any]
#: Keys of every answer.
COMMON = (
    *("version", "command", "success", "status", "message", "failure", "warnings", "files"),
    *("title", "overrides", "sets", "charge_law", "method", "rtol"),
)
#: Further keys of each command.
OWN = {
    command: tuple(keys.split())
    for command, keys in {
        "run": "area tier t_stop figures_from error fundamental fold_margin_min signals feel stream",
        "ac": "area skin sweeps",
        "plan": "area tier reasons start rates stiff sensitivity error_bound plan_area",
        "compare": "frequency gaps phasor transient_mean_area transient_coupled",
        "limits": "peak voltage sweeps capability",
        "design": "kind rate samples carrier limit slew lead peak at_limit worst rms worst_share rms_share "
        "largest_wanted largest_reached corrections",
        "fit": "parameters correlation groups signal count residual_rms objective objectives notes profiles",
        "fit-contact": "gap parameters correlation relations objective notes profiles",
        "sweep": "scenes failed n seed figures shares store",
        "export": "",
        "figures": "",
        "explore": "url",
        "sets": "parameter_sets",
        "check": "chunks",
    }.items()
}
#: Figures of a signal; a figure that a signal lacks is null.
FIGURES = ("min", "max", "peak", "mean", "rms", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")


def blank(command: str | None) -> Answer:
    """An answer with all its keys, before any result is known."""
    keys = (*COMMON, *OWN.get(command or "", ()))
    empty = {"success": False, "warnings": [], "files": [], "overrides": {}, "sets": []}
    return {**dict.fromkeys(keys), **empty, "version": __version__, "command": command}


def of_circuit(circuit: Circuit, charge_law: str | None) -> Answer:
    """The part of an answer that describes the circuit; an unknown charge law is refused."""
    from fingerspice.circuit.circuit import CHARGE_LAWS
    from fingerspice.waveforms.waveform import require

    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    known = {"title": circuit.title, "overrides": dict(circuit.overrides), "sets": list(circuit.sets)}
    return {**known, "charge_law": law}


def of_run(solution: Solution) -> Answer:
    """The part of an answer that describes a run: its method and error, and figures of every signal in SI units."""
    from fingerspice.results.signals import SIGNALS

    s, rows = solution.summary(), []
    for name in [key.removesuffix("_peak") for key in s if key.endswith("_peak")]:
        signal, _, element = name.partition(":")
        if not element and signal in ("u_gap", "area", "f_el", "f_t", "friction") and len(solution.gaps) == 1:
            element = solution.gaps[0]
        figures = {figure: s.get(f"{name}_{figure}") for figure in FIGURES}
        rows.append({"signal": signal, "element": element or None, "unit": SIGNALS[signal][0], **figures})
    return {
        "charge_law": solution.charge_law, "method": solution.method, "area": solution.area_mode,
        "tier": solution.plan.tier, "error": vars(solution.error), "signals": rows, "t_stop": s["t_stop"],
        **{key: s.get(key) for key in ("figures_from", "fundamental", "fold_margin_min")},
    }  # fmt: skip


Deck = Annotated[Path, typer.Argument(metavar="DECK", help="Netlist file (.cir), - for standard input.")]
Out = Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="Folder of the files; out by default.")]
Name = Annotated[
    str | None, typer.Option("--name", metavar="NAME", help="Name of the files; that of the deck by default.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace results of other circuits, and other files.")]
Rtol = Annotated[float, typer.Option(help="Largest error of gap voltage and force, relative to their peaks.")]
ChargeLaw = Annotated[str | None, typer.Option(help="local or mobile; the included library's by default.")]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="PATH=VALUE|NAME", help="Change a value: Xgap.d=3u; or apply a named set: moist. Repeatable."
    ),
]


def _named(kind: str, example: str) -> Any:
    said = f"Apply a named set of this kind: {example} (list: fingerspice sets)."
    return typer.Option(f"--{kind}", metavar="[ELEMENT=]NAME", help=said)


Finger = Annotated[list[str] | None, _named("finger", "moist, or Xlight=dry for one of several")]
Coating = Annotated[list[str] | None, _named("coating", "3M")]
Drive = Annotated[list[str] | None, _named("drive", "Fig4-5kHz")]
_SPECS = "'SQUARE(200 100)', 'Vdrive=DC 5', 'WAV(a.wav gain=150)', 'TABLE(a.csv)'"
Source = Annotated[
    list[str] | None,
    typer.Option("--source", metavar="[NAME=]SPEC", help=f"Replace a source: {_SPECS}."),
]
Stop = Annotated[str | None, typer.Option(metavar="TIME", help="End of the run, s: 50m; TSTOP by default.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON (docs/json.md), nothing else on stdout.")]
NoPlot = Annotated[bool, typer.Option("--no-plot", help="Write no picture.")]
Schematic = Annotated[
    bool, typer.Option("--schematic", help="Draw the circuit, too: small in the picture, and NAME_schematic.svg.")
]
Streamed = Annotated[
    bool,
    typer.Option("--stream", help="Write a long run piece by piece to a Zarr store, which a second call goes on with."),
]
Chunk = Annotated[
    str | None, typer.Option(metavar="TIME", help="With --stream: length of a piece of the store, s; 10 by default.")
]
Signals = Annotated[
    str | None, typer.Option(metavar="NAME,...", help="With --stream: what is written; u_gap,f_el by default.")
]
NetCdf = Annotated[bool, typer.Option("--netcdf", help="With --stream: write the whole as NetCDF, too, at the end.")]
