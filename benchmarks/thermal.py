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
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from yardsticks import core_s, plain_store

from sdc_taichi import build_fleet, load_config, make_configs
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Coil, Conditions, Hall

SIZES = ((4096, 20, 200), (256, 1000, 40), (1, 100_000, 40))
QUICK_SIZES = ((4, 20, 200), (1, 400, 40))
STEP_S, SUBSTEPS = 900.0, 15


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


def measure(n_dcs: int, racks: int, servers: int, repeats: int) -> dict[str, float]:
    """Core time of a step in ns per server, by what is computed."""
    load = np.linspace(0.1, 0.9, n_dcs)
    flat = Hall(fleet_of(n_dcs, racks, servers, "approach"), "f32")
    alike = Conditions(np.full(n_dcs, 18.0), load)
    flat.solve(alike)
    layers = flat.servers()

    fleet = fleet_of(n_dcs, racks, servers, "recirculation")
    hall = Hall(fleet, "f32")
    off = np.random.default_rng(0).uniform(-0.1, 0.1, fleet.racks)
    uneven = replace(alike, rack_load=np.clip(load[fleet.rack_dc] + off, 0.0, 1.0))
    settled = hall.steady_state(alike)
    none, ample = np.zeros(n_dcs), np.full(n_dcs, 1e12)
    coil = Coil(
        setpoint_c=alike.unit_supply_c,
        room_j=none,
        room_j_per_k=np.full(n_dcs, 1e9),
        limit_w=ample,
        fan_w_per_m3s=np.full(n_dcs, 500.0),
    )

    def advance(met: Conditions) -> object:
        return hall.advance(met, settled, coil, STEP_S, STEP_S / SUBSTEPS)

    in_all = n_dcs * racks * servers
    steps: dict[str, Callable[[], object]] = {
        "roof": plain_store(in_all),
        "flat": lambda: (flat.solve(alike), flat.servers(layers)),
        "steady": lambda: (hall.solve(alike), hall.servers(layers)),
        "uneven steady": lambda: (hall.solve(uneven), hall.servers(layers)),
        "transient": lambda: (advance(alike), hall.servers(layers)),
        "uneven transient": lambda: (advance(uneven), hall.servers(layers)),
    }
    spent_s = core_s(steps, repeats)
    return {name: float(1e9 * np.median(spent) / in_all) for name, spent in spent_s.items()}


def row(ns: dict[str, float]) -> list[tuple[str, float]]:
    """Heads and figures of one line."""
    out = [("roof", ns["roof"]), ("flat", ns["flat"]), ("of roof", ns["roof"] / ns["flat"])]
    for name in ("steady", "transient"):
        out.append((name, ns[name]))
        out.append(("to flat", ns[name] / ns["flat"]))
        out.append(("of roof", ns["roof"] / ns[name]))
    for name, head in (("uneven steady", "uneven steady"), ("uneven transient", "uneven trans.")):
        out += [(head, ns[name]), ("to flat", ns[name] / ns["flat"])]
    return out


def main() -> None:
    """Print one line per size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, for correctness only")
    quick = parser.parse_args().quick
    from sdc_taichi.kernels.compiler import runtime

    threads = runtime.ensure_started()
    print(f"{threads} threads, f32, {SUBSTEPS} substeps; core time in ns per server")
    for number, size in enumerate(QUICK_SIZES if quick else SIZES):
        cells = row(measure(*size, repeats=1 if quick else 10))
        if number == 0:
            heads = "".join(f" {head:>{max(len(head), 7)}}" for head, _ in cells)
            print(f"{'DCs x racks x servers':>22}{heads}")
        figures = "".join(f" {value:>{max(len(head), 7)}.2f}" for head, value in cells)
        print(f"{' x '.join(map(str, size)):>22}{figures}", flush=True)


if __name__ == "__main__":
    main()
