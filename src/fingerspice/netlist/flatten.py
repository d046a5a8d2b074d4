"""Conversion of element lines to flat statements: expands subcircuit calls, renames nodes, evaluates values."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.devices import DEVICES, layer_devices
from fingerspice.netlist.lexer import Group, Lexeme, Line, group, lex
from fingerspice.netlist.reader import DIRECTIVES, Subcircuit
from fingerspice.netlist.scope import Bare, Call, Number, Scope, Token, Value
from fingerspice.netlist.slips import nearest, stray_word

#: Limits of subcircuit calls: total number of expanded lines and characters, nesting, and characters of a flat name.
MAX_EXPANDED = 100_000
MAX_EXPANDED_TEXT = 4 * 2**20
MAX_DEPTH = 32
MAX_NAME = 400

_VALUED = {"R": "resistor", "C": "capacitor", "V": "voltage source", "I": "current source"}
_ELSEWHERE = {
    "A": "an XSPICE model",
    "B": "a behavioural source (a function of time is given in Python, sources={'V1': f})",
    "D": "a diode",
    "E": "a controlled source",
    "F": "a controlled source",
    "G": "a controlled source",
    "H": "a controlled source",
    "J": "a transistor",
    "K": "a coupled inductor",
    "L": "an inductor",
    "M": "a transistor",
    "O": "a transmission line",
    "Q": "a transistor",
    "S": "a switch",
    "T": "a transmission line",
    "U": "a transmission line",
    "W": "a switch",
    "Y": "a transmission line",
    "Z": "a transistor",
}


@dataclass(frozen=True, slots=True)
class Statement:
    """One element of the flat circuit."""

    name: str  # Name as written, with the names of the enclosing calls in front: ``Xfinger.Xgap``
    letter: str  # R, C, V, I, or X for a native device
    # Nodes in lower case, ground as ``0``; a node inside a subcircuit has the names of the enclosing calls in front
    nodes: tuple[str, ...]
    node_names: tuple[str, ...]  # The same nodes as written
    device: str | None  # A native device's name in upper case
    body: tuple[Number | Token | Call, ...]  # The words after the nodes; empty for an X
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    param_where: dict[str, Where]  # Places of the keys
    where: Where  # Place of the name


@dataclass(frozen=True, slots=True)
class Directive:
    """A line such as `.tran 10u 50m uic`."""

    name: str  # Name in lower case, with its dot
    args: tuple[Number | Token | Call, ...]  # Words of the line, numbers evaluated
    # Values of `key=value` pairs by key in lower case; `.ic v(area)=1` has the key ``v(area)``
    params: dict[str, Value]
    param_where: dict[str, Where]  # Places of the keys
    where: Where  # Place of the dot
    text: str  # The line as written, continuations joined


@dataclass(slots=True)
class _Instance:
    """A subcircuit call that is being expanded, or the deck itself."""

    definition: Subcircuit
    scope: Scope
    outside: _Instance | None = None  # the instance in which the definition stands
    prefix: str = ""  # as written, ends in a dot
    ports: dict[str, tuple[str, str]] = field(default_factory=dict)
    calls: tuple[Subcircuit, ...] = ()  # definitions being expanded, outermost first

    def node(self, name: str) -> tuple[str, str]:
        """Canonical and written name of a node named in this instance."""
        lower = name.lower()
        if lower in ("0", "gnd"):
            return "0", name
        return self.ports.get(lower) or (f"{self.prefix}{lower}".lower(), f"{self.prefix}{name}")

    def find(self, name: str) -> tuple[Subcircuit, _Instance] | None:
        """The definition of that name visible here, and the instance that contains it; None if there is none."""
        instance: _Instance | None = self
        while instance is not None:
            if name in instance.definition.inner:
                return instance.definition.inner[name], instance
            instance = instance.outside
        return None

    def visible(self) -> list[str]:
        """Names that an X line may call from here."""
        names = list(layer_devices())
        instance: _Instance | None = self
        while instance is not None:
            names += [sub.name for sub in instance.definition.inner.values()]
            instance = instance.outside
        return names


def directive_of(name: str, line: Line, rest: int, scope: Scope) -> Directive:
    """A directive whose arguments start at position `rest`, evaluated in a scope."""
    words = group(line, lex(line, rest), probes=True)
    args = scope.words(line, words.words)
    start = line.start
    return Directive(name, args, *scope.pairs(line, words), line.where(start), line.text[start:])


class Flattener:
    """Turns the element lines of a deck into statements.

    Attributes
    ----------
    statements : list of Statement
        Statements in the order of the deck; a call is replaced by the statements of its subcircuit.
    starts : list of Directive
        The `.ic` lines, also of subcircuits, with the nodes of the flat circuit.
    """

    def __init__(self) -> None:
        self.statements: list[Statement] = []
        self.starts: list[Directive] = []
        self._names: dict[str, Where] = {}
        self._expanded = 0
        self._expanded_text = 0

    def run(self, root: Subcircuit, scope: Scope) -> None:
        """Add the statements of a deck, whose parameters have their values."""
        self._expand(_Instance(root, scope))

    def _expand(self, instance: _Instance) -> None:
        for line in instance.definition.elements:
            self._element(line, instance)
        for line, rest in instance.definition.starts:
            self.starts.append(_flat_start(directive_of(".ic", line, rest, instance.scope), instance))

    def _element(self, line: Line, instance: _Instance) -> None:
        lexemes = lex(line) or [Lexeme("", ",", line.start)]  # a line of commas has none
        first = lexemes[0]
        where = line.where(first.position)
        letter = first.text[:1].upper()
        if first.kind != "word" or not (letter.isascii() and letter.isalpha()):
            problem = (
                f"'{line.written(first)}' is no element: a line begins with R, C, V, I, X or a dot, a comment with *"
            )
            raise InputError(problem, where)
        if letter != "X" and letter not in _VALUED:
            raise InputError(_unknown_element(lexemes), where)
        name = f"{instance.prefix}{first.text}"
        if len(name) > MAX_NAME:
            raise InputError(f"an element's name of {len(name)} characters: at most {MAX_NAME} are allowed", where)
        earlier = self._names.setdefault(name.lower(), where)
        if earlier is not where:
            raise InputError(f"element '{name}' is defined twice, first at {earlier}", where)
        if letter == "X":
            self._call(line, lexemes, name, instance)
        else:
            self.statements.append(_valued(line, lexemes, name, instance))

    def _call(self, line: Line, lexemes: list[Lexeme], name: str, instance: _Instance) -> None:
        """An X line: a native device becomes a statement, and a subcircuit is expanded."""
        words = group(line, lexemes[1:], plain=len(lexemes))
        if words.stray is not None:
            hint = stray_word(words.stray.text, line.text[: words.stray.position])
            problem = f"'{words.stray.text}' follows the parameters: nodes and the device's name come first{hint}"
            raise InputError(problem, line.where(words.stray.position))
        plain = [word for word in words.words if isinstance(word, Lexeme) and word.text.lower() != "params:"]
        if not plain:
            problem = f"missing value: {name} needs nodes and a device's name"
            raise InputError(problem, line.where(lexemes[0].position))
        nodes, device = plain[:-1], plain[-1]
        where = line.where(device.position)
        if device.kind != "word":
            raise InputError(f"{line.written(device)} stands where a device's name belongs", where)
        native = device.text.upper()
        if native in layer_devices():
            _check_nodes(name, native, len(nodes), DEVICES[native].nodes, where)
            canonical, written = _nodes(line, nodes, instance)
            params = instance.scope.pairs(line, words, bare="arithmetic")
            given = {key: value.value for key, value in params[0].items() if isinstance(value, Number)}
            _refuse_captured(native, given, line, words, instance.scope)
            start = line.where(lexemes[0].position)
            self.statements.append(Statement(name, "X", canonical, written, native, (), *params, start))
            return
        found = instance.find(device.text.lower())
        if found is None:
            raise InputError(_unknown_device(line, plain, instance), where)
        called, outside = found
        _check_nodes(name, called.name, len(nodes), called.ports, where)
        self._check_depth(called, instance, len(instance.calls), where)
        ports = zip(called.ports, zip(*_nodes(line, nodes, instance), strict=True), strict=True)
        inner = _Instance(called, Scope(instance.scope), outside, f"{name}.", dict(ports))
        inner.calls = (*instance.calls, called)
        _bind(inner, line, words, instance.scope)
        called.called = True
        self._expand(inner)

    def _check_depth(self, called: Subcircuit, instance: _Instance, depth: int, where: Where) -> None:
        if any(called is outer for outer in instance.calls):
            start = next(i for i, outer in enumerate(instance.calls) if outer is called)
            path = " -> ".join(sub.name for sub in (*instance.calls[start:], called))
            raise InputError(f"subcircuit '{called.name}' calls itself: {path}", where)
        if depth >= MAX_DEPTH:
            raise InputError(f"subcircuits call each other more than {MAX_DEPTH} deep", where)
        self._expanded += 1 + len(called.elements) + len(called.params) + len(called.defaults)
        if self._expanded > MAX_EXPANDED:
            raise InputError(f"the subcircuits expand to more than {MAX_EXPANDED:,} lines", where)
        self._expanded_text += called.characters
        if self._expanded_text > MAX_EXPANDED_TEXT:
            raise InputError(f"the subcircuits expand to more than {MAX_EXPANDED_TEXT >> 20} MiB of text", where)


def _flat_start(start: Directive, instance: _Instance) -> Directive:
    """An `.ic` line with the canonical names of its nodes, which are those of a subcircuit's call."""
    params, places = dict[str, Value](), dict[str, Where]()
    for key, value in start.params.items():
        flat = f"v({instance.node(key[2:-1].strip())[0]})" if key.startswith("v(") else key
        if flat in params:
            raise InputError(f".ic gives node {flat[2:-1]!r} twice", start.param_where[key])
        params[flat], places[flat] = value, start.param_where[key]
    return replace(start, params=params, param_where=places)


def _bind(inner: _Instance, line: Line, words: Group, caller: Scope) -> None:
    """Evaluate a call's parameters: values on the X line in the caller's scope, defaults in the subcircuit's."""
    definition = inner.definition
    for formula in (*definition.defaults, *definition.params):
        inner.scope.define(formula)
    allowed = {formula.name.lower(): formula.name for formula in definition.defaults}
    for key, pair in words.params.items():
        if key not in allowed:
            hint = nearest(key, allowed) or f"; it has {' '.join(allowed.values()) or 'none'}"
            problem = f"subcircuit '{definition.name}' has no parameter '{pair.key.text}'{hint}"
            raise InputError(problem, line.where(pair.key.position))
        inner.scope.preset(key, caller.number(line, pair.value))
    inner.scope.solve()
    _refuse_captured(definition.name, inner.scope.values, line, words, caller)


def _refuse_captured(device: str, own: dict[str, float], line: Line, words: Group, caller: Scope) -> None:
    """Refuse a value on an X line with a name that is the caller's parameter here, and the device's own in ngspice."""
    for key, pair in words.params.items():
        for name, value in caller.references(line, pair.value).items():
            if name != key and own.get(name, value) != value:
                problem = (
                    f"{pair.key.text}={line.written(pair.value)} means {name} = {value:g} of the calling netlist here, "
                    f"and in ngspice {device}'s own {name} = {own[name]:g}; allowed: another name for one of them"
                )
                raise InputError(problem, line.where(pair.value.position))


def _valued(line: Line, lexemes: list[Lexeme], name: str, instance: _Instance) -> Statement:
    """Statement of an R, C, V or I line."""
    letter = lexemes[0].text[0].upper()
    where = line.where(lexemes[0].position)
    words = group(line, lexemes[1:], plain=2)
    nodes = [word for word in words.words[:2] if isinstance(word, Lexeme)]
    if len(nodes) < 2 or (len(words.words) == 2 and not words.params):
        missing = "node" if len(nodes) < 2 else "value"
        problem = f"missing {missing}: a {_VALUED[letter]} is written {name} node node value"
        raise InputError(problem, where)
    canonical, written = _nodes(line, nodes, instance)
    # The words of a source are keywords (DC, SIN); a word of a resistor or capacitor names a parameter.
    bare: Bare = "name" if letter in "RC" else "nothing"
    body = instance.scope.words(line, words.words[2:], bare)
    params = instance.scope.pairs(line, words, bare)
    return Statement(name, letter, canonical, written, None, body, *params, where)


def _nodes(line: Line, words: list[Lexeme], instance: _Instance) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Canonical and written names of nodes."""
    for word in words:
        if word.kind != "word":
            problem = f"{line.written(word)} stands where a node's name belongs"
            raise InputError(problem, line.where(word.position))
    pairs = [instance.node(word.text) for word in words]
    return tuple(pair[0] for pair in pairs), tuple(pair[1] for pair in pairs)


def _check_nodes(name: str, device: str, given: int, wanted: tuple[str, ...], where: Where) -> None:
    if given != len(wanted):
        plural = "" if len(wanted) == 1 else "s"
        nodes = f" ({' '.join(wanted)})" if wanted else ""
        raise InputError(f"{name}: {device} has {len(wanted)} node{plural}{nodes}, {given} given", where)


def _unknown_device(line: Line, words: list[Lexeme], instance: _Instance) -> str:
    """The message that the last word of an X line is not a device, with a hint."""
    last = line.written(words[-1])
    visible = instance.visible()
    known = {name.lower() for name in visible}
    for word in words[:-1]:
        # A device's name after two words or more is probably the device, and the words after it lack their `key=`.
        if word.text.lower() in known and word is not words[0] and words.index(word) >= 2:
            return f"{last} follows the device {word.text}: its parameters are written key=value"
    hint = nearest(words[-1].text, visible) or f"; devices are {' '.join(visible[:40])}"
    return f"'{words[-1].text}' is not a device or a .subckt{hint}"


def _unknown_element(lexemes: list[Lexeme]) -> str:
    """The message that a line with these words is not an element, with a hint."""
    name = lexemes[0].text
    if any(lexeme.text.upper() in layer_devices() for lexeme in lexemes[3:]):
        return f"'{name}': a device's name begins with X, as in X{name}"
    if f".{name.lower()}" in DIRECTIVES:
        return f"'{name}': a directive begins with a dot, as in .{name.lower()}"
    kind = _ELSEWHERE.get(name[0].upper())
    what = f"'{name}' is {kind}, which is not supported" if kind else f"'{name}' is no known element"
    return f"{what}; elements are R, C, V, I, and X with {', '.join(layer_devices())} or a .subckt"
