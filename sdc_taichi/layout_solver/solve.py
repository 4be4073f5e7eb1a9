"""Layout solver: potential flow through a hall, transport of the rack exhausts, and temperatures.

It computes the shares of exhaust air in the intake of every rack for halls without a CFD study, and
the temperatures at the design point. docs/layout-solver.md describes the method and its limits.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.hall import air_metrics
from sdc_taichi.hall.design_point import design_point
from sdc_taichi.hall.matrix_file import MOST_MATRIX_RACKS
from sdc_taichi.hall.rack_servers import air_properties
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.compiler.arrays import aligned
from sdc_taichi.layout_solver.grid import DEFAULT_CELL_M, LEAST_LEAK, Grid, build_grid
from sdc_taichi.types import F64, I32

MIXING_M = 0.3
"""Eddy diffusivity divided by air speed, in m; the value is half the length of a floor tile. On
cells of less than 0.6 m the numerical diffusion of upwind differences is smaller than this, so
results do not depend on the cell length."""

_TAG_CELL_S, _CELL_S = 7e-7, 5e-5
"""Computing time of one thread for one tag, and of all other systems, in s per cell, on a server
processor of 2023."""

_TOLERANCE = 1e-13
"""Tolerance of linear systems: norm of the residual divided by that of the right-hand side."""
_MOST_ITERATIONS = 20_000
"""Largest number of iterations for one linear system."""


class SolverProgress(Protocol):
    """Callback ``(done, total, expected_s)`` of the layout solver."""

    def __call__(self, done: int, total: int, expected_s: float) -> None:
        """Show the progress.

        Args:
            done: Number of solved tags; 0 before the first system.
            total: Number of all tags.
            expected_s: Expected computing time of the whole solution, in s.
        """


@dataclass(frozen=True, slots=True)
class LayoutSolution:
    """Air and temperatures of a hall of R racks at its design point."""

    R: F64
    """Share of each source rack's exhaust (columns) in each rack's intake (rows), (R, R)."""
    supply_share: F64
    """Share of air from the floor tiles in the intake of each rack, (R,)."""
    approach_k: F64
    """Inlet temperature of each rack minus supply air, in K, (R,)."""
    supply_c: float
    """Supply air temperature, in C."""
    return_c: float
    """Return air temperature, in C."""
    shi: float
    """Supply heat index, see ``air_metrics.shi``."""
    rhi: float
    """Return heat index, see ``air_metrics.rhi``."""
    rti_pct: float
    """Return temperature index, in %, see ``air_metrics.rti``."""
    rci_hi_pct: float
    """Rack cooling index at the high end against the allowable range of the ASHRAE class, in %."""
    rci_lo_pct: float
    """Rack cooling index at the low end against the allowable range of the ASHRAE class, in %."""
    mass_residual: float
    """Sum of the cells' absolute mass imbalances, divided by the supply airflow."""
    share_residual: float
    """Largest deviation from 1 of the sum of a row of R and the rack's share of supply air."""
    energy_residual: float
    """Absolute difference of return heat and IT power, divided by IT power. It is the larger value
    of two computations: with R, and with temperatures solved directly on the grid."""
    direct_difference_k: float
    """Largest difference of inlets computed with R and inlets solved on the grid, in K."""
    cells: int
    """Number of air cells."""
    seconds: float
    """Computing time of the solution, in s."""
    provenance: dict[str, Any]
    """Provenance of the matrix, to be stored in its file."""


def solve(
    config: DataCenterConfig,
    *,
    airflow_m3s: F64,
    power_w: F64,
    supply_m3s: float,
    supply_c: float,
    cell_m: float = DEFAULT_CELL_M,
    progress: SolverProgress | None = None,
) -> LayoutSolution:
    """Solve the airflow and the temperatures of a hall.

    The airflow is a potential flow: div(grad phi) = 0 in the air, with given flows through rack
    faces, floor tiles and returns. A scalar tag c for each rack is 1 in its exhaust and 0 in all
    other air that enters the hall; it obeys div(u*c) = div(MIXING_M*|u|*grad c). The tags give R.
    Inlets follow from T_in = T_sup + R (T_out - T_sup) and T_out = T_in + P/(rho*cp*V) (Tang, Gupta
    and Varsamopoulos 2008). For comparison, the temperatures are also solved directly on the grid.

    Args:
        config: Configuration of the data center.
        airflow_m3s: Airflow of each rack, m3/s, (R,).
        power_w: IT power of each rack, W, (R,).
        supply_m3s: Total airflow of the CRAC units, m3/s.
        supply_c: Supply air temperature, C.
        cell_m: Largest cell length, m.
        progress: Callback, called before the first system and after each part of the tags.

    Raises:
        ConfigError: The cell length is out of range, or there are too many cells or racks.
        SdcError: A linear system cannot be solved to the tolerance.
    """
    start_s = time.perf_counter()
    hall = config.hall
    if hall.racks > MOST_MATRIX_RACKS:
        raise ConfigError(
            f"{config.name}: {hall.racks:,} racks; the layout solver takes at most "
            f"{MOST_MATRIX_RACKS:,}, the largest matrix that a hall can use"
        )
    grid = build_grid(hall, airflow_m3s, supply_m3s, cell_m)
    air = _GridAir(grid, airflow_m3s, progress)
    mass_residual = air.find_flow() / supply_m3s
    R, supply_share, returned_m3s = air.exhaust_shares()

    rise_k = power_w / (air_properties(config).j_per_m3_k * airflow_m3s)
    approach_k: F64 = np.asarray(np.linalg.solve(np.eye(hall.racks) - R, R @ rise_k), np.float64)
    returned_m3k_s = float(returned_m3s @ (approach_k + rise_k))
    direct_k, direct_m3k_s = air.temperatures(rise_k)
    it_m3k_s = float(airflow_m3s @ rise_k)
    return_c = supply_c + returned_m3k_s / supply_m3s
    return LayoutSolution(
        R=R,
        supply_share=supply_share,
        approach_k=approach_k,
        supply_c=float(supply_c),
        return_c=return_c,
        **_indices(config, airflow_m3s, supply_c, return_c, supply_c + approach_k, rise_k),
        mass_residual=mass_residual,
        share_residual=float(np.abs(R.sum(axis=1) + supply_share - 1.0).max()),
        energy_residual=max(
            abs(m3k_s / it_m3k_s - 1.0) for m3k_s in (returned_m3k_s, direct_m3k_s)
        ),
        direct_difference_k=float(np.abs(direct_k - approach_k).max()),
        cells=grid.cells,
        seconds=time.perf_counter() - start_s,
        provenance=_provenance(config, grid, cell_m, supply_m3s, supply_c),
    )


def _indices(
    config: DataCenterConfig,
    airflow_m3s: F64,
    supply_c: float,
    return_c: float,
    inlet_c: F64,
    rise_k: F64,
) -> dict[str, float]:
    """Compute the indices of air management, by their names in ``LayoutSolution``.

    Args:
        config: Configuration with the ASHRAE class of the servers.
        airflow_m3s: Airflow of each rack, m3/s, (R,).
        supply_c: Supply air temperature, C.
        return_c: Return air temperature, C.
        inlet_c: Inlet temperature of each rack, C, (R,).
        rise_k: Temperature rise through each rack, K, (R,).
    """
    inlet = air_metrics.rise_m3k_s(airflow_m3s, inlet_c, supply_c)
    outlet = air_metrics.rise_m3k_s(airflow_m3s, inlet_c + rise_k, supply_c)
    flow_m3s = float(airflow_m3s.sum())
    it_rise_k = air_metrics.it_rise_k(inlet, outlet, flow_m3s)
    low_c, high_c = air_metrics.allowable_c(config.protection.ashrae_class)
    over_k, under_k = air_metrics.over_27_sum_k(inlet_c), air_metrics.under_18_sum_k(inlet_c)
    racks = len(inlet_c)
    return {
        "shi": float(air_metrics.shi(inlet, outlet, flow_m3s)),
        "rhi": float(air_metrics.rhi(inlet, outlet, flow_m3s)),
        "rti_pct": float(air_metrics.rti(return_c, supply_c, it_rise_k)),
        "rci_hi_pct": float(air_metrics.rci_hi(over_k, racks, allowable_c=high_c)),
        "rci_lo_pct": float(air_metrics.rci_lo(under_k, racks, allowable_c=low_c)),
    }


class _GridAir:
    """Linear systems of a grid of N cells and R racks, for flow, exhaust tags and temperatures.

    Args:
        grid: Grid with the flows through its boundaries.
        airflow_m3s: Airflow of each rack, m3/s, (R,).
        progress: Callback; None shows nothing.
    """

    def __init__(self, grid: Grid, airflow_m3s: F64, progress: SolverProgress | None) -> None:
        self._threads = runtime.ensure_started()
        from sdc_taichi.kernels import airflow
        from sdc_taichi.kernels.compiler.launch import run_once

        self._kernels, self._run = airflow, run_once
        self._grid = grid
        self._racks = len(airflow_m3s)
        slices = min(self._threads, self._racks // airflow.LANES + 1)
        tags_s = _TAG_CELL_S * (self._racks + 1) / slices
        self._expected_s = grid.cells * (tags_s + _CELL_S)
        self._progress = progress
        self._tell(0)
        fronts = grid.fronts
        self._front_share = fronts.m3s / np.repeat(airflow_m3s, np.diff(fronts.face_offsets))
        # Coefficients of the transport of tags, see ``kernels.airflow``.
        self._off_diagonal = np.zeros_like(grid.conductance_m)
        self._diagonal = np.zeros(grid.cells)

    def _tell(self, done: int) -> None:
        """Call the progress callback with the number of solved tags."""
        if self._progress is not None:
            self._progress(done, self._racks + 1, self._expected_s)

    def find_flow(self) -> float:
        """Solve the flow potential and compute the transport coefficients of the tags.

        Returns:
            Sum of the cells' absolute mass imbalances, m3/s.
        """
        grid = self._grid
        diagonal = grid.conductance_m[:-1].sum(axis=1)
        # With given flows at all boundaries, the potential has a free constant. This term fixes it.
        diagonal[-1] *= 2.0
        entering = -grid.boundary_m3s[:-1].sum(axis=1)
        cells = np.arange(grid.cells, dtype=np.int32)
        offsets = np.array([0, grid.cells], np.int32)
        potential = self._solve(grid.conductance_m, diagonal, offsets, cells, entering, "potential")
        imbalance_m3s = np.empty(grid.cells)
        self._run(
            self._kernels.transport_kernel(),
            beyond=grid.beyond,
            conductance_m=grid.conductance_m,
            boundary_m3s=grid.boundary_m3s,
            area_m2=grid.area_m2,
            mixing_m=MIXING_M,
            potential_m2s=potential.first_solution,
            speed_ms=np.zeros(grid.cells + 1),
            imbalance_m3s=imbalance_m3s,
            off_diagonal=self._off_diagonal,
            diagonal=self._diagonal,
        )
        return float(np.abs(imbalance_m3s).sum())

    def exhaust_shares(self) -> tuple[F64, F64, F64]:
        """Solve one tag for the exhaust of each rack, and one for the supply air.

        Returns:
            Matrix of exhaust shares, (R, R), share of supply air in the intake of each rack, (R,),
            and flow of each rack's exhaust into the returns, m3/s, (R,).
        """
        grid, backs = self._grid, self._grid.backs
        end = backs.face_offsets[-1] + len(grid.supply_cell)
        offsets = np.append(backs.face_offsets, end).astype(np.int32)
        cell = np.concatenate([backs.cell, grid.supply_cell])
        amount = np.concatenate([backs.m3s, grid.supply_m3s])
        tags = self._solve(self._off_diagonal, self._diagonal, offsets, cell, amount, "tags")
        # Exact shares are not negative; remove rounding errors and negative zeros.
        shares = np.maximum(tags.intake, 0.0)
        return shares[:, :-1].copy(), shares[:, -1].copy(), tags.returned[:-1]

    def temperatures(self, rise_k: F64) -> tuple[F64, float]:
        """Solve the temperatures on a grid in which air flows through the racks.

        Args:
            rise_k: Temperature rise through each rack, K, (R,).

        Returns:
            Inlet minus supply temperatures, K, (R,), and the sum over the returns of flow times
            return minus supply temperature, m3 K/s.
        """
        backs = self._grid.backs
        amount = backs.m3s * np.repeat(rise_k, np.diff(backs.face_offsets))
        offsets = np.array([0, len(amount)], np.int32)
        temperatures = self._solve(
            self._off_diagonal,
            self._diagonal,
            offsets,
            backs.cell,
            amount,
            "temperatures",
            through_racks=True,
        )
        return temperatures.intake[:, 0], float(temperatures.returned[0])

    def _solve(
        self,
        off_diagonal: F64,
        diagonal: F64,
        source_offsets: I32,
        source_cell: I32,
        source: F64,
        what: str,
        *,
        through_racks: bool = False,
    ) -> _SystemSolution:
        """Solve a linear system for T right-hand sides, see ``kernels.airflow``.

        Args:
            off_diagonal: Coefficients of the neighbouring cells, (N + 1, 6).
            diagonal: Coefficient of each cell, (N,).
            source_offsets: Index of the first source of each right-hand side, and the number of
                sources, (T + 1,).
            source_cell: Cell of each source, (sources,).
            source: Value that each source adds to the right-hand side of its cell, (sources,).
            what: Name of the right-hand sides, for error messages.
            through_racks: True if the mean value at a rack's front also enters the cells at its
                back.

        Raises:
            SdcError: A linear system cannot be solved to the tolerance.
        """
        grid, kernels = self._grid, self._kernels
        right_sides = len(source_offsets) - 1
        lanes = kernels.LANES if right_sides > kernels.FEW_LANES else kernels.FEW_LANES
        slices = min(self._threads, -(-right_sides // lanes))
        vectors = kernels.WORK_VECTORS + through_racks
        work = aligned((slices, vectors, grid.cells + 1, lanes), np.float64)
        inverse_pivot = np.empty((slices, grid.cells + 1))
        solution = _SystemSolution(
            first_solution=np.empty(grid.cells + 1),
            intake=np.empty((self._racks, right_sides)),
            returned=np.empty(right_sides),
            relative_residual=np.empty(right_sides),
            iterations=np.empty(right_sides, np.int32),
        )
        # One vector of right-hand sides for each thread at a time, to show the progress.
        for first in range(0, right_sides, slices * lanes):
            part = slice(first, min(first + slices * lanes, right_sides))
            count = part.stop - first
            groups = -(-count // lanes)
            intake = aligned((self._racks, groups, lanes), np.float64)
            returned, residual, iterations = aligned((3, groups, lanes), np.float64)
            self._run(
                kernels.bicgstab_kernel(lanes),
                serial=False,
                through_racks=int(through_racks),
                slices=slices,
                most_iterations=_MOST_ITERATIONS,
                tolerance=_TOLERANCE,
                beyond=grid.beyond,
                off_diagonal=off_diagonal,
                diagonal=diagonal,
                front_offsets=grid.fronts.face_offsets,
                front_cell=grid.fronts.cell,
                front_share=self._front_share,
                back_offsets=grid.backs.face_offsets,
                back_cell=grid.backs.cell,
                back_m3s=grid.backs.m3s,
                source_offsets=source_offsets[first : part.stop + 1],
                source_cell=source_cell,
                source=source,
                work=work,
                inverse_pivot=inverse_pivot,
                return_cell=grid.return_cell,
                return_m3s=grid.return_m3s,
                first_solution=solution.first_solution,
                intake=intake,
                returned=returned,
                relative_residual=residual,
                iterations=iterations,
            )
            solution.intake[:, part] = intake.reshape(self._racks, -1)[:, :count]
            solution.returned[part] = returned.reshape(-1)[:count]
            solution.relative_residual[part] = residual.reshape(-1)[:count]
            solution.iterations[part] = iterations.reshape(-1)[:count]
            if right_sides > 1:
                self._tell(part.stop)
        residual, iterations = solution.relative_residual, solution.iterations
        worst = int(np.argmax(np.where(np.isfinite(residual), residual, np.inf)))
        if not residual[worst] <= 100 * _TOLERANCE:
            raise SdcError(
                f"layout solver: {what} {worst} of {right_sides} stopped at a residual of "
                f"{residual[worst]:.3g} after {iterations[worst]} iterations; valid is at most "
                f"{100 * _TOLERANCE:g}: change cell_m, or measures of very different size"
            )
        return solution


@dataclass(frozen=True, slots=True)
class _SystemSolution:
    """Solution of a linear system for T right-hand sides.

    Values have the unit of the sources divided by that of flow.
    """

    first_solution: F64
    """Values of the cells for the first right-hand side, (N + 1,)."""
    intake: F64
    """Mean value at the front of each rack, (R, T)."""
    returned: F64
    """Sum over the returns of flow times value, (T,)."""
    relative_residual: F64
    """Norm of the residual divided by that of the right-hand side, (T,)."""
    iterations: I32
    """Number of iterations for each right-hand side, (T,)."""


def solve_at_design_point(
    config: DataCenterConfig,
    cell_m: float = DEFAULT_CELL_M,
    progress: SolverProgress | None = None,
) -> LayoutSolution:
    """Solve airflow and temperatures of a hall at full load and design supply temperature.

    Args:
        config: The data center.
        cell_m: Largest cell length, m.
        progress: Callback, see ``solve``.

    Raises:
        ConfigError: The outlet model is not ``server``, the cell length is out of range, or there
            are too many cells or racks.
        SdcError: A linear system cannot be solved to the tolerance.
    """
    outlets = config.servers.outlet_model
    if outlets != "server":
        raise ConfigError(
            f"{config.name}: servers.outlet_model {outlets}: hall solve heats the air of every "
            "server by its own power; valid is server"
        )
    hall = config.hall
    # With containment, the CRAC airflow depends on the remaining recirculation.
    contained = hall.layout.containment > 0 and hall.inlet_model == "recirculation"
    design = calibrate(config).design if contained else design_point(config)
    return solve(
        config,
        airflow_m3s=design.airflow_m3s,
        power_w=design.it_w,
        supply_m3s=design.crac_flow_m3s,
        supply_c=design.supply_c,
        cell_m=cell_m,
        progress=progress,
    )


def _provenance(
    config: DataCenterConfig, grid: Grid, cell_m: float, supply_m3s: float, supply_c: float
) -> dict[str, Any]:
    """Return the provenance of a matrix, without a date: equal solutions give equal files."""
    hall = config.hall
    return {
        "package": f"sdc-taichi {version('sdc-taichi')}",
        "solver": "potential flow, hybrid differences, BiCGSTAB with diagonal incomplete LU",
        "config": config.name,
        "config_sha256": hashlib.sha256(config.to_yaml().encode()).hexdigest(),
        "rows": hall.rows,
        "racks_per_row": hall.racks_per_row,
        "layout": hall.layout.model_dump(mode="json"),
        "cell_m": cell_m,
        "cells": grid.cells,
        "grid": [len(width) for width in grid.widths_m],
        "mixing_m": MIXING_M,
        "least_leak": LEAST_LEAK,
        "supply_m3s": supply_m3s,
        "supply_c": supply_c,
        "tolerance": _TOLERANCE,
    }
