"""How well the model of CDUs repeats the measured liquid loop of the ESIF hall in Golden, Colorado.

    SDC_REAL_DATA=FOLDER python examples/esif_fit.py [--fit 201609 201705] [--pairs]

FOLDER/esif holds files NREL_HPCDC_yyyymm.csv, one row a minute: heat into air and into the liquid
loop (kW), and supply and return temperature of each (C). Five parameters are fitted to the months
that ``--fit`` names. The model then predicts each other month from total heat and water supply
alone, and the script prints how far it is from the measured return temperature and liquid share.
Each minute is computed for itself, as a steady state, so gaps and date formats do not matter.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from sdc_taichi.plant.liquid import (
    CduParameters,
    conductance_w_per_k,
    exchanger_ua_w_per_k,
    ua_share,
)

F64 = npt.NDArray[np.float64]
FITTED = ("201609", "201705")
DESIGN_W = 800e3
"""Heat for which the exchangers of the CDUs are sized, about the highest of a year."""


@dataclass(frozen=True)
class Month:
    """Minutes of one month that are free of faults, (minutes,)."""

    heat_w: F64
    """Heat into air and liquid, which is the electric power of all equipment."""
    supply_c: F64
    """Facility water entering the CDUs."""
    return_c: F64
    """Facility water leaving the CDUs."""
    liquid_w: F64
    """Heat into the facility water."""
    dropped: int
    """Rows left out: a value is missing, or a sensor reports no heat or no flow."""


@dataclass(frozen=True)
class Hall:
    """The five fitted parameters."""

    capture: float = 0.9
    """Share of the power of liquid-cooled racks that goes into their coolant."""
    air_only_w: float = 100e3
    """Power of equipment without liquid cooling."""
    setpoint_c: float = 30.0
    """Supply temperature that the valves of the CDUs hold in the secondary loop."""
    coolant_w_per_k: float = 1e5
    """Heat capacity flow of the secondary loop, whose pumps run at constant speed."""
    approach_k: float = 3.0
    """Secondary supply over facility supply at design heat and flow: size of the exchangers."""


def read_month(path: Path) -> Month:
    """Reads a file by the position of its columns; their names are not unique."""
    rows, dropped = [], 0
    with path.open(encoding="utf-8-sig", newline="") as file:
        for row in itertools.islice(csv.reader(file), 1, None):
            try:
                rows.append([float(cell) for cell in row[1:7]])
            except ValueError:
                dropped += 1
    values = np.array([row for row in rows if len(row) == 6]).reshape(-1, 6)
    air_kw, air_supply_c, air_return_c, liquid_kw, supply_c, return_c = values.T
    # A sensor that is down reports 0 F, which is -18 C, or heat of zero or less.
    valid = (air_kw > 0) & (liquid_kw > 0) & (air_supply_c > 0) & (supply_c > 0)
    valid &= (air_return_c > air_supply_c) & (return_c > supply_c)
    return Month(
        1e3 * (air_kw + liquid_kw)[valid],
        supply_c[valid],
        return_c[valid],
        1e3 * liquid_kw[valid],
        dropped + len(rows) - int(valid.sum()),
    )


def months(folder: Path) -> dict[str, Month]:
    """All months of a folder by their names, such as 201609."""
    return {path.stem[-6:]: read_month(path) for path in sorted(folder.glob("NREL_HPCDC_*.csv"))}


def liquid_w(hall: Hall, heat_w: F64) -> F64:
    """Heat of the liquid-cooled racks into their coolant."""
    return hall.capture * np.maximum(heat_w - hall.air_only_w, 0.0)


def return_c(hall: Hall, heat_w: F64, supply_c: F64) -> F64:
    """Facility water leaving the CDUs, whose valves hold the secondary supply at its setpoint."""
    into_w, rate = liquid_w(hall, heat_w), hall.coolant_w_per_k
    ua = exchanger_ua_w_per_k(DESIGN_W, rate, rate, approach_k=hall.approach_k)

    def resistance(at: F64) -> F64:
        """1/K at a flow of 1/at relative to design."""
        share = ua_share(
            1.0,
            1.0 / at,
            wall_share=CduParameters.wall_share,
            side_share=CduParameters.side_share,
        )
        return 1.0 / conductance_w_per_k(ua * share, rate, rate / at)

    wanted = np.maximum(hall.setpoint_c + into_w / rate - supply_c, 0.1) / np.maximum(into_w, 1.0)
    # Newton for the resistance over 1/flow, which is nearly a straight line.
    lowest, highest = 1.0 / CduParameters.max_valve, 1.0 / CduParameters.min_valve
    at = np.clip(rate * wanted, lowest, highest)
    for _ in range(6):
        value = resistance(at)
        slope = (resistance(at * (1 + 1e-5)) - value) / (1e-5 * at)
        at = np.clip(at + (wanted - value) / slope, lowest, highest)
    return supply_c + into_w * at / rate


def fit(data: Sequence[Month]) -> Hall:
    """Parameters by least squares of every tenth minute, robust to outliers.

    Heat comes first, since it does not depend on the loop; then the loop, with the heat that the
    model predicts rather than the measured one.
    """
    heat, supply, back, into = (
        np.concatenate([getattr(month, name)[::10] for month in data])
        for name in ("heat_w", "supply_c", "return_c", "liquid_w")
    )
    start = Hall()
    split = least_squares(
        lambda p: (liquid_w(Hall(p[0], 1e3 * p[1]), heat) - into) / 10e3,
        (start.capture, start.air_only_w / 1e3),
        loss="soft_l1",
    ).x
    capture, air_only_w = float(split[0]), 1e3 * float(split[1])
    loop = least_squares(
        lambda p: (
            (return_c(Hall(capture, air_only_w, p[0], 1e3 * p[1], p[2]), heat, supply) - back) / 0.3
        ),
        (start.setpoint_c, start.coolant_w_per_k / 1e3, start.approach_k),
        bounds=((20, 40, 0.3), (34, 500, 20)),
        loss="soft_l1",
    ).x
    return Hall(capture, air_only_w, float(loop[0]), 1e3 * float(loop[1]), float(loop[2]))


def errors(hall: Hall, month: Month) -> tuple[F64, F64]:
    """Model minus measurement in each minute: return temperature (K), liquid share of heat."""
    return (
        return_c(hall, month.heat_w, month.supply_c) - month.return_c,
        (liquid_w(hall, month.heat_w) - month.liquid_w) / month.heat_w,
    )


def rms(values: F64) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def lines(hall: Hall, data: dict[str, Month], fitted: Sequence[str]) -> Iterator[str]:
    """The parameters, and the errors of each month beside those of a constant.

    The constant is the mean return temperature, or share, of the months that were fitted.
    """
    yield (
        f"fitted to {', '.join(fitted)}: capture {hall.capture:.3f}, air only "
        f"{hall.air_only_w / 1e3:.0f} kW, setpoint {hall.setpoint_c:.1f} C, coolant "
        f"{hall.coolant_w_per_k / 1e3:.0f} kW/K, approach {hall.approach_k:.1f} K"
    )
    known = [data[name] for name in fitted]
    mean_c = float(np.mean(np.concatenate([m.return_c for m in known])))
    mean_share = float(np.mean(np.concatenate([m.liquid_w / m.heat_w for m in known])))
    for name, month in data.items():
        kelvin, share = errors(hall, month)
        constant = (rms(mean_c - month.return_c), rms(mean_share - month.liquid_w / month.heat_w))
        yield (
            f"  {name} {'fitted  ' if name in fitted else 'held out'}  return rms "
            f"{rms(kelvin):.2f} K, mean {kelvin.mean():+.2f} K, constant {constant[0]:.2f} K; "
            f"share rms {100 * rms(share):.1f}, mean {100 * share.mean():+.1f}, constant "
            f"{100 * constant[1]:.1f} points; {month.heat_w.size} minutes, {month.dropped} dropped"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the fit and the errors."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--fit", nargs="+", default=FITTED, metavar="yyyymm")
    parser.add_argument("--pairs", action="store_true", help="fit to each pair of months in turn")
    asked = parser.parse_args(arguments)
    root = os.environ.get("SDC_REAL_DATA")
    data = months(Path(root) / "esif") if root else {}
    if missing := sorted({*asked.fit} - {*data}):
        sys.exit(f"SDC_REAL_DATA={root or ''}: no file esif/NREL_HPCDC_{missing[0]}.csv")
    for names in itertools.combinations(data, 2) if asked.pairs else [tuple(asked.fit)]:
        print("\n".join(lines(fit([data[name] for name in names]), data, names)))


if __name__ == "__main__":
    main()
