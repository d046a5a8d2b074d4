"""Makes texture.wav: half a second of a finger on a grating, 16 bits at 16 kHz.

The grooves pass 60 times a second (1.5 mm apart at 90 mm/s), each a short double flank, and the land between them is
rough: 300 tones from 40 to 900 Hz whose amplitude falls with frequency. Nothing is random, so that the file is the same
wherever it is made: python circuits/texture.py
"""

from __future__ import annotations

import wave
from pathlib import Path

import numpy as np

RATE, SECONDS, GROOVES = 16_000, 0.5, 60.0


def texture() -> np.ndarray:
    """The recording in integers of 16 bits, shape (8000,)."""
    t = np.arange(round(RATE * SECONDS)) / RATE
    since = (t * GROOVES + 0.5) % 1.0 - 0.5
    flanks = -since * np.exp(-((since / 0.06) ** 2))
    k = np.arange(300)[:, None]
    f = 40.0 * (900.0 / 40.0) ** (k / 299.0)
    # Multiples of the golden ratio spread the phases evenly.
    rough = np.sum(f**-0.5 * np.sin(2.0 * np.pi * (f * t + 0.6180339887498949 * k * k % 1.0)), axis=0)
    whole = flanks / np.abs(flanks).max() + 0.6 * rough / np.abs(rough).max()
    # It fades in and out, so that its ends are no jumps.
    fade = np.clip(np.minimum(t, t[-1] - t) / 0.01, 0.0, 1.0)
    whole *= fade * fade * (3.0 - 2.0 * fade)
    return np.asarray(np.round(32_767 * whole / np.abs(whole).max()), "<i2")


def main() -> None:
    with wave.open(str(Path(__file__).with_name("texture.wav")), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(RATE)
        file.writeframes(texture().tobytes())


if __name__ == "__main__":
    main()
