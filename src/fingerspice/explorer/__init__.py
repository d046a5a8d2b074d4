"""The explorer's server: on the loopback address alone, for whoever has the token in its link."""

from __future__ import annotations

import base64
import hmac
import json
import re
import secrets
import struct
import threading
import webbrowser
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import fingerspice as fs
from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError, printable
from fingerspice.base.pages import in_notebook
from fingerspice.explorer import scene
from fingerspice.explorer.request import asked_by
from fingerspice.waveforms.waveform import require

ADDRESS = "127.0.0.1"
FRAME_HEIGHT, MOST_FRAMES = 900, 8  # Height (px) of the page in a notebook; explorers that one notebook keeps running
MOST_BYTES, SILENCE = 5_000_000, 30.0  # Bytes of a request; s of silence on a connection
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
#: Pages that may show the explorer within them, where a notebook has asked for it: those of this computer.
_NOTEBOOKS = " ".join(f"{kind}://{host}:*" for kind in ("http", "https") for host in (ADDRESS, "localhost"))
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors "
)
_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_FRAMES: deque[Explorer] = deque()  # Those that this notebook shows, oldest first: a cell run again starts another


def pages() -> dict[str, bytes]:
    """The files of the page by name."""
    files = Path(__file__).with_name("page").iterdir()
    return {file.name: file.read_bytes() for file in files if file.suffix[1:] in _TYPES}


class Explorer:
    """A running explorer: its address, and how it ends.

    Parameters
    ----------
    circuit : Circuit, optional
        What the page shows first; by default the first example.
    port : int
        0 takes a free one.
    asked : mapping, optional
        How the page runs the circuit first: keys and values as the fields of `request.Asked`.
    framed : bool
        Whether a notebook on this computer may show the page in a frame; a cell then shows this object as the page.

    Attributes
    ----------
    url : str
        The link to the page, token included. Whoever has it can run scenes on this computer, and nothing else.

    Raises
    ------
    InputError
        If the port is taken, or no port number.
    """

    def __init__(
        self, circuit: fs.Circuit | None = None, port: int = 0, *, asked: Mapping[str, Any] | None = None,
        framed: bool = False,
    ) -> None:  # fmt: skip
        require(0 <= port <= 65535, "port", port, "0 to 65535, where 0 takes a free one")
        self.token = secrets.token_urlsafe(24)
        self.circuit, self.asked, self.framed = circuit, dict(asked or {}), framed
        self.files = pages()
        self._one_at_a_time = threading.Lock()
        try:
            self._server = _Server((ADDRESS, port), type("Handler", (_Handler,), {"explorer": self}))
        except OSError as error:
            text = f"port {port} of {ADDRESS} cannot be used: {error.strerror}; allowed: a free port"
            raise InputError(text) from None
        self.port = int(self._server.server_address[1])
        self.url = f"http://{ADDRESS}:{self.port}/{self.token}/"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    def __repr__(self) -> str:
        return f"<Explorer at {self.url}>"

    def _repr_html_(self) -> str | None:
        if not self.framed:
            return None
        style = f"width: 100%; height: {FRAME_HEIGHT}px; border: 1px solid #CCCCCC;"
        shown = f'src="{self.url}" title="fingerspice explorer" style="{style}"'
        return f'<iframe {shown} allow="clipboard-write"></iframe>'

    def open(self) -> None:
        """Open the page in the browser."""
        webbrowser.open(self.url)

    def wait(self) -> None:
        """Return when the explorer is stopped, or this program interrupted (Ctrl-C)."""
        try:
            while self._thread.is_alive():
                self._thread.join(0.5)
        except KeyboardInterrupt:
            self.stop()

    def stop(self) -> None:
        """Close the server; a second call does nothing."""
        if not self._thread.is_alive():
            return
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def answers(self, what: str, given: Any) -> Iterator[bytes]:
        """The answer to what the page asks for, in the parts in which it is found, or why there is none."""
        try:
            # Python's filters of warnings belong to the whole process, and two runs at once would not be faster.
            with self._one_at_a_time:
                found = _ACTIONS[what](given, self.circuit)
            if isinstance(found, str):
                found = {"ok": True, "text": found}
            parts = iter([found]) if isinstance(found, dict) else found
            while True:
                with self._one_at_a_time:
                    part = next(parts, None)
                if part is None:
                    return
                yield framed(part)
        except (InputError, fs.SolveError) as error:
            yield framed({"ok": False, "message": str(error)})
        except Exception as error:
            text = printable(f"this is a fault of fingerspice, please report it ({type(error).__name__}: {error})")
            yield framed({"ok": False, "status": "FAULT", "message": text})


def explore(shown: fs.Circuit | fs.Solution | None = None, *, port: int = 0, browser: bool = True) -> Explorer:
    """Show a circuit, or a run's circuit, on a local page on which its values can be changed (docs/explore.md).

    The `Explorer` runs until its `stop` is called, or the program ends; `wait` lets a script wait for Ctrl-C. A
    notebook keeps the latest eight that it shows.

    Parameters
    ----------
    shown : Circuit or Solution, optional
        By default the first of the page's example scenes. A run's circuit begins with the run's charge law, area mode,
        error and number of periods, as far as the page has them.
    port : int
        Port of the loopback address; 0 takes a free one.
    browser : bool
        Whether the page is shown: in a notebook below the cell whose last line this is, and otherwise in the browser.

    Raises
    ------
    InputError
        If the port is taken, or no port number.
    """
    circuit, asked = (shown.circuit, asked_by(shown)) if isinstance(shown, fs.Solution) else (shown, {})
    framed = browser and in_notebook()
    explorer = Explorer(circuit, port, asked=asked, framed=framed)
    if framed:
        _FRAMES.append(explorer)
        while len(_FRAMES) > MOST_FRAMES:
            _FRAMES.popleft().stop()
    elif browser:
        explorer.open()
    return explorer


#: What the page asks for, and what answers, in one part or in several.
_ACTIONS: dict[str, Callable[[Any, fs.Circuit | None], Any]] = {
    "scene": scene.parts, "set": scene.applied, "means": scene.means, "deck": scene.as_deck,
    "python": scene.as_python,
}  # fmt: skip


def framed(data: Any) -> bytes:
    """Data as the JSON's length and the number of doubles (four bytes each), the JSON, and the doubles of all arrays.

    All numbers are little-endian. In the JSON an array is its place among the doubles, and its size. The doubles begin
    at a multiple of eight bytes, so that the page need not copy them.
    """
    arrays: list[bytes] = []
    places: dict[int, dict[str, list[int]]] = {}
    end = 0

    def place(x: FloatArray) -> dict[str, list[int]]:
        nonlocal end
        if id(x) not in places:
            arrays.append(np.ascontiguousarray(x, "<f8").tobytes())
            places[id(x)] = {"f64": [end, x.size]}
            end += x.size
        return places[id(x)]

    text = json.dumps(data, default=place)
    if "NaN" in text or "Infinity" in text:
        # Seldom, and all data have to be gone through: what is not finite is null.
        text = json.dumps(json.loads(text, parse_constant=lambda _: None))
    content = text.encode() + b" " * (-len(text) % 8)
    return b"".join([struct.pack("<II", len(content), end), content, *arrays])


#: What the page as one file may load.
_STATIC_POLICY = "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data: blob:"


def static_page(circuit: fs.Circuit | None = None) -> str:
    """The page as HTML that needs no other file, of a circuit's run or all example scenes; no slider moves on it."""
    files = {name: content.decode("utf-8") for name, content in pages().items()}
    start = scene.beginning(circuit)
    if circuit is not None:
        start["examples"] = []
    shown = [{"name": "own", **start["own"]}] if circuit is not None else start["examples"]
    scenes = {one["name"]: scene.scene({"last": 2, **one["request"]}, circuit) for one in shown}
    baked = base64.b64encode(framed({"start": start, "scenes": scenes})).decode("ascii")
    # Modules import each other by the names of the import map.
    bare = {
        name.removesuffix(".js"): re.sub(r'from "\./(\w+)\.js"', r'from "\1"', text)
        for name, text in files.items()
        if name.endswith(".js") and name != "uplot.js"
    }
    app = bare.pop("app")
    encoded = {name: base64.b64encode(text.encode()).decode("ascii") for name, text in bare.items()}
    imports = json.dumps({"imports": {name: f"data:text/javascript;base64,{text}" for name, text in encoded.items()}})
    parts = [
        f'<meta http-equiv="Content-Security-Policy" content="{_STATIC_POLICY}">',
        f"<style>{files['uplot.css']}\n{files['style.css']}</style>",
        f"<script>{files['uplot.js']}</script>",
        f'<script type="text/plain" id="baked">{baked}</script>',
        f'<script type="importmap">{imports}</script>',
        f'<script type="module">{app}</script>',
    ]
    replaced = ('<link rel="stylesheet"', "<script src", '<script type="module"')
    lines = files["index.html"].splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(replaced))
    return "\n".join([*lines[:first], *parts, *(x for x in lines[first:] if not x.startswith(replaced)), ""])


class _Server(ThreadingHTTPServer):
    """A server that says nothing about connections that break."""

    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that is closed breaks its connections: no error of ours."""


class _Refused(Exception):
    """A request that gets no answer but a status and a sentence, its arguments."""


class _Handler(BaseHTTPRequestHandler):
    """Answers to the requests of one explorer, which a subclass names."""

    explorer: ClassVar[Explorer]
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "fingerspice", ""
    timeout, disable_nagle_algorithm = SILENCE, True

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is logged: the token stands in every line."""

    def do_GET(self) -> None:
        self._answer(self._file)

    def do_POST(self) -> None:
        # Also of a request that is refused all is read, up to a limit, so that the browser takes the answer.
        length = self.headers.get("Content-Length", "")
        known = length.isascii() and length.isdigit() and "Transfer-Encoding" not in self.headers
        self._size = None if not known else int(length) if len(length) <= 12 else 10**12
        self._sent, left = b"", min(self._size or 0, 4 * MOST_BYTES)
        while left > 0 and (piece := self.rfile.read(min(left, MOST_BYTES))):
            self._sent, left = piece, left - len(piece)
        self._answer(self._run)

    def _answer(self, make: Callable[[str], tuple[str, Iterator[bytes]]]) -> None:
        """Send the kind and the parts of what is asked for, each part as soon as it is made."""
        status = HTTPStatus.OK
        try:
            kind, parts = make(self._allowed())
        except _Refused as error:
            self.close_connection = True
            status, text = error.args
            kind, parts = "application/json", iter([json.dumps({"ok": False, "message": text}).encode()])
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Transfer-Encoding", "chunked")
        self.send_header("Content-Security-Policy", _POLICY + (_NOTEBOOKS if self.explorer.framed else "'none'"))
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        for part in parts:
            self.wfile.write(b"%x\r\n%b\r\n" % (len(part), part))
        self.wfile.write(b"0\r\n\r\n")

    def _allowed(self) -> str:
        """What is asked for, of a request that may ask."""
        hosts = (f"{ADDRESS}:{self.explorer.port}", f"localhost:{self.explorer.port}")
        if self.headers.get("Host") not in hosts:
            raise _Refused(HTTPStatus.FORBIDDEN, f"the host is not {hosts[0]}")
        token, _, what = self.path.lstrip("/").partition("?")[0].partition("/")
        # A notebook's page is another site; it may load this one into a frame, and nothing else.
        frame = self.command == "GET" and what == "" and self.headers.get("Sec-Fetch-Dest") == "iframe"
        own = self.headers.get("Sec-Fetch-Site", "same-origin") in ("same-origin", "none")
        mine = self.headers.get("Origin") in (None, *(f"http://{host}" for host in hosts))
        if not mine or not (own or (frame and self.explorer.framed)):
            raise _Refused(HTTPStatus.FORBIDDEN, "another page may not ask")
        if not hmac.compare_digest(token.encode(), self.explorer.token.encode()):
            raise _Refused(HTTPStatus.FORBIDDEN, "the link's token is missing or wrong; open the link that was printed")
        return what

    def _file(self, what: str) -> tuple[str, Iterator[bytes]]:
        if what == "start":
            start = json.dumps(scene.beginning(self.explorer.circuit, self.explorer.asked))
            return "application/json", iter([start.encode()])
        name = what or "index.html"
        if name not in self.explorer.files:
            raise _Refused(HTTPStatus.NOT_FOUND, "there is no such file")
        return _TYPES[name.rpartition(".")[2]], iter([self.explorer.files[name]])

    def _run(self, what: str) -> tuple[str, Iterator[bytes]]:
        if what not in _ACTIONS:
            raise _Refused(HTTPStatus.NOT_FOUND, f"nothing of that name; allowed: {', '.join(_ACTIONS)}")
        if self._size is None:
            raise _Refused(HTTPStatus.LENGTH_REQUIRED, "the request has no length")
        if self._size > MOST_BYTES:
            text = f"the request has {self._size} bytes; allowed: at most {MOST_BYTES:,}"
            raise _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, text)
        try:
            given = json.loads(self._sent)
        except (ValueError, RecursionError):
            raise _Refused(HTTPStatus.BAD_REQUEST, "the request is not JSON") from None
        return "application/octet-stream", self.explorer.answers(what, given)
