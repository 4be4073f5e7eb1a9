"""Cost of halls with air in them against the flat hall and the memory roof, in one run.

    python benchmarks/thermal.py [--quick]

Each figure is one step of all data centers with its per-server layers, as core time per server:
``flat`` with constant approach temperatures, ``steady`` with quasi-steady recirculation,
``transient`` with SUBSTEPS substeps. The roof is a plain store of the three layers. Racks are alike
and loaded alike; in ``uneven`` hall the load of every rack is up to 10 % of full load off the mean,
so that the racks' exhausts are mixed in every sweep. Core time, since it does not depend on what
else the machine does.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import no_type_check

import numpy as np

from sdc_taichi import build_fleet, load_config, make_configs
from sdc_taichi.fleet import Fleet
from sdc_taichi.hall import Coil, Conditions, Hall

SIZES = ((4096, 20, 200), (256, 1000, 40), (1, 100_000, 40))
QUICK_SIZES = ((16, 20, 200), (2, 100, 40), (1, 400, 40))
SUBSTEPS = 15
HEADS = (
    "roof", "flat", "of roof", "steady", "to flat", "of roof", "transient", "to flat", "of roof",
    "uneven steady", "to flat", "uneven trans.", "to flat",
)  # fmt: skip


def fleet_of(n_dcs: int, racks: int, servers: int, inlet_model: str) -> Fleet:
    """A fleet of equal halls of one server type in five height zones."""
    rows = next(r for r in range(int(racks**0.5), 0, -1) if racks % r == 0)
    settings = [
        f"hall.rows={rows}",
        f"hall.racks_per_row={racks // rows}",
        f"hall.servers_per_rack={servers}",
        f"hall.inlet_model={inlet_model}",
        "hall.supply_approach_k=5.15",
        "hall.return_approach_k=-3.1",
        "hall.height_zones=5",
        "servers.power_w=[150, 10]",
    ]
    return build_fleet(make_configs(load_config("corrected", settings), count=n_dcs))


def core_s(call: Callable[[], object], repeats: int) -> float:
    """Least core time of several runs, s."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def roof_s(servers: int, repeats: int) -> float:
    """A plain store of three layers, s."""
    from sdc_taichi.kernels.backend import ti

    @ti.kernel
    @no_type_check
    def store(a: ti.template(), b: ti.template(), c: ti.template(), x: ti.f32):
        for i in a:
            a[i] = x
            b[i] = x
            c[i] = x

    fields = [ti.field(ti.f32) for _ in range(3)]
    builder = ti.FieldsBuilder()
    for field in fields:
        builder.dense(ti.i, servers).place(field)
    tree = builder.finalize()
    out = core_s(lambda: (store(*fields, 1.0), ti.sync()), repeats)
    tree.destroy()
    return out


def measure(n_dcs: int, racks: int, servers: int, repeats: int) -> tuple[float, ...]:
    """The figures of one line."""
    load, rng = np.linspace(0.1, 0.9, n_dcs), np.random.default_rng(0)
    flat = Hall(fleet_of(n_dcs, racks, servers, "approach"), "f32")
    met = Conditions(np.full(n_dcs, 18.0), load)
    layers = (flat.solve(met), flat.servers())[1]

    def expanded(hall: Hall, step: Callable[[], object]) -> float:
        return core_s(step, repeats) + core_s(lambda: hall.servers(layers), repeats)

    ns = 1e9 / (n_dcs * racks * servers)
    roof = roof_s(n_dcs * racks * servers, repeats) * ns
    flat_ns = expanded(flat, lambda: flat.solve(met)) * ns
    fleet = fleet_of(n_dcs, racks, servers, "recirculation")
    hall = Hall(fleet, "f32")
    at_units = Conditions(np.full(fleet.units, 18.0), load)
    uneven = replace(
        at_units,
        rack_load=np.clip(load[fleet.rack_dc] + rng.uniform(-0.1, 0.1, fleet.racks), 0.0, 1.0),
    )
    state = hall.settle(at_units)
    every = np.ones(n_dcs)
    coil = Coil(at_units.unit_supply_c, 0.0 * every, 1e9 * every, 1e12 * every, 500.0 * every)
    steady, transient = [], []
    for now in (at_units, uneven):
        steady.append(expanded(hall, lambda now=now: hall.solve(now)) * ns)  # type: ignore[misc]
    for now in (at_units, uneven):
        transient.append(
            expanded(
                hall,
                lambda now=now: hall.advance(now, state, coil, 900.0, 900.0 / SUBSTEPS),  # type: ignore[misc]
            )
            * ns
        )
    return (
        roof, flat_ns, roof / flat_ns,
        steady[0], steady[0] / flat_ns, roof / steady[0],
        transient[0], transient[0] / flat_ns, roof / transient[0],
        steady[1], steady[1] / flat_ns, transient[1], transient[1] / flat_ns,
    )  # fmt: skip


def main() -> None:
    """Print one line per size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, for correctness only")
    quick = parser.parse_args().quick
    from sdc_taichi import runtime

    threads = runtime.ensure_started()
    print(f"{threads} threads, f32, {SUBSTEPS} substeps; core time in ns per server")
    row = "{:>22}" + "".join(f" {{:>{max(len(head), 7)}}}" for head in HEADS)
    print(row.format("DCs x racks x servers", *HEADS))
    for size in QUICK_SIZES if quick else SIZES:
        figures = measure(*size, 3 if quick else 10)
        print(row.format(" x ".join(map(str, size)), *(f"{x:.2f}" for x in figures)), flush=True)


if __name__ == "__main__":
    main()
