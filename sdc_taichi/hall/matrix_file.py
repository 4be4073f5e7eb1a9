"""Reader of files with recirculation matrices of R racks.

Entry [j, i] of matrix ``R`` is the share of rack i's exhaust in the intake of rack j. Entry [j, i]
of matrix ``D`` is the temperature rise of rack j's intake by the power of rack i, in K/W.
"""

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
"""Largest number of racks of a hall with a matrix file; such a matrix takes 0.5 GB in f64."""
MOST_D_K_PER_W = 1000.0
"""Largest valid entry of D, in K/W."""

_NPY_MAGIC = b"\x93NUMPY"
_ROUND_OFF = 1e-9
"""Largest absolute value of a negative entry that counts as a rounding error. It applies to entries
of R, and to entries of D divided by the largest entry."""


def read_matrix(config: DataCenterConfig, path: Path) -> tuple[str, F64]:
    """Read a matrix file and return its kind, ``R`` or ``D``, and its numbers, (R, R).

    An .npz file contains an array ``R`` or ``D``. A .csv file contains only numbers, one row per
    receiving rack; ``hall.recirculation.matrix_kind`` gives its kind.

    Raises:
        ConfigError: The file is invalid; the message names the file and the error.
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
    """Return the matrix of exhaust shares for a matrix of kind ``R`` or ``D``, (R, R).

    D, in K/W, is defined by T_in = T_sup + D P at the design airflow. It follows that
    R = M (1 + M)^-1 with M = D rho cp V (Tang, Gupta and Varsamopoulos 2008).

    Args:
        config: The data center.
        path: Path of the matrix file, for error messages.
        kind: ``R`` or ``D``.
        matrix: Numbers of the file, (R, R).
        design: Design point with the airflow of the racks.

    Raises:
        ConfigError: The matrix is invalid; the message names the file and the error.
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
    """Return the exhaust shares R = M (1 + M)^-1 with M = D rho cp V, (R, R)."""
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
    """Read the kind and the numbers of a matrix file, without a check of a .csv file's shape."""
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
    """Read the kind and the numbers of an .npz file, (racks, racks)."""
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
    """Read the numbers of a .csv file, without a check of the shape."""
    with (
        io.TextIOWrapper(file, "utf-8-sig") as text,
        decoding(path, "rows of numbers separated by ','", ConfigError),
        warnings.catch_warnings(),
    ):
        # Suppress NumPy's warning about an empty file; the check of the shape reports an error.
        warnings.simplefilter("ignore", UserWarning)
        lines = (line.strip() for line in text)
        return np.loadtxt(lines, delimiter=",", ndmin=2, dtype=np.float64)


def _check_shape(path: Path, kind: str, shape: tuple[int, ...], racks: int) -> None:
    if shape != (racks, racks):
        raise ConfigError(f"{path}: {kind} has shape {shape}, expected ({racks}, {racks})")
