"""A netlist file as a flat list of evaluated statements: expands subcircuit calls, renames nodes, evaluates values.

A statement has a name, nodes and values; `netlist` and `sources` give it a meaning. The steps are those of `lexer`
(from text to words), `reader` (lines by kind, included files), `expressions` (parameters and values) and `_Instance`
(subcircuit calls). Every error has its place in the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import dropwhile
from pathlib import Path
from types import MappingProxyType

from fingerspice.base.errors import InputError, Where, printable
from fingerspice.circuit.devices import DEVICES, called_devices
from fingerspice.netlist.expressions import Bare, Call, Number, Scope, Value, in_scope
from fingerspice.netlist.lexer import MAX_NAME, NUMBER, Group, Lexeme, Line, group, is_unit, lex, nearest
from fingerspice.netlist.reader import DIRECTIVES, MAX_BYTES, OTHERS, Deck, Statement, Subcircuit
from fingerspice.netlist.sources import SOURCES
from fingerspice.waveforms.waveform import refuse

LONGEST_TITLE = 200  #: Characters of a title that are shown; the middle of a longer title is left out.
#: Limits of subcircuit calls: total number of expanded lines and characters, and nesting.
MAX_EXPANDED = 100_000
MAX_EXPANDED_TEXT = 4 * 2**20
MAX_DEPTH = 32

_LETTERS = [name for name, spec in DEVICES.items() if spec.cells is None]  #: Elements with a letter of their own.
#: Forms of a controlled source that follows otherwise than in proportion, by the word after its nodes.
NONLINEAR = ("POLY", "VALUE", "TABLE", "LAPLACE", "FREQ", "CHEBYSHEV", "VOL", "CUR")

_STATEMENT = re.compile(  #: Titles that are probably the netlist's first statement.
    rf"[rclvi]\w*\s+\S+\s+\S+\s+(?:\{{|'|[-+.\d]|(?:dc|ac|sine|{'|'.join(SOURCES)})\b)"
    rf"|(?:x\w*(?:\s+\S+){{3}}\s+(?:{'|'.join(called_devices())})|{'|'.join(map(re.escape, DIRECTIVES))})(?:\s|$)",
    re.IGNORECASE,
)


def parse_deck(text: str, path: Path | None = None, values: Mapping[str, float] = MappingProxyType({})) -> Deck:
    """Read a netlist, whose first line is the title.

    Files are included from the folder of `path`, that of the file with this text; without it, only native libraries.
    The deck's own parameters in `values` have these instead of their own.
    """
    deck = Deck(text, path)
    refuse(not text.strip("\ufeff \t\r\n"), f"'{deck.file}' is empty: a netlist begins with a title line")
    refuse(len(text) > MAX_BYTES, f"'{deck.file}' is larger than {MAX_BYTES >> 20} MiB")
    refuse("\0" in text, f"'{deck.file}' is not text (it holds NUL characters)")
    title, *lines = deck.split(text.removeprefix("\ufeff"))
    deck.title = printable(re.sub(r"(?i)^\.title\s+", "", title.strip()), LONGEST_TITLE)
    if _STATEMENT.match(deck.title):
        problem = f"the first line is the title, but '{deck.title}' reads like a statement: add a title above"
        deck.warn(problem, Where(deck.file, 1))
    try:
        deck.read_lines(lines)
        scope = Scope(deck.root.params, functions=(functions := in_scope(deck.functions)))
        for name, value in values.items():
            scope.preset(name, Number(value, f"{value:g}", deck.root.where))
        deck.params = {**scope.solve(), **functions}
        _Instance(deck, deck.root, scope).expand()
    except InputError as error:
        raise with_comma(error, deck.warnings) from None
    for defined in deck.root.inner.values():
        # In a library it is usual that some subcircuits are never called.
        if defined.where.file == deck.file and not (defined.called or defined.skipped):
            deck.warn(f"subcircuit '{defined.name}' is never called, and its body was not read", defined.where)
    return deck


def with_comma(error: InputError, warnings: Iterable[str]) -> InputError:
    """The error, with the warning about a decimal comma in the same line, if there is one."""
    place = f"{error.where.file}:{error.where.line}:" if error.where else "none"
    found = [text.partition(": ")[2] for text in warnings if text.startswith(place) and "decimal comma" in text]
    return InputError("; note ".join([error.message, *found]), error.where) if found else error


@dataclass(slots=True)
class _Instance:
    """A subcircuit call that is being expanded into statements and directives of the deck, or the deck itself."""

    deck: Deck
    definition: Subcircuit
    scope: Scope
    around: tuple[_Instance, ...] = ()  # Those around the definition, innermost first, whose subcircuits it may call
    prefix: str = ""  # as written, ends in a dot
    ports: dict[str, tuple[str, str]] = field(default_factory=dict)
    calls: tuple[Subcircuit, ...] = ()  # definitions being expanded, outermost first

    def node(self, name: str) -> tuple[str, str]:
        """Canonical and written name of a node named in this instance."""
        lower = name.lower()
        if lower in ("0", "gnd"):
            return "0", name
        if lower in self.deck.shared and lower not in self.ports:
            return lower, self.deck.shared[lower]
        return self.ports.get(lower) or (f"{self.prefix}{lower}".lower(), f"{self.prefix}{name}")

    def nodes(self, words: list[Lexeme]) -> list[tuple[str, str]]:
        """Canonical and written names of nodes."""
        for word in words:
            if word.kind != "word":
                raise InputError(f"{word.written} stands where a node's name belongs", word.where)
        return [self.node(word.text) for word in words]

    def expand(self) -> None:
        """Add the statements and directives; an `.ic` line gets the canonical names of its nodes."""
        for line in self.definition.elements:
            self._element(line)
        for name, line, rest in self.definition.directives:
            words, params = group(lex(line, rest), probes=True), dict[str, Value]()
            args = self.scope.words(words.words)
            for key, value in self.scope.pairs(words).items():
                probe = name == ".ic" and key.startswith("v(")
                flat = f"v({self.node(key[2:-1].strip())[0]})" if probe else key
                refuse(flat in params, f".ic gives node {flat[2:-1]!r} twice", value.key)
                params[flat] = value
            self.deck.directives[name].append(Call(name, args, params, line.where(), line.text))

    def _element(self, line: Line) -> None:
        lexemes = lex(line) or [Lexeme("", ",", 0, line)]  # a line of commas has none
        first = lexemes[0]
        where, letter = first.where, first.text[:1].upper()
        if first.kind != "word" or not (letter.isascii() and letter.isalpha()):
            begins = f"a line begins with {', '.join(_LETTERS)}, X or a dot, a comment with *"
            raise InputError(f"'{first.written}' is no element: {begins}", where)
        # A device's name without its X may begin with the letter of an element.
        called = letter in "LKEGFHS" and any(x.kind == "=" for x in lexemes) and _calls(lexemes)
        if letter != "X" and (letter not in DEVICES or called):
            raise InputError(_unknown_element(lexemes), where)
        name = f"{self.prefix}{first.text}"
        if len(name) > MAX_NAME:
            raise InputError(f"an element's name of {len(name)} characters: at most {MAX_NAME} are allowed", where)
        if (earlier := self.deck.names.setdefault(name.lower(), where)) is not where:
            raise InputError(f"element '{name}' is defined twice, first at {earlier}", where)
        if letter == "X":
            self._call(name, lexemes)
            return
        spec = DEVICES[letter]
        form = ["node"] * len(spec.nodes) + [*spec.control]
        scope, words = self.scope, group(lexemes[1:], plain=len(form))
        # A coupling may be one of more than two inductors.
        count = max(len(form), len(words.words) - 1) if letter == "K" else len(form)
        heads = [word for word in words.words[:count] if isinstance(word, Lexeme)]
        other = [x.text for x in lexemes[3:4] if spec.control and x.text.upper() in NONLINEAR]
        article, last = "an" if spec.what[0] in "aeiou" else "a", "model" if letter == "S" else "value"
        written_so = f"{article} {spec.what} is written {name} {' '.join(form)} {last}"
        refuse(other, f"{name} is given by {other and other[0]}: {written_so}, and follows in proportion only", where)
        missing = form[len(heads)] if len(heads) < len(form) else ""
        missing = missing or ("" if len(words.words) > count or words.params else last)
        refuse(missing, f"missing {missing}: {written_so}", where)
        found, rest = self.nodes(heads[: len(spec.nodes)]), heads[len(spec.nodes) :]
        canonical, written = tuple(x for x, _ in found), tuple(x for _, x in found)
        # Nodes, or elements of the same subcircuit.
        own = (f"{self.prefix}{x.text}".lower() for x in rest)
        control = tuple(x for x, _ in self.nodes(rest)) if "node" in spec.control else tuple(own)
        # A word of a switch names a model; that of any other element may name a parameter, as in ngspice.
        bare: Bare = "nothing" if letter == "S" else "name"
        body, params = scope.words(words.words[count:], bare), scope.pairs(words, bare)
        self.deck.statements.append(Statement(name, letter, canonical, written, body, params, where, control))

    def _call(self, name: str, lexemes: list[Lexeme]) -> None:
        """An X line: a native device becomes a statement, and a subcircuit is expanded."""
        words, scope = group(lexemes[1:], plain=len(lexemes)), self.scope
        if (stray := words.stray) is not None:
            number = stray.line.text[: stray.position].rpartition("=")[2].strip()
            apart = NUMBER.fullmatch(number) and is_unit(stray.text)
            hint = f"; a unit joins its number, {number}{stray.text}" if apart else ""
            problem = f"'{stray.text}' follows the parameters: nodes and the device's name come first{hint}"
            raise InputError(problem, stray.where)
        plain = [word for word in words.words if isinstance(word, Lexeme) and word.text.lower() != "params:"]
        refuse(not plain, f"missing value: {name} needs nodes and a device's name", lexemes[0])
        *nodes, device = plain
        refuse(device.kind != "word", f"{device.written} stands where a device's name belongs", device)
        native, key = device.text.upper(), device.text.lower()
        around = tuple(dropwhile(lambda one: key not in one.definition.inner, (self, *self.around)))
        called = around[0].definition.inner[key] if around else None
        if called is None and native not in called_devices():
            raise InputError(_unknown_device(plain, self), device.where)
        shown, wanted = (called.name, called.ports) if called else (native, DEVICES[native].nodes)
        if len(nodes) != len(wanted):
            count = f"{len(wanted)} node{'' if len(wanted) == 1 else 's'}"
            named = f" ({' '.join(wanted)})" if wanted else ""
            raise InputError(f"{name}: {shown} has {count}{named}, {len(nodes)} given", device.where)
        if called is None:
            canonical, written = zip(*self.nodes(nodes), strict=True)
            params = scope.pairs(words, bare="arithmetic")
            given = {key: value.value for key, value in params.items() if isinstance(value, Number)}
            _refuse_captured(native, given, words, scope)
            self.deck.statements.append(Statement(name, native, canonical, written, (), params, lexemes[0].where))
            return
        # Count what the call expands to; refuse circles, and what is too deep or too much.
        for start, outer in enumerate(self.calls):
            if outer is called:
                path = " -> ".join(sub.name for sub in (*self.calls[start:], called))
                raise InputError(f"subcircuit '{called.name}' calls itself: {path}", device.where)
        self.deck.expanded += 1 + len([*called.elements, *called.params, *called.defaults, *called.directives])
        self.deck.expanded_text += called.characters
        refuse(len(self.calls) >= MAX_DEPTH, f"subcircuits call each other more than {MAX_DEPTH} deep", device)
        refuse(self.deck.expanded > MAX_EXPANDED, f"the subcircuits expand to more than {MAX_EXPANDED:,} lines", device)
        problem = f"the subcircuits expand to more than {MAX_EXPANDED_TEXT >> 20} MiB of text"
        refuse(self.deck.expanded_text > MAX_EXPANDED_TEXT, problem, device)
        ports = dict(zip(called.ports, self.nodes(nodes), strict=True))
        called.called = True
        # Values on the X line are evaluated in the caller's scope, defaults in the subcircuit's.
        inner = Scope((*called.defaults, *called.params), scope)
        allowed = {default.key.text.lower(): default.key.text for default in called.defaults}
        for parameter, (word, value) in words.params.items():
            if parameter not in allowed:
                hint = nearest(parameter, allowed) or f"; it has {' '.join(allowed.values()) or 'none'}"
                raise InputError(f"subcircuit '{called.name}' has no parameter '{word.text}'{hint}", word.where)
            inner.preset(parameter, scope.number(value))
        _refuse_captured(called.name, inner.solve(), words, scope)
        _Instance(self.deck, called, inner, around, f"{name}.", ports, (*self.calls, called)).expand()


def _refuse_captured(device: str, own: dict[str, float], words: Group, caller: Scope) -> None:
    """Refuse a value on an X line with a name that is the caller's parameter here, and the device's own in ngspice."""
    for given, (key, value) in words.params.items():
        for name, here in caller.references(value).items():
            if name != given and own.get(name, here) != here:
                problem = f"{key.text}={value.written} means {name} = {here:g} of the calling netlist here"
                problem += f", and in ngspice {device}'s own {name} = {own[name]:g}"
                raise InputError(f"{problem}; allowed: another name for one of them", value.where)


def _unknown_device(words: list[Lexeme], instance: _Instance) -> str:
    """The message that the last word of an X line is not a device, with a hint."""
    last = words[-1]
    inner = [one.definition.inner for one in (instance, *instance.around)]
    visible = [*called_devices(), *(sub.name for subs in inner for sub in subs.values())]
    known = {name.lower() for name in visible}
    for word in words[2:-1]:
        # A device's name after two words or more is probably the device, and the words after it lack their `key=`.
        if word.text.lower() in known:
            return f"{last.written} follows the device {word.text}: its parameters are written key=value"
    hint = nearest(last.text, visible) or f"; devices are {' '.join(visible[:40])}"
    return f"'{last.text}' is not a device or a .subckt{hint}"


def _calls(lexemes: list[Lexeme]) -> bool:
    """Whether a line has the name of a device behind its nodes."""
    return any(lexeme.text.upper() in called_devices() for lexeme in lexemes[3:])


def _unknown_element(lexemes: list[Lexeme]) -> str:
    """The message that a line with these words is not an element, with a hint."""
    name = lexemes[0].text
    if _calls(lexemes):
        return f"'{name}': a device's name begins with X, as in X{name}"
    if f".{name.lower()}" in DIRECTIVES:
        return f"'{name}': a directive begins with a dot, as in .{name.lower()}"
    kind = OTHERS["elements"].get(name[0].upper())
    kind, _, instead = (kind or "").partition("; ")
    what = f"'{name}' is {kind}, which is not supported" if kind else f"'{name}' is no known element"
    what += f": {instead}" if instead else ""
    return f"{what}; elements are {', '.join(_LETTERS)}, and X with {', '.join(called_devices())} or a .subckt"
