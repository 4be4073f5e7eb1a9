"""Forecasts that err: for controllers of runs, and for those that act beside learners."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import sdc_taichi
from sdc_taichi import ConfigError, ForecastError, RuntimeStateError, Simulator, load_config
from sdc_taichi.cli.app import app
from sdc_taichi.control import Forecast, View, view_maker
from sdc_taichi.control.view import walk_keys
from sdc_taichi.envs.core import Core
from sdc_taichi.envs.features import CI_LEADS_H, WEATHER_LEADS_H, feature_slices
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.types import F64, Actions

ERROR = ForecastError(ci_share=0.1, temperature_k=2.0)
SITES = ("NY", "CA")


def configs() -> list[Any]:
    return [load_config("tiny", [f"name={s}", f"site.location={s}"]) for s in SITES]


class Listener:
    """Controller that keeps the carbon intensities and dry bulbs it has been forecast."""

    def __init__(self) -> None:
        self.seen: list[tuple[F64, F64]] = []

    def reset(self, seed: Any) -> None:
        self.seen = []

    def act(self, view: View) -> Actions:
        coming = view.forecast(24.0)
        self.seen.append((coming.ci_g_per_kwh, coming.outdoor_c))
        return Actions()


def heard(sim: Simulator, seed: int, error: ForecastError = ERROR) -> F64:
    """Carbon intensities and dry bulbs of a run of some steps, (steps, 2, B, n)."""
    listener = Listener()
    sdc_taichi.simulate(sim, listener, 6, seed, forecast_error=error)
    return np.array(listener.seen)


@pytest.fixture(scope="module")
def sim() -> Any:
    with Simulator(configs()) as made:
        made.reset(0)
        yield made


def test_forecasts_of_runs_follow_the_seed_and_not_the_batch(sim: Simulator) -> None:
    first, again, other = heard(sim, 3), heard(sim, 3), heard(sim, 4)
    np.testing.assert_array_equal(first, again)
    perfect = heard(sim, 3, ForecastError())
    np.testing.assert_array_equal(first[..., 0], perfect[..., 0])
    errors = first / perfect - 1.0
    assert np.all(errors[:, 0, :, -1] != (other / perfect - 1.0)[:, 0, :, -1])
    assert errors[0, 0, 0, -1] != pytest.approx(errors[0, 0, 1, -1])
    for dc, config in enumerate(configs()):
        with Simulator([config]) as alone:
            np.testing.assert_array_equal(heard(alone, 3)[:, :, 0], first[:, :, dc])


def test_both_temperatures_err_alike_and_prices_do_not(sim: Simulator) -> None:
    sim.reset(0)
    seen, true = (view_maker(sim, error)(None).forecast(24.0) for error in (ERROR, ForecastError()))
    assert np.all(seen.wet_bulb_c <= seen.outdoor_c)
    np.testing.assert_allclose(
        seen.wet_bulb_c - true.wet_bulb_c, seen.outdoor_c - true.outdoor_c, atol=1e-12
    )
    assert np.max(np.abs(seen.outdoor_c - true.outdoor_c)) > 0.1
    np.testing.assert_array_equal(seen.price_per_kwh, true.price_per_kwh)


def test_carbon_intensity_is_cut_at_zero(sim: Simulator) -> None:
    drivers, index = sim.drivers, np.zeros((2, 3), dtype=np.int64)
    seen = Forecast(drivers, index, ci_error=np.full((2, 3), -2.0))
    np.testing.assert_array_equal(seen.ci_g_per_kwh, 0.0)


def test_agents_and_controllers_beside_them_see_the_same_errors() -> None:
    options = EnvOptions(agents=("agent_ls",), days=1, forecast_error=ERROR)
    core = Core(configs(), options)
    columns = feature_slices(core.features["agent_ls"])
    for seed in (5, 6, 5):
        observations = core.reset(seed)
        for _ in range(3):
            seen: Any = observations["agent_ls"]
            coming = core.view.forecast(24.25)
            ci = coming.ci_g_per_kwh[:, [round(4 * h) for h in CI_LEADS_H]]
            np.testing.assert_allclose(seen[:, columns["ci_forecast"]] * 1000, ci, rtol=1e-5)
            outdoor_c = coming.outdoor_c[:, [round(4 * h) for h in WEATHER_LEADS_H]]
            of_agent_c = seen[:, columns["outdoor_forecast"]] * 80 - 30
            np.testing.assert_allclose(of_agent_c, outdoor_c, atol=1e-4)
            observations = core.step({"agent_ls": np.ones(2, dtype=np.int64)}).observations
    core.close()


def test_view_of_an_earlier_step_says_that_it_is_too_old(sim: Simulator) -> None:
    sim.reset(0)
    look = view_maker(sim, ERROR)
    early = look(None)
    for _ in range(300):
        late = look(sim.step())
    late.forecast(24.0)
    with pytest.raises(RuntimeStateError, match="reset starts again"):
        early.forecast(24.0)


def test_walks_of_equal_seeds_differ_by_name() -> None:
    keys = walk_keys(np.array([0, 0, 1]), ["a", "b", "a"])
    assert len(set(keys.tolist())) == 3
    assert keys.min() >= 0


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("ci=0.1,temperature=1", ForecastError(0.1, 1.0)),
        ("temperature=2.5", ForecastError(0.0, 2.5)),
        (" ci = 0 ", ForecastError()),
    ],
)
def test_text_of_errors(text: str, wanted: ForecastError) -> None:
    assert ForecastError.parse(text) == wanted


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "valid is ci=SHARE, temperature=K"),
        ("0.1", "valid is ci=SHARE, temperature=K"),
        ("temprature=1", "did you mean 'temperature'"),
        ("ci=0.1,ci=0.2", "ci is given twice"),
        ("ci=ten", "ci 'ten' is no number"),
        ("ci=11", "ci_share: 11; valid is 0..10"),
        ("ci=nan", "valid is 0..10|is no number"),
        ("temperature=-1", "temperature_k: -1; valid is 0..40"),
    ],
)
def test_text_that_is_not_valid(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ForecastError.parse(text)


def test_command_line_records_the_errors(tmp_path: Path) -> None:
    def run(out: str, *more: str) -> Any:
        arguments = ["simulate", "tiny", "--days", "1", "--controller", "lookahead-24h", "--quiet"]
        done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / out), *more])
        assert done.exit_code == 0, done.output
        return json.loads((tmp_path / out / "metrics.json").read_text())

    erring = run("erring", "--forecast-error", "ci=1,temperature=1")
    assert erring["forecast_error"] == {"ci_share": 1.0, "temperature_k": 1.0}
    perfect = run("perfect")
    assert perfect["forecast_error"] == {"ci_share": 0.0, "temperature_k": 0.0}
    assert perfect["total"]["cfp_kg"] != erring["total"]["cfp_kg"]
