"""Recordings and tables from files: reading by decks, the command line and Python, and refused files."""

import itertools
import os
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile

import fingerspice as fs
from commands import QUICK, Command
from deck_edits import edited
from fingerspice.netlist import reader
from fingerspice.waveforms import files
from scenes import listed, refuses, table1_deck

GUID = bytes.fromhex("800000aa00389b71")


def chunk(name: bytes, data: bytes, order: str = "<", size: int | None = None, pad: bool = True) -> bytes:
    """A chunk of a WAV file, also with another size than its own."""
    length = struct.pack(f"{order}I", len(data) if size is None else size)
    return name + length + data + (b"\0" if pad and len(data) % 2 else b"")


def wav(
    data: bytes, bits: int = 16, *, kind: int = 1, channels: int = 1, rate: int = 8000, extensible: bool = False,
    head: bytes = b"RIFF", size: int | None = None, long: int | None = None, whole: int | None = None,
    before: bytes = b"", after: bytes = b"", pace: int | None = None,
) -> bytes:  # fmt: skip
    """A WAV file written from its specification, whose header may lie: `kind` is 1 for integers and 3 for floats.

    `size` and `long` are the sizes of its samples in their chunk and in RF64's header, `whole` that of the file, and
    `pace` the bytes a second.
    """
    order, block = ">" if head == b"RIFX" else "<", channels * bits // 8
    form = struct.pack(
        f"{order}HHIIHH", 0xFFFE if extensible else kind, channels, rate, rate * block if pace is None else pace, block,
        bits,
    )  # fmt: skip
    if extensible:
        form += struct.pack(f"{order}HHIIHH", 22, bits, 0, kind, 0, 16) + GUID
    body = before + chunk(b"fmt ", form, order) + chunk(b"data", data, order, size) + after
    if head == b"RF64":
        sizes = struct.pack("<QQQI", len(body) + 40, len(data) if long is None else long, len(data) // block, 0)
        body = chunk(b"ds64", sizes) + body
    return head + struct.pack(f"{order}I", len(body) + 4 if whole is None else whole) + b"WAVE" + body


def pieced(kind: str, count: int = 12, channels: int = 1, *, head: bytes = b"RIFF", **header: Any) -> bytes:
    """A WAV file of random samples, such as of ``i3``."""
    width = int(kind[1])
    random = np.random.default_rng(width)
    if kind[0] == "f":
        data = random.normal(size=count * channels).astype(f"{'>' if head == b'RIFX' else '<'}{kind}").tobytes()
    else:
        data = random.bytes(count * channels * width)
    return wav(data, 8 * width, kind=3 if kind[0] == "f" else 1, channels=channels, head=head, **header)


def packed(values: np.ndarray, width: int = 2) -> bytes:
    """Integers as little-endian samples of so many bytes; those of one byte have 128 added."""
    if width == 1:
        return bytes((values + 128).astype(np.uint8))
    return b"".join(int(v).to_bytes(width, "little", signed=True) for v in values)


def read_both_ways(path: Path, channel: int | None = None) -> tuple[object, object]:
    """What a file gives read at once and read piece by piece: its values and rate, or the refusal."""

    def one(at_once: bool) -> object:
        try:
            wave = fs.Samples.from_wav(path, 150.0, channel, at_once=at_once)
            return wave.values.tobytes(), wave.rate
        except fs.InputError as error:
            return str(error)

    return one(True), one(False)


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# WAV ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_integers_are_scaled_by_their_type_exactly(width: int, tmp_path: Path) -> None:
    full = 2 ** (8 * width - 1)
    whole = np.array([-full, full - 1, 0, 1, -1, full // 2, -full // 3])
    (tmp_path / "a.wav").write_bytes(wav(packed(whole, width), 8 * width, rate=44100))
    wave = fs.Samples.from_wav(str(tmp_path / "a.wav"), 150.0)
    np.testing.assert_array_equal(wave.values, 150.0 * (whole / full))
    assert (wave.rate, wave.start) == (44100.0, 0.0)


@pytest.mark.parametrize("extensible", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("head", [b"RIFF", b"RIFX", b"RF64"])
def test_whole_files_are_read_as_scipy_reads_them(head: bytes, channels: int, extensible: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.wav"
    size = 0xFFFFFFFF if head == b"RF64" else None
    for kind in ("u1", "i2", "i3", "i4", "i5", "i8", "f4", "f8"):
        path.write_bytes(pieced(kind, 13, channels, head=head, size=size, extensible=extensible))
        rate, data = wavfile.read(path)
        full = 2.0 ** (8 * data.dtype.itemsize - 1)
        for channel in range(channels):
            expected = data.reshape(13, channels)[:, channel].astype(float)
            if kind[0] != "f":
                expected = (expected - 128.0 * (kind == "u1")) / full
            for found in read_both_ways(path, channel):
                assert found == ((150.0 * expected).tobytes(), float(rate)), kind


MONO, STEREO = wav(packed(np.arange(40))), wav(packed(np.arange(40)), channels=2)
BAD_WAV: list[tuple[bytes, str]] = [
    (b"", "'a.wav' is empty"),
    (b"RIF", "'a.wav' is no WAV file; allowed: WAV (convert it), or a table by TABLE"),
    (b"ID3\x04" + bytes(99), "'a.wav' is no WAV file, it begins as MP3 does; allowed: WAV (convert it)"),
    (b"\xff\xfb\x90" + bytes(99), "it begins as MP3 does"),
    (b"OggS" + bytes(99), "it begins as Ogg does"),
    (b"time,u\n0,1\n", "'a.wav' is no WAV file; allowed"),
    (MONO[:30], "'a.wav' is broken or cut short"),
    (MONO[:40], "'a.wav' is broken or cut short"),
    (MONO[:-1], "cut short"),
    (MONO[:-20], "'a.wav' is cut short: it ends before the samples that its header promises"),
    (STEREO[:-3], "cut short"),
    (STEREO, "'a.wav' has 2 channels and none is chosen; allowed: channel=0 to 1"),
    (MONO[:22] + b"\0\0" + MONO[24:], "'a.wav' is broken"),
    (wav(bytes(8), rate=0), "'a.wav' is broken: its header gives a rate of 0 Hz"),
    (wav(b""), "'a.wav' holds no samples"),
    (wav(bytes(9), 8, kind=6), "'a.wav' holds samples as ALAW; allowed: PCM or float (convert it)"),
    (
        wav(np.array([0, np.nan], "<f4").tobytes(), 32, kind=3),
        "'a.wav': sample number 1 is nan; allowed: finite numbers",
    ),
    (wav(b"\0\0"), "samples is shape (1,); allowed: one row of two or more"),
    (pieced("i2", after=chunk(b"data", bytes(24))), "holds two 'data' chunks; allowed: one"),
    (pieced("i2", size=60, whole=36 + 24), "is cut short: it ends before the samples that its header promises"),
    (pieced("i2", size=23), "cut short or broken: 23 bytes are no whole number of samples of 2"),
    (pieced("i2", pace=999), "is broken: its header says that 1 channels of 16 bits take 2 bytes, at 8000 Hz 999"),
    (pieced("i2", head=b"RF64", size=0xFFFFFFFF, long=2**40), "is cut short"),
    (pieced("i2", head=b"RF64", size=24, long=20), "is broken: its header gives 24 and 20 bytes of samples"),
    (wav(bytes(8), extensible=True).replace(GUID, bytes(8)), "holds samples as 0xfffe; allowed: PCM or float"),
]


@pytest.mark.parametrize(("data", "said"), BAD_WAV, ids=range(len(BAD_WAV)))
def test_what_is_no_whole_recording_is_refused(data: bytes, said: str, in_folder: None) -> None:
    Path("a.wav").write_bytes(data)
    for found in read_both_ways(Path("a.wav")):
        assert isinstance(found, str)
        assert "\n" not in found
        assert said in found


def test_a_malformed_file_gives_the_same_values_or_the_same_refusal_at_once_and_in_pieces(tmp_path: Path) -> None:
    path, told = tmp_path / "a.wav", {"values": 0, "refused": 0}
    odd, second = chunk(b"LIST", b"INFOx"), chunk(b"data", bytes(24))
    around = [
        (b"", b""), (odd, b""), (b"", odd), (b"", second), (second, b""), (b"", b"TAG of a player"),
        (chunk(b"LIST", b"INFOx", pad=False), b""), (chunk(b"fmt ", bytes(16)), b""), (b"", chunk(b"fmt ", bytes(16))),
        (b"", chunk(b"LIST", b"", size=2**31)), (chunk(b"ds64", struct.pack("<QQQI", 99, 8, 4, 0)), b""),
    ]  # fmt: skip
    files = [
        pieced(kind, channels=channels, head=head, size=size, long=long, whole=whole, before=before, after=after)
        for kind, channels in (("i2", 2), ("f4", 1))
        for head in (b"RIFF", b"RIFX", b"RF64")
        for size, whole in itertools.product([None, 0, 5, 60, 0xFFFFFFFF], (None, 20))
        for long in ((None, 2**64 - 1) if head == b"RF64" else (None,))
        for before, after in around
    ]
    sound = pieced("i3", extensible=True, before=odd)
    files += [sound[:length] for length in range(1, len(sound))]
    files += [sound[:at] + bytes([value]) + sound[at + 1 :] for at in range(80) for value in (0, 255)]
    for data in files:
        path.write_bytes(data)
        whole_file, in_pieces = read_both_ways(path, 0)
        assert whole_file == in_pieces, data
        told["refused" if isinstance(whole_file, str) else "values"] += 1
    assert min(told.values()) > 100


@pytest.mark.parametrize("size", [0xFFFFFFFF, 0x7FFFF000])
@pytest.mark.parametrize("kind", ["i2", "i3", "f8"])
def test_a_stream_whose_header_does_not_know_its_end_is_read_to_the_end_of_the_file(kind, size, tmp_path):
    sound, live = tmp_path / "sound.wav", tmp_path / "live.wav"
    sound.write_bytes(pieced(kind))
    live.write_bytes(pieced(kind, size=size, whole=0xFFFFFFFF))
    assert read_both_ways(live) == read_both_ways(sound)
    assert not isinstance(read_both_ways(live)[0], str)
    # The recorder was killed within a sample.
    live.write_bytes(live.read_bytes()[:-1])
    assert "cut short or broken" in str(read_both_ways(live)[0])


@pytest.mark.parametrize("at_once", [True, False])
def test_channels_and_gains_that_cannot_be_are_refused(at_once: bool, in_folder: None) -> None:
    Path("a.wav").write_bytes(STEREO)
    Path("b.wav").write_bytes(MONO)
    for name, gain, channel, said in (
        ("a.wav", 1.0, 2, "'a.wav' has no channel 2; allowed: channel=0 to 1"),
        ("b.wav", 1.0, 1, "'b.wav' has no channel 1; allowed: channel=0, its only one"),
        ("a.wav", 1.0, "left", "'a.wav' has no channel 'left'; allowed: channel=0 to 1"),
        ("b.wav", float("nan"), None, "gain is nan; allowed: a finite number of V at full scale"),
        ("a.wav", "150", 0, "gain is '150'; allowed: a finite number of V at full scale"),
    ):
        assert refuses("", fs.Samples.from_wav, name, gain, channel, at_once=at_once) == said
    # A gain beyond the range is refused by the samples that it makes too large.
    Path("c.wav").write_bytes(wav(packed(np.full(9, 2**14))))
    said = refuses("", fs.Samples.from_wav, "c.wav", 3e12, at_once=at_once)
    assert said == "'c.wav': a sample is 1.5e+12 V; allowed: a size up to 1e+12"
    Path("c.wav").write_bytes(wav(bytes(18)))
    assert fs.Samples.from_wav("c.wav", 3e12, at_once=at_once).peak(0.0, 1.0) == 0.0


def test_files_beyond_the_limits_are_refused_unread(in_folder: None, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in (("a.wav", 5 * 10**9), ("a.csv", 10**8)):
        with Path(name).open("wb") as file:
            file.truncate(size)
    said = "'a.wav' has 4,768 MiB; allowed: at most 1,024 MiB"
    assert refuses("", fs.Samples.from_wav, "a.wav", 1.0) == refuses("", fs.PWL.from_table, "a.wav") == said
    assert refuses("", fs.PWL.from_table, "a.csv") == "'a.csv' has 95 MiB; allowed: at most 64 MiB"
    monkeypatch.setattr(files, "MAX_SAMPLES", 30)
    Path("b.wav").write_bytes(MONO)
    assert refuses("", fs.Samples.from_wav, "b.wav", 1.0) == "'b.wav' has 40 samples; allowed: at most 30"
    assert "640 samples; allowed: at most 30" in refuses("", fs.Samples(np.arange(40), 1.0).upsampled)
    Path("c.csv").write_text("".join(f"{i} 0\n" for i in range(40)))
    assert refuses("", fs.PWL.from_table, "c.csv") == "'c.csv' has 40 samples; allowed: at most 30"
    np.savez_compressed("d.npz", t=np.zeros(400))
    assert "unpacks to" in refuses("", fs.PWL.from_table, "d.npz")


def test_what_is_no_file_is_refused(in_folder: None) -> None:
    Path("folder").mkdir()
    os.mkfifo("pipe")
    assert refuses("", fs.Samples.from_wav, "folder", 1.0) == "'folder' is a folder, not a file"
    assert refuses("", fs.Samples.from_wav, "no.wav", 1.0) == "'no.wav' does not exist"
    assert refuses("", fs.PWL.from_table, "a\0b") == "'a\\x00b' does not exist"
    assert refuses("", fs.PWL.from_table, "pipe") == "'pipe' is not an ordinary file"


# Tables -------------------------------------------------------------------------------------------------------


TABLES: dict[str, str] = dict(listed("two_columns"))


@pytest.mark.parametrize("text", TABLES.values(), ids=TABLES.keys())
def test_a_table_of_two_columns_is_read_without_more_words(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    wave = fs.PWL.from_table(tmp_path / "a.csv")
    np.testing.assert_allclose(wave.times, [0.0, 0.001, 0.003], rtol=1e-15)
    np.testing.assert_allclose(wave.values, [1.0, -2.5, 4.0], rtol=1e-15)


def test_columns_are_chosen_by_name_or_number(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("index,t (ms),left (V),Right (V)\n0,0,1,2\n1,2,3,4\n")
    for time, value in (("t", "Right"), ("T", "right"), (1, 3), (None, "Right")):
        assert fs.PWL.from_table(path, time, value) == fs.PWL((0.0, 0.002), (2.0, 4.0))  # type: ignore[arg-type]
    wave = fs.Samples.from_table(path, 500.0, "left")
    np.testing.assert_array_equal(wave.values, [1.0, 3.0])
    assert wave.rate == 500.0
    path.write_text("1\n3\n-2\n")
    np.testing.assert_array_equal(fs.Samples.from_table(path, 500.0).values, [1.0, 3.0, -2.0])


def test_arrays_of_numpy_are_columns(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, u=np.array([1, 3, -2]), time=np.array([0.0, 0.5, 1.0]))
    assert fs.PWL.from_table(path) == fs.PWL((0.0, 0.5, 1.0), (1.0, 3.0, -2.0))
    np.savez_compressed(path, u=np.array([1.0, 3.0, -2.0]), rate=48000)
    wave = fs.Samples.from_table(path)
    np.testing.assert_array_equal(wave.values, [1.0, 3.0, -2.0])
    assert wave.rate == 48000.0
    # Times that agree with the rate say no more than it does.
    np.savez(path, u=np.array([1.0, 3.0, -2.0]), t=np.arange(3) / 48000, rate=48000)
    assert fs.Samples.from_table(path).rate == 48000.0
    assert "is a table with a rate; allowed: one with times" in refuses("", fs.PWL.from_table, path)


MICRO = "t (\xb5s),drive (V)\n0,0\n1000,10\n2000,20\n3000,0\n".encode("latin-1")


@pytest.mark.parametrize(
    ("data", "columns"),
    [
        (b"; captured, dt = 1m\n* 4 points\n0 0\n1m 10 ; peak soon\n2m 20\n3m 0\n", ()),
        (b"time\tV(n001)\n0.0e+000\t0.0e+000\n1.0e-003\t1.0e+001\n2.0e-003\t2.0e+001\n3.0e-003\t0.0e+000\n", ()),
        (b"time\tV(a,b)\tI(R1)\n0\t0\t5\n1m\t10\t5\n2m\t20\t5\n3m\t0\t5\n", ("time", "V(a,b)")),
        (b"time\tV(a)\nStep Information: R=1k  (Run: 1/1)\n0\t0\n1e-3\t10\n2e-3\t20\n3e-3\t0\n", ()),
        (MICRO, ()),
        (b"n,time_s,u,i,on\n1,0,0,nan,no\n1,1e-3,10,inf,\n1,2e-3,20,1,yes\n1,3e-3,0,2k7,1\n", ("time_s", "u")),
    ],
    ids=["comments", "LTspice", "LTspice's choice", "one step", "Latin-1", "cells nobody asked for"],
)
def test_tables_of_other_programs_are_read(data: bytes, columns: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(data)
    assert fs.PWL.from_table(tmp_path / "a.txt", *columns) == fs.PWL((0.0, 1e-3, 2e-3, 3e-3), (0.0, 10.0, 20.0, 0.0))


@pytest.mark.parametrize(
    "text", ["0 0 1m 10 2m 20 3m 0", "0, 0, 1m, 10, 2m, 20, 3m, 0\n", "0\n0\n1m\n10\n2m\n20\n3m\n0\n"]
)
def test_a_file_of_a_pwl_alternates_times_and_values(text: str, folder: Path) -> None:
    points = fs.PWL((0.0, 1e-3, 2e-3, 3e-3), (0.0, 10.0, 20.0, 0.0))
    Path("decks/line.txt").write_text(text)
    same(source("PWL FILE=line.txt"), points)
    assert fs.PWL.from_table("decks/line.txt", pairs=True) == points
    Path("decks/line.txt").write_text(text.replace("10", "", 1).replace("\n\n", "\n").replace(" , ", " "))
    said = "'decks/line.txt' holds 7 numbers; allowed: pairs of time and value"
    assert said in refuses("", source, "PWL FILE=line.txt")
    Path("decks/line.txt").write_text(text.replace("2m", "0.5m"))
    assert "the time 0.0005 s follows 0.001 s" in refuses("", source, "PWL FILE=line.txt")


@pytest.mark.parametrize(("text", "given", "said"), listed("tables"), ids=[said for *_, said in listed("tables")])
def test_what_is_no_table_is_refused_with_its_line(text, given, said, in_folder):
    Path("a.csv").write_text(text)
    assert said in refuses("", fs.PWL.from_table, "a.csv", **given)


def test_rates_that_contradict_the_times_are_refused(in_folder: None) -> None:
    Path("a.csv").write_text("t,u\n0,1\n0.001,2\n0.0025,2\n")
    np.savez("a.npz", u=np.zeros(30), t=np.arange(30) / 44100, rate=48000)
    late = "'a.csv', line 4: the time 0.0025 s is not that of sample 2 at 1000 Hz, 0.002 s; allowed: times or a rate"
    for name, rate, value, said in (
        *(("a.csv", 1000.0, value, late) for value in (None, "u", 1)),
        ("a.csv", -1.0, "u", "the rate is -1 Hz; allowed: a number of Hz, > 0"),
        ("a.csv", 0, "u", "the rate is 0 Hz; allowed: a number of Hz, > 0"),
        ("a.csv", np.nan, "u", "the rate is nan Hz; allowed: a number of Hz, > 0"),
        ("a.csv", "1k", "u", "the rate is '1k'; allowed: a number of Hz, > 0"),
        ("a.csv", None, None, "is a table with times; allowed: one with a rate"),
        ("a.npz", None, None, "row 2: the time 4.53515e-05 s is not that of sample 2 at 48000 Hz, 4.16667e-05 s"),
        ("a.npz", 44100.0, None, "the rate given is 44100 Hz, and its own is 48000 Hz; allowed: one rate"),
    ):
        assert said in refuses("", fs.Samples.from_table, name, rate, value)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"t": np.arange(3), "u": np.arange(4)}, "has arrays of different length (t 3, u 4); allowed: one length"),
        ({"t": np.arange(3), "u": np.array([0.0, np.nan, 1.0])}, "row 1: column 'u' is nan; allowed: finite numbers"),
        ({"t": np.array([0.0, 2.0, 1.0]), "u": np.arange(3)}, "row 2: the time 1 s follows 2 s"),
        ({"t": np.zeros((2, 2))}, "the array 't' has shape (2, 2); allowed: one row a column"),
        ({"t": np.array(["a", "b"])}, "the array 't' is of <U1; allowed: real numbers"),
        ({"t": np.array([1j])}, "the array 't' is of complex128; allowed: real numbers"),
        ({"t": np.array([{}, None])}, "cannot be read as NPZ: Object arrays cannot be loaded"),
        ({"t": np.zeros(0), "u": np.zeros(0)}, "holds no numbers"),
        ({"rate": np.array(48000)}, "holds no numbers"),
    ],
)
def test_arrays_that_are_no_columns_are_refused(arrays: dict[str, np.ndarray], said: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    assert said in refuses("", fs.PWL.from_table, tmp_path / "a.npz")


def test_a_broken_npz_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, t=np.arange(300.0), u=np.arange(300.0))
    whole = path.read_bytes()
    for broken in (whole[:900], b"junk" + whole[4:900], b"time,voltage\n0,1\n"):
        path.write_bytes(broken)
        assert "cannot be read as NPZ" in refuses("", fs.PWL.from_table, path)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("readme.txt", "no array")
    assert "the array 'readme.txt' is of another kind; allowed: real numbers" in refuses("", fs.PWL.from_table, path)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.45])
@pytest.mark.parametrize("factor", [4, 16])
def test_upsampled_tones_are_as_near_as_is_said(factor: int, share: float) -> None:
    rate, f = 8000.0, share * 8000.0
    wave = fs.Samples(np.sin(2.0 * np.pi * share * np.arange(600) + 0.3), rate)
    dense = wave.upsampled(factor)
    assert (dense.rate, dense.start) == (factor * rate, 0.0)
    np.testing.assert_array_equal(dense.values[::factor], wave.values)
    t = np.linspace(100.0 / rate, 500.0 / rate, 20011)
    miss = np.abs(dense(t) - np.sin(2.0 * np.pi * f * t + 0.3)).max()
    lines = (np.pi * share / factor) ** 2 / 2.0
    assert miss < 1.01 * lines + 2e-4
    assert miss > 0.9 * lines - 2e-4


def test_an_upsampled_recording_is_held_at_its_ends() -> None:
    wave = fs.Samples(np.full(50, 3.0), 100.0, 0.2).upsampled(8)
    np.testing.assert_allclose(wave.values, 3.0, rtol=1e-4)
    assert wave.values.size == 49 * 8 + 1
    assert wave.start == 0.2
    for factor in (1, 65, 2.5):
        assert "allowed: 2 to 64, a whole number" in refuses("", wave.upsampled, factor)


# In decks -----------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a deck's folder and files in it, and a recording beside it."""
    inner = tmp_path / "decks" / "data"
    inner.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(3)
    data = random.integers(-(2**15), 2**15, 400)
    Path("outside.wav").write_bytes(MONO)
    Path("decks/mono.wav").write_bytes(wav(packed(data)))
    Path("decks/data/stereo one.wav").write_bytes(wav(packed(data), channels=2, rate=4000))
    Path("decks/table.csv").write_text("time (ms),left,right\n0,0,5\n1,100,6\n3,-100,7\n")
    Path("decks/plain.csv").write_text("left,right\n0,5\n100,6\n-100,7\n")
    Path("decks/points.txt").write_text("0 0\n1m 100\n3m -100\n")
    np.savez("decks/rate.npz", u=data[:100] / 2**15, rate=8000)
    return tmp_path


def source(text: str, before: str = "") -> fs.Waveform:
    """The waveform of a deck's source, whose deck lies in ``decks/``."""
    path = Path("decks/pad.cir")
    path.write_text(table1_deck(text, extra=before))
    wave = fs.read_netlist(path)["Vdrive"].waveform
    assert wave is not None
    return wave


def same(a: fs.Waveform, b: fs.Waveform) -> None:
    t = np.linspace(0.0, 0.06, 997)
    assert type(a) is type(b)
    np.testing.assert_array_equal(a(t), b(t))


def test_decks_name_files_beside_them(folder: Path) -> None:
    mono, stereo = Path("decks/mono.wav"), Path("decks/data/stereo one.wav")
    wave = fs.Samples.from_wav(mono, 150.0)
    same(source("wav(mono.wav 150)"), wave)
    for given in ("mono.wav 150", "mono.wav gain=150", "mono.wav,150,0", "mono.wav {3*50} channel=0"):
        same(source(f"WAVEFILE({given})"), wave)
    same(source("WAVEFILE(mono.wav 150 upsample=4)"), wave.upsampled(4))
    same(source('WAVEFILE("data/stereo one.wav" 20 1)'), fs.Samples.from_wav(stereo, 20.0, 1))
    same(source("wavefile=mono.wav"), fs.Samples.from_wav(mono, 1.0))
    same(source('wavefile="data\\stereo one.wav" chan=1'), fs.Samples.from_wav(stereo, 1.0, 1))
    # LTspice takes the first channel where none is chosen.
    same(source('wavefile="data/stereo one.wav" Rser=1'), fs.Samples.from_wav(stereo, 1.0, 0))
    points = fs.PWL((0.0, 1e-3, 3e-3), (0.0, 100.0, -100.0))
    for text in ("PWL FILE=points.txt", "PWL(file=points.txt)", 'PWL file="points.txt"', "TABLE(table.csv time left)"):
        same(source(text), points)
    same(source("TABLE(table.csv 0 2)"), fs.PWL(points.times, (5.0, 6.0, 7.0)))
    same(source("TABLE(table.csv value=right)"), fs.PWL(points.times, (5.0, 6.0, 7.0)))
    same(source("PWL FILE=points.txt td=2m r=0"), fs.PWL((2e-3, 3e-3, 5e-3), points.values, 2e-3))
    same(source("TABLE(rate.npz)"), fs.Samples.from_table("decks/rate.npz"))
    same(source("TABLE(rate.npz upsample=4)"), fs.Samples.from_table("decks/rate.npz").upsampled(4))
    same(source("TABLE(plain.csv rate=1k value=left)"), fs.Samples([0.0, 100.0, -100.0], 1000.0))
    # In an included file names count from its own folder.
    Path("decks/data/part.inc").write_text('Vpart part 0 WAVEFILE("stereo one.wav" 7 0)\nRpart part 0 1k\n')
    Path("decks/pad.cir").write_text(table1_deck("DC 1", extra=".include data/part.inc"))
    part = fs.read_netlist("decks/pad.cir")["Vpart"].waveform
    assert part is not None
    same(part, fs.Samples.from_wav(stereo, 7.0, 0))


@pytest.mark.parametrize(("text", "said"), listed("files"), ids=[text for text, _ in listed("files")])
def test_files_that_a_deck_may_not_or_cannot_read_are_refused_with_its_line(text: str, said: str, folder: Path) -> None:
    Path("decks/link.wav").symlink_to(folder / "outside.wav")
    message = refuses("", source, text)
    assert message.startswith("decks/pad.cir:3:")
    assert said in message


def test_all_files_of_a_deck_together_have_a_limit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "MAX_SOURCE_BYTES", 1000)
    twice = "Vother other 0 WAVEFILE(mono.wav 1)\nRother other 0 1k"
    source("WAVEFILE(mono.wav 150)")
    said = "decks/pad.cir:8:25: the sources' files are larger than"
    assert said in refuses("", source, "WAVEFILE(mono.wav 150)", twice)


# On the command line ------------------------------------------------------------------------------------------


def test_sources_of_the_command_line_are_named_from_the_working_directory(command: Command, tmp_path: Path) -> None:
    Path("far").mkdir()
    Path("decks").mkdir()
    deck = edited((".tran 10u 50m uic", "*"))
    Path("decks/no_end.cir").write_text(deck)
    Path("far/a.wav").write_bytes(wav(packed(np.arange(-200, 200) * 50)))
    Path("far/a.csv").write_text("0 0\n10m 100\n20m -100\n")
    recording = "WAV(far/a.wav gain=150)"
    for spec in (recording, f"WAVEFILE({tmp_path}/far/a.wav 150)", "TABLE(far/a.csv)", "PWL FILE=far/a.csv"):
        words = ("run", "decks/no_end.cir", "--source", spec, "--stop", "20m", "--no-plot", "--overwrite", "--csv")
        command(*words, "--start", "5m").ok()
        t = np.loadtxt("out/no_end.csv", delimiter=",", skiprows=1)[:, 0]
        assert (t[0], t[-1]) == (0.005, 0.02)
        assert np.unique(t).size >= 1001
    assert command("export", "decks/no_end.cir", "--source", recording, "--stop", "5m", "-o", "x.cir").code == 0
    exported = Path("x.cir").read_text()
    assert ".tran 5e-06 0.005 uic" in exported
    # 8 samples a millisecond: up to the first beyond the end.
    assert exported[exported.index("PWL(") : exported.index(")", exported.index("PWL("))].count(" ") < 2 * 46
    refused = command("run", "decks/no_end.cir", "--source", "WAV(far/b.wav gain=150)", "--stop", "20m").refused()
    assert refused.err == "fingerspice: --source 'WAV(far/b.wav gain=150)': source: 'far/b.wav' does not exist\n"
    # A deck does not reach there.
    Path("decks/out.cir").write_text(deck.replace("SIN(0 200 100)", "WAVEFILE(../far/a.wav 150)"))
    assert "lies outside the netlist's folder" in command("run", "decks/out.cir", "--stop", "20m").err


def test_results_tell_recordings_apart_by_their_names(command: Command) -> None:
    for name in ("a.wav", "b.wav"):
        Path(name).write_bytes(wav(packed(np.arange(-200, 200) * 50)))
    Path("a.csv").write_text("".join(f"{i}m {i % 7}\n" for i in range(200)))
    words = ("run", "pad.cir", "--stop", "1m", "--no-plot", "--source")
    assert command(*words, "WAV(a.wav 150)").code == 0
    assert command(*words, "WAV(a.wav 150)").code == 0
    assert "--overwrite" in command(*words, "WAV(b.wav 150)").err
    assert command(*words, "TABLE(a.csv)", "--name", "table").code == 0
    loaded = fs.load("out/table.nc").circuit
    assert loaded.overrides == {"Vdrive": "TABLE(a.csv)"}
    assert loaded["Vdrive"].waveform == fs.PWL.from_table("a.csv")


@pytest.mark.parametrize(("deck", "source"), [("pad.cir", ["--source", "WAV(a.wav 150)"]), ("own.cir", [])])
def test_a_recording_longer_than_the_run_is_told(command: Command, deck: str, source: list[str]) -> None:
    Path("a.wav").write_bytes(wav(packed(np.arange(-400, 400) * 50)))
    Path("own.cir").write_text(edited(QUICK, ("SIN(0 200 100)", "WAVEFILE(a.wav 150)")))
    words = ("run", deck, "--no-plot", "--overwrite", "--rtol", "1e-4", *source)
    told = "the recording ends at 0.099875 s, and the run at the deck's TSTOP = 0.02 s; --stop 0.099875 takes all"
    assert told in command(*words).err
    for stop in ("20m", "0.099875"):
        assert "the recording ends" not in command(*words, "--stop", stop).err
