"""Which fixed setpoint uses least power, over weather and load, with each preset.

    python examples/setpoint_study.py FOLDER

writes FOLDER/best_setpoint.png and prints the tables. Every grid point is one data center of a
fleet, held at its setpoint for one step at constant weather and demand.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sdc_taichi import Simulator, drivers_from_arrays, load_config
from sdc_taichi.config import apply_overrides

DRY_BULB_ABOVE_WET_K = 5.0
WET_BULBS_C = np.arange(-5.0, 28.0, 1.0)
UTILISATIONS = np.arange(0.2, 1.01, 0.05)


def power_kw(
    preset: str,
    wet_bulb_c: npt.ArrayLike,
    utilisation: npt.ArrayLike,
    setpoint_c: npt.ArrayLike,
    overrides: tuple[str, ...] = (),
) -> npt.NDArray[np.float64]:
    """Facility power on the grid, shape (wet bulbs, utilisations, setpoints).

    Args:
        preset: name of a preset or path of a config.
        wet_bulb_c: outdoor wet bulbs; the dry bulb is 5 K above.
        utilisation: demands as a share of capacity.
        setpoint_c: setpoints within the preset's range.
        overrides: further ``a.b=c`` assignments.
    """
    wet, load, setpoints = (
        np.asarray(x, dtype=np.float64) for x in (wet_bulb_c, utilisation, setpoint_c)
    )
    common = ["hvac.sizing.design_wet_bulb_c=26", "workload.max_utilisation=1.0", *overrides]
    base = load_config(preset, common)
    held = [apply_overrides(base, [f"hvac.setpoint.initial_c={s}"]) for s in setpoints]
    grid = [(w, u, s) for w in wet for u in load for s in range(len(setpoints))]
    configs = [
        held[s].model_copy(update={"name": f"{w:g} C, {u:.0%}, {setpoints[s]:g} C"})
        for w, u, s in grid
    ]
    weather = np.array([[w] for w, _, _ in grid])
    drivers = drivers_from_arrays(
        weather + DRY_BULB_ABOVE_WET_K,
        weather,
        np.zeros_like(weather),
        np.array([[u] for _, u, _ in grid]),
    )
    with Simulator(configs, drivers=drivers, precision="f64") as sim:
        sim.reset()
        result = sim.step()
    return ((result.it_w + result.overhead_w) / 1e3).reshape(len(wet), len(load), len(setpoints))


def main(folder: Path) -> None:
    """Draw the figure and print the tables."""
    from matplotlib.figure import Figure

    wet_bulb, load = WET_BULBS_C, UTILISATIONS
    studies = {
        "corrected": (np.arange(16.0, 23.01, 0.5), ()),
        "sustaindc": (np.append(np.arange(15.0, 21.6, 0.5), 21.6), ("site.location=CA",)),
    }
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, (preset, (setpoints, overrides)) in zip(axes, studies.items(), strict=True):
        power = power_kw(preset, wet_bulb, load, setpoints, overrides)
        best = setpoints[power.argmin(axis=2)]
        gain = 100.0 * (power.max(axis=2) / power.min(axis=2) - 1.0)
        image = axis.pcolormesh(
            load, wet_bulb, best, cmap="cividis", vmin=15, vmax=23, shading="nearest"
        )
        axis.set(title=f"preset {preset}", xlabel="utilisation")
        print(
            f"{preset}: best setpoint C (rows wet bulb, columns utilisation), worst over best in %"
        )
        for w in range(0, len(wet_bulb), 4):
            cells = " ".join(
                f"{best[w, u]:5.1f} ({gain[w, u]:4.1f})" for u in range(0, len(load), 4)
            )
            print(f"{wet_bulb[w]:6.0f}  {cells}")
    axes[0].set_ylabel("outdoor wet bulb (C)")
    figure.colorbar(image, ax=axes, label="setpoint of least facility power (C)")
    figure.savefig(folder / "best_setpoint.png", dpi=110)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/setpoint_study.py FOLDER")
    main(Path(sys.argv[1]))
