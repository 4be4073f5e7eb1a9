"""Server temperatures and power over all racks of all data centers.

Servers of a rack that are alike form a group, which is computed once; ``expand`` copies its
values to per-server layers. Racks point into groups and groups into servers by offsets, so halls
may have any size. Every literal here is exact in binary, so that f64 runs lose nothing to the
default f32 literals of the runtime.

Row order of the two-dimensional arguments:

- ``groups`` (GROUP_ROWS, n_groups): count, full W, idle W, inlet offset K, load deviation
- ``dcs`` (DC_ROWS, n_dcs): see ``DC_ROWS``
- ``inputs`` (2, n_dcs): supply air C, utilisation
- ``rack_out`` (RACK_OUT, n_racks), ``group_out`` (GROUP_OUT, n_groups), ``dc_out`` (DC_OUT, n_dcs)
"""

from functools import cache
from typing import Any, no_type_check

from .backend import ti

GROUP_ROWS = ("count", "full_w", "idle_w", "inlet_offset_k", "load_deviation")
DC_ROWS = (
    "cpu_slope_per_k",
    "cpu_offset",
    "cpu_shift",
    "fan_slope_per_k",
    "fan_offset",
    "fan_shift",
    "fan_low",
    "fan_high",
    "fan_reference_ratio",
    "fan_exponent",
    "fan_reference_w",
    "fan_full_m3s",
    "air_j_per_m3_k",
    "curve_limit_c",
)
RACK_OUT = ("cpu_w", "fan_w", "airflow_m3s", "inlet_c", "inlet_max_c", "outlet_c")
GROUP_OUT = ("inlet_c", "outlet_c", "power_w")
DC_OUT = ("cpu_w", "fan_w", "airflow_m3s", "inlet_mean_c", "inlet_max_c", "outlet_mean_c")
OUTLET_MODELS = ("server", "rack", "released")

# A parallel loop of at most 512 iterations runs on one thread, so each slice of racks gets 512.
_BLOCK = 512


def _real(precision: str) -> Any:
    return {"f32": ti.f32, "f64": ti.f64}[precision]


@cache
def reduce_kernel(precision: str) -> Any:
    """Kernel that computes every group once and sums it per rack and per data center.

    Equations: CPU power max(idle, full*(slope*T + offset + shift*u)); airflow ratio
    y = clip(slope*T + offset + shift*u); fan power reference*(y/reference ratio)^exponent
    (Sun et al. 2021; EnergyPlus ElectricEquipment:ITE:AirCooled), T at most the curve limit.
    Utilisation of a group is u + deviation*u*(1 - u), which conserves the rack's work and stays
    within 0..1.
    Outlet: ``server`` is T + P/(rho*cp*V) per group, ``rack`` the same with the rack's sums, and
    ``released`` the rack fit T + 1.918*P^1.096/(0.526*rho*cp*V^0.824) - 14.01 of the released
    SustainDC, whose constants come in as ``fit``.
    """
    real = _real(precision)
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)
    doubles_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)

    @ti.kernel
    @no_type_check
    def reduce(
        outlet_model: ti.template(),
        write_groups: ti.template(),
        slices: ti.i32,
        group_start: ints_1d,
        rack_dc: ints_1d,
        rack_start: ints_1d,
        approach_k: reals_1d,
        groups: reals_2d,
        dcs: reals_2d,
        inputs: reals_2d,
        fit: reals_1d,
        rack_out: reals_2d,
        group_out: reals_2d,
        dc_out: doubles_2d,
    ):
        n_racks = rack_dc.shape[0]
        for k in range(slices * 512):
            if k % 512 == 0:
                first = ti.cast(ti.cast(k // 512, ti.i64) * n_racks // slices, ti.i32)
                last = ti.cast((ti.cast(k // 512, ti.i64) + 1) * n_racks // slices, ti.i32)
                for q in range(first, last):
                    n = rack_dc[q]
                    base = inputs[0, n] + approach_k[q]
                    u = inputs[1, n]
                    spread = u * (real(1.0) - u)
                    servers = real(0.0)
                    cpu = real(0.0)
                    fan = real(0.0)
                    flow = real(0.0)
                    inlet = real(0.0)
                    hottest = base + groups[3, group_start[q]]
                    heat = real(0.0)
                    for g in range(group_start[q], group_start[q + 1]):
                        t = base + groups[3, g]
                        load = u + groups[4, g] * spread
                        on_curve = ti.min(t, dcs[13, n])
                        ratio = dcs[0, n] * on_curve + dcs[1, n] + dcs[2, n] * load
                        cpu_1 = ti.max(groups[2, g], groups[1, g] * ratio)
                        y = ti.min(
                            ti.max(dcs[3, n] * on_curve + dcs[4, n] + dcs[5, n] * load, dcs[6, n]),
                            dcs[7, n],
                        )
                        speed = y / dcs[8, n]
                        fan_1 = dcs[10, n]
                        # A branch on data, not one kernel per exponent: compiled apart, they
                        # would round apart, and a data center must not depend on its batch.
                        if dcs[9, n] == real(3.0):
                            fan_1 *= speed * speed * speed
                        elif dcs[9, n] == real(1.0):
                            fan_1 *= speed
                        else:
                            fan_1 *= ti.pow(speed, dcs[9, n])
                        flow_1 = dcs[11, n] * y
                        many = groups[0, g]
                        servers += many
                        cpu += many * cpu_1
                        fan += many * fan_1
                        flow += many * flow_1
                        inlet += many * t
                        heat += many * flow_1 * t
                        hottest = ti.max(hottest, t)
                        if ti.static(write_groups):
                            group_out[0, g] = t
                            group_out[1, g] = t + (cpu_1 + fan_1) / (dcs[12, n] * flow_1)
                            group_out[2, g] = cpu_1 + fan_1
                    outlet = (heat + (cpu + fan) / dcs[12, n]) / flow
                    if ti.static(outlet_model == 1):
                        outlet = inlet / servers + (cpu + fan) / (dcs[12, n] * flow)
                    elif ti.static(outlet_model == 2):
                        outlet = (
                            inlet / servers
                            + fit[0]
                            * ti.pow(cpu + fan, fit[1])
                            / (fit[2] * dcs[12, n] * ti.pow(flow, fit[3]))
                            + fit[4]
                        )
                    if ti.static(write_groups and outlet_model != 0):
                        for g in range(group_start[q], group_start[q + 1]):
                            group_out[1, g] = outlet
                    rack_out[0, q] = cpu
                    rack_out[1, q] = fan
                    rack_out[2, q] = flow
                    rack_out[3, q] = inlet / servers
                    rack_out[4, q] = hottest
                    rack_out[5, q] = outlet
        for n in range(dc_out.shape[1]):
            cpu_dc = ti.cast(0.0, ti.f64)
            fan_dc = ti.cast(0.0, ti.f64)
            flow_dc = ti.cast(0.0, ti.f64)
            inlet_dc = ti.cast(0.0, ti.f64)
            outlet_dc = ti.cast(0.0, ti.f64)
            hottest_dc = ti.cast(rack_out[4, rack_start[n]], ti.f64)
            for q in range(rack_start[n], rack_start[n + 1]):
                cpu_dc += ti.cast(rack_out[0, q], ti.f64)
                fan_dc += ti.cast(rack_out[1, q], ti.f64)
                flow_dc += ti.cast(rack_out[2, q], ti.f64)
                inlet_dc += ti.cast(rack_out[3, q], ti.f64)
                outlet_dc += ti.cast(rack_out[5, q], ti.f64)
                hottest_dc = ti.max(hottest_dc, ti.cast(rack_out[4, q], ti.f64))
            racks = ti.cast(rack_start[n + 1] - rack_start[n], ti.f64)
            dc_out[0, n] = cpu_dc
            dc_out[1, n] = fan_dc
            dc_out[2, n] = flow_dc
            dc_out[3, n] = inlet_dc / racks
            dc_out[4, n] = hottest_dc
            dc_out[5, n] = outlet_dc / racks

    return reduce


@cache
def expand_kernel(precision: str) -> Any:
    """Kernel that copies the values of every group to its servers.

    It stores at the speed of memory into the caller's arrays, one per layer; no field, whose
    memory would outlive the simulator and whose kernels would be compiled per simulator.
    """
    real = _real(precision)
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    @no_type_check
    def expand(
        slices: ti.i32,
        server_start: ints_1d,
        group_out: reals_2d,
        inlet_c: reals_1d,
        outlet_c: reals_1d,
        power_w: reals_1d,
    ):
        n_groups = server_start.shape[0] - 1
        for k in range(slices * 512):
            if k % 512 == 0:
                first = ti.cast(ti.cast(k // 512, ti.i64) * n_groups // slices, ti.i32)
                last = ti.cast((ti.cast(k // 512, ti.i64) + 1) * n_groups // slices, ti.i32)
                for g in range(first, last):
                    inlet = group_out[0, g]
                    outlet = group_out[1, g]
                    power = group_out[2, g]
                    for s in range(server_start[g], server_start[g + 1]):
                        inlet_c[s] = inlet
                        outlet_c[s] = outlet
                        power_w[s] = power

    return expand
