"""The commands, but for those of `cli/studies.py`; exit codes: 1 for a failed solve, 2 for bad input or a full disk."""

from __future__ import annotations

import gc
import json
import signal
import sys
import textwrap
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

import fingerspice as fs
from fingerspice.base.announcing import NO_FOLDER, paced
from fingerspice.base.arrays import positive_row
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside
from fingerspice.cli import studies, terminal
from fingerspice.cli.options import FOLDER, SETS, Job, Makes, add_command, area_from_text, check_output, with_times
from fingerspice.cli.terminal import complain, outcome, say
from fingerspice.waveforms.waveform import refuse, require

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
    try:
        app(standalone_mode=True)
    except SystemExit as exit_:
        # typer has refused the usage with a message on stderr; with --json print an answer as well.
        refused = getattr(exit_.__context__, "format_message", None)
        if refused is not None and "--json" in sys.argv[1:]:
            command = next((word for word in sys.argv[1:] if word in terminal.OWN), None)
            terminal.say_json({**terminal.blank(command), "status": "BAD_INPUT", "message": refused()})
        raise
    except Exception as error:
        # One sentence instead of a traceback.
        code, _, said = outcome(error)
        complain(said)
        raise SystemExit(code) from None
    finally:
        # Flush the text that typer has printed.
        say(end="")


def run(
    job: Job,
    area: Annotated[str, "coupled, mean, frozen, or an area in m^2."] = "coupled",
    method: Annotated[str, "auto, exponential, radau, scipy:LSODA, torchdiffeq:dopri5, ..."] = "auto",
    start: Annotated[
        str, "deck (as its .tran says), uncharged, dc, periodic; or TIME of the first output: 5m."
    ] = "deck",
    jumps: Annotated[str, "Rows at jumps of the source: both, or none, so that time rises strictly."] = "both",
    csv: Annotated[bool, "Write CSV instead of NetCDF."] = False,
    raw: Annotated[bool, "Write a raw file of SPICE, too."] = False,
    stream: Annotated[
        bool, "Write a long run piece by piece to a Zarr store, which a second call goes on with."
    ] = False,
    chunk: Annotated[str | None, "With --stream: length of a piece of the store, s; 10 by default.", "TIME"] = None,
    signals: Annotated[str | None, "With --stream: what is written; u_gap,f_el by default.", "NAME,..."] = None,
    netcdf: Annotated[bool, "With --stream: write the whole as NetCDF, too, at the end."] = False,
    feel: Annotated[bool, "Say, and draw, what the hand feels of the friction."] = False,
    schematic: Annotated[bool, "Draw the circuit, too: small in the picture, and NAME_schematic.svg."] = False,
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
    from fingerspice.circuit.describe import area_given
    from fingerspice.solve.simulation import check_arguments, simulate

    if schematic:  # Only then: it loads matplotlib, which takes as long as a run.
        from fingerspice.plots.schematic import put_beside
    circuit, start = with_times(job.read(), job.stop, start)
    ends = studies.ends_beside(circuit)
    if circuit.tran is None and (circuit.op or ends):
        job.check_files(circuit, *ends)
        said, others = studies.beside_run(job, circuit)
        job.give(lambda: "\n\n".join([circuit.title, *said]), others)
        return
    if circuit.tran is None:
        raise InputError(f"{job.deck} has no .tran line; allowed: .tran TSTEP TSTOP [TSTART [TMAX]] [uic], or --stop")
    check_arguments(job.rtol, method, start, jumps)
    how: dict[str, Any] = {"start": start, "rtol": job.rtol, "method": method, "area": area_given(area_from_text(area))}
    how |= {"charge_law": job.charge_law, "t_stop": None if job.stop is None else circuit.tran.stop}
    if stream or chunk or signals or netcdf:
        from fingerspice.cli.store import run_streamed

        refuse(not stream, "--chunk, --signals and --netcdf go with --stream")
        _alone("does not go with --stream, which writes Zarr; allowed: --netcdf beside it",
               csv=csv, raw=raw, feel=feel, schematic=schematic)  # fmt: skip
        run_streamed(job, circuit, how, chunk=chunk, signals=signals, netcdf=netcdf)
        return
    if circuit.steps:
        _alone("goes with one run, and the deck has .step; allowed: its values by --set",
               feel=feel, schematic=schematic)  # fmt: skip
        studies.stepped(job, circuit, how, [".csv" if csv else ".nc", ".png", *([".raw"] if raw else []), *ends])
        return
    fingers, unfelt = list[fs.Feel](), None
    refuse(feel and not circuit.by_device("GAP"), "--feel: the circuit has no GAP, so there is no friction to feel")
    more = [end for end, on in (("_schematic.svg", schematic), ("_feel.png", feel), (".raw", raw)) if on]
    job.check_files(circuit, ".csv" if csv else ".nc", ".png", *more, *ends)
    said, others = studies.beside_run(job, circuit) if circuit.op or ends else ([], {})
    with paced("simulating") as update:
        solution = simulate(circuit, **how, jumps=jumps, throw=False, progress=update)
    if job.json:
        job.answer.update(**terminal.of_run(solution))
    if feel and solution.success:
        try:
            fingers += [fs.feel(solution, name) for name in solution.record.names("f_t")]
            job.answer.update(feel=[one.to_dict() for one in fingers])
        except InputError as error:
            # The outputs are too few or uneven, which is told after the files of the run have been written.
            unfelt = error
    makes: Makes = {
        ".csv": solution.to_csv, ".nc": solution.to_netcdf, ".raw": solution.to_raw,
        ".png": lambda: put_beside(solution.plot(), circuit) if schematic else solution.plot(),
        # An SVG file knows no names of our own, and keeps all of them as one text.
        "_schematic.svg": lambda file: circuit.draw().write(file, {"Description": json.dumps(job.about)}),
        "_feel.png": lambda: fingers[0].plot(fingers[1:]) if fingers else None, **others,
    }  # fmt: skip
    if not solution.t.size:
        job.files.clear()
    job.give(lambda: "\n\n".join([solution._page(), *map(str, fingers), *said]), makes)
    if solution.failure is not None:
        raise fs.SolveError(solution.failure, solution)
    if unfelt is not None:
        raise unfelt


def _alone(why: str, **options: bool) -> None:
    """Refuse these options if they are given."""
    for option in [key for key, on in options.items() if on]:
        raise InputError(f"--{option} {why}")


def ac(
    job: Job,
    sweep: Annotated[str | None, "Sweep; the deck's .ac line by default.", "'dec N F1 F2'"] = None,
    area: Annotated[str, "mean, frozen, coupled (large signal), or an area in m^2."] = "mean",
    amplitude: Annotated[list[float] | None, "With --area coupled: source amplitude in V; may be repeated."] = None,
    skin: Annotated[str, "SKIN's data: swept, at each frequency; own, at its f."] = "swept",
    finger: Annotated[str | None, "Which of several GAPs.", "GAP"] = None,
    impedance: Annotated[bool, "Draw the impedance too, with that of gaps shorted as of a finger at rest."] = False,
) -> None:
    """Phasor sweep of DECK: gap voltage, phase, area and mean force against frequency.

    The source's AC magnitude and phase drive it; without AC its fundamental does.

    Examples:
      fingerspice ac circuits/fingerpad.cir --sweep 'dec 10 10 100k' --out out
      fingerspice ac circuits/fingerpad.cir --area frozen --json
      fingerspice ac circuits/fingerpad.cir --area coupled --amplitude 50 --amplitude 200
      fingerspice ac circuits/fingerpad.cir --impedance
    """
    from fingerspice.circuit.circuit import AcSweep
    from fingerspice.circuit.describe import heading
    from fingerspice.netlist.netlist import sweep_from_text
    from fingerspice.plots.traces import plot_phasor
    from fingerspice.results.spectrum import phasor_csv
    from fingerspice.solve.simulation import check_arguments
    from fingerspice.studies.steady import sweep_frequencies

    coupled = area == "coupled"
    job.answer.update(method="steady_state" if coupled else "phasor")
    circuit = job.read()
    gaps = [e.name.lower() for e in circuit.by_device("GAP")]
    a_set = finger is not None and finger.lower() not in gaps and finger.lower() in map(str.lower, fs.parameters())
    require(not a_set, f"--finger {finger!r}", "a set of parameters, and here a GAP is meant", f"--set {finger}")
    check_arguments(job.rtol)
    try:
        line = sweep_from_text(sweep) if sweep is not None else circuit.ac or AcSweep("dec", 20, 10.0, 1e5)
    except InputError as error:
        raise InputError(f"--sweep {error.message}") from None
    frequencies = sweep_frequencies(line)
    refuse(coupled and skin != "swept", f"--skin {skin} does not go with --area coupled; allowed: --skin swept")
    if amplitude:
        refuse(not coupled, f"--amplitude goes with --area coupled, not with --area {area}")
        positive_row("amplitude", amplitude, "V")
    found: tuple[Any, ...] = ()
    if not coupled:
        found = (fs.phasor(circuit, frequencies, area=area_from_text(area), skin=skin, finger=finger),)
    drawn = ("_impedance.png",) if impedance else ()
    job.check_files(circuit, "_ac.csv", "_ac.png", *drawn)
    if coupled:
        with paced("sweeping") as update:
            found = fs.large_signal(
                circuit, frequencies, amplitude, charge_law=job.charge_law, rtol=job.rtol, finger=finger,
                progress=update,
            )  # fmt: skip
    job.answer.update(sweeps=[r.to_dict() for r in found] if job.json else None)
    makes: dict[str, Any] = {"_ac.csv": partial(phasor_csv, found), "_ac.png": partial(plot_phasor, found, circuit)}
    if drawn and not job.no_plot:
        refuse(found[0].impedance is None, "--impedance: there is none of a large signal, or of several sources")
        shorts = circuit.varied({f"{gap}.r": _SHORT for gap in gaps})
        rest = {"gaps shorted": fs.phasor(shorts, frequencies, area="frozen", skin=skin, finger=finger)} if gaps else {}
        makes["_impedance.png"] = partial(found[0].plot_impedance, "sliding" if gaps else "", **rest)
    job.give(lambda: "\n\n".join([heading(circuit), *(one._page(40) for one in found)]), makes)


def plan(
    job: Job,
    area: Annotated[str, "coupled, mean, frozen, or an area in m^2."] = "coupled",
    charge: Annotated[bool, Option(help="Whether the source's charge and current are wanted.")] = True,
) -> None:
    """Tell which model DECK needs for the error asked for, and why, without a run.

    Examples:
      fingerspice plan circuits/fingerpad.cir
      fingerspice plan circuits/fingerpad.cir --area frozen --rtol 1e-6 --json
    """
    from fingerspice.circuit.describe import head_lines

    circuit, _ = with_times(job.read(), job.stop)
    result = fs.plan(circuit, charge_law=job.charge_law, area=area_from_text(area), rtol=job.rtol, charge=charge)
    found = result.to_dict()
    job.answer.update(plan_area=found.pop("area"), **found)
    job.give(lambda: "\n".join([*head_lines(circuit), "", str(result)]))


def compare(
    job: Job,
    other: Annotated[Path | None, Option("--with", metavar="FILE.raw", help="Another simulator's run.")] = None,
) -> None:
    """Compare the periodic state of DECK with its phasor solution, and say what the ripple of the area does.

    Or compare its run with the raw file of ngspice or LTspice.

    Examples:
      fingerspice compare circuits/fingerpad.cir
      fingerspice compare circuits/fingerpad_5khz.cir --json --no-plot
      fingerspice compare finger.cir --with finger.raw
    """
    from fingerspice.solve.simulation import check_arguments

    circuit = job.read()
    check_arguments(job.rtol)
    job.check_files(circuit, "_compare.png")
    if other is not None:
        beside = fs.compare_raw(circuit, other, charge_law=job.charge_law, rtol=job.rtol)
        job.answer.update(method=beside.solution.method, **beside.to_dict())
        job.give(lambda: str(beside), {"_compare.png": beside.plot})
        return
    result = fs.compare(circuit, charge_law=job.charge_law, rtol=job.rtol)
    job.answer.update(method=result.solution.method, **result.to_dict())
    job.give(lambda: str(result), {"_compare.png": result.plot})


def export(
    job: Job, output: Annotated[Path, Option("--output", "-o", metavar="FILE", help="The ngspice deck to write.")]
) -> None:
    """Write DECK as one self-contained ngspice deck: bodies included, parameters folded in.

    Example:
      fingerspice export circuits/fingerpad.cir -o fingerpad_ngspice.cir
    """
    circuit, _ = with_times(job.read(), job.stop)
    check_output(output, job.deck)
    _give_file(job, output, fs.export_netlist(circuit, charge_law=job.charge_law))


def _give_file(job: Job, file: Path, text: str) -> None:
    job.files = {"": file}
    job.give(str, {"": lambda file: write_aside(file, lambda path: path.write_text(text, encoding="utf-8"))})


def explore(
    job: Job,
    deck: Annotated[
        Path | None, Argument(metavar="[DECK]", help="Netlist file (.cir); the page has examples of its own.")
    ] = None,
    port: Annotated[int, "Port of the loopback address; 0 takes a free one."] = 0,
    no_browser: Annotated[bool, "Print the link, and open no browser."] = False,
    static: Annotated[Path | None, "Write the page as one file, and serve nothing.", "OUT.html"] = None,
) -> None:
    """Open a local page on which DECK's values move and the run follows; Ctrl-C ends it.

    Examples:
      fingerspice explore circuits/fingerpad.cir
      fingerspice explore circuits/fingerpad.cir --finger moist --coating 3M-insulating
      fingerspice explore --port 8000 --no-browser
      fingerspice explore circuits/click.cir --static click.html
    """
    for option in SETS if deck is None else ():
        if given := getattr(job, option):
            raise InputError(f"--{option} {given[0]!r} is given without a deck; allowed: a netlist file before it")
    job.deck = deck or job.deck
    circuit = None if deck is None else job.read()
    if static is not None:
        from fingerspice.explorer import static_page

        check_output(static, deck)
        _give_file(job, static, static_page(circuit))
        return
    explorer, ended = fs.Explorer(circuit, port), list[int]()
    job.answer.update(url=explorer.url)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ended.append(number))
    job.give(lambda: f"the explorer is at {explorer.url}\nCtrl-C ends it")

    def serve() -> None:
        if not no_browser:
            explorer.open()
        # An event does not do here: a signal that comes while its lock is held would wait for that lock for ever.
        while not ended:
            time.sleep(0.1)
        explorer.stop()

    job.then = serve


def figures(
    job: Job,
    only: Annotated[list[int] | None, "Only these of the paper's figures 2 to 5."] = None,
    gallery: Annotated[bool, "The explorer's scenes instead, and the decks in the folder circuits."] = False,
) -> None:
    """Draw the paper's Figs. 2 to 5 from scratch, each as PNG with its data as CSV; or a gallery.

    Examples:
      fingerspice figures --out out --only 4 --only 5
      fingerspice figures --gallery
    """
    from fingerspice.explorer.scene import draw, shown_runs
    from fingerspice.studies.figures import FIGURES, make_figures

    refuse(gallery and only, "--only and --gallery are both given; allowed: one of them")
    folder = (job.out or FOLDER) / ("gallery" if gallery else "")
    # The decks are those of `circuits` below the current folder.
    runs = shown_runs(Path("circuits")) if gallery else {}
    drawn = {folder / f"{name}.png": make for name, make in runs.items()}
    for file in drawn or [folder / f"fig{one}.{kind}" for one in only or FIGURES for kind in ("png", "csv")]:
        check_output(file)
    with paced("drawing") as update:
        files = [*drawn] or make_figures(folder, only=only, progress=update)
        for i, (file, make) in enumerate(drawn.items(), 1):
            draw(make, file)
            update(i / len(drawn))
    job.answer.update(files=[*map(str, files)])
    job.give(str)


def sets(
    job: Job, name: Annotated[str | None, Argument(metavar="[NAME]", help="A set; without it all are listed.")] = None
) -> None:
    """List the named sets of parameters, or show the values of one with their ranges and sources.

    Examples:
      fingerspice sets
      fingerspice sets moist
    """
    found = fs.parameters() if name is None else fs.parameters(name)
    shown = fs.parameters().values() if name is None else [fs.parameters(name)]
    job.answer.update(parameter_sets=[one.to_dict() for one in shown])
    job.give(lambda: str(found))


def help_deck(job: Job) -> None:
    """List all that a deck may say: elements, devices and their parameters, sources, directives, measures, functions.

    Example:
      fingerspice help-deck
    """
    from fingerspice.netlist.sources import vocabulary

    found = vocabulary()
    job.answer.update(vocabulary=found)
    # Short words stand beside one another.
    kinds = {
        kind: rows if max(map(len, rows)) > 24 else textwrap.wrap("  ".join(rows), 100) for kind, rows in found.items()
    }
    job.give(lambda: "\n".join(x for kind, rows in kinds.items() for x in (f"{kind}:", *(f"  {row}" for row in rows))))


def check(
    job: Job, store: Annotated[Path, Argument(metavar="STORE", help="Folder that run --stream or sweep --store wrote.")]
) -> None:
    """Verify that every chunk of a store is as it was written.

    Example:
      fingerspice check out/long.zarr
    """
    from fingerspice.results.runfile import check_store

    chunks = check_store(store)
    job.answer.update(chunks=chunks)
    job.give(lambda: f"{store}: {sum(chunks.values()):,} chunks of {len(chunks)} arrays are as they were written")


def warm(job: Job) -> None:
    """Compile everything that runs may need, in two processes, and keep it: no later run waits for the compiler.

    Example:
      fingerspice warm
    """
    from fingerspice.base.compiled import cache_folder
    from fingerspice.cli.warm import warm_up

    folder = cache_folder()
    refuse(folder is None, f"compiled code cannot be kept: {NO_FOLDER}")
    with paced("compiling") as update:
        warm_up(update)
    job.give(lambda: f"all is compiled, in {folder}")


_SHORT = 1.0  # Resistance of a shorted gap, ohm
_FILES = "deck out name overwrite"
_END = "json no_plot"
#: Every command with all its options, in the order of its help.
_COMMANDS: dict[Callable[..., None], str] = {
    run: f"{_FILES} rtol charge_law area method set finger coating drive source stop start jumps csv raw "
    f"stream chunk signals netcdf feel schematic {_END}",
    ac: f"{_FILES} sweep area amplitude skin finger impedance charge_law rtol set source {_END}",
    plan: "deck rtol charge_law area stop charge set source json",
    compare: f"{_FILES} other rtol charge_law set source {_END}",
    studies.limits: f"{_FILES} points span capability limit carrier set source {_END}",
    studies.design: f"table {_FILES} carrier limit slew rate charge_law set {_END}",
    studies.fit: f"table deck free groups out name overwrite average skin profile charge_law set {_END}",
    studies.fit_contact: f"tables deck free finger out name overwrite profile set {_END}",
    studies.sweep: f"file out name overwrite {_END} store workers scheduler shard",
    export: "deck output charge_law set source stop json",
    figures: "out only gallery json",
    explore: "deck set finger coating drive port no_browser static json",
    sets: "name json",
    help_deck: "json",
    check: "store json",
    warm: "json",
}
for _function, _options in _COMMANDS.items():
    add_command(app, _options, _function)


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, Option("--version", help="Print the version.", is_eager=True)] = False) -> None:
    if version:
        say(f"fingerspice {fs.__version__}")
        raise typer.Exit
