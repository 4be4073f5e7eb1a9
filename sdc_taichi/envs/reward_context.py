"""Inputs of reward terms beside the result of a step, computed when a term reads them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.envs.coming_means import coming_means
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.types import F64, I64

END_OF_DAY_START_H = 23.0
"""Hour of the day from which queued tasks cost, more and more (paper, F.1)."""
COMING_H = 24
"""Hours over whose mean intensity or price waiting work and stored energy are valued."""
COMING_SERIES = {"coming_ci": "ci_g_per_kwh", "coming_price": "price_per_kwh"}
"""Series whose coming means are values of the context, by the name of the value."""


class RewardContext:
    """Fields of ``TermContext`` that follow from the time, the data centers and their inputs."""

    def __init__(self) -> None:
        # Values that hold for all steps of an episode.
        self._fixed: dict[str, F64] = {}
        self._drivers: Drivers | None = None
        self._coming_steps = 0
        # Means by name of the value, with the series that they are made of.
        self._means: dict[str, tuple[FleetSeries, FleetSeries]] = {}
        # By step of the day.
        self._end_of_day_weight = np.zeros(0)

    def reset(self, view: View) -> None:
        """Start an episode.

        Args:
            view: the view before the first step.
        """
        per_hour = view.fleet.steps_per_hour
        self._drivers, self._coming_steps = view.drivers, COMING_H * per_hour
        self._end_of_day_weight = _end_of_day_weight(np.arange(24 * per_hour), view.step_h)
        self._fixed = {
            "design_kwh": view.sizing.facility_w * view.step_h / 1e3,
            "task_kwh": view.sizing.it_w * view.step_h / (1e3 * TASKS_PER_STEP),
            "demand_charge_per_kw": view.fleet.values("tariff.demand_charge_per_kw"),
        }

    def values(self, step: int, names: Iterable[str]) -> dict[str, F64]:
        """Values of a step by name, (B,) each.

        Args:
            step: index of the step, 0 at reset.
            names: names of fields of ``TermContext``.
        """
        return {name: self._value(step, name) for name in names}

    def _value(self, step: int, name: str) -> F64:
        if name in self._fixed:
            return self._fixed[name]
        assert self._drivers is not None, "reset comes first"
        index = self._drivers.start + step
        if name == "end_of_day_weight":
            return self._end_of_day_weight[index % len(self._end_of_day_weight)]
        series_name = name.removesuffix("_before")
        after = 0 if name.endswith("_before") else 1
        return self._coming(series_name, self._drivers).at(index + after)

    def _coming(self, name: str, drivers: Drivers) -> FleetSeries:
        """Coming means of a series, made anew where the inputs are others."""
        series: FleetSeries = getattr(drivers, COMING_SERIES[name])
        if name not in self._means or self._means[name][0] is not series:
            self._means[name] = series, coming_means(series, self._coming_steps)
        return self._means[name][1]


def _end_of_day_weight(step_of_day: I64, step_h: float) -> F64:
    """Weight of queued tasks by step of the day; 1 at the last."""
    hour, span_h = step_of_day * step_h, 24.0 - step_h - END_OF_DAY_START_H
    weight = (hour - END_OF_DAY_START_H) / span_h if span_h > 0 else np.ones(len(hour))
    return np.where(hour >= END_OF_DAY_START_H, weight, 0.0)
