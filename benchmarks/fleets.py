"""Speed of fleets that share work beside data centers alone: ``python benchmarks/fleets.py``."""

from __future__ import annotations

import argparse
import time

import numpy as np

from sdc_taichi import Actions, Simulator, load_config, make_configs


def main() -> None:
    """Measure both in turns, and print steps of data centers per second and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=512, help="fleets of eight sites")
    parser.add_argument("--steps", type=int, default=30, help="steps of a measurement")
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each")
    chosen = parser.parse_args()
    config = load_config("fleet_of_eight")
    fleets = make_configs(config, count=chosen.fleets)
    alone = [member.model_copy(update={"fleet": None}) for member in fleets]
    rng = np.random.default_rng(0)
    with Simulator(fleets) as together, Simulator(alone) as apart:
        shares = rng.uniform(0.0, 1.0, (together.size, together.fleet.sites_per_fleet))
        speeds = []
        for sim in (apart, together):
            sim.reset()
        for _ in range(chosen.rounds + 1):
            row = []
            for sim, transfer in ((apart, None), (together, shares)):
                actions = Actions(load=0.5, transfer=transfer)
                begin = time.perf_counter()
                for _ in range(chosen.steps):
                    sim.step(actions)
                row.append(sim.size * chosen.steps / (time.perf_counter() - begin))
            speeds.append(row)
        # The first round compiles.
        single, shared = np.median(speeds[1:], axis=0)
    print(f"{together.size} data centers alone: {single:,.0f} steps/s")
    print(f"{chosen.fleets} fleets: {shared:,.0f} steps/s, {100 * shared / single:.0f} %")


if __name__ == "__main__":
    main()
