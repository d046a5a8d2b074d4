"""One call of a command: the options that commands share, the circuit they ask for, and the files of its results."""

from __future__ import annotations

import dataclasses
import hashlib
import html
import inspect
import json
import os
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, get_args

import typer
from typer import Argument, Option

import fingerspice as fs
from fingerspice.base.errors import FingerspiceWarning, InputError, printable
from fingerspice.base.files import write_aside
from fingerspice.base.units import parse_number
from fingerspice.cli.terminal import blank, complain, outcome, say, say_json
from fingerspice.results.outcome import SolveError
from fingerspice.waveforms.waveform import refuse, require

LARGEST_AREA = 0.01  # Largest area that causes no warning, m^2; a larger one was probably given in mm^2
LONGEST_SOURCE = 1000  # Largest number of characters of a source's numbers that are stored with the results
FOLDER = Path("out")  # Folder of the results unless another one is named
#: First bytes of the tables that the commands write, and last ones of the heads of those about steps.
_HEADS = (
    b"t [s],u_source", b"frequency [Hz],gain [1],", b"frequency [Hz],v:", b"parameter,value [SI],unit,",
    b"time (s),drive (V)", b"time (s),wanted force (N),",
)  # fmt: skip
_TAIL = b",status"
SETS = ("set", "finger", "coating", "drive")  # Options that name sets of parameters
_SET = "Apply a named set of this kind: {} (list: fingerspice sets)."
_SPECS = "'SQUARE(200 100)', 'Vdrive=DC 5', 'WAV(a.wav gain=150)', 'TABLE(a.csv)'"


#: What makes the files of a job, by their endings: it draws a picture or gives None; else it is given the path.
Makes = Mapping[str, Callable[..., Any]]


@dataclass
class Job:
    """One call of a command: the options that commands share, with the defaults of those that it does not take.

    Each warning that is given inside becomes one line on stderr and a part of the answer. If JSON is wanted, the answer
    is printed at the end, even if that is an error.
    """

    answer: dict[str, Any]
    deck: Annotated[Path, Argument(metavar="DECK", help="Netlist file (.cir), - for standard input.")]
    out: Annotated[Path | None, "Folder of the files; out by default.", "FOLDER"] = None
    name: Annotated[str | None, "Name of the files; that of the deck by default.", "NAME"] = None
    overwrite: Annotated[bool, "Replace results of other circuits, and other files."] = False
    rtol: Annotated[float, "Largest error of gap voltage and force, relative to their peaks."] = 1e-8
    charge_law: Annotated[str | None, "local or mobile; the included library's by default."] = None
    set: Annotated[
        list[str] | None, "Change a value: Xgap.d=3u; or apply a named set: moist. Repeatable.", "PATH=VALUE|NAME"
    ] = None
    finger: Annotated[list[str] | None, _SET.format("moist, or Xlight=dry for one of several"), "[ELEMENT=]NAME"] = None
    coating: Annotated[list[str] | None, _SET.format("3M"), "[ELEMENT=]NAME"] = None
    drive: Annotated[list[str] | None, _SET.format("Fig4-5kHz"), "[ELEMENT=]NAME"] = None
    source: Annotated[list[str] | None, f"Replace a source: {_SPECS}.", "[NAME=]SPEC"] = None
    stop: Annotated[str | None, "End of the run, s: 50m; TSTOP by default.", "TIME"] = None
    json: Annotated[bool, "Print JSON (docs/json.md), nothing else on stdout."] = False
    no_plot: Annotated[bool, "Write no picture."] = False
    files: dict[str, Path] = field(default_factory=dict, init=False)  # Files of the results by their endings
    about: dict[str, str] = field(default_factory=dict, init=False)  # Texts kept in a picture
    then: Callable[[], None] | None = field(default=None, init=False)  # Called after the answer has been printed

    @contextmanager
    def told(self) -> Iterator[None]:
        """What is done inside is told: by its warnings, and by the answer at its end."""
        with warnings.catch_warnings(action="always", category=FingerspiceWarning):
            warnings.showwarning = self._show
            try:
                yield
                self.answer.update(success=True, status="SUCCESS", message="success")
            except Exception as error:
                _, status, said = outcome(error)
                failure = error.failure.to_dict() if isinstance(error, SolveError) else None
                self.answer.update(status=status, message=said, failure=failure)
                raise
            finally:
                if self.json:
                    say_json(self.answer)

    def _show(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = str(message)
        if text not in self.answer["warnings"]:
            self.answer["warnings"].append(text)
            complain(f"warning: {text}")

    def read(self) -> fs.Circuit:
        """The circuit that the options ask for, of which the answer tells.

        It is the deck's with named sets, ``--set`` values, and ``--source``: of these the last has the last word. Gives
        the reader's warnings, without those about replaced values, and those about directives.
        """
        from fingerspice.circuit.circuit import CHARGE_LAWS
        from fingerspice.circuit.describe import directive_warnings, option_notes

        with warnings.catch_warnings(record=True, action="always", category=FingerspiceWarning) as noticed:
            circuit = fs.read_netlist(self.deck)
        given, changes = circuit.warnings, self.set or []
        # A path has a dot, and the name of a set none.
        named = [change for change in changes if change and not re.search("[=.]", change)]
        try:
            for option in SETS:
                for text in named if option == "set" else getattr(self, option) or ():
                    circuit = _with_set(circuit, option, text)
            circuit = _with_values(circuit, changes, named)
            circuit = _with_sources(circuit, self.source or [])
            given = circuit.warnings
        finally:
            # If a change is refused, show all warnings of the deck, since any of them may explain the refusal.
            for warning in noticed:
                if str(warning.message) in map(printable, given):
                    warnings.warn(str(warning.message), FingerspiceWarning, stacklevel=2)
        # `simulate` gives these warnings itself, but commands that do not call it with this circuit would not.
        steps = self.answer["command"] in ("run", "export")
        for text in directive_warnings(dataclasses.replace(circuit, steps=()) if steps else circuit):
            warnings.warn(text, FingerspiceWarning, stacklevel=2)
        for text in option_notes(circuit):
            self.answer["warnings"].append(text)
            complain(f"note: {text}")
        law = self.charge_law or circuit.charge_law or "local"
        require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
        known = {"title": circuit.title, "overrides": dict(circuit.overrides), "sets": list(circuit.sets)}
        self.answer.update(**known, charge_law=law)
        return circuit

    def check_files(self, circuit: fs.Circuit, *ends: str) -> Path:
        """The path of the results without its end, of which files with these ends are checked before anything is run.

        They go into the folder `out` under the deck's name, or the one given; with `overwrite` they may replace files
        of other or unknown circuits.
        """
        name, allowed = self.name, "a file's name without folder and end; --out names the folder"
        plain = name is None or (name not in ("", ".", "..") and Path(name).name == name and name.isprintable())
        require(plain, "--name", repr(name), allowed)
        path = (self.out or FOLDER) / (name or (circuit.path or self.deck).stem)
        wanted = [end for end in ends if not (self.no_plot and end.endswith(".png"))]
        self.files = {end: path.with_name(f"{path.name}{end}") for end in wanted}
        self.about = {
            "program": "fingerspice", "title": circuit.title, "file": str(circuit.path or ""),
            "deck_sha256": _hash(circuit.text), "overrides": json.dumps(dict(circuit.overrides)),
            "charge_law": self.charge_law or circuit.charge_law or "local",
            "files": json.dumps([file.name for file in self.files.values()]),
        }  # fmt: skip
        earlier = False
        for file in self.files.values():
            check_output(file, self.deck)
            if file.is_file() and not self.overwrite:
                earlier |= self._of_earlier_text(file)
        if earlier:
            complain(f"note: the results in {path.parent} are of an earlier text of {self.deck} and are replaced")
        return path

    def give(self, text: Callable[[], str], makes: Makes = MappingProxyType({})) -> None:
        """Write the files, then print a text unless JSON is wanted, even if a file cannot be written."""
        if self.about and self.files:
            self.make_folder()
        written: list[str] = self.answer["files"]
        if any(end.endswith(".png") for end in self.files):
            from matplotlib import artist

            # While it is imported, matplotlib writes documentation of its classes for a tenth of a run.
            artist.kwdoc = lambda artist: ""
        try:
            for end, file in self.files.items():
                if not end.endswith(".png"):
                    makes[end](file)
                elif (picture := makes[end]()) is None:
                    continue
                else:
                    from fingerspice.plots.drawing import save

                    save(picture, file, about=self.about)
                written.append(str(file))
        finally:
            said = [*filter(None, [text()]), *(f"wrote {file}" for file in written)]
            if said and not self.json:
                say("\n".join(said))

    def make_folder(self) -> None:
        """When the default folder is created, put a .gitignore into it, to keep results out of version control."""
        if self.out is None and not FOLDER.exists():
            # Ignore an error: writing the results will then fail as well, with a message.
            with suppress(InputError):
                write_aside(FOLDER / ".gitignore", lambda path: path.write_text("*\n"))

    def _of_earlier_text(self, file: Path) -> bool:
        """Whether a file is of an earlier text of the deck; refused is one of another circuit, or an unknown one."""
        ways = "allowed: --name NAME, another --out, or --overwrite"
        try:
            held, own = _texts_in(file), self.about
            changes = [dict(json.loads(one["overrides"])) for one in (held, own)]
            same_deck, same_law = (held[key] == own[key] for key in ("deck_sha256", "charge_law"))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, SyntaxError):
            # The file was not written by this package, or is a table; beside a WAV file there is such a table.
            with suppress(OSError), (file.with_suffix(".csv") if file.suffix == ".wav" else file).open("rb") as stream:
                head = stream.readline(10_000).rstrip()
                if head.startswith(_HEADS) or head.endswith(_TAIL):
                    complain(f"note: {file} is replaced; a table alone does not say which circuit it is of")
                    return False
            raise InputError(f"{file} is there already, and nothing says which circuit it is of; {ways}") from None
        if changes[0] != changes[1]:
            said = [_with(one) for one in changes]
        elif not same_law:
            said = [f"under the {one['charge_law']} law" for one in (held, own)]
        elif not same_deck and (held.get("file", "") != own["file"] or not held.get("file")):
            said = [f"of the deck {held.get('file') or 'of another text'}", f"of {self.deck}"]
        else:
            return not same_deck
        raise InputError(f"{file} holds a result {said[0]}, and this one is {said[1]}; {ways}")


def add_command(app: typer.Typer, options: str, function: Callable[..., None]) -> None:
    """Make a function of a `Job` and of options of its own a command, whose help has all options in this order."""
    name = function.__name__.replace("_", "-")
    own = inspect.signature(function, eval_str=True).parameters
    known = {**inspect.signature(Job, eval_str=True).parameters, **own}

    def call(**given: Any) -> None:
        shared = {key: value for key, value in given.items() if key not in own}
        job = Job(blank(name, given), **{"deck": Path(), **shared})
        with job.told():
            function(job, **{key: value for key, value in given.items() if key in own})
        if job.then is not None:
            job.then()

    taken = []
    for one in (known[key] for key in options.split()):
        # As typer takes it: an annotation has the help, and what stands for the value there.
        kind, said, *value = get_args(one.annotation)
        if isinstance(said, str):
            # With its name a switch has no second option that switches it off.
            said = Option(f"--{one.name.replace('_', '-')}", help=said, metavar=value[0] if value else None)
        taken.append(one.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, said]))
    # In the help an empty line keeps two lines apart.
    call.__doc__ = (inspect.getdoc(function) or "").replace("\n  fingerspice", "\n\n  fingerspice")
    call.__signature__ = inspect.Signature(taken)  # type: ignore[attr-defined]
    app.command(name)(call)


def _with_set(circuit: fs.Circuit, option: str, text: str) -> fs.Circuit:
    element, equals, name = (part.strip() for part in text.rpartition("="))
    try:
        return fs.parameters(name, None if option == "set" else option).apply(circuit, element if equals else None)
    except InputError as error:
        other = "; or PATH=VALUE, such as Xgap.d=3u" if option == "set" and "unknown set" in error.message else ""
        raise InputError(f"--{option} {text!r}: {error.message}{other}") from None


def _with_values(circuit: fs.Circuit, changes: list[str], named: list[str]) -> fs.Circuit:
    """The circuit with all ``--set`` values applied together, as two exponents may only be legal together."""
    values: dict[str, str] = {}
    for change in (change for change in changes if change not in named):
        path, equals, text = (part.strip() for part in change.partition("="))
        allowed = "PATH=VALUE, such as Xgap.d=3u"
        refuse(not (equals and path), f"--set {change!r} is not understood; allowed: {allowed}")
        values[path] = text
    try:
        return circuit.replace(values) if values else circuit
    except InputError as error:
        # Leave out the place in the deck, because the error is in the option.
        raise InputError(f"--set {' '.join(map(repr, changes))}: {error.message}") from None


def _with_sources(circuit: fs.Circuit, texts: list[str]) -> fs.Circuit:
    """The circuit with every ``--source``; the source's name may be left out if the circuit has only one."""
    from fingerspice.circuit.describe import overridden
    from fingerspice.circuit.statespace import driving_sources
    from fingerspice.netlist.netlist import source_from_text
    from fingerspice.waveforms.periodic import MOST_SHOWN

    if not texts:
        return circuit
    names = {e.name.lower(): e.name for e in driving_sources(circuit)}
    sources: dict[str, fs.Waveform] = {}
    # The results describe a recording or a long table by the option's text, instead of by its numbers.
    named_by: dict[str, str] = {}
    for text in texts:
        named, equals, spec = (part.strip() for part in text.partition("="))
        # In PWL(...) r=10m the text before the = is not a source's name.
        if not (equals and named.replace(".", "").isidentifier()):
            named, spec = "", text
        known = ", ".join(names.values()) or "no source"
        if not named and len(names) != 1:
            raise InputError(f"--source {text!r}: the circuit has {known}; allowed: NAME=SPEC with one of these names")
        name = names.get(named.lower(), "") if named else known
        if not name or name in sources:
            problem = "is given twice" if name else f"is not a source of the circuit; allowed: {known}"
            raise InputError(f"--source {text!r}: {named or name} {problem}")
        try:
            sources[name] = source_from_text(spec, circuit)
        except InputError as error:
            raise InputError(f"--source {error.message}") from None
        long = isinstance(wave := sources[name], fs.PWL) and len(wave.times) > MOST_SHOWN
        if long or isinstance(wave, fs.Samples) or len(repr(wave)) > LONGEST_SOURCE:
            named_by[name] = spec
    changed = overridden(circuit, sources)
    return dataclasses.replace(changed, overrides={**changed.overrides, **named_by})


def with_times(circuit: fs.Circuit, stop: str | None, start: str = "deck") -> tuple[fs.Circuit, str]:
    """The circuit with ``--stop`` and ``--start`` in place of TSTOP and TSTART, and the mode of the run's start.

    Without a .tran line the run starts uncharged and has 1,001 outputs.
    """
    from fingerspice.circuit.circuit import Tran

    tran, t_stop = circuit.tran, number("--stop", stop)
    t_start = number("--start", start) if start and start[0] in "+-.0123456789" else None
    start = start if t_start is None else "deck"
    if tran is None and t_stop is not None:
        tran = Tran((t_stop - (t_start or 0.0)) / 1000.0, t_stop, uic=True)
    elif tran is None or (t_stop is None and t_start is None):
        return circuit, start
    first, last = tran.start if t_start is None else t_start, tran.stop if t_stop is None else t_stop
    refuse(last <= 0.0, f"--stop {last:g} s; allowed: more than 0 s")
    if t_start is not None and not 0.0 <= first < last:
        raise InputError(f"--start {first:g} s; allowed: from 0 s to less than the end, {last:g} s")
    enough, least = last >= first + tran.step * (1.0 - 1e-12), f"TSTART + TSTEP = {first + tran.step:g} s or more"
    require(enough, f"--stop {last:g} s", "before the second output", least)
    return dataclasses.replace(circuit, tran=dataclasses.replace(tran, stop=last, start=first)), start


def number(option: str, text: str | None, *, positive: bool = False) -> float | None:
    """The number of an option, with SPICE's scales, such as ``50m``; None if the option is not given."""
    try:
        value = None if text is None else parse_number(text)
    except ValueError as error:
        raise InputError(f"{option} {text!r}: {error}") from None
    require(value is None or value > 0.0 or not positive, option, text, "> 0")
    return value


def area_from_text(text: str) -> str | float:
    """The name of a mode, or an area in m^2."""
    try:
        area = parse_number(text)
    except ValueError:
        return text
    if area > LARGEST_AREA:
        text = f"--area {text} is in m^2, {area * 1e6:g} mm^2; a fingerpad has tens of mm^2, which is 35e-6 or 35u here"
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    return area


def check_output(file: Path, deck: Path | None = None) -> None:
    """Before a run, refuse an output file that cannot be written or is the deck itself; writes nothing."""
    allowed = "allowed: a folder that can be written"
    try:
        folder = next((one for one in file.parents if one.exists() or one.is_symlink()), file.parents[-1])
        # This raises OSError if a name is too long; the check needs a folder that exists.
        for name in file.relative_to(folder).parts:
            (folder / name).exists()
        refuse(not folder.is_dir(), f"cannot write {file}: {folder} is not a folder; {allowed}")
        refuse(not os.access(folder, os.W_OK | os.X_OK), f"cannot write {file}: no permission in {folder}; {allowed}")
        # Some folders, such as those of /proc, take nothing new whatever their permissions say.
        with tempfile.TemporaryFile(dir=folder):
            pass
        refuse(file.is_dir(), f"cannot write {file}: it is a folder; allowed: a file's name")
        same = deck is not None and file.exists() and deck.exists() and file.samefile(deck)
        refuse(same, f"cannot write {file}: it is the deck itself; allowed: another name or folder")
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror}; {allowed}") from None


def _with(changes: Mapping[str, str]) -> str:
    said = [f"{path}={value if len(value) <= 40 else value[:36] + ' ...'}" for path, value in changes.items()]
    return f"with {', '.join(said[:8])}" if said else "of the deck as it is"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()


def _texts_in(file: Path) -> dict[str, Any]:
    """Texts kept in a file; of a table, those in the picture of the same name, if it lists the table's file."""
    if file.suffix == ".nc":
        import h5netcdf

        with h5netcdf.File(file, "r") as data:
            attributes = {str(key): str(value) for key, value in data.attrs.items()}
        return {**attributes, "deck_sha256": _hash(attributes["deck"])}
    if file.suffix == ".svg":
        # A schematic has them as its description.
        found = re.search(r"<dc:description>(.*?)</dc:description>", file.read_text(encoding="utf-8"), re.DOTALL)
        return {} if found is None else dict(json.loads(html.unescape(found[1])))
    from PIL import Image

    picture = file.with_suffix(".png")
    if not picture.is_file():
        # `design` writes NAME_drive.wav, NAME_drive.csv and NAME_friction.csv with the picture NAME_design.png.
        picture = file.with_name(f"{file.stem.rpartition('_')[0]}_design.png")
    with Image.open(picture) as image:
        text: dict[str, Any] = dict(getattr(image, "text", {}))
    return text if file.name in json.loads(text.get("files", "[]")) else {}
