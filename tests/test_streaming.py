"""Runs chunk by chunk: bitwise equal to the whole run, in constant memory, in a store that survives a crash."""

import json
import os
import pickle
import random
import re
import signal
import sys
import time
import tracemalloc
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
import recording_errors
from commands import Command, tree
from fingerspice.solve import streaming
from fingerspice.solve.recordings import block as pieces
from fingerspice.waveforms import samples
from processes import forked, no_room_here
from scenes import cases, dispersive_deck, every_law, listed, refuses, shipped, table1, table1_deck
from test_source_files import wav as wav_bytes

RATE = 48_000.0
NAMES = ("t", "u_gap", "f_el", "q_source", "i_source", "u_source", "u_layer", "friction")


@pytest.fixture(autouse=True)
def _without_warnings_in_short_pieces(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(pieces, "PIECE", 1 << 15)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        yield


def wav(path: Path, count: int, high: float = 4000.0) -> Path:
    """A WAV file of noise, 16 bits, its first half ten times more quiet."""
    from scipy.io import wavfile

    values = recording_errors.noise(3, count, RATE, 50.0, high)
    values[: count // 2] *= 0.1
    wavfile.write(path, int(RATE), np.round(32767.0 * values).astype(np.int16))
    return path


def deck(path: Path, recording: Path, seconds: float) -> Path:
    """Table 1 under a recording at 150 V."""
    path.write_text(table1_deck(f"WAVEFILE({recording.name} 150)", tran=f"50u {seconds!r} uic"))
    return path


def joined(chunks: list[fs.Solution], name: str) -> np.ndarray:
    return np.concatenate([getattr(chunk, name) for chunk in chunks])


@pytest.mark.parametrize("skin", ["frozen", "dispersive"])
@every_law
def test_chunks_are_the_whole_to_the_last_bit(law: str, skin: str, tmp_path: Path) -> None:
    count = 2 * pieces.PIECE + 1234
    path = wav(tmp_path / "a.wav", count)
    circuit = fs.parse_netlist(dispersive_deck() if skin == "dispersive" else table1_deck())
    assert bool(circuit.by_device("SKIN_DISPERSIVE")) == (skin == "dispersive")
    drive, stop = fs.Samples.from_wav(path, 150.0), (count - 1.4) / RATE
    # For each number of modes and rule of nodes code is compiled anew: these are what other tests need, too.
    rtol = 1e-6 if (skin, law) == ("dispersive", "local") else 1e-4
    how = {"t_stop": stop, "rtol": rtol, "charge_law": law, "start": "uncharged"}
    t = np.arange(count - 1) / RATE
    whole = fs.simulate(circuit, sources=drive, t_eval=t, **how)
    assert whole.method == "relaxation"
    for length in (977, pieces.PIECE, 10**6):
        lazy = fs.Samples.from_wav(path, 150.0, at_once=False)
        stream = fs.stream(circuit, sources=lazy, count=length, **how)
        chunks = list(stream)
        assert len(chunks) == len(stream) == -(-t.size // length)
        for name in NAMES:
            np.testing.assert_array_equal(joined(chunks, name), getattr(whole, name))
        assert chunks[-1].error == whole.error
        # The samples were never in memory at once.
        assert "values" not in vars(lazy)


@pytest.mark.parametrize("step", [1e-3, 1.7e-5])
def test_outputs_between_samples_are_those_of_the_whole_too(step: float) -> None:
    values = 150.0 * recording_errors.noise(5, pieces.PIECE + 500, RATE, 50.0, 4000.0)
    samples, circuit = fs.Samples(values, RATE, start=0.3 / RATE), table1()
    how = {"sources": samples, "t_stop": (values.size - 3) / RATE, "rtol": 1e-5, "start": "uncharged"}
    chunks = list(fs.stream(circuit, chunk=0.31, step=step, **how))
    t = joined(chunks, "t")
    np.testing.assert_array_equal(t, step * np.arange(t.size))
    whole = fs.simulate(circuit, t_eval=t, **how)
    for name in ("u_gap", "f_el", "q_source"):
        np.testing.assert_array_equal(joined(chunks, name), getattr(whole, name))


def test_a_quiet_beginning_is_followed_to_its_own_scale() -> None:
    values = 150.0 * recording_errors.noise(5, 2 * pieces.PIECE, RATE, 50.0, 4000.0)
    values[: pieces.PIECE] *= 0.05
    circuit = table1()
    how = {
        "sources": fs.Samples(values, RATE),
        "t_stop": (values.size - 1) / RATE,
        "rtol": 1e-4,
        "start": "uncharged",
        "charge": False,
    }
    first = next(fs.stream(circuit, count=pieces.PIECE, **how))
    exact = fs.simulate(circuit, t_eval=first.t[:4000], **how | {"t_stop": 0.1, "rtol": 1e-10})
    peak = np.abs(first.u_gap).max()
    assert peak < 10.0
    assert np.abs(first.u_gap[:4000] - exact.u_gap).max() <= first.error.u_gap <= 1e-4 * peak


@pytest.mark.parametrize("name", ["two_fingers", "amplifier", "fingerpad_square", "texture_recording"])
def test_any_circuit_is_streamed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streaming, "WINDOW", 400)
    circuit = shipped(name)
    how = {"rtol": 1e-6, "t_stop": 0.03}
    one, other = (list(fs.stream(circuit, count=count, **how)) for count in (251, 10**6))
    for signal_name in ("t", "u_gap", "q_source"):
        np.testing.assert_array_equal(joined(one, signal_name), joined(other, signal_name))
    whole = fs.simulate(circuit, t_eval=np.minimum(joined(one, "t"), 0.03), **how)
    # Each window states its own error, and what one leaves dies away in the next.
    assert np.abs(joined(one, "u_gap") - whole.u_gap).max() <= 4e-6 * np.abs(whole.u_gap).max()


def test_later_windows_state_the_errors_of_the_louder_ones_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streaming, "WINDOW", 300)
    fading = {"Vdrive": fs.Sine(200.0, 500.0, damping=200.0)}
    errors = [c.error.u_gap for c in fs.stream(shipped("amplifier"), count=300, rtol=1e-6, t_stop=0.03, sources=fading)]
    assert len(errors) > 3
    assert errors == sorted(errors)


def test_what_cannot_be_followed_by_samples_goes_on_by_other_steps() -> None:
    values = 100.0 * recording_errors.noise(5, pieces.PIECE + 600, RATE, 50.0, 2000.0)
    # Beyond the range of the area's polynomial, in the second piece only.
    values[pieces.PIECE + 300 :] *= 40.0
    circuit = table1()
    how = {"sources": fs.Samples(values, RATE), "t_stop": (values.size - 1) / RATE, "rtol": 1e-4, "start": "uncharged"}
    chunks = list(fs.stream(circuit, count=pieces.PIECE // 2, **how))
    assert chunks[-1].success
    tail = fs.simulate(circuit, t_eval=chunks[-1].t, **how)
    assert np.abs(chunks[-1].u_gap - tail.u_gap).max() <= 3e-4 * np.abs(tail.u_gap).max()


def test_a_stream_goes_on_from_a_mark() -> None:
    values = 150.0 * recording_errors.noise(5, 2 * pieces.PIECE, RATE, 50.0, 4000.0)
    circuit = table1()
    for sources in (fs.Samples(values, RATE), fs.Square(200.0, 100.0)):
        how = {"sources": sources, "t_stop": 2.7, "rtol": 1e-4, "step": 3e-5, "count": 20_011, "start": "uncharged"}
        whole = list(fs.stream(circuit, **how))
        stream = fs.stream(circuit, **how)
        for number in range(1, len(whole)):
            next(stream)
            # As a file keeps it.
            mark = json.loads(json.dumps(stream.mark()))
            other = fs.stream(circuit, **how)
            other.go_to(mark, number * 20_011)
            chunk = next(other)
            for name in ("t", "u_gap", "q_source"):
                np.testing.assert_array_equal(getattr(chunk, name), getattr(whole[number], name))


def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    circuit, most = table1(), []
    # The first makes what later runs through the same circuit use again.
    for seconds in (45, 45, 120):
        path = wav(tmp_path / f"{seconds}.wav", 48_000 * seconds)
        tracemalloc.start()
        samples = fs.Samples.from_wav(path, 150.0, at_once=False)
        for chunk in fs.stream(circuit, sources=samples, t_stop=seconds - 0.1, rtol=1e-3, chunk=2.0, start="uncharged"):
            assert chunk.f_el is not None
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[2] < 1.1 * most[1] + 1e6


@pytest.mark.parametrize(
    ("given", "said"), [*listed("streams"), ({"count": 10**10, "step": 1e-12, "t_stop": 1.0}, "outputs with")]
)
def test_a_stream_that_cannot_be_is_refused_at_once(given: dict[str, object], said: str) -> None:
    refuses(said.replace("(", r"\("), fs.stream, table1(), **given)


def test_a_run_that_fails_gives_what_came_before() -> None:
    circuit = table1()
    source = fs.Function(lambda t: np.where(t < 0.12345, 100.0 * np.sin(700.0 * t), np.nan))
    found = []
    with pytest.raises(fs.SolveError) as caught:
        found.extend(fs.stream(circuit, sources=source, t_stop=0.3, step=1e-4, count=500, start="uncharged", rtol=1e-5))
    assert caught.value.failure.status is fs.Status.SOURCE_NOT_FINITE
    assert len(found) == 2
    assert all(chunk.success for chunk in found)
    assert caught.value.solution.t[0] == pytest.approx(0.1)
    assert caught.value.solution.t[-1] == pytest.approx(0.12345, abs=1e-4)


def test_a_run_to_a_fold_ends_as_the_whole_one() -> None:
    circuit = table1().replace({"Xgap.d": 1e-6, "Vdrive": fs.Sine(1500.0, 100.0)})
    with pytest.raises(fs.SolveError) as whole:
        fs.simulate(circuit, charge_law="mobile", rtol=1e-6)
    with pytest.raises(fs.SolveError) as caught:
        list(fs.stream(circuit, step=1e-5, count=30, charge_law="mobile", rtol=1e-6))
    one, other = whole.value.failure, caught.value.failure
    assert other.status is one.status is fs.Status.FOLD
    assert caught.value.solution.t[-1] == other.t == pytest.approx(one.t, rel=1e-6)
    assert (other.u_gap, other.area) == pytest.approx((one.u_gap, one.area), rel=1e-3)


def test_what_was_stated_stays_where_another_method_takes_over() -> None:
    # A loud piece, then a quiet one whose end is louder than what the polynomials cover.
    current = 2e-4 * recording_errors.noise(5, 3 << 15, RATE, 50.0, 4000.0)
    current[1 << 15 :] *= 1e-3
    current[3 << 14 : (3 << 14) + 2000] *= 1e4
    source = fs.Samples(current, RATE)
    stream = fs.stream(shipped("current_drive"), sources=source, t_stop=2.0, count=8192, rtol=1e-4)
    chunks = [next(stream) for _ in range(6)]
    assert [chunk.method for chunk in chunks] == [*["relaxation"] * 4, *["exponential"] * 2]
    assert np.all(np.diff([chunk.error.u_gap for chunk in chunks]) >= 0.0)


# Recordings in files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize(("bits", "kind"), [(8, 1), (16, 1), (24, 1), (32, 1), (32, 3), (64, 3)])
@pytest.mark.parametrize("channels", [1, 3])
def test_parts_of_a_file_are_those_of_the_whole(bits, kind, channels, order, tmp_path, monkeypatch):
    monkeypatch.setattr(samples, "AT_ONCE", 50)
    rng = np.random.default_rng(bits)
    if kind == 3:
        floats = rng.uniform(-1.0, 1.0, 301 * channels).astype(f"{'<' if order == 'little' else '>'}f{bits // 8}")
        data = floats.tobytes()
    else:
        data = rng.integers(0, 256, 301 * channels * bits // 8, dtype=np.uint8).tobytes()
    path = tmp_path / "a.wav"
    path.write_bytes(wav_bytes(data, bits, kind=kind, channels=channels, head=b"RIFX" if order == "big" else b"RIFF"))
    channel = channels - 1
    whole = fs.Samples.from_wav(path, 150.0, channel)
    parts = fs.Samples.from_wav(path, 150.0, channel, at_once=False)
    assert (parts.rate, parts.count) == (whole.rate, whole.count) == (8000.0, 301)
    t = np.append(rng.uniform(-0.01, 0.05, 200), np.arange(301) / 8000.0)
    np.testing.assert_array_equal(parts.value(t), whole.value(t))
    np.testing.assert_array_equal(parts.breakpoints(0.001, 0.02), whole.breakpoints(0.001, 0.02))
    np.testing.assert_array_equal(parts.between(-3, 305), whole.between(-3, 305))
    assert parts.peak(0.0, 0.03) == whole.peak(0.0, 0.03)
    edges = np.arange(20, 31) / 8000.0
    np.testing.assert_array_equal(parts.terms(edges[:-1], edges[1:]), whole.terms(edges[:-1], edges[1:]))
    assert "values" not in vars(parts)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(parts)).values, whole.values)
    np.testing.assert_array_equal(parts.values, whole.values)
    np.testing.assert_array_equal(parts.value(t), whole.value(t))


def test_a_file_that_becomes_shorter_ends_a_stream_in_one_sentence(tmp_path: Path) -> None:
    path = wav(tmp_path / "a.wav", 3 * pieces.PIECE)
    drive = fs.Samples.from_wav(path, 150.0, at_once=False)
    stream = fs.stream(table1(), sources=drive, t_stop=2.0, rtol=1e-3, count=pieces.PIECE)
    next(stream)
    path.write_bytes(path.read_bytes()[: 3 * pieces.PIECE])
    refuses("has become shorter while it was read", list, stream)


# The store ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A folder with a deck of 4 s, streamed in 40 pieces."""
    pytest.importorskip("zarr")
    deck(tmp_path / "long.cir", wav(tmp_path / "a.wav", 200_000), 4.0)
    return tmp_path


STREAM = ("run", "long.cir", "--stream", "--rtol", "1e-4", "--chunk", "0.1", "--signals", "u_gap,f_el,u_layer")
FEW = ("run", "long.cir", "--stream", "--stop", "0.3", "--rtol", "1e-4", "--chunk", "0.1")
PATH = Path("out/long.zarr")


@pytest.fixture
def few(scene: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> Command:
    """The command in the folder of a store that `FEW` has written, in four pieces."""
    monkeypatch.chdir(scene)
    assert command(*FEW).code == 0
    return command


def test_a_store_holds_the_run(scene: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    import xarray

    monkeypatch.chdir(scene)
    answer = command(*STREAM, "--netcdf", "--json").ok().json
    assert answer["stream"]["chunks"] == 41
    assert (answer["method"], answer["files"]) == ("relaxation", ["out/long.zarr", "out/long.nc"])
    circuit = fs.read_netlist("long.cir")
    whole = fs.simulate(circuit, t_eval=np.arange(192_001) / RATE, rtol=1e-4, charge=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for file, how in ((PATH, {"engine": "zarr", "consolidated": False}), ("out/long.nc", {})):
            with xarray.open_dataset(file, **how) as given:
                for name, values in (("time", whole.t), ("f_el", whole.f_el), ("u_layer", whole.u_layer)):
                    np.testing.assert_array_equal(given[name], values)
                assert given["u_gap"].attrs["units"] == "V"
    # Once more: everything is there.
    again = json.loads(command(*STREAM, "--json").out)
    assert again["stream"]["found"] == 41
    assert again["error"] == answer["error"]


def test_a_killed_run_goes_on_to_the_same_bytes(scene: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scene)
    written, killed = scene / "parts" / "long.zarr" / "f_el" / "c", 0
    for pieces_there in (*range(1, 34, cases(8, 32)), 40):
        process = forked(lambda: command(*STREAM, "--out", "parts"))
        while process.is_alive() and (not written.is_dir() or len(os.listdir(written)) < pieces_there):
            time.sleep(1e-3)
        process.kill()
        process.join()
        killed += process.exitcode == -signal.SIGKILL
    assert killed > 0
    assert [command(*STREAM, "--out", out).code for out in ("parts", "whole")] == [0, 0]
    assert tree(scene / "parts" / "long.zarr") == tree(scene / "whole" / "long.zarr")


def test_a_full_disk_loses_nothing(scene: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scene)
    # A piece of u_layer has 115 kB, and one of u_gap 38 kB: there is no room for all pieces, then none for the whole.
    pieces_missing = "0 of 41 pieces are written, and the same command goes on from there"
    for size, words, said in (
        (60_000, STREAM, rf"cannot write out/long\.zarr: .*; {pieces_missing}"),
        (1_000_000, (*STREAM, "--netcdf"), r"cannot write out/long\.nc: File too large"),
    ):
        with no_room_here(size):
            result = command(*words)
        assert result.code == 2
        (line,) = [line for line in result.lines if not line.startswith("fingerspice: warning")]
        assert re.fullmatch(f"fingerspice: {said}", line)
    assert not Path("out/long.nc").exists()
    assert command(*STREAM, "--netcdf").code == 0


def test_a_store_of_another_run_is_refused(few: Command) -> None:
    before = tree(Path("out"))
    others = {
        "rtol": (*FEW[:5], "--rtol", "1e-5", "--chunk", "0.1"),
        "chunk": (*FEW[:-1], "0.2"),
        "end": (*FEW[:4], "0.25", *FEW[5:]),
        "charge law": (*FEW, "--charge-law", "mobile"),
        "circuit": (*FEW, "--set", "Xgap.d=3u"),
        "signals": (*FEW, "--signals", "u_gap"),
        "source": (*FEW, "--source", "WAV(a.wav gain=100)"),
    }
    for what, arguments in others.items():
        result = few(*arguments)
        (line,) = [line for line in result.lines if not line.startswith("fingerspice: warning")]
        assert result.code == 2
        assert f"out/long.zarr holds a run of {'other' if what == 'signals' else 'another'} {what}" in line
        assert tree(Path("out")) == before
    assert few(*others["rtol"], "--overwrite").code == 0


def test_a_damaged_store_is_refused(few: Command) -> None:
    piece, head = PATH / "f_el/c/1", PATH / "zarr.json"
    piece.write_bytes(piece.read_bytes()[:-8])
    said = few(*FEW).refused()
    assert f"{PATH} is damaged: {piece} is missing or cut short; allowed: a run with --overw" in said.lines[-1]
    head.write_bytes(head.read_bytes()[:200])
    said = few(*FEW, "--overwrite").refused()
    assert f"{PATH} is there already and is no whole store of a run" in said.lines[-1]
    assert piece.exists()


def test_a_flipped_bit_of_a_store_is_found(few: Command) -> None:
    import zarr

    rng, sound, head = random.Random(3), tree(PATH), PATH / "zarr.json"
    assert few("check", str(PATH)).out == f"{PATH}: 12 chunks of 3 arrays are as they were written\n"
    assert json.loads(few("check", str(PATH), "--json").out)["chunks"] == {"f_el": 4, "time": 4, "u_gap": 4}
    for name, chunk in [(name, i) for name in ("f_el", "u_gap", "time") for i in rng.sample(range(4), cases(4, 1))]:
        file = PATH / name / "c" / str(chunk)
        content = bytearray(file.read_bytes())
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        file.write_bytes(content)
        for words in (FEW, ("check", str(PATH))):
            result = few(*words).refused()
            assert f"{PATH} is damaged: {file} has changed since it was written; allowed: " in result.lines[-1]
        with pytest.raises(ValueError, match="checksum"):
            zarr.open_group(PATH, mode="r")[name][:]
        file.write_bytes(sound[str(file.relative_to(PATH))] or b"")
    # The state from which the run goes on is not in a chunk.
    head.write_text(head.read_text().replace('"chunks_done": 4', '"chunks_done": 3'))
    assert "is no whole store of a run" in few(*FEW).lines[-1]
    assert f"is damaged: {head} has changed" in few("check", str(PATH)).lines[-1]
    (PATH / "f_el/c/2").unlink()
    assert few("check", str(PATH)).code == 2
    said = "fingerspice: out is no whole store; allowed: one that --stream or --store wrote"
    assert few("check", "out").lines == [said]


def test_a_store_of_an_earlier_version_says_that_it_has_no_checksums(few: Command) -> None:
    for file in PATH.rglob("zarr.json"):
        about = json.loads(file.read_text())
        about["codecs"] = [one for one in about.get("codecs", ()) if one["name"] != "crc32c"]
        about["attributes"].get("run", {}).pop("kind of checksum", None)
        about["attributes"].pop("checksum", None)
        file.write_text(json.dumps(about))
    for file in PATH.glob("*/c/*"):
        file.write_bytes(file.read_bytes()[:-4])
    assert f"{PATH} has no checksums, as an earlier version wrote it" in few("check", str(PATH)).lines[-1]
    said = f"{PATH} holds a run of another kind of checksum (None, and this one crc32c); allowed: --name NAME"
    assert said in few(*FEW).lines[-1]


def test_options_of_streams_are_checked_and_without_zarr_a_store_says_how_to_get_it(scene, command, monkeypatch):
    monkeypatch.chdir(scene)
    for arguments, said in (
        ("--chunk 1", "--chunk, --signals and --netcdf go with --stream"),
        ("--stream --csv", "--csv does not go with --stream"),
        ("--stream --chunk soon", "--chunk 'soon'"),
        ("--stream --signals u_gap,loudness", "--signals names 'loudness'; allowed: "),
    ):
        result = command("run", "long.cir", *arguments.split()).refused()
        assert said in result.lines[-1]
    (scene / "flat.cir").write_text("rc\nV1 a 0 SIN(0 1 50)\nR1 a b 1k\nC1 b 0 1u\n.tran 1m 40m\n.end\n")
    for name in ("u_layer", "f_el"):
        result = command("run", "flat.cir", "--stream", "--signals", f"v,{name}").refused()
        assert f"--signals names '{name}'; allowed: u_source, q_source" in result.lines[-1]
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert "pip install 'fingerspice[stream]'" in command(*STREAM).lines[-1]
    assert not (scene / "out").exists()
