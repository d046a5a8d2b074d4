"""Arguments and options that several commands share, and the options of streaming."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

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
