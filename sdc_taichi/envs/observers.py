"""Observers by value of the option ``observations``."""

from __future__ import annotations

from collections.abc import Callable

from sdc_taichi.envs.observer import Observer
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.envs.released_observer import ReleasedObserver
from sdc_taichi.sim.fleet import Fleet


def _named_features(fleet: Fleet, options: EnvOptions, new_inputs: bool) -> Observer:
    return Observer(
        fleet,
        agents=options.agents,
        features=options.features,
        ci_leads_h=options.ci_leads_h,
        weather_leads_h=options.weather_leads_h,
        forecast_error=options.forecast_error,
        new_inputs=new_inputs,
        commands={agent: options.commands_of(agent) for agent in options.agents},
    )


def _released_vectors(fleet: Fleet, options: EnvOptions, new_inputs: bool) -> ReleasedObserver:
    return ReleasedObserver(options.agents)


OBSERVERS: dict[str, Callable[[Fleet, EnvOptions, bool], Observer | ReleasedObserver]] = {
    "default": _named_features,
    "sustaindc": _released_vectors,
}
"""Makers of observers by value of the option ``observations``."""


def make_observer(
    fleet: Fleet, options: EnvOptions, *, new_inputs: bool = False
) -> Observer | ReleasedObserver:
    """The observer of the agents that learn.

    Args:
        fleet: the data centers.
        options: what agents see.
        new_inputs: whether episodes may have other inputs than those before.

    Raises:
        ConfigError: features or leads that do not fit the data centers.
    """
    return OBSERVERS[options.observations](fleet, options, new_inputs)
