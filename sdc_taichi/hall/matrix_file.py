"""Recirculation matrices that a user brings in a file: R of shares, or D of heat."""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import DesignPoint
from sdc_taichi.types import F64

MOST_MATRIX_RACKS = 8192
"""Most racks of a hall with a matrix of the user's: half a gigabyte in f64."""

_ROUND_OFF = 1e-9
"""Negative shares, and negative entries of D over the largest, that are no more than rounding."""


def read_matrix(config: DataCenterConfig, path: Path) -> tuple[str, F64]:
    """Kind, R or D, and numbers of a user's file, (R, R).

    An .npz file holds an array ``R`` or ``D``, a .csv file the numbers alone, one row per receiving
    rack, with ``hall.recirculation.matrix_kind``.

    Raises:
        ConfigError: naming the file and what is wrong with it.
    """
    kind, matrix = _read_numbers(config, path)
    racks = config.hall.racks
    if matrix.shape != (racks, racks):
        raise ConfigError(f"{path}: {kind} has shape {matrix.shape}, expected ({racks}, {racks})")
    if not np.all(np.isfinite(matrix)):
        j, i = np.argwhere(~np.isfinite(matrix))[0]
        raise ConfigError(f"{path}: {kind}[{j}, {i}] is {matrix[j, i]}; valid is a finite number")
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
    hall = config.hall
    air_j_per_m3_k = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
    rise = matrix * (air_j_per_m3_k * design.airflow_m3s)
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
        raise ConfigError(f"{path}: ends in {path.suffix!r}; valid are .npz and .csv")
    if suffix == ".csv" and wanted is None:
        raise ConfigError(f"{path}: a .csv needs hall.recirculation.matrix_kind R or D")
    try:
        if suffix == ".csv":
            return str(wanted), np.loadtxt(path, delimiter=",", ndmin=2, dtype=np.float64)
        with open(path, "rb") as raw:
            file = np.load(raw, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise ConfigError(
                    f"{path}: holds one array without a name; valid is an .npz with R or D"
                )
            found = [name for name in ("R", "D") if name in file.files]
            if len(found) != 1:
                raise ConfigError(
                    f"{path}: holds {sorted(file.files)}; valid is one of the arrays R and D"
                )
            if wanted not in (None, found[0]):
                raise ConfigError(
                    f"{path}: holds {found[0]}, hall.recirculation.matrix_kind is {wanted}"
                )
            matrix = file[found[0]]
    except (OSError, ValueError, EOFError, KeyError, BadZipFile) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: cannot be read as a matrix ({error})") from None
    if matrix.dtype.kind not in "fiu":
        raise ConfigError(f"{path}: {found[0]} holds {matrix.dtype}; valid are real numbers")
    return found[0], np.asarray(matrix, dtype=np.float64)
