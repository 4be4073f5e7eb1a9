"""The benchmark at tiny size: what it writes, and whether its peer equals the kernel."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi import build_fleet, make_configs
from sdc_taichi.sim.hall_solver import Hall

pytestmark = pytest.mark.repo

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What one run writes."""
    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as out:
        patch.syspath_prepend(str(BENCHMARKS))
        patch.setattr(sys, "argv", ["bench.py", "--quick", "--out", str(folder)])
        bench, fresh = map(importlib.import_module, ("bench", "fresh"))
        in_new_process = bench.child

        def child(part: str, *arguments: Any, **variables: str) -> Any:
            """Runs in this process, which has the kernels, what needs no process of its own."""
            if part == "cycles":
                return in_new_process(part, *arguments, **variables)
            return fresh.PARTS[part](*arguments)

        patch.setattr(bench, "child", child)
        bench.main()
    written = json.loads((folder / "bench.json").read_text(encoding="utf-8"))
    # Every figure is printed as well.
    for figure in written["figures"]:
        assert figure["name"] in out.getvalue()
    return dict(written)


@pytest.mark.slow
def test_all_parts_are_measured_and_speed_is_judged_by_ratios(written: dict[str, Any]) -> None:
    figures, machine = written["figures"], written["machine"]
    assert machine["cpu"]
    assert len(machine["roof_gb_per_s_and_core"]) == 2
    parts = "kernel halls liquid calls environments optima planned scaling start recording"
    assert {f["part"] for f in figures} == set(parts.split())
    assert len({f["name"] for f in figures}) == len(figures)
    for figure in figures:
        if figure["value"] is None:
            assert figure["note"].startswith("skipped: "), figure
        else:
            assert np.isfinite(figure["value"]), figure
    with_target = [f for f in figures if f["target"]]
    assert len(with_target) > 20
    units = {"", "relative", "calls", "sweeps", "B/server", "MB", "kB"}
    assert {f["unit"] for f in with_target} <= units
    # At tiny size the agreement of the peer is judged alone.
    judged = [f for f in figures if f["met"] is not None]
    assert all(f["unit"] == "relative" and f["met"] for f in judged)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
@pytest.mark.parametrize("each_its_own", [False, True])
def test_the_peer_computes_what_the_kernel_computes(
    monkeypatch: pytest.MonkeyPatch, each_its_own: bool
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    peer, steps = map(importlib.import_module, ("peer", "steps"))
    if each_its_own:
        overrides = ["hall.inlet_model=approach", *steps.STRAIGHT_LINES]
        fleet = build_fleet(make_configs(steps.unlike(overrides, 7), count=3))
    else:
        fleet = steps.fleet_of(3, 10, 7, "approach")
    conditions = steps.conditions(fleet)
    hall = Hall(fleet, "f64")
    sums, layers = hall.solve(conditions), hall.servers()
    arguments = peer.Arguments(fleet, conditions)
    peer.c_step(arguments, 2)()
    for name in ("inlet_c", "outlet_c", "power_w"):
        np.testing.assert_allclose(
            getattr(arguments.layers, name), getattr(layers, name), rtol=2e-6
        )
    for column, name in enumerate(("cpu_w", "it_fan_w", "it_airflow_m3s")):
        np.testing.assert_allclose(arguments.sums[:, column], getattr(sums, name), rtol=2e-6)
    for column, name in enumerate(
        ("cpu_w", "fan_w", "airflow_m3s", "inlet_c", "inlet_max_c", "outlet_c")
    ):
        theirs, ours = arguments.racks[:, column], getattr(sums, f"rack_{name}")
        np.testing.assert_allclose(theirs, ours, rtol=2e-6, err_msg=name)
