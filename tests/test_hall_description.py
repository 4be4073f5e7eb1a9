"""What ``hall show`` says agrees with the calibration, with linear algebra and with the heat."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sdc_taichi import SdcError, load_config
from sdc_taichi.cli.hall import describe_hall, hall_app
from sdc_taichi.hall.rack_servers import air_properties
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.sim.design_hall import (
    EXACT_RADIUS_RACKS,
    DesignHall,
    design_hall_values,
    solve_design_hall,
)
from sdc_taichi.sim.inlet_parts import state_texts

WIDE = ["hall.supply_approach_k=5.15", "hall.return_approach_k=-3.1", "servers.power_w=[200, 20]"]

pytestmark = pytest.mark.filterwarnings("ignore:.*racks of more than 60 kW")


@pytest.fixture(scope="module")
def corrected() -> DesignHall:
    return solve_design_hall(load_config("corrected"))


def heat_closes(found: DesignHall) -> None:
    assert found.air is not None
    air = air_properties(found.config)
    carried_w = air.j_per_m3_k * found.unit_m3s.sum() * (found.air.return_c - found.supply_c)
    assert carried_w == pytest.approx(found.it_w.sum(), rel=1e-10)


def test_the_papers_hall_comes_out() -> None:
    config = load_config("corrected", ["hall.recirculation.calibrate=rack"])
    corrected = solve_design_hall(config)
    np.testing.assert_allclose(corrected.approach_k, config.hall.rack_approach_k(), atol=1e-9)
    assert corrected.air is not None
    assert corrected.air.return_c - corrected.outlet_c.mean() == pytest.approx(-3.1, abs=1e-9)
    np.testing.assert_allclose(
        corrected.air.exhaust_share, calibrate(config).exhaust_share, rtol=1e-9
    )
    heat_closes(corrected)
    # Racks alike: shares, bypass and RTI have a closed form.
    alike = solve_design_hall(
        load_config("corrected", [*WIDE, "hall.recirculation.calibrate=rack"])
    ).air
    assert alike is not None
    crac_rise_k = 1.0 / (air_properties(config).j_per_m3_k * 5.663e-5)
    rise_k = crac_rise_k - 5.15 + 3.10
    assert rise_k == pytest.approx(12.53, abs=0.01)
    share, ratio = 5.15 / (5.15 + rise_k), crac_rise_k / rise_k
    np.testing.assert_allclose(alike.exhaust_share, share, rtol=1e-9)
    assert alike.bypass_share == pytest.approx(1.0 - (1.0 - share) * ratio, abs=1e-9)
    assert alike.rti_pct == pytest.approx(100.0 * ratio, abs=1e-6)
    assert alike.shi == pytest.approx(share, abs=1e-9)


def test_spectral_radius_is_that_of_the_matrix(corrected: DesignHall) -> None:
    assert corrected.air is not None
    low, high = corrected.air.spectral_radius_bounds
    exact = float(np.abs(np.linalg.eigvals(calibrate(corrected.config).matrix())).max())
    assert low <= exact + 1e-12
    assert exact <= high + 1e-12
    assert high - low < 1e-8
    share = corrected.air.exhaust_share
    assert share.min() < exact < share.max()


def test_containment_warms_less_and_still_closes(corrected: DesignHall) -> None:
    closed = solve_design_hall(
        load_config("corrected", ["hall.layout.containment=0.8", "hvac.crac.units=3"])
    )
    assert corrected.air is not None
    assert closed.air is not None
    assert np.all(closed.approach_k < 0.3 * corrected.approach_k)
    assert closed.air.shi < 0.3 * corrected.air.shi
    # The units make up for the exhaust that the racks no longer breathe.
    need_m3s = np.sum((1.0 - closed.air.exhaust_share) * closed.airflow_m3s)
    design_m3s = need_m3s / (1.0 - 0.2 * corrected.air.bypass_share)
    # Exposure, and with it the bypass, is a little different behind containment.
    assert closed.unit_m3s.sum() == pytest.approx(design_m3s, rel=1e-3)
    heat_closes(closed)


@pytest.mark.parametrize("overrides", [["hall.layout.containment=1"], ["hall.supply_approach_k=0"]])
def test_no_recirculation_is_zero_of_no_sign(overrides: list[str]) -> None:
    found = solve_design_hall(load_config("corrected", [*overrides, "hvac.crac.units=3"]))
    assert found.air is not None
    for values in (
        found.approach_k,
        found.air.exhaust_share,
        np.array(found.air.spectral_radius_bounds),
    ):
        np.testing.assert_array_equal(values, 0.0)
        assert not np.signbit(values).any()
    text = describe_hall(found)
    assert "over supply 0.00 K" in text
    assert not re.search(r"-0\.?0*(?![0-9.])", text)


def test_approach_model_has_inlets_and_no_flows() -> None:
    found = solve_design_hall(load_config("tiny"))
    assert found.air is None
    np.testing.assert_allclose(
        design_hall_values(found)["approach_k"], found.config.hall.rack_approach_k(), atol=0.2
    )
    # Server 2 of rack 1 sits 0.4 K above its rack.
    assert (found.hottest_rack, found.hottest_server) == (1, 2)
    assert found.inlet_max_c.max() == pytest.approx(28.4)
    text = describe_hall(found)
    assert "return air" not in text
    assert "spectral" not in text
    assert "inlet model approach" in text


def test_radius_of_a_hall_too_large_to_iterate_is_bounded_by_its_rows() -> None:
    config = load_config("large", ["hall.rows=101"])
    assert config.hall.racks > EXACT_RADIUS_RACKS
    found = solve_design_hall(config)
    assert found.air is not None
    share = found.air.exhaust_share
    assert found.air.spectral_radius_bounds == (share.min(), share.max())


def show(*arguments: object) -> str:
    done = CliRunner().invoke(hall_app, ["show", *map(str, arguments)])
    if done.exception is not None:
        raise done.exception
    return done.stdout


def test_json_has_an_entry_per_rack_and_unit(corrected: DesignHall) -> None:
    values = json.loads(show("corrected", "hvac.crac.units=4", "--json"))
    assert {len(values[k]) for k in ("approach_k", "inlet_c", "rack_it_w", "exhaust_share")} == {20}
    assert [u["x_m"] for u in values["crac_units"]] == [0.0, 6.6, 0.0, 6.6]
    assert sum(u["airflow_m3s"] for u in values["crac_units"]) == pytest.approx(
        values["crac_flow_m3s"]
    )
    np.testing.assert_allclose(values["inlet_c"], corrected.inlet_c, atol=1e-9)
    assert values["hottest_inlet_c"] == pytest.approx(max(values["inlet_max_c"]))


def test_picture_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "new" / "plan.png"
    assert show("tiny", "--out", out).splitlines()[-1] == f"Floor plan: {out}"
    assert out.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SdcError, match="exists; choose another name or replace it with --force"):
        show("tiny", "--out", out)
    show("tiny", "--out", out, "--force")
    with pytest.raises(SdcError, match=r"valid is a name that ends in \.png"):
        show("tiny", "--out", tmp_path / "plan.jpg")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(SdcError, match="is a folder"):
        show("tiny", "--out", tmp_path / "folder.png")
    with pytest.raises(SdcError, match="cannot be written"):
        show("tiny", "--out", out / "below.png")
    assert [p.name for p in out.parent.iterdir()] == ["plan.png"]


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ([], "computed; the config gives means of a reference hall of even racks, open hall"),
        (["hall.recirculation.calibrate=rack"], "imposed rack by rack by the config, in the hall"),
    ],
)
def test_output_says_whether_approaches_are_imposed(settings: list[str], text: str) -> None:
    found = solve_design_hall(load_config("corrected", settings))
    assert f"approaches    {text}" in describe_hall(found)
    assert design_hall_values(found)["approaches"].startswith(text)
    assert text in " ".join(state_texts(found.inlets.parts(0)))


def test_hall_may_be_over_supplied() -> None:
    ample = ["hall.supply_approach_k=1.5", "hall.return_approach_k=-5"]
    found = solve_design_hall(load_config("corrected", ample))
    assert found.air is not None
    assert found.air.rti_pct == pytest.approx(81, abs=1)
    assert found.air.bypass_share > 0.2
    heat_closes(found)
