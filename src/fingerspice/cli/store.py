"""A run on the disk as a Zarr store that grows chunk by chunk, and can be continued after a crash.

Every chunk of the run is one chunk of each array. The number of finished chunks is an attribute of the store's group,
whose file is replaced atomically after the chunk's data have reached the disk.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from fingerspice.base.errors import InputError
from fingerspice.base.files import UNFINISHED, settle_on_disk, write_aside, write_durably
from fingerspice.results.datafiles import CHECKSUM, SIGNATURE, Variable, fault, signature, variables, zarr_library
from fingerspice.results.solution import Solution

#: Attributes of the group: identity of the run, number of finished chunks, state to continue from, and results so far.
RUN, DONE, MARK, SO_FAR = "run", "chunks_done", "goes_on", "so_far"
# Number of bytes of the store that are copied at once.
_PIECE = 1 << 25


class Store:
    """A store of one run.

    Parameters
    ----------
    path : Path
        Folder of the store.
    run : mapping
        Identity of the run: all inputs that determine its results, as plain data.
    total, count : int
        Number of outputs of the run, and of a chunk.
    """

    def __init__(self, path: Path, run: dict[str, Any], total: int, count: int) -> None:
        self.zarr = zarr_library()
        self.run = json.loads(json.dumps({**run, "kind of checksum": CHECKSUM}))
        self.path, self.total, self.count = path, total, count
        self.done = 0
        self.mark: dict[str, Any] = {}
        self.so_far: dict[str, Any] = {}

    @property
    def chunks(self) -> int:
        """Number of chunks of the whole run."""
        return -(-self.total // self.count)

    def open(self, overwrite: bool) -> None:
        """Open an existing store of the same run, to continue it; with `overwrite` remove any store.

        Raises
        ------
        InputError
            If the folder is not a store, or the store is damaged or holds another run.
        """
        if not os.path.lexists(self.path):
            return
        ways = "allowed: --name NAME, another --out, or --overwrite"
        attributes = self._attributes()
        if attributes is None:
            raise InputError(f"{self.path} is there already and is no whole store of a run; allowed: --name or --out")
        if overwrite:
            shutil.rmtree(self.path)
            return
        for key, own in self.run.items():
            held = attributes[RUN].get(key)
            if held != own:
                said = "" if len(f"{held}{own}") > 80 else f" ({held}, and this one {own})"
                other = "other" if key == "signals" else "another"
                raise InputError(f"{self.path} holds a run of {other} {key.replace('_', ' ')}{said}; {ways}")
        self.done, self.mark, self.so_far = attributes[DONE], attributes[MARK], attributes[SO_FAR]
        for file, size in self._files(attributes):
            what = fault(file, size)
            if what is not None:
                raise InputError(f"{self.path} is damaged: {file} {what}; allowed: --overwrite")
        self._tidy(attributes)

    def _tidy(self, attributes: dict[str, Any]) -> None:
        """Remove unfinished files of a call that was killed."""
        whole = {file for file, _ in self._files(attributes)}
        begun = [file for name in attributes["arrays"] for file in (self.path / name / "c").rglob("*")]
        for file in [*self.path.glob(f"{UNFINISHED}*"), *begun]:
            if file not in whole and file.is_file():
                file.unlink()

    def _attributes(self) -> dict[str, Any] | None:
        """Attributes of the group; None if it is not a store of this program, or they have changed."""
        try:
            found = json.loads((self.path / "zarr.json").read_text())["attributes"]
            whole = all(isinstance(found[key], dict) for key in (RUN, MARK, SO_FAR, "arrays"))
            sound = found.get(SIGNATURE, "") in ("", signature(found))
            return found if whole and sound and isinstance(found[DONE], int) and found[DONE] >= 0 else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def _files(self, attributes: dict[str, Any]) -> list[tuple[Path, int]]:
        """Files of the finished chunks, and their sizes without checksum, bytes."""
        return [
            (self._file(name, k, columns), 8 * self.count * max(columns, 1))
            for name, columns in attributes["arrays"].items()
            for k in range(attributes[DONE])
        ]

    def _file(self, name: str, chunk: int, columns: int) -> Path:
        folder = self.path / name / "c" / str(chunk)
        return folder / "0" if columns else folder

    def write(self, chunk: int, solution: Solution, signals: list[str], about: dict[str, Any], mark: Any) -> None:
        """Write a chunk, then record it as finished; `mark` is the state from which the run continues.

        Raises
        ------
        InputError
            If it cannot be written; the earlier chunks stay.
        """
        data, coords = variables(solution, np.ones(solution.t.size, bool), signals)
        data = {"time": coords["time"], **data}
        try:
            if not self.path.exists():
                self._create(data, coords, about)
            start = chunk * self.count
            group = self.zarr.open_group(self.path, mode="r+", use_consolidated=False)
            for name, (_, values, _) in data.items():
                with self.zarr.config.set({"array.write_empty_chunks": True}):
                    group[name][start : start + len(values)] = values
                file = self._file(name, chunk, values.shape[1] if values.ndim > 1 else 0)
                settle_on_disk(file)
                settle_on_disk(file.parent)
            self._note(chunk + 1, mark, solution)
        except OSError as error:
            raise InputError(
                f"cannot write {self.path}: {error.strerror or error}; {self.done} of {self.chunks} pieces are "
                "written, and the same command goes on from there"
            ) from None
        self.done = chunk + 1

    def _create(self, data: dict[str, Variable], coords: dict[str, Variable], about: dict[str, Any]) -> None:
        """Create the store with its arrays, still without values, under a temporary name, then rename it."""
        aside = self.path.with_name(f"{UNFINISHED}{self.path.name}")
        shutil.rmtree(aside, ignore_errors=True)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        columns = {name: values.shape[1] if values.ndim > 1 else 0 for name, (_, values, _) in data.items()}
        attributes = {**about, RUN: self.run, DONE: 0, MARK: {}, SO_FAR: {}, "arrays": columns}
        try:
            group = self.zarr.create_group(aside, zarr_format=3, attributes=attributes)
            for name, (dimensions, values, said) in data.items():
                names = {d: coords[d][1].tolist() for d in dimensions if d != "time"}
                group.create_array(
                    name, shape=(self.total, *values.shape[1:]), chunks=(self.count, *values.shape[1:]), dtype="<f8",
                    compressors=[self.zarr.codecs.Crc32cCodec()], fill_value=np.nan, dimension_names=dimensions,
                    attributes={**said, **names},
                )  # fmt: skip
            aside.rename(self.path)
            settle_on_disk(self.path.parent)
        finally:
            shutil.rmtree(aside, ignore_errors=True)

    def _note(self, done: int, mark: Any, solution: Solution) -> None:
        self.so_far = {
            "method": solution.method, "area": solution.area_mode, "tier": solution.plan.tier,
            "t_stop": solution.t_stop, "error": vars(solution.error), "fold_margin_min": solution.fold_margin_min,
        }  # fmt: skip
        file = self.path / "zarr.json"
        about = json.loads(file.read_text())
        about["attributes"] |= {DONE: done, MARK: mark, SO_FAR: self.so_far}
        about["attributes"][SIGNATURE] = signature(about["attributes"])
        write_durably(file, json.dumps(about, indent=1).encode())

    def to_netcdf(self, path: Path) -> Path:
        """Write the whole run as NetCDF, piece by piece.

        Raises
        ------
        InputError
            If the file cannot be written, or the disk has too little room.
        """
        import h5netcdf

        group = self.zarr.open_group(self.path, mode="r")
        arrays = dict(group.arrays())
        size = sum(array.nbytes for array in arrays.values()) + 2**20

        def write(target: Path) -> None:
            # HDF5 ends the process on a full disk: reserve the room first, so that a full disk raises an error here.
            with target.open("wb") as room:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(room.fileno(), 0, size)
                elif shutil.disk_usage(target.parent).free < size:
                    raise OSError(f"it takes {size / 1e9:.3g} GB, which the disk has not")
            with h5netcdf.File(target, "w") as file:
                self._copy(group, arrays, file)

        return write_aside(path, write)

    def _copy(self, group: Any, arrays: dict[str, Any], file: Any) -> None:
        """Copy all arrays and texts into a NetCDF file."""
        file.dimensions["time"] = self.total
        for name, array in arrays.items():
            names = array.metadata.dimension_names
            for dimension, length in zip(names[1:], array.shape[1:], strict=True):
                if dimension not in file.dimensions:
                    file.dimensions[dimension] = length
            variable = file.create_variable(name, names, dtype="f8")
            for key, value in array.attrs.asdict().items():
                variable.attrs[key] = value if isinstance(value, str) else json.dumps(value)
            rows = max(1, _PIECE // (8 * max(1, int(np.prod(array.shape[1:])))))
            for at in range(0, self.total, rows):
                variable[at : at + rows] = array[at : at + rows]
        for key, value in group.attrs.asdict().items():
            if isinstance(value, str):
                file.attrs[key] = value
