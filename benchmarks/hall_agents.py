"""Compare how much power rules for the CRAC units of a hall need, in steady states.

    python benchmarks/hall_agents.py [FOLDER] [--halls 6 16 64] [--servers NAME ...] [--quick]

compares rules for fan speeds and setpoints with the best commands found for each unit: fans that
follow the need of the racks, one speed and one setpoint for all, and local control, in which each
fan follows the hottest inlet of its own zone by PI (proportional and integral control). A figure is
the power of the facility above that of the best found, in % of the power of cooling (HVAC and fans
of the servers). The last table is the cliff: the cost of 2 % less air than racks need. Writes
``hall_agents.json`` to FOLDER and prints tables. ``--servers sustaindc`` gives the servers the
curves of preset ``sustaindc``, whose fans and processors draw more with every kelvin.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig, load_config
from sdc_taichi.control.unit_zones import UnitZones
from sdc_taichi.optimum.hall_search import FoundCommands, best_found, cost_w, found, one_speed
from sdc_taichi.optimum.uncoordinated import title_of, uncoordinated
from sdc_taichi.sim.commanded_halls import CommandedHalls, HallConditions
from sdc_taichi.sim.drivers import load_drivers
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.zone_loads import zone_of_rack
from sdc_taichi.types import F64

LIMIT_C = 27.0
"""Highest server inlet, in C."""
WEATHER_C = {"hot": (35.0, 24.0), "mild": (20.0, 15.0)}
"""Outdoor dry bulb and wet bulb, in C."""
LOADS = {
    ".6 even": (1, 1, [0.6]),
    ".9/.3": (1, 2, [0.9, 0.3]),
    "1/.47": (2, 2, [1.0, 0.4667, 0.4667, 0.4667]),
}
"""Blocks of rows, blocks of places, and their loads: halves of rows, or a quarter of the hall."""
CASES: dict[str, list[tuple[str, str, tuple[int, ...]]]] = {
    "6": [
        ("mild", ".6 even", ()),
        ("mild", ".9/.3", ()),
        ("hot", "1/.47", ()),
        ("hot", ".9/.3", (0,)),
    ],
    "64": [("mild", ".9/.3", ()), ("hot", "1/.47", ())],
}
CASES["16"] = CASES["6"]
PLANT = -1
"""Player that chooses the setpoint; the others are units by their number."""
SETPOINTS_C, TARGETS_C = (19.0, 20, 21, 22, 23, 24, 25), (25.0, 26, 26.5, 26.9)
"""Common setpoints and targets of the hottest inlet of a zone, in C, that local control tries."""
SENSOR_ERROR_K, SENSOR_DRAWS = 0.5, 4
"""Largest error of the sensors of a unit, in K, and number of draws."""
OVERSUPPLY_DECAY = 3.0
"""Decay of exhaust shares with oversupply in all cases, between the fitted 2.6 and 4."""
SUSTAINDC = (
    "servers.cpu_power_points=null", "servers.cpu_power_ratio_lb=[0.01, 1.0]",
    "servers.cpu_power_ratio_ub=[0.03, 1.02]",
)  # fmt: skip
"""Processors of preset ``sustaindc``."""
SUSTAINDC_FANS = (
    "servers.fan_airflow_ratio_lb=[0.01, 0.225]", "servers.fan_airflow_ratio_ub=[0.225, 1.0]",
    "servers.fan_airflow_ratio_limits=null",
)  # fmt: skip
"""Server fans of preset ``sustaindc``."""
CLIFF_HALL = (
    "hvac.crac.flow_model=controlled", "hall.recirculation.oversupply_decay=0",
    "hvac.crac.plenum_coupling=0", "hvac.crac.return_air=common", "hall.layout.containment=0.75",
)  # fmt: skip
"""Hall of fixed shares, in which excess air changes nothing."""
QUICK = {"generations": 4, "copies": 96, "pi_steps": 30, "pi_last": 10, "rounds": (1,)}
FULL = {"generations": 45, "copies": 96, "pi_steps": 130, "pi_last": 40, "rounds": (1, 10)}


@dataclass(frozen=True, slots=True)
class Row:
    """Excess power of the rules in one case, in % of the power of cooling; None if too warm."""

    hall: str
    """Number of CRAC units."""
    weather: str
    """Name of the weather."""
    load: str
    """Name of the loads."""
    down: tuple[int, ...]
    """Units that are down."""
    excess: dict[str, float | None]
    """Excess by rule."""
    alone: dict[str, float | None]
    """Excess by way of planning without coordination."""
    best: dict[str, Any]
    """Commands and results of the best found."""
    seconds: float
    """Time of the search, in s."""


class Case:
    """One hall in one weather, with one load and some units down."""

    def __init__(
        self, config: DataCenterConfig, weather: str, load: str, down: Sequence[int], effort: Any
    ) -> None:
        rows, places, loads = LOADS[load]
        zones = {"row_blocks": rows, "place_blocks": places, "fixed": loads}
        config = config.model_validate(
            config.model_dump() | {"workload": config.workload.model_dump() | {"zone_loads": zones}}
        )
        drivers, copies = load_drivers([config]), effort["copies"]
        self.effort = effort
        self.halls = CommandedHalls(config, drivers, copies)
        self.few = CommandedHalls(config, drivers, len(SETPOINTS_C) * len(TARGETS_C) + 1)
        self.following = CommandedHalls(config, drivers, 37, fans="follow_servers")
        running = np.ones(self.halls.units)
        running[list(down)] = 0.0
        self.conditions = HallConditions(
            np.array(loads)[zone_of_rack(config)], *WEATHER_C[weather], running
        )
        fleet = build_fleet(config)
        self.design_speed = float(fleet.design_speed[0])
        self.initial_c = config.hvac.setpoint.initial_c
        index = UnitZones(fleet).racks(running)
        self.zone_racks, self.zone_first = index.racks, index.first

    def follow(self, supply_c: F64) -> FoundCommands:
        """Fans that follow the need, at the best of some setpoints in C."""
        commands_c = np.repeat(supply_c[:, None], self.halls.units, axis=1)
        slowest = np.full_like(commands_c, self.halls.min_speed)
        states = self.following.at(slowest, commands_c, self.conditions)
        return found(states, int(np.argmin(cost_w(states, LIMIT_C))), commands_c, LIMIT_C)

    def local_control(self, setpoint_c: F64, target_c: F64, error_k: F64) -> list[FoundCommands]:
        """Fans by PI on the hottest inlets of their zones; means of the last steps.

        Args:
            setpoint_c: Common setpoint of each of m variants, in C, (m,).
            target_c: Target of the hottest inlet, in C, (m,).
            error_k: Errors of the sensors, in K, (m, U).
        """
        halls, effort = self.few, self.effort
        supply_c = np.repeat(setpoint_c[:, None], halls.units, axis=1)
        integral = np.full_like(supply_c, 0.75)
        speed, kept = integral.copy(), []
        for step in range(effort["pi_steps"]):
            states = halls.at(speed, supply_c, self.conditions)
            if step >= effort["pi_steps"] - effort["pi_last"]:
                kept.append((states, speed))
            hottest_c = np.maximum.reduceat(
                states.rack_inlet_max_c[:, self.zone_racks], self.zone_first, axis=1
            )
            above_k = np.clip(hottest_c + error_k - target_c[:, None], -2.0, 2.0)
            gain = 0.02 if step < 40 else 0.004
            integral = np.clip(integral + gain * above_k, halls.min_speed, 1.0)
            speed = np.clip(integral + 0.01 * above_k, halls.min_speed, 1.0)

        def mean(name: str) -> F64:
            return np.asarray(np.mean([getattr(states, name) for states, _ in kept], axis=0))

        power_w, inlet_c = mean("facility_w"), mean("inlet_max_c")
        speeds = np.mean([each for _, each in kept], axis=0)
        cost = power_w + 200e3 * np.maximum(inlet_c - LIMIT_C, 0.0)
        cooling_w = mean("cooling_w")
        return [
            FoundCommands(
                speeds[i], supply_c[i], float(cost[i]), float(power_w[i]), float(cooling_w[i]),
                float(inlet_c[i]),
            )
            for i in range(len(setpoint_c))
        ]  # fmt: skip

    def uncoordinated(self) -> dict[str, FoundCommands]:
        """Speeds of units and setpoint of the plant that each choose for the whole hall, alone.

        Each minimises the power of the facility with the penalty for inlets above the limit. Idle
        units run at the speed of the design point, and an idle plant holds the initial setpoint.
        """
        halls, idle_speed, idle_c = self.halls, self.design_speed, self.initial_c
        speeds = np.linspace(halls.min_speed, 1.0, halls.copies)
        setpoints_c = np.linspace(*halls.setpoint_c, 37)

        def commands(plans: Mapping[int, float], count: int) -> tuple[F64, F64]:
            speed = [plans.get(unit, idle_speed) for unit in range(halls.units)]
            supply_c = np.full((count, halls.units), plans.get(PLANT, idle_c))
            return np.tile(speed, (count, 1)), supply_c

        def best_response(player: int, plans: Mapping[int, float]) -> float:
            choices = setpoints_c if player == PLANT else speeds
            speed, supply_c = commands(plans, len(choices))
            if player == PLANT:
                supply_c[:] = choices[:, None]
            else:
                speed[:, player] = choices
            states = halls.at(speed, supply_c, self.conditions)
            return float(choices[np.argmin(cost_w(states, LIMIT_C))])

        def evaluate(plans: Mapping[int, float]) -> FoundCommands:
            speed, supply_c = commands(plans, 1)
            return found(halls.at(speed, supply_c, self.conditions), 0, supply_c, LIMIT_C)

        units = np.flatnonzero(self.conditions.running).tolist()
        ways = uncoordinated([*units, PLANT], best_response, self.effort["rounds"])
        plans: dict[str, dict[int, float]] = {"idle": {}, **ways}
        return {title_of(way) if way != "idle" else way: evaluate(x) for way, x in plans.items()}

    def row(self, hall: str, weather: str, load: str, down: tuple[int, ...]) -> Row:
        """Compare the rules in this case."""
        begin, units = time.perf_counter(), self.halls.units
        low_c, high_c = self.halls.setpoint_c
        rules = {
            "fixed 23 C": [self.follow(np.array([23.0]))],
            "setpoint reset, fans follow": [self.follow(np.linspace(low_c, high_c, 37))],
            "one speed, one setpoint": [one_speed(self.halls, self.conditions, LIMIT_C, grids=5)],
        }
        pairs_c = np.stack(np.meshgrid(SETPOINTS_C, TARGETS_C, indexing="ij")).reshape(2, -1)
        tried = np.concatenate([pairs_c, [[20.0], [26.0]]], axis=1)
        *tuned, fixed = self.local_control(tried[0], tried[1], np.zeros((tried.shape[1], units)))
        best = int(np.argmin([each.cost_w for each in tuned]))
        setpoint_c, target_c = pairs_c[:, best]
        errors_k = np.array(
            [
                np.random.default_rng(draw).uniform(-SENSOR_ERROR_K, SENSOR_ERROR_K, units)
                for draw in range(SENSOR_DRAWS)
            ]
        )
        rules["local PI, tuned"] = [tuned[best]]
        rules["local PI, sensors ±.5 K"] = self.local_control(
            np.full(SENSOR_DRAWS, setpoint_c),
            np.full(SENSOR_DRAWS, target_c - SENSOR_ERROR_K),
            errors_k,
        )
        rules["local PI, 20/26 C"] = [fixed]
        steady = [commands for each in rules.values() for commands in each]
        starts = sorted(steady, key=lambda commands: commands.cost_w)[:2]
        least = best_found(
            self.halls, self.conditions, starts, LIMIT_C,
            generations=self.effort["generations"], seed=0,
        )  # fmt: skip
        excess = {name: _excess(each, least, name) for name, each in rules.items()}
        alone = {way: _excess([c], least) for way, c in self.uncoordinated().items()}
        best_values = {
            "facility_kw": least.facility_w / 1e3,
            "cooling_kw": least.cooling_w / 1e3,
            "inlet_max_c": least.inlet_max_c,
            "speed": least.speed.round(3).tolist(),
            "supply_c": least.supply_c.round(2).tolist(),
            "tuned": [float(setpoint_c), float(target_c)],
            "tuned_speed": tuned[best].speed.round(3).tolist(),
        }
        seconds = time.perf_counter() - begin
        return Row(hall, weather, load, down, excess, alone, best_values, seconds)


def _excess(each: Sequence[FoundCommands], least: FoundCommands, rule: str = "") -> float | None:
    """Return the mean excess over the best found, in % of its cooling power; None if too warm."""
    if max(c.inlet_max_c for c in each) > LIMIT_C + 0.05 and "sensors" not in rule:
        return None
    above_w = float(np.mean([c.facility_w - least.facility_w for c in each]))
    return above_w / least.cooling_w * 100.0


def cliff(servers: str) -> list[dict[str, float]]:
    """Steady states of ``hall_of_2026`` at 60 % load and less and less air, 18 C supply."""
    values = [*CLIFF_HALL, *(() if servers == "preset" else (*SUSTAINDC, *SUSTAINDC_FANS))]
    config = load_config("hall_of_2026", values)
    drivers, units = load_drivers([config]), config.hvac.crac.units
    conditions = HallConditions(np.full(config.hall.racks, 0.6), *WEATHER_C["mild"], np.ones(units))
    shares = np.array([1.02, 1.0, 0.99, 0.98, 0.97])
    supply_c = np.full((len(shares), units), 18.0)
    following = CommandedHalls(config, drivers, 2, fans="follow_servers")
    need = following.at(np.full((1, units), 0.3), supply_c[:1], conditions).speed.max()
    halls = CommandedHalls(config, drivers, len(shares))
    states = halls.at(np.repeat(shares[:, None] * need, units, axis=1), supply_c, conditions)
    above_w = states.facility_w - states.facility_w[1]
    return [
        {
            "air": float(share),
            "speed": float(share * need),
            "facility_kw": float(states.facility_w[i] / 1e3),
            "cooling_kw": float(states.cooling_w[i] / 1e3),
            "excess_pct": float(100.0 * above_w[i] / states.cooling_w[1]),
            "inlet_max_c": float(states.inlet_max_c[i]),
        }
        for i, share in enumerate(shares)
    ]


def study(halls: Sequence[str], servers: str, effort: Any) -> list[Row]:
    """Compare the rules in the cases of some halls, named by their number of units."""
    rows = []
    for hall in halls:
        values = [f"hall.recirculation.oversupply_decay={OVERSUPPLY_DECAY}"]
        values += SUSTAINDC if servers == "sustaindc" else ()
        config = load_config(f"hall_agents_{hall}", values)
        for weather, load, down in CASES[hall]:
            case = Case(config, weather, load, down, effort)
            rows.append(case.row(hall, weather, load, down))
            print(table(rows[-1:]).splitlines()[-1], f"{rows[-1].seconds:.0f} s", flush=True)
    return rows


def table(rows: Sequence[Row], values: str = "excess") -> str:
    """Return the rows as a table in Markdown, with the values of ``excess`` or ``alone``."""
    names = list(getattr(rows[0], values))
    lines = ["| hall, weather, load | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for row in rows:
        down = ", one down" if row.down else ""
        cells = ["too warm" if v is None else f"{v:.1f}" for v in getattr(row, values).values()]
        label = f"{row.hall}, {row.weather}, {row.load}{down}"
        lines.append("| " + " | ".join([label, *cells]) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", nargs="?", default="build", type=Path)
    parser.add_argument("--halls", nargs="+", default=["6", "16", "64"], choices=list(CASES))
    parser.add_argument("--servers", nargs="+", default=["preset"], choices=["preset", "sustaindc"])
    parser.add_argument("--quick", action="store_true", help="few steps of each search")
    chosen = parser.parse_args()
    results: dict[str, Any] = {}
    for servers in chosen.servers:
        rows = study(chosen.halls, servers, QUICK if chosen.quick else FULL)
        states = cliff(servers)
        print(f"\nservers: {servers}\n\n{table(rows)}\n\n{table(rows, 'alone')}\n")
        for state in states:
            print(", ".join(f"{name} {value:.4g}" for name, value in state.items()))
        rows_values = [{name: getattr(row, name) for name in Row.__slots__} for row in rows]
        results[servers] = {"rows": rows_values, "cliff": states}
    chosen.folder.mkdir(parents=True, exist_ok=True)
    (chosen.folder / "hall_agents.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
