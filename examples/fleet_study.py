"""Compute the carbon, in %, that eight sites save by sending work to each other.

    python examples/fleet_study.py
    python examples/fleet_study.py --weeks 27 --days 2 --flexible 0.2

Every variant of the fleet and every week is one fleet of a batch. Savings are in % of the carbon
of the same fleet whose work runs where and when it arrives: for bounds, plans and geo-mpc at the
cheapest setpoints, for rules at a fixed setpoint.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Simulator,
    View,
    load_config,
    make_configs,
    make_controller,
    simulate,
    with_values,
)
from sdc_taichi.control import Controller
from sdc_taichi.optimum.fleet import emissions_g, solve_fleet

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
REGIONS = (("GA", "NY", "VA"), ("IL", "TX"), ("AZ", "CA", "WA"))
SETPOINT_C = 22
TASK_KWH = 618 / 400
"""Energy that the facility of preset ``corrected`` needs for a task more, in kWh."""
QUEUE_H = {0.2: 2.5, 0.4: 5.0}
"""Longest queue by flexible share, in h."""
RULES = ("geo-all-to-cleanest", "geo-three-cleanest", "geo-all-cleaner", "geo-central")


def variants(sites: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the values of each variant of the fleet by its name."""
    free = {"link_share_per_hour": None, "transfer_kwh_per_task": 0.0}
    groups = [[s for s in region if s in sites] for region in REGIONS]
    named: dict[str, dict[str, Any]] = {"both": free}
    named["space"] = {**free, "queue_limit_h": 0.001}
    named |= {f"link {x}": {**free, "link_share_per_hour": x} for x in (0.2, 0.1, 0.05, 0.02)}
    ratios = (0.06, 0.3, 1, 2)
    named |= {f"ratio {x}": {**free, "transfer_kwh_per_task": x * TASK_KWH} for x in ratios}
    if all(len(group) > 1 for group in groups):
        named["3 regions"] = {**free, "residency": groups}
    return named


def fleet_of(
    flexible: float, week: int, sites: Sequence[str], values: dict[str, Any]
) -> list[DataCenterConfig]:
    """Return the data centers of a variant that begins in a week."""
    of_fleet = {k: v for k, v in values.items() if k != "queue_limit_h"}
    config = with_values(
        load_config("corrected"),
        {
            "site.start": str(np.datetime64("2018-01-01") + 7 * week)[5:],
            "hvac.setpoint.initial_c": SETPOINT_C,
            "workload.flexible_share": flexible,
            "workload.queue_limit_h": values.get("queue_limit_h", QUEUE_H.get(flexible, 5.0)),
            "fleet": {"sites": list(sites), **of_fleet},
        },
    )
    return make_configs(config)


class WithDrain:
    """A rule for transfers; queues drain as fast as capacity allows.

    Args:
        rule: controller that gives transfers.
    """

    commands = ("load", "transfer")

    def __init__(self, rule: Controller) -> None:
        self._rule = rule

    def reset(self, seed: Any) -> None:
        """Reset the rule."""
        self._rule.reset(seed)

    def act(self, view: View) -> Actions:
        """Return the transfers of the rule, and the command to drain."""
        return Actions(load=1.0, transfer=self._rule.act(view).transfer)


def study(
    flexible: float, weeks: Sequence[int], steps: int, sites: Sequence[str] = SITES
) -> dict[str, tuple[float, float]]:
    """Return bound and achieved savings of each variant and controller, in %; nan for none."""
    rows: dict[str, tuple[float, float]] = {}
    named = variants(sites)
    fleets = [fleet_of(flexible, week, sites, v) for v in named.values() for week in weeks]
    with Simulator([dc for fleet in fleets for dc in fleet]) as sim:
        best = solve_fleet(sim, steps=steps)
    staying, idle = (g.reshape(len(named), -1).sum(axis=1) for g in (best.cooled_g, best.idle_g))

    def saved(emitted: Any) -> list[float]:
        return list(100.0 * (1.0 - emitted.reshape(len(named), -1).sum(axis=1) / staying))

    alone = saved(best.stay_g)[0]
    rows["time"] = alone, np.nan
    pairs = zip(saved(best.bound_g), saved(best.achieved_g), strict=True)
    rows |= dict(zip(named, pairs, strict=True))
    # Without room in queues, no plan that moves work can be followed.
    rows["space"] = rows["space"][0], np.nan
    with Simulator([dc for fleet in fleets[: len(weeks)] for dc in fleet]) as sim:
        for name in (*RULES, "geo-mpc"):
            controller = make_controller(name, sim.fleet)
            of_rule = name in RULES
            if of_rule:
                controller = WithDrain(controller)
            sums = simulate(sim, controller, steps).sums
            emitted = emissions_g(sim, sums["carbon_g"], sums["transfer_g"], steps).sum()
            rows[name] = np.nan, 100.0 * (1.0 - emitted / (idle if of_rule else staying)[0])
    return rows


def main() -> None:
    """Print the table of the study."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--weeks", type=int, nargs="+", default=[3, 15, 27, 39])
    parser.add_argument("--days", type=float, default=7.0)
    parser.add_argument("--flexible", type=float, nargs="+", default=[0.2, 0.4])
    parser.add_argument("--sites", nargs="+", default=list(SITES))
    chosen = parser.parse_args()
    for flexible in chosen.flexible:
        print(f"\n| {100 * flexible:g} % flexible | bound | achieved |\n|---|---|---|")
        for name, (bound, achieved) in study(
            flexible, chosen.weeks, round(96 * chosen.days), chosen.sites
        ).items():
            print(f"| {name} | {bound:.2f} | {achieved:.2f} |".replace("nan", ""), flush=True)


if __name__ == "__main__":
    main()
