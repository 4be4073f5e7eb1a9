"""Print a table of the embedded years: energy, water, PUE, WUE and best setpoints at all sites.

    python docs/make/years.py [PRESET]

Each site runs a year of idle commands at every whole setpoint side by side. The best setpoint of
a month is that of the lowest facility energy.
"""

from __future__ import annotations

import sys

import numpy as np

from sdc_taichi import Actions, Simulator, load_config, with_values

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
STEPS_PER_HOUR = 4
MONTH_OF_STEP = np.repeat(
    np.arange(12), np.array([31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31]) * 24 * STEPS_PER_HOUR
)


def main(preset: str) -> None:
    """Print the table of a preset."""
    base = load_config(preset, ["site.start=01-01"])
    limits = base.hvac.setpoint
    setpoints = np.arange(np.ceil(limits.min_c), np.floor(limits.max_c) + 1)
    configs = [
        with_values(base, {"site.location": site, "hvac.setpoint.initial_c": float(setpoint)})
        for site in SITES
        for setpoint in setpoints
    ]
    shape = (12, len(SITES), setpoints.size)
    it_kwh, all_kwh, water_l = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    with Simulator(configs) as sim:
        sim.reset(seed=0)
        for month in MONTH_OF_STEP:
            result = sim.step(Actions())
            it_kwh[month] += result.it_kwh.reshape(shape[1:])
            all_kwh[month] += result.facility_kwh.reshape(shape[1:])
            water_l[month] += result.water_l.reshape(shape[1:])
    best = setpoints[all_kwh.argmin(axis=2)]
    initial = int(np.flatnonzero(setpoints == limits.initial_c)[0])
    print("| site | energy (MWh) | PUE | water (m3) | WUE (l/kWh) | best setpoint by month (C) |")
    print("|---|---|---|---|---|---|")
    for i, site in enumerate(SITES):
        it, energy, water = (x[:, i, initial].sum() for x in (it_kwh, all_kwh, water_l))
        months = " ".join(f"{x:.0f}" for x in best[:, i])
        print(
            f"| {site} | {energy / 1e3:,.0f} | {energy / it:.3f} | {water / 1e3:,.0f} |"
            f" {water / it:.2f} | {months} |"
        )


if __name__ == "__main__":
    main(*(sys.argv[1:] or ["corrected"]))
