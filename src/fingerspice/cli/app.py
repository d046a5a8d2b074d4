"""The command line. Exit codes: 0 for success, 1 for a failed solve, 2 for bad input or a full disk."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Annotated

import typer

from fingerspice.base.arrays import positive_row
from fingerspice.base.errors import InputError
from fingerspice.cli import answers, options
from fingerspice.cli import design as designs
from fingerspice.cli import fit as fits
from fingerspice.cli import sweep as sweeps
from fingerspice.cli.answers import (
    AsJson,
    ChargeLaw,
    Chunk,
    Coating,
    Deck,
    Drive,
    Finger,
    Name,
    NetCdf,
    NoPlot,
    Out,
    Overwrite,
    Rtol,
    Schematic,
    Set,
    Signals,
    Source,
    Stop,
    Streamed,
)  # fmt: skip
from fingerspice.cli.check import check
from fingerspice.cli.design import limits
from fingerspice.cli.explore import explore
from fingerspice.cli.figures import figures
from fingerspice.cli.options import area_from_text, check_output, read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.run_files import Touch, large_sweep, run_streamed, written
from fingerspice.cli.terminal import Answering, answer_usage, listen, plain_errors, progress, say
from fingerspice.results.outcome import SolveError


def sets(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="A set; without it all are listed.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the named sets of parameters, or show the values of one with their ranges and sources.

    Examples:

      fingerspice sets

      fingerspice sets moist
    """
    from fingerspice.sets.parameters import parameters

    with Answering("sets", as_json) as answer:
        found = parameters() if name is None else parameters(name)
        shown = parameters().values() if name is None else [parameters(name)]
        answer.update(parameter_sets=[one.to_dict() for one in shown])
        answer.give(lambda: str(found))


app = typer.Typer(
    context_settings={"help_option_names": ["--help", "-h"]},
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="SPICE for the sliding fingertip: voltages, contact area and friction on an electroadhesive touchscreen.",
)


def main() -> None:
    """Entry point of the `fingerspice` command."""
    # Loading libraries creates a million objects and no garbage; with the default threshold, garbage collection takes a
    # fifth of a run.
    gc.set_threshold(500_000)
    listen()
    with plain_errors():
        try:
            app(standalone_mode=True)
        except SystemExit as exit_:
            # typer has refused the usage with a message on stderr; with --json print an answer as well.
            refused = getattr(exit_.__context__, "format_message", None)
            if refused is not None:
                answer_usage(refused())
            raise
        finally:
            # Flush the text that typer has printed.
            say(end="")


@app.command()
def run(
    deck: Deck,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    rtol: Rtol = 1e-8,
    charge_law: ChargeLaw = None,
    area: Annotated[str, typer.Option(help="coupled, mean, frozen, or an area in m^2.")] = "coupled",
    method: Annotated[
        str, typer.Option(help="auto, exponential, radau, scipy:LSODA, torchdiffeq:dopri5, ...")
    ] = "auto",
    changes: Set = None,
    finger: Finger = None,
    coating: Coating = None,
    drive: Drive = None,
    source: Source = None,
    stop: Stop = None,
    start: Annotated[
        str, typer.Option(help="deck (as its .tran says), uncharged, dc, periodic; or TIME of the first output: 5m.")
    ] = "deck",
    jumps: Annotated[
        str, typer.Option(help="Rows at jumps of the source: both, or none, so that time rises strictly.")
    ] = "both",
    csv: Annotated[bool, typer.Option("--csv", help="Write CSV instead of NetCDF.")] = False,
    stream: Streamed = False,
    chunk: Chunk = None,
    signals: Signals = None,
    netcdf: NetCdf = False,
    feel: Annotated[bool, typer.Option("--feel", help="Say, and draw, what the hand feels of the friction.")] = False,
    schematic: Schematic = False,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Simulate DECK in time: a summary, a data file and a picture.

    Examples:

      fingerspice run circuits/fingerpad.cir

      fingerspice run circuits/fingerpad.cir --source 'SQUARE(200 100)' --set Xgap.d=3u --csv

      fingerspice run circuits/fingerpad.cir --stop 20m --start periodic

      fingerspice run circuits/click.cir --source 'WAV(circuits/texture.wav gain=150)' --start 0.1 --stop 0.5

      fingerspice run circuits/fingerpad.cir --charge-law mobile --rtol 1e-6 --json --no-plot

      fingerspice run circuits/am_carrier.cir --feel

      fingerspice run circuits/fingerpad.cir --finger moist --coating 3M-insulating --drive Fig4-5kHz

      fingerspice run long.cir --stream --rtol 1e-5 --signals u_gap,f_t
    """
    from fingerspice.results.report import summary_table
    from fingerspice.solve.simulation import check_arguments, simulate

    with Answering("run", as_json, charge_law=charge_law, method=method, rtol=rtol, area=area) as answer:
        circuit = read_circuit(deck, changes, source, finger=finger, coating=coating, drive=drive)
        answer.update(**answers.of_circuit(circuit, charge_law))
        circuit, start = options.with_times(circuit, stop, start)
        if circuit.tran is None:
            raise InputError(f"{deck} has no .tran line; allowed: .tran TSTEP TSTOP [TSTART [TMAX]] [uic], or --stop")
        t_stop = None if stop is None else circuit.tran.stop
        fixed = area_from_text(area)
        check_arguments(rtol, method, fixed, start, jumps)
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        if stream or chunk or signals or netcdf:
            options.check_streamed(stream, csv=csv, feel=feel, schematic=schematic)
            how = {"charge_law": charge_law, "area": fixed, "rtol": rtol}
            how |= {"method": method, "start": start, "t_stop": t_stop}
            run_streamed(answer, results, circuit, how, chunk=chunk, signals=signals, netcdf=netcdf)
            return
        data = results.file(".csv" if csv else ".nc")
        picture = None if no_plot else results.file(".png")
        drawn = results.file("_schematic.svg") if schematic else None
        touch = Touch(circuit, None if no_plot else results) if feel else None
        with progress() as update:
            solution = simulate(
                circuit, t_stop=t_stop, charge_law=charge_law, area=fixed, rtol=rtol, method=method,
                start=start, jumps=jumps, throw=False, progress=update,
            )  # fmt: skip
        if as_json:
            answer.update(**answers.of_run(solution))
        writes = written(solution, data, picture, results, drawn)
        if touch is not None and solution.success:
            answer.update(feel=touch.look(solution))
            writes += touch.writes
        answer.give(lambda: "\n\n".join([summary_table(solution), *(touch.said if touch else ())]), writes)
        if solution.failure is not None:
            raise SolveError(solution.failure, solution)
        if touch is not None and touch.failed is not None:
            raise touch.failed


@app.command()
def ac(
    deck: Deck,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    sweep: Annotated[
        str | None, typer.Option(metavar="'dec N F1 F2'", help="Sweep; the deck's .ac line by default.")
    ] = None,
    area: Annotated[str, typer.Option(help="mean, frozen, coupled (large signal), or an area in m^2.")] = "mean",
    amplitude: Annotated[
        list[float] | None, typer.Option(help="With --area coupled: source amplitude in V; may be repeated.")
    ] = None,
    skin: Annotated[str, typer.Option(help="SKIN's data: swept, at each frequency; own, at its f.")] = "swept",
    finger: Annotated[str | None, typer.Option(metavar="GAP", help="Which of several GAPs.")] = None,
    charge_law: ChargeLaw = None,
    rtol: Rtol = 1e-8,
    changes: Set = None,
    source: Source = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Phasor sweep of DECK: gap voltage, phase, area and mean force against frequency.

    The source's AC magnitude and phase drive it; without AC its fundamental does.

    Examples:

      fingerspice ac circuits/fingerpad.cir --sweep 'dec 10 10 100k' --out out

      fingerspice ac circuits/fingerpad.cir --area frozen --json

      fingerspice ac circuits/fingerpad.cir --area coupled --amplitude 50 --amplitude 200
    """
    from fingerspice.results.phasor_solution import phasor_csv, phasor_tables
    from fingerspice.solve.simulation import check_arguments
    from fingerspice.studies.phasors import phasor
    from fingerspice.studies.sweeps import sweep_frequencies

    how = "steady_state" if area == "coupled" else "phasor"
    with Answering("ac", as_json, charge_law=charge_law, method=how, rtol=rtol, area=area, skin=skin) as answer:
        circuit = read_circuit(deck, changes, source)
        answer.update(**answers.of_circuit(circuit, charge_law))
        options.check_finger(finger, circuit)
        check_arguments(rtol)
        frequencies = sweep_frequencies(options.sweep(sweep, circuit))
        if area == "coupled" and skin != "swept":
            raise InputError(f"--skin {skin} does not go with --area coupled; allowed: --skin swept")
        if amplitude and area == "coupled":
            positive_row("amplitude", amplitude, "V")
        if area != "coupled":
            if amplitude:
                raise InputError(f"--amplitude goes with --area coupled, not with --area {area}")
            found = [phasor(circuit, frequencies, area=area_from_text(area), skin=skin, finger=finger)]
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        data = results.file("_ac.csv")
        picture = None if no_plot else results.file("_ac.png")
        if area == "coupled":
            found = [*large_sweep(circuit, frequencies, amplitude, charge_law=charge_law, rtol=rtol, finger=finger)]
        results.open()

        def drawn() -> object:
            from fingerspice.plots.traces import plot_phasor

            return plot_phasor(found, circuit)

        answer.update(sweeps=[r.to_dict() for r in found] if as_json else None)
        writes = [lambda: phasor_csv(found, data), *results.pictures(picture, drawn)]
        answer.give(lambda: phasor_tables(found, circuit), writes)


@app.command()
def plan(
    deck: Deck,
    rtol: Rtol = 1e-8,
    charge_law: ChargeLaw = None,
    area: Annotated[str, typer.Option(help="coupled, mean, frozen, or an area in m^2.")] = "coupled",
    stop: Stop = None,
    charge: Annotated[bool, typer.Option(help="Whether the source's charge and current are wanted.")] = True,
    changes: Set = None,
    source: Source = None,
    as_json: AsJson = False,
) -> None:
    """Tell which model DECK needs for the error asked for, and why, without a run.

    Examples:

      fingerspice plan circuits/fingerpad.cir

      fingerspice plan circuits/fingerpad.cir --area frozen --rtol 1e-6 --json
    """
    from fingerspice.circuit.describe import head_lines
    from fingerspice.solve.simulation import plan as make

    with Answering("plan", as_json, charge_law=charge_law, rtol=rtol, area=area) as answer:
        circuit = read_circuit(deck, changes, source)
        answer.update(**answers.of_circuit(circuit, charge_law))
        circuit, _ = options.with_times(circuit, stop)
        result = make(circuit, charge_law=charge_law, area=area_from_text(area), rtol=rtol, charge=charge)
        answer.update(**answers.of_plan(result))
        answer.give(lambda: "\n".join([*head_lines(circuit), "", str(result)]))


@app.command()
def compare(
    deck: Deck,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    rtol: Rtol = 1e-8,
    charge_law: ChargeLaw = None,
    changes: Set = None,
    source: Source = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Compare the periodic state of DECK with its phasor solution, and say what the ripple of the area does.

    Examples:

      fingerspice compare circuits/fingerpad.cir

      fingerspice compare circuits/fingerpad_5khz.cir --json --no-plot
    """
    from fingerspice.solve.simulation import check_arguments
    from fingerspice.studies.comparison import compare as run_comparison
    from fingerspice.studies.reports import comparison_table

    with Answering("compare", as_json, charge_law=charge_law, rtol=rtol) as answer:
        circuit = read_circuit(deck, changes, source)
        answer.update(**answers.of_circuit(circuit, charge_law))
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        check_arguments(rtol)
        picture = None if no_plot else results.file("_compare.png")
        result = run_comparison(circuit, charge_law=charge_law, rtol=rtol)
        if picture is not None:
            results.open()
        answer.update(method=result.solution.method, **result.to_dict())
        answer.give(lambda: comparison_table(result), results.pictures(picture, result.plot))


for _command in (limits, designs.design, fits.fit, fits.fit_contact, sweeps.sweep):
    app.command()(_command)


@app.command()
def export(
    deck: Deck,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The ngspice deck to write.")],
    charge_law: ChargeLaw = None,
    changes: Set = None,
    source: Source = None,
    stop: Stop = None,
    as_json: AsJson = False,
) -> None:
    """Write DECK as one self-contained ngspice deck: bodies included, parameters folded in.

    Example:

      fingerspice export circuits/fingerpad.cir -o fingerpad_ngspice.cir
    """
    from fingerspice.base.files import write_aside
    from fingerspice.studies.export import export_netlist

    with Answering("export", as_json, charge_law=charge_law) as answer:
        circuit = read_circuit(deck, changes, source)
        answer.update(**answers.of_circuit(circuit, charge_law))
        circuit, _ = options.with_times(circuit, stop)
        check_output(output, deck)
        text = export_netlist(circuit, charge_law=charge_law)
        answer.give(str, [lambda: write_aside(output, lambda path: path.write_text(text, encoding="utf-8"))])


app.command()(figures)
app.command()(explore)
app.command()(sets)
app.command()(check)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        from fingerspice import __version__

        say(f"fingerspice {__version__}")
        raise typer.Exit
