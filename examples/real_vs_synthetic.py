"""A year of every site on measured files beside the embedded synthetic year.

    SDC_REAL_DATA=FOLDER python examples/real_vs_synthetic.py > docs/real-vs-synthetic.md

FOLDER holds weather/*.epw, carbon/XX_NG_&_avgCI.csv and workload/Alibaba_CPU_Data_Hourly_1.csv.
Idle controller, preset corrected; the measured and the synthetic year of a site run side by side,
in plants of the same sizes.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sdc_taichi import DataCenterConfig, Simulator, load_config
from sdc_taichi.config.hvac_schema import HvacConfig
from sdc_taichi.exogenous import read_epw
from sdc_taichi.exogenous.series import DesignConditions
from sdc_taichi.exogenous.synthetic import synthetic_sites

QUANTITIES = ("it_kwh", "hvac_kwh", "grid_kwh", "carbon_g", "water_l")


def real_files(folder: Path, site: str) -> dict[str, str]:
    """Weather, carbon and workload file of a site in FOLDER."""
    patterns = {
        "weather_file": f"weather/USA_{site}_*.epw",
        "carbon_file": f"carbon/{site}_NG_*.csv",
        "workload_file": "workload/Alibaba_CPU_Data_Hourly_1.csv",
    }
    found = {key: sorted(folder.glob(pattern)) for key, pattern in patterns.items()}
    missing = [patterns[key] for key, paths in found.items() if not paths]
    if missing:
        raise FileNotFoundError(f"{folder}: no file {', '.join(missing)}")
    return {key: str(paths[0]) for key, paths in found.items()}


def pairs_of_configs(folder: Path, steps_per_hour: int) -> list[DataCenterConfig]:
    """Measured and synthetic data center of every site, in turn."""
    base = load_config("corrected", [f"simulation.steps_per_hour={steps_per_hour}"])
    configs = []
    for site in synthetic_sites():
        measured = real_files(folder, site)
        hvac = _sized_for(base.hvac, read_epw(measured["weather_file"]).design)
        for name, files in (("measured", measured), ("synthetic", {})):
            where = base.site.model_copy(update={"location": site, **files})
            update = {"name": f"{site}-{name}", "site": where, "hvac": hvac}
            configs.append(base.model_copy(update=update))
    return configs


def _sized_for(hvac: HvacConfig, design: DesignConditions | None) -> HvacConfig:
    """Section ``hvac`` with the design conditions of a weather file."""
    if design is None:
        return hvac
    weather = {"design_outdoor_c": design.outdoor_c, "design_wet_bulb_c": design.wet_bulb_c}
    return hvac.model_copy(update={"sizing": hvac.sizing.model_copy(update=weather)})


def year(configs: list[DataCenterConfig], steps: int) -> dict[str, npt.NDArray[np.float64]]:
    """Sums of QUANTITIES over the run, each (data centers,)."""
    with Simulator(configs) as sim:
        sim.reset()
        sums = {name: np.zeros(sim.size) for name in QUANTITIES}
        for _ in range(steps):
            result = sim.step()
            for name in QUANTITIES:
                sums[name] += getattr(result, name)
    return sums


def table(configs: list[DataCenterConfig], sums: dict[str, npt.NDArray[np.float64]]) -> str:
    """Markdown: measured, synthetic and difference in % for every site."""
    rows = {
        "IT (MWh)": sums["it_kwh"] / 1e3,
        "HVAC (MWh)": sums["hvac_kwh"] / 1e3,
        "PUE": 1.0 + sums["hvac_kwh"] / sums["it_kwh"],
        "CFP (t)": sums["carbon_g"] / 1e6,
        "water (m3)": sums["water_l"] / 1e3,
    }
    lines = ["| site | " + " | ".join(rows) + " |", "|---|" + "---|" * len(rows)]
    for index in range(0, len(configs), 2):
        cells = []
        for name, values in rows.items():
            real, made = values[index], values[index + 1]
            digits = 3 if name == "PUE" else 0
            cells.append(
                f"{real:.{digits}f} / {made:.{digits}f} ({100 * (made / real - 1):+.1f} %)"
            )
        lines.append(f"| {configs[index].site.location} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the page."""
    if "SDC_REAL_DATA" not in os.environ:
        sys.exit("set SDC_REAL_DATA to the folder of the measured files")
    configs = pairs_of_configs(Path(os.environ["SDC_REAL_DATA"]), steps_per_hour=4)
    print("# Measured and synthetic years\n")
    print(
        "One year of each site at 15-minute steps, preset `corrected`, idle controller, trace "
        "`alibaba_1`: measured files / embedded synthetic year (difference). Made by "
        "`examples/real_vs_synthetic.py`.\n"
    )
    print(table(configs, year(configs, 4 * 8760)))
    print(
        "\nThe synthetic year is fitted to hourly statistics of weather, carbon intensity and "
        "workload ([data.md](data.md)), not to these results. The measured Alibaba file repeats "
        "one week; the synthetic trace has the same distribution and does not repeat."
    )


if __name__ == "__main__":
    main()
