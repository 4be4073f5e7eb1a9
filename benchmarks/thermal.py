"""Speed of the server kernels as ratios to the memory roof of the same machine, in one run.

    python benchmarks/thermal.py [--quick]

The roof is a plain store of the three per-server layers, measured beforehand. ``reduce`` computes
all groups and sums them per rack and per data center; ``expand`` writes the per-server layers;
``alike`` racks are one group each, in ``mixed`` racks every server is a group of its own.
"""

import argparse
import time
from collections.abc import Callable
from typing import no_type_check

import numpy as np

from sdc_taichi import build_fleet, load_config, make_configs
from sdc_taichi.fleet import Fleet
from sdc_taichi.hall import Hall

SIZES = ((4096, 20, 200), (256, 1000, 40), (1, 100_000, 40))
Z = 5
QUICK_SIZES = ((16, 20, 200), (2, 100, 40), (1, 400, 40))


def fleet_of(n_dcs: int, racks: int, servers: int, *, mixed: bool) -> Fleet:
    """A fleet of equal halls."""
    rng = np.random.default_rng(0)
    rows = next(r for r in range(int(racks**0.5), 0, -1) if racks % r == 0)
    settings = [
        f"hall.rows={rows}",
        f"hall.racks_per_row={racks // rows}",
        f"hall.servers_per_rack={servers}",
        "hall.supply_approach_k=5.15",
        "hall.return_approach_k=-3.1",
        "servers.power_w=[150, 10]",
        f"hall.height_zones={Z}",
    ]
    if mixed:
        nameplates = rng.integers(120, 400, servers)
        rack = [{"count": 1, "full_w": int(w), "idle_w": 20} for w in nameplates]
        settings.append(f"servers.groups=[{rack}]")
    return build_fleet(make_configs(load_config("corrected", settings), count=n_dcs))


def best_of(call: Callable[[], object], repeats: int) -> float:
    """Shortest of several runs, s."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Print one line per size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, for correctness only")
    quick = parser.parse_args().quick
    from sdc_taichi import runtime
    from sdc_taichi.kernels.backend import ti

    threads = runtime.ensure_started()

    @ti.kernel
    @no_type_check
    def store(a: ti.template(), b: ti.template(), c: ti.template(), x: ti.f32):
        for i in a:
            a[i] = x
            b[i] = x
            c[i] = x

    print(f"threads {threads}; times in ns per server; share of roof = roof time / time")
    row = "{:>24} {:>8} {:>8} {:>8} {:>8} {:>10} {:>8} {:>10}"
    heads = ("roof", "expand", "share", "alike", "to expand", "mixed", "to roof")
    print(row.format("DCs x racks x servers", *heads))
    for n_dcs, racks, servers in QUICK_SIZES if quick else SIZES:
        total = n_dcs * racks * servers
        repeats = 3 if quick else 10
        fields = [ti.field(ti.f32) for _ in range(3)]
        builder = ti.FieldsBuilder()
        for field in fields:
            builder.dense(ti.i, total).place(field)
        tree = builder.finalize()
        roof = best_of(lambda: (store(*fields, 1.0), ti.sync()), repeats)  # noqa: B023
        tree.destroy()
        alike = Hall(fleet_of(n_dcs, racks, servers, mixed=False), "f32")
        supply, load = np.full(n_dcs, 18.0), np.linspace(0.1, 0.9, n_dcs)
        reduce_alike = best_of(lambda: alike.solve(supply, load), repeats)  # noqa: B023
        layers = alike.servers()
        expand = best_of(lambda: alike.servers(layers), repeats)  # noqa: B023
        mixed = Hall(fleet_of(n_dcs, racks, servers, mixed=True), "f32")
        reduce_mixed = best_of(lambda: mixed.solve(supply, load), repeats)  # noqa: B023
        ns = 1e9 / total
        figures = (
            roof * ns,
            expand * ns,
            roof / expand,
            reduce_alike * ns,
            reduce_alike / expand,
            reduce_mixed * ns,
            reduce_mixed / roof,
        )
        print(row.format(f"{n_dcs} x {racks} x {servers}", *(f"{x:.3f}" for x in figures)))


if __name__ == "__main__":
    main()
