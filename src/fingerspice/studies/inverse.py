"""The drive that makes a wanted force or friction."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_aside
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.circuit.arguments import require_circuit, require_number
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.network import Network
from fingerspice.circuit.statespace import Stack
from fingerspice.physics.contact import Contact
from fingerspice.results.record import sealed
from fingerspice.results.solution import Solution
from fingerspice.studies.inversion import gap_voltage, network_drive, run_with, stack_drive
from fingerspice.waveforms.ramps import Samples
from fingerspice.waveforms.waveform import Waveform, as_waveform, require

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture

#: Samples of the drive for a period of a carrier, at least.
PER_CARRIER = 64
# Share of the peak of the force, missed without a limit, from which on there is a warning.
_NOTABLE = 0.01


@dataclass(frozen=True, repr=False)
class InverseDrive(Shown):
    """A drive, the force that was wanted of it, and the one that it makes in a run of `simulate`.

    With a carrier, forces are means around each sample (half of the carrier's period, twice: a single mean would keep a
    ripple where the force rises or falls), and half a period at either end of the run is NaN.

    Attributes
    ----------
    drive : Samples
        Voltage of the source, V; the run starts uncharged.
    source : str
        Name of the source.
    t : ndarray, shape (n,)
        Times of the samples, s.
    wanted, reached : ndarray, shape (n,)
        Electroadhesive force, N.
    limited : ndarray of bool, shape (n,)
        Where the limit of voltage or slope decides the drive.
    carrier : float or None
        Hz.
    contact : Contact
        Of the finger.
    solution : Solution
        The run with this drive.
    """

    drive: Samples
    source: str
    t: FloatArray
    wanted: FloatArray
    reached: FloatArray
    limited: BoolArray
    carrier: float | None
    contact: Contact = field(repr=False)
    solution: Solution = field(repr=False)

    def __post_init__(self) -> None:
        for x in (self.t, self.wanted, self.reached):
            sealed(x)

    @property
    def missed(self) -> float:
        """Largest difference between wanted and reached force, N."""
        return float(np.nanmax(np.abs(self.reached - self.wanted)))

    @property
    def missed_rms(self) -> float:
        """Root mean square of the difference between wanted and reached force, N."""
        return float(np.sqrt(np.nanmean((self.reached - self.wanted) ** 2)))

    @property
    def missed_share(self) -> float:
        """`missed` over the largest force wanted."""
        return self.missed / (float(np.nanmax(self.wanted)) or 1.0)

    @property
    def limited_share(self) -> float:
        """Share of the time in which a limit decides the drive."""
        return float(np.mean(self.limited))

    def friction(self, force: FloatArray) -> FloatArray:
        """Friction force (Eq. 1) that belongs to an electroadhesive force, N."""
        return self.contact.mu * (self.contact.f_n + force)

    def to_dict(self) -> dict[str, Any]:
        """The keys of ``--json``."""
        return {
            "source": self.source, "carrier": self.carrier, "rate": self.drive.rate, "samples": int(self.t.size),
            "peak": float(np.abs(self.drive.values).max()), "wanted_max": float(np.nanmax(self.wanted)),
            "missed": self.missed, "missed_rms": self.missed_rms, "missed_share": self.missed_share,
            "limited_share": self.limited_share,
        }  # fmt: skip

    def _page(self) -> Page:
        found, with_carrier = self.to_dict(), "" if self.carrier is None else f" on a carrier of {self.carrier:g} Hz"
        rows = [
            ("largest force wanted", f"{found['wanted_max']:.4g} N"),
            ("largest drive", f"{found['peak']:.4g} V"),
            ("wanted and reached differ by at most", f"{self.missed:.3g} N ({100.0 * self.missed_share:.2g} %)"),
            ("root mean square of that", f"{self.missed_rms:.3g} N"),
            ("decided by a limit", f"{100.0 * self.limited_share:.3g} % of the time"),
        ]
        head = f"drive of {self.source}: {self.t.size} samples at {self.drive.rate:g} Hz{with_carrier}"
        return Page([head, "", Table(("", "value"), rows)])

    def plot(self) -> Picture:
        """Drive, and wanted and reached friction over time."""
        from fingerspice.plots.inverse import plot_inverse

        return plot_inverse(self)

    def to_csv(self, path: str | Path) -> Path:
        """Write time (s), drive (V), and wanted and reached friction (N) as columns with a header."""
        columns = [self.t, self.drive.values, self.friction(self.wanted), self.friction(self.reached)]

        def write(aside: Path) -> None:
            head = "time (s),drive (V),friction wanted (N),friction reached (N)"
            np.savetxt(aside, np.column_stack(columns), fmt="%.12g", delimiter=",", header=head, comments="")

        return write_aside(Path(path), write)

    def to_wav(self, path: str | Path) -> float:
        """Write the drive as a WAV file of floats between -1 and 1; returns its gain, V at full scale.

        The rate of such a file is a whole number.

        Raises
        ------
        InputError
            For another rate.
        """
        from scipy.io import wavfile

        rate = round(self.drive.rate)
        require(abs(rate - self.drive.rate) <= 1e-9 * rate, "the rate", f"{self.drive.rate:g} Hz", "a whole number")
        gain = float(np.abs(self.drive.values).max()) or 1.0
        values = (self.drive.values / gain).astype(np.float32)
        write_aside(Path(path), lambda aside: wavfile.write(aside, rate, values))
        return gain


def inverse_drive(
    circuit: Circuit,
    *,
    force: ArrayLike | Waveform | Callable[[float], float] | None = None,
    friction: ArrayLike | Waveform | Callable[[float], float] | None = None,
    rate: float | None = None,
    t_stop: float | None = None,
    carrier: float | None = None,
    limit: float | None = None,
    slew: float | None = None,
    charge_law: str | None = None,
    rtol: float = 1e-6,
) -> InverseDrive:
    """The voltage of a circuit's source that makes a wanted force or friction, from an uncharged start.

    In a series stack the gap voltage that has the force is prescribed, and what the other layers add to it follows:
    there is no search. For any other circuit with one finger and one source the drive is corrected by the linear
    response from source to gap until a run has the force.

    Parameters
    ----------
    circuit : Circuit
    force, friction : array_like, Samples, or waveform
        One of the two: electroadhesive force, or friction force (Eq. 1), N. An array has its `rate`; between its values
        are straight lines. A waveform or function of time (s) gives N in place of V, and needs `rate` and `t_stop`.
    rate : float, optional
        Samples of the drive per second, and values of an array. With a carrier the drive has 64 samples or more per
        period of it, and `rate` is that of the array alone.
    t_stop : float, optional
        End, s; by default that of the array.
    carrier : float, optional
        Hz; the force is then the mean over a period of the carrier, whose amplitude is modulated. Without a carrier the
        gap voltage is never negative.
    limit, slew : float, optional
        Largest size (V) and slope (V/s) of the drive. Where they do not allow what is wanted, the drive is as near to
        it as they let it be, and follows again as soon as it can.
    charge_law, rtol
        As in `simulate`.

    Returns
    -------
    InverseDrive

    Raises
    ------
    InputError
        For a force that no voltage reaches, and for circuits with several fingers or sources, or with an area that does
        not follow the gap's voltage at once.
    SolveError
        Where the run with the drive fails.

    Warns
    -----
    FingerspiceWarning
        Where the force is missed by more than 1 % of its peak without any limit.
    """
    require_circuit(circuit)
    for what, value, unit in (("rate", rate, "Hz"), ("t_stop", t_stop, "s"), ("carrier", carrier, "Hz"),
                              ("limit", limit, "V"), ("slew", slew, "V/s")):  # fmt: skip
        if value is not None:
            require_number(what, value, f"a number in {unit}")
            require(0.0 < value < math.inf, what, f"{value:g} {unit}", f"more than 0 {unit}")
    network = network_of(circuit)
    contact, name = _finger(network), network.sources[0].name if network.stack is None else _only_source(network.stack)
    given, is_force = _given(force, friction)
    wave, wanted_rate, stop = _as_wave(given, rate, t_stop)
    own_rate = _drive_rate(wanted_rate, carrier)
    count = math.floor(stop * own_rate * (1.0 + 1e-12)) + 1
    require(count >= 3, "t_stop", f"{stop:g} s", f"at least three samples at {own_rate:g} Hz")
    t = np.arange(2 * count - 1) / (2.0 * own_rate)
    wanted = wave.value(t) if is_force else wave.value(t) / contact.mu - contact.f_n
    u = gap_voltage(contact, wanted, carrier, t, is_force)
    law = charge_law or circuit.charge_law or "local"
    bounds = limit or math.inf, slew or math.inf
    if network.stack is not None:
        values, limited = stack_drive(network.stack, contact, law, u, own_rate, bounds)
        solution = run_with(circuit, name, values, own_rate, law, rtol)
    else:
        values, limited, solution = network_drive(circuit, network, name, u[::2], own_rate, law, rtol, bounds)
    reached = _mean(np.asarray(solution.f_el), own_rate, carrier)
    found = InverseDrive(
        Samples(values, own_rate), name, t[::2], _mean(wanted[::2], own_rate, carrier), reached, limited, carrier,
        contact, solution,
    )  # fmt: skip
    if found.missed_share > _NOTABLE and not limited.any():
        text = (
            f"the drive misses the wanted force by {100.0 * found.missed_share:.2g} % of its peak: this circuit "
            "does not pass to the gap what is as slow, or as sudden; carrier= may help, or a force that rises from 0"
        )
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    return found


def _finger(network: Network) -> Contact:
    """The contact of a circuit's only finger."""
    contacts = [c for c in network.contacts if c is not None]
    if len(contacts) != 1 or len(network.areas) != 1 or network.areas[0].given is not None:
        raise InputError(f"an inverse drive needs one GAP whose area follows its voltage, and this circuit has "
                         f"{len(contacts)} GAPs and {len(network.areas)} areas")  # fmt: skip
    if len(network.sources) != 1:
        names = ", ".join(e.name for e in network.sources)
        raise InputError(f"an inverse drive needs one source, and this circuit has {names}")
    return contacts[0]


def _only_source(stack: Stack) -> str:
    names = [e.name for e, _ in stack.sources]
    if len(names) != 1:
        raise InputError(f"an inverse drive needs one source, and this circuit has {', '.join(names)}")
    return names[0]


def _given(force: Any, friction: Any) -> tuple[Any, bool]:
    """What is wanted, and whether it is a force."""
    if (force is None) == (friction is None):
        raise InputError("an inverse drive is for one of force= and friction=, N; given are "
                         f"{'none' if force is None else 'both'}")  # fmt: skip
    return (force, True) if friction is None else (friction, False)


def _as_wave(given: Any, rate: float | None, t_stop: float | None) -> tuple[Waveform, float, float]:
    """What is wanted as a waveform, with its rate (Hz) and its end (s)."""
    if isinstance(given, Samples):
        return given, given.rate, t_stop or given.start + (given.values.size - 1) / given.rate
    if isinstance(given, Waveform) or callable(given):
        if rate is None or t_stop is None:
            raise InputError("a wanted force given as a waveform needs rate= (Hz) and t_stop= (s)")
        return as_waveform(given), rate, t_stop
    if rate is None:
        raise InputError("a wanted force given as an array needs rate=, its values per second")
    try:
        values = np.asarray(given, float)
    except (TypeError, ValueError):
        raise InputError(f"a wanted force is {given!r}; allowed: numbers in N") from None
    wave = Samples(values, rate)
    return wave, rate, t_stop or (values.size - 1) / rate


def _drive_rate(rate: float, carrier: float | None) -> float:
    """Samples of the drive per second."""
    if carrier is None:
        return rate
    return carrier * max(PER_CARRIER, 4 * math.ceil(0.25 * rate / carrier))


def _mean(force: FloatArray, rate: float, carrier: float | None) -> FloatArray:
    """A force, or its mean around each sample: over half of the carrier's period, which is the force's, and again."""
    if carrier is None:
        return force
    half, out = round(0.25 * rate / carrier), force
    for _ in range(2):
        total = np.concatenate([[0.0], np.cumsum(0.5 * (out[1:] + out[:-1]))])
        out = (total[2 * half :] - total[: total.size - 2 * half]) / (2.0 * half)
    ends = np.full(2 * half, np.nan)
    return np.concatenate([ends, out, ends])
