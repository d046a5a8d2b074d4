"""The command line. Exit codes: 0 for success, 1 for a failed solve, 2 for bad input or a full disk.

The commands on a circuit are `run`, `ac`, `plan`, `compare`, and those around it `export`, `sets`, `check`, `figures`
and `explore`; those for studies are in `cli/studies.py`.
"""

from __future__ import annotations

import gc
import json
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from fingerspice.base.announcing import paced
from fingerspice.base.arrays import positive_row
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside
from fingerspice.cli import studies, terminal
from fingerspice.cli.options import FOLDER, Job, Results, add_command, area_from_text, check_output, with_times
from fingerspice.cli.terminal import answer_usage, complain, is_input, listen, said_of, say
from fingerspice.results.outcome import SolveError

if TYPE_CHECKING:
    from fingerspice.results.spectrum import PhasorSolution
    from fingerspice.studies.feel import Feel

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


_AREA = Option(help="coupled, mean, frozen, or an area in m^2.")


def run(
    job: Job,
    area: Annotated[str, _AREA] = "coupled",
    method: Annotated[str, Option(help="auto, exponential, radau, scipy:LSODA, torchdiffeq:dopri5, ...")] = "auto",
    start: Annotated[
        str, Option(help="deck (as its .tran says), uncharged, dc, periodic; or TIME of the first output: 5m.")
    ] = "deck",
    jumps: Annotated[
        str, Option(help="Rows at jumps of the source: both, or none, so that time rises strictly.")
    ] = "both",
    csv: Annotated[bool, Option("--csv", help="Write CSV instead of NetCDF.")] = False,
    stream: Annotated[
        bool,
        Option("--stream", help="Write a long run piece by piece to a Zarr store, which a second call goes on with."),
    ] = False,
    chunk: Annotated[
        str | None,
        Option(metavar="TIME", help="With --stream: length of a piece of the store, s; 10 by default."),
    ] = None,
    signals: Annotated[
        str | None, Option(metavar="NAME,...", help="With --stream: what is written; u_gap,f_el by default.")
    ] = None,
    netcdf: Annotated[
        bool, Option("--netcdf", help="With --stream: write the whole as NetCDF, too, at the end.")
    ] = False,
    feel: Annotated[bool, Option("--feel", help="Say, and draw, what the hand feels of the friction.")] = False,
    schematic: Annotated[
        bool, Option("--schematic", help="Draw the circuit, too: small in the picture, and NAME_schematic.svg.")
    ] = False,
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

    circuit, start = with_times(job.read(), job.stop, start)
    if circuit.tran is None:
        raise InputError(f"{job.deck} has no .tran line; allowed: .tran TSTEP TSTOP [TSTART [TMAX]] [uic], or --stop")
    fixed = area_from_text(area)
    check_arguments(job.rtol, method, fixed, start, jumps)
    how: dict[str, Any] = {"charge_law": job.charge_law, "area": fixed, "rtol": job.rtol, "method": method}
    how |= {"start": start, "t_stop": None if job.stop is None else circuit.tran.stop}
    results = Results(job, circuit)
    if stream or chunk or signals or netcdf:
        from fingerspice.cli.store import run_streamed

        if not stream:
            raise InputError("--chunk, --signals and --netcdf go with --stream")
        for option in [key for key, on in (("csv", csv), ("feel", feel), ("schematic", schematic)) if on]:
            raise InputError(f"--{option} does not go with --stream, which writes Zarr; allowed: --netcdf beside it")
        run_streamed(results, how, chunk=chunk, signals=signals, netcdf=netcdf)
        return
    results.will_write(
        ".csv" if csv else ".nc", lambda file: solution.to_csv(file) if csv else solution.to_netcdf(file)
    )
    results.will_draw(".png", lambda: put_beside(solution.plot(), circuit) if schematic else solution.plot())
    if schematic:
        # An SVG file knows no names of our own, and keeps all of them as one text.
        results.will_write(
            "_schematic.svg", lambda file: circuit.draw().write(file, {"Description": json.dumps(results.about)})
        )
    fingers: list[Feel] = []
    if feel:
        if not circuit.by_device("GAP"):
            raise InputError("--feel: the circuit has no GAP, so there is no friction to feel")
        results.will_draw("_feel.png", lambda: fingers[0].plot(fingers[1:]) if fingers else None)
    with paced("simulating") as update:
        solution = simulate(circuit, **how, jumps=jumps, throw=False, progress=update)
    if job.as_json:
        job.answer.update(**terminal.of_run(solution))
    unfelt = None
    if feel and solution.success:
        try:
            fingers += [felt(solution, name) for name in solution.record.names("f_t")]
            job.answer.update(feel=[one.to_dict() for one in fingers])
        except InputError as error:
            # The outputs are too few or uneven, which is told after the files of the run have been written.
            unfelt = error
    writes = results.ready() if solution.t.size else []
    job.answer.give(lambda: "\n\n".join([solution._page(), *map(str, fingers)]), writes)
    if solution.failure is not None:
        raise SolveError(solution.failure, solution)
    if unfelt is not None:
        raise unfelt


def ac(
    job: Job,
    sweep: Annotated[str | None, Option(metavar="'dec N F1 F2'", help="Sweep; the deck's .ac line by default.")] = None,
    area: Annotated[str, Option(help="mean, frozen, coupled (large signal), or an area in m^2.")] = "mean",
    amplitude: Annotated[
        list[float] | None, Option(help="With --area coupled: source amplitude in V; may be repeated.")
    ] = None,
    skin: Annotated[str, Option(help="SKIN's data: swept, at each frequency; own, at its f.")] = "swept",
    finger: Annotated[str | None, Option(metavar="GAP", help="Which of several GAPs.")] = None,
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
    from fingerspice.results.spectrum import phasor_csv, phasor_tables
    from fingerspice.sets.parameters import parameters
    from fingerspice.solve.simulation import check_arguments
    from fingerspice.studies.steady import large_signal, phasor, sweep_frequencies

    coupled = area == "coupled"
    job.answer.update(method="steady_state" if coupled else "phasor")
    circuit = job.read()
    gaps = [e.name.lower() for e in circuit.by_device("GAP")]
    if finger is not None and finger.lower() not in gaps and finger.lower() in map(str.lower, parameters()):
        raise InputError(
            f"--finger {finger!r} is a set of parameters, and here a GAP is meant; allowed: --set {finger}"
        )
    check_arguments(job.rtol)
    try:
        line = sweep_from_text(sweep) if sweep is not None else circuit.ac or AcSweep("dec", 20, 10.0, 1e5)
    except InputError as error:
        raise InputError(f"--sweep {error.message}") from None
    frequencies = sweep_frequencies(line)
    found: tuple[PhasorSolution, ...] = ()
    if coupled:
        if skin != "swept":
            raise InputError(f"--skin {skin} does not go with --area coupled; allowed: --skin swept")
        if amplitude:
            positive_row("amplitude", amplitude, "V")
    elif amplitude:
        raise InputError(f"--amplitude goes with --area coupled, not with --area {area}")
    else:
        found = (phasor(circuit, frequencies, area=area_from_text(area), skin=skin, finger=finger),)
    results = Results(job, circuit)
    results.will_write("_ac.csv", lambda file: phasor_csv(found, file))
    results.will_draw("_ac.png", lambda: plot_phasor(found, circuit))
    if coupled:
        with paced("sweeping") as update:
            found = large_signal(
                circuit, frequencies, amplitude, charge_law=job.charge_law, rtol=job.rtol, finger=finger,
                progress=update,
            )  # fmt: skip
    job.answer.update(sweeps=[r.to_dict() for r in found] if job.as_json else None)
    job.answer.give(lambda: phasor_tables(found, circuit), results.ready())


def plan(
    job: Job,
    area: Annotated[str, _AREA] = "coupled",
    charge: Annotated[bool, Option(help="Whether the source's charge and current are wanted.")] = True,
) -> None:
    """Tell which model DECK needs for the error asked for, and why, without a run.

    Examples:

      fingerspice plan circuits/fingerpad.cir

      fingerspice plan circuits/fingerpad.cir --area frozen --rtol 1e-6 --json
    """
    from fingerspice.circuit.describe import head_lines
    from fingerspice.solve.simulation import plan as make

    circuit, _ = with_times(job.read(), job.stop)
    result = make(circuit, charge_law=job.charge_law, area=area_from_text(area), rtol=job.rtol, charge=charge)
    found = result.to_dict()
    job.answer.update(**{key: found[key] for key in terminal.OWN["plan"] if key in found and key != "area"})
    job.answer.update(plan_area=result.area)
    job.answer.give(lambda: "\n".join([*head_lines(circuit), "", str(result)]))


def compare(job: Job) -> None:
    """Compare the periodic state of DECK with its phasor solution, and say what the ripple of the area does.

    Examples:

      fingerspice compare circuits/fingerpad.cir

      fingerspice compare circuits/fingerpad_5khz.cir --json --no-plot
    """
    from fingerspice.solve.simulation import check_arguments
    from fingerspice.studies.comparison import compare as run_comparison

    circuit = job.read()
    results = Results(job, circuit)
    check_arguments(job.rtol)
    results.will_draw("_compare.png", lambda: result.plot())
    result = run_comparison(circuit, charge_law=job.charge_law, rtol=job.rtol)
    job.answer.update(method=result.solution.method, **result.to_dict())
    job.answer.give(lambda: str(result), results.ready())


def export(
    job: Job,
    output: Annotated[Path, Option("--output", "-o", metavar="FILE", help="The ngspice deck to write.")],
) -> None:
    """Write DECK as one self-contained ngspice deck: bodies included, parameters folded in.

    Example:

      fingerspice export circuits/fingerpad.cir -o fingerpad_ngspice.cir
    """
    from fingerspice.studies.export import export_netlist

    circuit, _ = with_times(job.read(), job.stop)
    check_output(output, job.deck)
    text = export_netlist(circuit, charge_law=job.charge_law)
    job.answer.give(str, [partial(_write_text, output, text)])


def _write_text(file: Path, text: str) -> Path:
    return write_aside(file, lambda path: path.write_text(text, encoding="utf-8"))


def explore(
    job: Job,
    deck: Annotated[
        Path | None, Argument(metavar="[DECK]", help="Netlist file (.cir); the page has examples of its own.")
    ] = None,
    port: Annotated[int, Option(help="Port of the loopback address; 0 takes a free one.")] = 0,
    no_browser: Annotated[bool, Option("--no-browser", help="Print the link, and open no browser.")] = False,
    static: Annotated[
        Path | None, Option("--static", metavar="OUT.html", help="Write the page as one file, and serve nothing.")
    ] = None,
) -> Callable[[], None] | None:
    """Open a local page on which DECK's values move and the run follows; Ctrl-C ends it.

    Examples:

      fingerspice explore circuits/fingerpad.cir

      fingerspice explore circuits/fingerpad.cir --finger moist --coating 3M-insulating

      fingerspice explore --port 8000 --no-browser

      fingerspice explore circuits/click.cir --static click.html
    """
    from fingerspice.explorer.server import Explorer

    circuit = None
    if deck is not None:
        job.deck = deck
        circuit = job.read()
    sets = {"set": job.changes, "finger": job.finger, "coating": job.coating, "drive": job.drive}
    for option, given in sets.items():
        if given and deck is None:
            raise InputError(f"--{option} {given[0]!r} is given without a deck; allowed: a netlist file before it")
    if static is not None:
        from fingerspice.explorer.server import static_page

        check_output(static, deck)
        job.answer.give(str, [partial(_write_text, static, static_page(circuit))])
        return None
    explorer, ended = Explorer(circuit, port), list[int]()
    job.answer.update(url=explorer.url)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ended.append(number))
    job.answer.give(lambda: f"the explorer is at {explorer.url}\nCtrl-C ends it")

    def serve() -> None:
        if not no_browser:
            explorer.open()
        # An event does not do here: a signal that comes while its lock is held would wait for that lock for ever.
        while not ended:
            time.sleep(0.1)
        explorer.stop()

    return serve


def figures(
    job: Job,
    only: Annotated[list[int] | None, Option(help="Only these of the paper's figures 2 to 5.")] = None,
    gallery: Annotated[
        bool,
        Option("--gallery", help="The explorer's scenes instead, and the decks in the folder circuits."),
    ] = False,
) -> None:
    """Draw the paper's Figs. 2 to 5 from scratch, each as PNG with its data as CSV; or a gallery.

    Examples:

      fingerspice figures --out out --only 4 --only 5

      fingerspice figures --gallery
    """
    folder = job.out or FOLDER
    if gallery and only:
        raise InputError("--only and --gallery are both given; allowed: one of them")
    if gallery:
        from fingerspice.explorer.scene import decks, draw, scenes

        # The decks are those of `circuits` below the current folder.
        entries, folder = [*decks(Path("circuits")), *scenes()], folder / "gallery"
        files = [folder / f"{one.name}.png" for one in entries]
        for file in files:
            check_output(file)
        folder.mkdir(parents=True, exist_ok=True)
        with paced("drawing") as update:
            for i, (one, file) in enumerate(zip(entries, files, strict=True), 1):
                draw(one, file)
                update(i / len(files))
    else:
        from fingerspice.studies.figures import FIGURES, make_figures

        for number in only or FIGURES:
            for kind in ("png", "csv"):
                check_output(folder / f"fig{number}.{kind}")
        with paced("drawing") as update:
            files = make_figures(folder, only=only, progress=update)
    job.answer.give(str, [partial(Path, file) for file in files])


def sets(
    job: Job,
    name: Annotated[str | None, Argument(metavar="[NAME]", help="A set; without it all are listed.")] = None,
) -> None:
    """List the named sets of parameters, or show the values of one with their ranges and sources.

    Examples:

      fingerspice sets

      fingerspice sets moist
    """
    from fingerspice.sets.parameters import parameters

    found = parameters() if name is None else parameters(name)
    shown = parameters().values() if name is None else [parameters(name)]
    job.answer.update(parameter_sets=[one.to_dict() for one in shown])
    job.answer.give(lambda: str(found))


def check(
    job: Job,
    store: Annotated[Path, Argument(metavar="STORE", help="Folder that run --stream or sweep --store wrote.")],
) -> None:
    """Verify that every chunk of a store is as it was written.

    Example:

      fingerspice check out/long.zarr
    """
    from fingerspice.results.runfile import check_store

    chunks = check_store(store)
    job.answer.update(chunks=chunks)
    said = f"{store}: {sum(chunks.values()):,} chunks of {len(chunks)} arrays are as they were written"
    job.answer.give(lambda: said)


_FILES = "deck out name overwrite"
_END = "as_json no_plot"
#: Every command with all its options, in the order of its help.
_COMMANDS: dict[Callable[..., Callable[[], None] | None], str] = {
    run: f"{_FILES} rtol charge_law area method changes finger coating drive source stop start jumps csv "
    f"stream chunk signals netcdf feel schematic {_END}",
    ac: f"{_FILES} sweep area amplitude skin finger charge_law rtol changes source {_END}",
    plan: "deck rtol charge_law area stop charge changes source as_json",
    compare: f"{_FILES} rtol charge_law changes source {_END}",
    studies.limits: f"{_FILES} points span capability limit carrier changes source {_END}",
    studies.design: f"table {_FILES} carrier limit slew rate charge_law changes {_END}",
    studies.fit: f"table deck free groups out name overwrite average skin profile charge_law changes {_END}",
    studies.fit_contact: f"tables deck free finger out name overwrite profile changes {_END}",
    studies.sweep: f"file out name overwrite {_END} store workers scheduler shard",
    export: "deck output charge_law changes source stop as_json",
    figures: "out only gallery as_json",
    explore: "deck changes finger coating drive port no_browser static as_json",
    sets: "name as_json",
    check: "store as_json",
}
for _function, _options in _COMMANDS.items():
    add_command(app, _options, _function)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        from fingerspice import __version__

        say(f"fingerspice {__version__}")
        raise typer.Exit
