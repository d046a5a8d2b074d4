"""The command line. Exit codes: 0 for success, 1 for a failed solve, 2 for bad input or a full disk."""

from __future__ import annotations

import gc
import json
from typing import Annotated, Any

import typer

from fingerspice.base.arrays import positive_row
from fingerspice.base.errors import InputError
from fingerspice.cli import options, studies, terminal, tools
from fingerspice.cli import sweep as sweeps
from fingerspice.cli.options import area_from_text, read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering, answer_usage, complain, is_input, listen, progress, said_of, say
from fingerspice.results.outcome import SolveError

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
    try:
        app(standalone_mode=True)
    except SystemExit as exit_:
        # typer has refused the usage with a message on stderr; with --json print an answer as well.
        refused = getattr(exit_.__context__, "format_message", None)
        if refused is not None:
            answer_usage(refused())
        raise
    except Exception as error:
        # One sentence instead of a traceback: exit code 2 for wrong input, 1 for any other error.
        complain(said_of(error))
        raise SystemExit(2 if is_input(error) else 1) from None
    finally:
        # Flush the text that typer has printed.
        say(end="")


@app.command()
def run(
    deck: terminal.Deck,
    out: terminal.Out = None,
    name: terminal.Name = None,
    overwrite: terminal.Overwrite = False,
    rtol: terminal.Rtol = 1e-8,
    charge_law: terminal.ChargeLaw = None,
    area: Annotated[str, typer.Option(help="coupled, mean, frozen, or an area in m^2.")] = "coupled",
    method: Annotated[
        str, typer.Option(help="auto, exponential, radau, scipy:LSODA, torchdiffeq:dopri5, ...")
    ] = "auto",
    changes: terminal.Set = None,
    finger: terminal.Finger = None,
    coating: terminal.Coating = None,
    drive: terminal.Drive = None,
    source: terminal.Source = None,
    stop: terminal.Stop = None,
    start: Annotated[
        str, typer.Option(help="deck (as its .tran says), uncharged, dc, periodic; or TIME of the first output: 5m.")
    ] = "deck",
    jumps: Annotated[
        str, typer.Option(help="Rows at jumps of the source: both, or none, so that time rises strictly.")
    ] = "both",
    csv: Annotated[bool, typer.Option("--csv", help="Write CSV instead of NetCDF.")] = False,
    stream: terminal.Streamed = False,
    chunk: terminal.Chunk = None,
    signals: terminal.Signals = None,
    netcdf: terminal.NetCdf = False,
    feel: Annotated[bool, typer.Option("--feel", help="Say, and draw, what the hand feels of the friction.")] = False,
    schematic: terminal.Schematic = False,
    as_json: terminal.AsJson = False,
    no_plot: terminal.NoPlot = False,
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
    from fingerspice.plots.schematic import put_beside
    from fingerspice.solve.simulation import check_arguments, simulate
    from fingerspice.studies.feel import feel as felt

    with Answering("run", as_json, charge_law=charge_law, method=method, rtol=rtol, area=area) as answer:
        circuit = read_circuit(deck, changes, source, finger=finger, coating=coating, drive=drive)
        answer.update(**terminal.of_circuit(circuit, charge_law))
        circuit, start = options.with_times(circuit, stop, start)
        if circuit.tran is None:
            raise InputError(f"{deck} has no .tran line; allowed: .tran TSTEP TSTOP [TSTART [TMAX]] [uic], or --stop")
        t_stop = None if stop is None else circuit.tran.stop
        fixed = area_from_text(area)
        check_arguments(rtol, method, fixed, start, jumps)
        how: dict[str, Any] = {"charge_law": charge_law, "area": fixed, "rtol": rtol}
        how |= {"method": method, "start": start, "t_stop": t_stop}
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        if stream or chunk or signals or netcdf:
            from fingerspice.cli.store import run_streamed

            if not stream:
                raise InputError("--chunk, --signals and --netcdf go with --stream")
            for option in [key for key, on in (("csv", csv), ("feel", feel), ("schematic", schematic)) if on]:
                raise InputError(
                    f"--{option} does not go with --stream, which writes Zarr; allowed: --netcdf beside it"
                )
            run_streamed(answer, results, circuit, how, chunk=chunk, signals=signals, netcdf=netcdf)
            return
        results.will_write(
            ".csv" if csv else ".nc", lambda file: solution.to_csv(file) if csv else solution.to_netcdf(file)
        )
        results.will_draw(
            ".png", lambda: put_beside(solution.plot(), circuit) if schematic else solution.plot(), unless=no_plot
        )
        if schematic:
            # An SVG file knows no names of our own, and keeps all of them as one text.
            results.will_write(
                "_schematic.svg", lambda file: circuit.draw().write(file, {"Description": json.dumps(results.about)})
            )
        if feel and not circuit.by_device("GAP"):
            raise InputError("--feel: the circuit has no GAP, so there is no friction to feel")
        image = results.file("_feel.png") if feel and not no_plot else None
        with progress() as update:
            solution = simulate(circuit, **how, jumps=jumps, throw=False, progress=update)
        if as_json:
            answer.update(**terminal.of_run(solution))
        writes, fingers, unfelt = results.ready() if solution.t.size else [], [], None
        if feel and solution.success:
            try:
                fingers = [felt(solution, name) for name in solution.record.names("f_t")]
                answer.update(feel=[one.to_dict() for one in fingers])
                writes += results.pictures(image, lambda: fingers[0].plot(fingers[1:]))
            except InputError as error:
                # The outputs are too few or uneven, which is told after the files of the run have been written.
                unfelt = error
        answer.give(lambda: "\n\n".join([solution._page(), *map(str, fingers)]), writes)
        if solution.failure is not None:
            raise SolveError(solution.failure, solution)
        if unfelt is not None:
            raise unfelt


@app.command()
def ac(
    deck: terminal.Deck,
    out: terminal.Out = None,
    name: terminal.Name = None,
    overwrite: terminal.Overwrite = False,
    sweep: Annotated[
        str | None, typer.Option(metavar="'dec N F1 F2'", help="Sweep; the deck's .ac line by default.")
    ] = None,
    area: Annotated[str, typer.Option(help="mean, frozen, coupled (large signal), or an area in m^2.")] = "mean",
    amplitude: Annotated[
        list[float] | None, typer.Option(help="With --area coupled: source amplitude in V; may be repeated.")
    ] = None,
    skin: Annotated[str, typer.Option(help="SKIN's data: swept, at each frequency; own, at its f.")] = "swept",
    finger: Annotated[str | None, typer.Option(metavar="GAP", help="Which of several GAPs.")] = None,
    charge_law: terminal.ChargeLaw = None,
    rtol: terminal.Rtol = 1e-8,
    changes: terminal.Set = None,
    source: terminal.Source = None,
    as_json: terminal.AsJson = False,
    no_plot: terminal.NoPlot = False,
) -> None:
    """Phasor sweep of DECK: gap voltage, phase, area and mean force against frequency.

    The source's AC magnitude and phase drive it; without AC its fundamental does.

    Examples:

      fingerspice ac circuits/fingerpad.cir --sweep 'dec 10 10 100k' --out out

      fingerspice ac circuits/fingerpad.cir --area frozen --json

      fingerspice ac circuits/fingerpad.cir --area coupled --amplitude 50 --amplitude 200
    """
    from fingerspice.circuit.circuit import AcSweep
    from fingerspice.netlist.netlist import sweep_from_text
    from fingerspice.plots.traces import plot_phasor
    from fingerspice.results.spectrum import PhasorSolution, phasor_csv, phasor_tables
    from fingerspice.sets.parameters import parameters
    from fingerspice.solve.simulation import check_arguments
    from fingerspice.studies.comparison import large_signal
    from fingerspice.studies.steady import phasor, sweep_frequencies

    how = "steady_state" if area == "coupled" else "phasor"
    with Answering("ac", as_json, charge_law=charge_law, method=how, rtol=rtol, area=area, skin=skin) as answer:
        circuit = read_circuit(deck, changes, source)
        answer.update(**terminal.of_circuit(circuit, charge_law))
        gaps = [e.name.lower() for e in circuit.by_device("GAP")]
        if finger is not None and finger.lower() not in gaps and finger.lower() in map(str.lower, parameters()):
            raise InputError(
                f"--finger {finger!r} is a set of parameters, and here a GAP is meant; allowed: --set {finger}"
            )
        check_arguments(rtol)
        try:
            line = sweep_from_text(sweep) if sweep is not None else circuit.ac or AcSweep("dec", 20, 10.0, 1e5)
        except InputError as error:
            raise InputError(f"--sweep {error.message}") from None
        frequencies = sweep_frequencies(line)
        found: tuple[PhasorSolution, ...] = ()
        if area == "coupled":
            if skin != "swept":
                raise InputError(f"--skin {skin} does not go with --area coupled; allowed: --skin swept")
            if amplitude:
                positive_row("amplitude", amplitude, "V")
        elif amplitude:
            raise InputError(f"--amplitude goes with --area coupled, not with --area {area}")
        else:
            found = (phasor(circuit, frequencies, area=area_from_text(area), skin=skin, finger=finger),)
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        results.will_write("_ac.csv", lambda file: phasor_csv(found, file))
        results.will_draw("_ac.png", lambda: plot_phasor(found, circuit), unless=no_plot)
        if area == "coupled":
            with progress("sweeping") as update:
                found = large_signal(
                    circuit, frequencies, amplitude, charge_law=charge_law, rtol=rtol, finger=finger, progress=update
                )
        answer.update(sweeps=[r.to_dict() for r in found] if as_json else None)
        answer.give(lambda: phasor_tables(found, circuit), results.ready())


@app.command()
def plan(
    deck: terminal.Deck,
    rtol: terminal.Rtol = 1e-8,
    charge_law: terminal.ChargeLaw = None,
    area: Annotated[str, typer.Option(help="coupled, mean, frozen, or an area in m^2.")] = "coupled",
    stop: terminal.Stop = None,
    charge: Annotated[bool, typer.Option(help="Whether the source's charge and current are wanted.")] = True,
    changes: terminal.Set = None,
    source: terminal.Source = None,
    as_json: terminal.AsJson = False,
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
        answer.update(**terminal.of_circuit(circuit, charge_law))
        circuit, _ = options.with_times(circuit, stop)
        result = make(circuit, charge_law=charge_law, area=area_from_text(area), rtol=rtol, charge=charge)
        found = result.to_dict()
        answer.update(**{key: found[key] for key in terminal.OWN["plan"] if key in found and key != "area"})
        answer.update(plan_area=result.area)
        answer.give(lambda: "\n".join([*head_lines(circuit), "", str(result)]))


@app.command()
def compare(
    deck: terminal.Deck,
    out: terminal.Out = None,
    name: terminal.Name = None,
    overwrite: terminal.Overwrite = False,
    rtol: terminal.Rtol = 1e-8,
    charge_law: terminal.ChargeLaw = None,
    changes: terminal.Set = None,
    source: terminal.Source = None,
    as_json: terminal.AsJson = False,
    no_plot: terminal.NoPlot = False,
) -> None:
    """Compare the periodic state of DECK with its phasor solution, and say what the ripple of the area does.

    Examples:

      fingerspice compare circuits/fingerpad.cir

      fingerspice compare circuits/fingerpad_5khz.cir --json --no-plot
    """
    from fingerspice.solve.simulation import check_arguments
    from fingerspice.studies.comparison import compare as run_comparison

    with Answering("compare", as_json, charge_law=charge_law, rtol=rtol) as answer:
        circuit = read_circuit(deck, changes, source)
        answer.update(**terminal.of_circuit(circuit, charge_law))
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        check_arguments(rtol)
        results.will_draw("_compare.png", lambda: result.plot(), unless=no_plot)
        result = run_comparison(circuit, charge_law=charge_law, rtol=rtol)
        answer.update(method=result.solution.method, **result.to_dict())
        answer.give(lambda: str(result), results.ready())


for _command in (
    *(studies.limits, studies.design, studies.fit, studies.fit_contact, sweeps.sweep),
    *(tools.export, tools.figures, tools.explore, tools.sets, tools.check),
):
    app.command()(_command)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        from fingerspice import __version__

        say(f"fingerspice {__version__}")
        raise typer.Exit
