"""Recirculation matrices: shapes, kinds of number, damaged, encrypted and inflated archives."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from fuzz import damage, physics
from fuzz.case import DefectError, Scratch
from sdc_taichi import load_config
from sdc_taichi.config import with_values

RACKS = 6
HALL = ("hall.rows=2", "hall.racks_per_row=3", "hall.servers_per_rack=20",
        "hall.supply_approach_k=4", "hall.return_approach_k=-3",
        "servers.power_w=[150, 10]")  # fmt: skip
AIR_W_PER_K = 220.0
"""Heat capacity flow of the air through one rack, about."""


class Trap:
    """Unpickled, it says so."""

    sprung = False

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        return spring, ()


def spring() -> int:
    """What a pickle in a matrix would call."""
    Trap.sprung = True
    return 1


def matrices(scratch: Scratch) -> None:
    """Give a hall a matrix from a file, and simulate it."""
    kind = scratch.pick(("R", "D"))
    matrix = _matrix(scratch, kind)
    path = _csv(scratch, matrix) if scratch.chance(0.35) else _npz(scratch, kind, matrix)
    given = kind if path.suffix == ".csv" or scratch.chance(0.3) else None
    values = {
        "hall.recirculation.matrix_file": str(path),
        "hall.recirculation.matrix_kind": given,
        "hall.recirculation.calibrate": scratch.pick((None, "rack", "row", "hall", "none")),
    }
    if scratch.chance(0.03):
        values["hall.recirculation.matrix_kind"] = None
    Trap.sprung = False
    physics.run(scratch, with_values(load_config("corrected", HALL), values))
    if Trap.sprung:
        raise DefectError("a file has run code")


def _matrix(scratch: Scratch, kind: str) -> Any:
    """Numbers of a matrix, right in half of the cases."""
    rng = scratch.rng
    matrix: Any = rng.dirichlet(np.ones(RACKS + 1), RACKS)[:, :RACKS] * 0.5
    if kind == "D":
        matrix = np.linalg.solve(np.eye(RACKS) - matrix.T, matrix.T).T / AIR_W_PER_K
    if scratch.chance(0.65):
        return matrix
    at = tuple(rng.integers(0, RACKS, 2))
    how = int(rng.integers(12))
    if how < 5:
        odd = (np.nan, np.inf, -0.1, 1.0, 1e308, -1e308, 1e-300, 5.0)
        matrix[at] = odd[int(rng.integers(len(odd)))]
        return matrix
    if how == 5:
        return matrix * float(rng.choice([0.0, 1e-300, 2.0, 1e308, -1.0]))
    if how == 6:
        return matrix[:, : int(rng.integers(RACKS))]
    if how == 7:
        return matrix[None] if scratch.chance(0.5) else matrix.ravel()
    if how == 8:
        return matrix[:0] if scratch.chance(0.5) else matrix[0, 0]
    kinds = ("complex128", "S4", "U8", "?", "i1", "u8", "f2", "M8[s]", "i4,f8", "object")
    with np.errstate(all="ignore"):
        return np.zeros_like(matrix, dtype=kinds[int(rng.integers(len(kinds)))])


def _npz(scratch: Scratch, kind: str, matrix: Any) -> Path:
    """An archive, damaged in half of the cases."""
    rng = scratch.rng
    members = {kind: _npy(matrix)}
    how = int(rng.integers(24))
    if how == 0:
        members = {str(rng.choice(["r", "R.npy", "matrix", "../R", ""])): members[kind]}
    elif how == 1:
        members = {"R": members[kind], "D": members[kind]}
    elif how == 2:
        members = {kind: damage.damaged_bytes(rng, members[kind])}
    elif how == 3:
        members = {kind: _claiming(rng)}
    elif how == 4:
        members = {kind: b"\x93NUMPY\x01\x00" + pickle.dumps(Trap())}
    elif how == 5:
        members = {kind: _npy(np.array([[Trap()]], dtype=object))}
    elif how == 6:
        members = {kind: members[kind] + bytes(1 << 26)}
    buffer = io.BytesIO()
    how_packed = zipfile.ZIP_DEFLATED if scratch.chance(0.3) or how == 6 else zipfile.ZIP_STORED
    if scratch.chance(0.05):
        how_packed = int(rng.choice([zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]))
    with zipfile.ZipFile(buffer, "w", how_packed) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    content = buffer.getvalue()
    if how == 7:
        content = _encrypted(content)
    elif how in (8, 9):
        content = damage.damaged_bytes(rng, content)
    elif how == 10:
        content = members[kind]
    return scratch.write("r.npz", content)


def _npy(matrix: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, matrix, allow_pickle=True)
    return buffer.getvalue()


def _claiming(rng: np.random.Generator) -> bytes:
    """A header that claims more numbers than any memory holds, or a shape that is none."""
    shapes = ("(1000000, 1000000)", "(9" + "9" * 30 + ", 6)", "(-6, 6)", "(6, 6.0)", "6", "()",
              "(" * 200 + ")" * 200, "(6, True)", "__import__('os')")  # fmt: skip
    shape = shapes[int(rng.integers(len(shapes)))]
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(288)


def _encrypted(content: bytes) -> bytes:
    """An archive that says of its members that they are encrypted."""
    out = bytearray(content)
    for signature, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = out.find(signature)
        if at >= 0:
            out[at + place] |= 1
    return bytes(out)


def _csv(scratch: Scratch, matrix: Any) -> Path:
    """Numbers as text, damaged in half of the cases."""
    rng = scratch.rng
    rows = [[f"{x}" for x in np.ravel(row)] for row in np.atleast_1d(matrix)]
    delimiter = ","
    if scratch.chance(0.4) and rows and rows[0]:
        how = int(rng.integers(6))
        if how == 0:
            rows.insert(0, [f"rack {i}" for i in range(RACKS)])
        elif how == 1:
            delimiter = str(rng.choice([";", "\t", " "]))
        elif how == 2:
            del rows[0][0]
        else:
            rows[0][0] = damage.scalar(rng)
    text = "\n".join(delimiter.join(row) for row in rows) + "\n"
    text = damage.lone_surrogates_escaped(text)
    content = damage.damaged_text(rng, text) if scratch.chance(0.25) else text.encode()
    return scratch.write("r.csv", content)
