"""Output of a drive found by `inverse_drive`: as a page, a picture, a WAV file and tables."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside
from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import head_lines, heading
from fingerspice.plots import drawing
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture
    from fingerspice.studies.inverse import InverseDrive

_FULL = 2.0**31


def drive_page(found: InverseDrive) -> Page:
    """A sentence about the accuracy that the drive reaches, and a table of its figures."""
    d = found.to_dict()
    wave = "without a carrier" if found.carrier is None else f"on a carrier of {format_si(found.carrier, 'Hz')}"
    said = f"drive for a wanted {found.kind}, {wave}: {_verdict(found)}"
    rows = [
        ("peak of the drive", format_si(found.peak, "V")),
        ("samples", f"{found.drive.values.size:,} at {format_si(found.drive.rate, 'Hz')}"),
        (f"largest {found.kind} wanted", format_si(d["largest_wanted"], "N")),
        (f"largest {found.kind} reached", format_si(d["largest_reached"], "N")),
        ("worst miss", f"{format_si(found.worst, 'N')}, {100.0 * found.worst_share:.2g} %"),
        ("rms miss", f"{format_si(found.rms, 'N')}, {100.0 * found.rms_share:.2g} %"),
        ("time at a limit", f"{100.0 * found.at_limit:.3g} %"),
    ]
    if found.lead > 0.0:
        rows.append(("rise before it", format_si(found.lead, "s")))
    return Page([*head_lines(found.circuit), said, "", Table(("", ""), rows)])


def _verdict(found: InverseDrive) -> str:
    if found.at_limit == 0.0:
        return f"met to {100.0 * found.worst_share:.2g} % of its largest value"
    limits = [format_si(found.limit, "V")] if math.isfinite(found.limit) else []
    limits += [format_si(found.slew, "V/s")] if math.isfinite(found.slew) else []
    return (
        f"the limits ({', '.join(limits)}) cost {format_si(found.worst, 'N')} at worst, {format_si(found.rms, 'N')} rms"
    )


def plot_drive(found: InverseDrive) -> Picture:
    """Picture of the wanted and the reached quantity, their difference, and the drive, against time."""
    figure, (top, middle, bottom) = drawing.new_figure(3, height=5.2, sharex=True, height_ratios=(3, 1.4, 2))
    wanted: FloatArray = found.wanted
    reached: FloatArray = found.force
    if found.kind == "friction":
        wanted, reached = found.wanted_friction, found.friction
    end = float(found.drive.values.size - 1) / found.drive.rate
    scale, unit = drawing.engineering(end, "s")
    force, newton = drawing.engineering(float(wanted.max(initial=0.0)) or 1.0, "N")
    t = scale * found.times
    top.plot(*drawing.thin(t, force * wanted), color=drawing.BLACK, linewidth=2.2, label="wanted")
    top.plot(
        *drawing.thin(t, force * reached), color=drawing.ORANGE, linewidth=1.2, linestyle=(0, (4, 1.5)), label="reached"
    )
    drawing.dress(top, f"{found.kind.capitalize()} [{newton}]")
    drawing.legend_above(top, 2)
    small, milli = drawing.engineering(max(found.worst, 1e-12), "N")
    middle.plot(
        *drawing.thin(t, np.asarray(small * (reached - wanted), np.float64)), color=drawing.VERMILION, linewidth=1.0
    )
    drawing.dress(middle, f"Miss [{milli}]")
    at = scale * np.arange(found.drive.values.size) / found.drive.rate
    bottom.plot(*drawing.thin(np.asarray(at, np.float64), found.drive.values), color=drawing.BLUE, linewidth=0.9)
    if math.isfinite(found.limit):
        for level in {
            math.copysign(found.limit, side) for side in (found.drive.values.min(), found.drive.values.max())
        }:
            bottom.axhline(level, color=drawing.GREY, linewidth=0.9, linestyle="--")
    drawing.dress(bottom, "Drive [V]", f"Time [{unit}]")
    mean = "" if found.carrier is None else f" · means over periods of the carrier, {format_si(found.carrier, 'Hz')}"
    limit = "; dashed: limit" if math.isfinite(found.limit) else ""
    drawing.caption(figure, f"{heading(found.circuit)} · {_verdict(found)}{mean}{limit}")
    return figure


def drive_wav(found: InverseDrive, path: Path, gain: float | None) -> Path:
    """Write the drive as `InverseDrive.to_wav` describes."""
    from scipy.io import wavfile

    rate = found.drive.rate
    if abs(rate - round(rate)) > 1e-9 * rate or not 1.0 <= rate < 2**32:
        raise InputError(f"a WAV file has a whole number of samples a second, and the drive has {rate:g}; allowed: "
                         "rate= a whole number of Hz")  # fmt: skip
    full = (found.peak or 1.0) if gain is None else gain
    require(full >= found.peak, "gain", f"{full:g} V at full scale", f"the drive's peak, {found.peak:.6g} V, or more")
    data = np.clip(np.rint(_FULL / full * found.drive.values), -_FULL, _FULL - 1.0).astype("<i4")

    def write(target: Path) -> None:
        with target.open("wb") as stream:
            wavfile.write(stream, round(rate), data)

    return write_aside(path, write)
