"""The halls of a fleet on the thermal kernel: supply air and load in, temperatures out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sdc_taichi import runtime
from sdc_taichi.errors import RuntimeStateError
from sdc_taichi.fleet import Fleet
from sdc_taichi.types import F64, Reals, ServerLayers

Precision = Literal["f32", "f64"]

_RELEASED_OUTLET_FIT = (1.918, 1.096, 0.526, 0.824, -14.01)
"""Rack outlet fit of the released SustainDC: factor, power exponent, divisor, flow exponent, K."""

_RACKS_PER_SLICE = 64
"""Fewer racks than this are not worth a thread of their own."""


@dataclass(frozen=True, slots=True)
class HallSums:
    """Sums and means of one evaluation: (B,) per data center, (R,) per rack."""

    cpu_w: F64
    fan_w: F64
    airflow_m3s: F64
    inlet_mean_c: F64
    inlet_max_c: F64
    outlet_mean_c: F64
    rack_cpu_w: Reals
    rack_fan_w: Reals
    rack_airflow_m3s: Reals
    rack_inlet_c: Reals
    rack_inlet_max_c: Reals
    rack_outlet_c: Reals


class Hall:
    """Kernel arguments of a fleet: plain arrays, given back with the object."""

    def __init__(self, fleet: Fleet, precision: Precision) -> None:
        threads = runtime.ensure_started()
        from sdc_taichi.kernels import thermal

        self._thermal = thermal
        self._precision = precision
        self._dtype = np.dtype(np.float32 if precision == "f32" else np.float64)
        self._fleet = fleet
        self._slices = max(1, min(8 * threads, fleet.racks // _RACKS_PER_SLICE))
        self._server_slices = max(1, min(8 * threads, fleet.servers // 4096))
        self._kernel = thermal.reduce_kernel(precision)
        self._outlet_model = thermal.OUTLET_MODELS.index(fleet.models["outlet"])
        self._groups = self._real(fleet.groups)
        self._dcs = self._real(fleet.dcs)
        self._approach_k = self._real(fleet.approach_k)
        self._fit = self._real(np.array(_RELEASED_OUTLET_FIT))
        self._inputs = np.zeros((2, fleet.size), self._dtype)
        self._no_groups = np.zeros((len(thermal.GROUP_OUT), 1), self._dtype)
        self._solved = False

    def _real(self, values: F64) -> Any:
        return np.ascontiguousarray(values, dtype=self._dtype)

    def solve(self, supply_c: F64, utilisation: F64) -> HallSums:
        """Temperatures and power at the given supply air (C) and utilisation, each (B,)."""
        self._inputs[0] = supply_c
        self._inputs[1] = utilisation
        self._solved = True
        racks, dcs = self._run(self._no_groups)
        return HallSums(*dcs, *racks)

    def servers(self, into: ServerLayers | None = None) -> ServerLayers:
        """Per-server layers of the last ``solve``, each (S,).

        Args:
            into: layers to overwrite and return; None allocates new ones.

        Raises:
            RuntimeStateError: before the first ``solve``.
        """
        if not self._solved:
            raise RuntimeStateError("no step has been done yet; server layers exist after one")
        group_out = np.empty((len(self._thermal.GROUP_OUT), self._groups.shape[1]), self._dtype)
        self._run(group_out)
        if into is None:
            into = ServerLayers(*(np.empty(self._fleet.servers, self._dtype) for _ in range(3)))
        expand = self._thermal.expand_kernel(self._precision)
        layers = (into.inlet_c, into.outlet_c, into.power_w)
        expand(self._server_slices, self._fleet.server_start, group_out, *layers)
        return into

    def forget(self) -> None:
        """Drop the last ``solve``, so that ``servers`` cannot show layers of another state."""
        self._solved = False

    def _run(self, group_out: Any) -> tuple[Any, Any]:
        runtime.ensure_started()
        fleet = self._fleet
        racks = np.empty((len(self._thermal.RACK_OUT), fleet.racks), self._dtype)
        dcs = np.empty((len(self._thermal.DC_OUT), fleet.size), np.float64)
        self._kernel(
            self._outlet_model,
            group_out is not self._no_groups,
            self._slices,
            fleet.group_start,
            fleet.rack_dc,
            fleet.rack_start,
            self._approach_k,
            self._groups,
            self._dcs,
            self._inputs,
            self._fit,
            racks,
            group_out,
            dcs,
        )
        return racks, dcs
