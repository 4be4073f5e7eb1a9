"""Files with recirculation matrices: R, shares of exhaust air, or D, temperature rises."""

from __future__ import annotations

import io
import math
import warnings
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.hall.design_point import DesignPoint
from sdc_taichi.types import F64
from sdc_taichi.user_file import MOST_MATRIX_BYTES, ArrayFile, decoding, open_input

MOST_MATRIX_RACKS = 8192
"""Largest number of racks of a hall with a matrix of the user; the matrix takes 0.5 GB in f64."""
MOST_D_K_PER_W = 1000.0
"""Highest valid entry of D, in K/W: a rack of 1 W that warms another's intake by 1,000 K."""

_NPY_MAGIC = b"\x93NUMPY"
_ROUND_OFF = 1e-9
"""Size up to which negative shares, and negative entries of D divided by the largest, are rounding
errors."""


def read_matrix(config: DataCenterConfig, path: Path) -> tuple[str, F64]:
    """Kind, R or D, and numbers of a user's file, (R, R).

    An .npz file holds an array ``R`` or ``D``, a .csv file the numbers alone, one row per receiving
    rack, with ``hall.recirculation.matrix_kind``.

    Raises:
        ConfigError: naming the file and what is wrong with it.
    """
    kind, matrix = _read_numbers(config, path)
    racks = config.hall.racks
    _check_shape(path, kind, matrix.shape, racks)
    if not np.all(np.isfinite(matrix)):
        j, i = np.argwhere(~np.isfinite(matrix))[0]
        raise ConfigError(f"{path}: {kind}[{j}, {i}] is {matrix[j, i]}; valid is a finite number")
    highest, unit = (1.0, "") if kind == "R" else (MOST_D_K_PER_W, " K/W")
    j, i = np.unravel_index(np.argmax(np.abs(matrix)), matrix.shape)
    if abs(matrix[j, i]) > highest:
        raise ConfigError(
            f"{path}: {kind}[{j}, {i}] is {matrix[j, i]:.6g}{unit}; valid is 0..{highest:g}{unit}"
        )
    return kind, matrix


def share_matrix(
    config: DataCenterConfig, path: Path, kind: str, matrix: F64, design: DesignPoint
) -> F64:
    """R of a user's R or D, (R, R).

    D is in K/W at the design airflow: T_in = T_sup + D P, from which R = M (1 + M)^-1 with
    M = D rho cp V (Tang, Gupta and Varsamopoulos 2008).

    Args:
        config: The data center.
        path: File of the matrix, for errors.
        kind: R or D.
        matrix: Numbers of the file, (R, R).
        design: Design point with the airflow of the racks.

    Raises:
        ConfigError: naming the file and what is wrong with it.
    """
    shares = _shares_of_heat(config, path, matrix, design) if kind == "D" else matrix
    j, i = np.unravel_index(np.argmin(shares), shares.shape)
    if shares[j, i] < -_ROUND_OFF:
        raise ConfigError(
            f"{path}: rack {j} takes a share of {shares[j, i]:.3g} of its air from rack {i}; valid "
            "is at least 0"
        )
    shares = np.maximum(shares, 0.0)
    worst = int(np.argmax(shares.sum(axis=1)))
    total = float(shares[worst].sum())
    if total >= 1.0:
        raise ConfigError(
            f"{path}: row {worst} sums to {total:.6g}; valid is below 1, the rest being supply air"
        )
    return shares


def _shares_of_heat(config: DataCenterConfig, path: Path, matrix: F64, design: DesignPoint) -> F64:
    """R of D, R = M (1 + M)^-1 with M = D rho cp V, (R, R)."""
    j, i = np.unravel_index(np.argmin(matrix), matrix.shape)
    if matrix[j, i] < -_ROUND_OFF * np.max(np.abs(matrix)):
        raise ConfigError(f"{path}: D[{j}, {i}] is {matrix[j, i]:.3g} K/W; valid is at least 0")
    rise = matrix * (design.air_j_per_m3_k * design.airflow_m3s)
    try:
        shares = np.linalg.solve(np.eye(len(rise)) + rise.T, rise.T).T
    except np.linalg.LinAlgError:
        raise ConfigError(
            f"{path}: no R belongs to this D, since 1 + D rho cp V is singular; valid is D of "
            "a hall in which every rack gives its heat to the air"
        ) from None
    return np.asarray(shares, dtype=np.float64)


def _read_numbers(config: DataCenterConfig, path: Path) -> tuple[str, F64]:
    """Kind and numbers of a file, of whatever shape."""
    racks, wanted = config.hall.racks, config.hall.recirculation.matrix_kind
    if racks > MOST_MATRIX_RACKS:
        raise ConfigError(
            f"{path}: a matrix for {racks:,} racks; valid is at most {MOST_MATRIX_RACKS:,}"
        )
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise ConfigError(f"{path}: ends in {shortened(path.suffix)}; valid are .npz and .csv")
    if suffix == ".csv" and wanted is None:
        raise ConfigError(f"{path}: a .csv needs hall.recirculation.matrix_kind R or D")
    with open_input(path, MOST_MATRIX_BYTES, ConfigError) as file:
        if suffix == ".csv":
            return str(wanted), _read_csv(path, file)
        return _read_npz(path, file, racks, wanted)


def _read_npz(path: Path, file: BinaryIO, racks: int, wanted: str | None) -> tuple[str, F64]:
    """Kind and numbers of an .npz file, (racks, racks)."""
    if file.read(len(_NPY_MAGIC)) == _NPY_MAGIC:
        raise ConfigError(f"{path}: holds one array without a name; valid is an .npz with R or D")
    arrays = ArrayFile(file, path, ConfigError)
    kinds = [name for name in ("R", "D") if name in arrays.names]
    if len(kinds) != 1:
        raise ConfigError(
            f"{path}: holds {shortened(sorted(arrays.names))}; valid is one of the arrays R and D"
        )
    (kind,) = kinds
    if wanted not in (None, kind):
        raise ConfigError(f"{path}: holds {kind}, hall.recirculation.matrix_kind is {wanted}")
    shape, dtype = arrays.header(kind)
    if dtype.kind not in "fiu":
        raise ConfigError(f"{path}: {kind} holds {dtype}; valid are real numbers")
    _check_shape(path, kind, shape, racks)
    matrix = arrays.read(kind, math.prod(shape) * dtype.itemsize)
    return kind, np.asarray(matrix, dtype=np.float64)


def _read_csv(path: Path, file: BinaryIO) -> F64:
    """Numbers of a .csv file, of whatever shape."""
    with (
        io.TextIOWrapper(file, "utf-8-sig") as text,
        decoding(path, "rows of numbers separated by ','", ConfigError),
        warnings.catch_warnings(),
    ):
        # NumPy warns about a file without numbers, which the check of the shape refuses.
        warnings.simplefilter("ignore", UserWarning)
        lines = (line.strip() for line in text)
        return np.loadtxt(lines, delimiter=",", ndmin=2, dtype=np.float64)


def _check_shape(path: Path, kind: str, shape: tuple[int, ...], racks: int) -> None:
    if shape != (racks, racks):
        raise ConfigError(f"{path}: {kind} has shape {shape}, expected ({racks}, {racks})")
