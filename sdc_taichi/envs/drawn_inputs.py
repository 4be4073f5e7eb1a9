"""Years and workload traces that episodes draw, as the options ``years`` and ``traces`` say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.sim.drivers import Drivers, InputReader
from sdc_taichi.types import I64


@dataclass(frozen=True, slots=True)
class Draw:
    """Inputs of the episodes of B environments."""

    years: tuple[int, ...] | None
    """Seed of the synthetic series of each environment, B; None is ``site.seed``."""
    traces: tuple[str, ...] | None
    """Workload trace of each environment, B; None is what the config names."""


class DrawnInputs:
    """Draws years and traces of episodes, and reads them.

    Args:
        configs: config of each environment, B.
        options: what episodes draw from.

    Raises:
        ConfigError: years of data centers without a synthetic series, or an unknown trace.
        DataError: the file of a trace is not valid.
    """

    def __init__(self, configs: Sequence[DataCenterConfig], options: EnvOptions) -> None:
        self._years, self._traces = options.years, options.traces
        self._reader = InputReader(configs)
        self._last: tuple[Draw, Drivers] | None = None
        traces = [self._reader.check_trace(trace) for trace in self._traces or ()]
        some_trace_is_synthetic = any(trace.synthetic for trace in traces)
        if self._years is not None and not some_trace_is_synthetic:
            for config, synthetic in zip(configs, self._reader.is_synthetic(), strict=True):
                if not synthetic:
                    raise ConfigError(
                        f"years: without effect on {config.name}, of which no input is synthetic; "
                        "valid with embedded sites or traces"
                    )

    def first(self) -> Drivers:
        """Inputs that the configs name, by which devices are sized."""
        return self._reader.read()

    def draw(self, generators: Sequence[np.random.Generator]) -> Draw:
        """Year and trace of the next episodes.

        Args:
            generators: that of each environment, of which the same numbers are drawn whatever the
                options.
        """
        drawn = np.array([rng.integers(2**63 - 1, size=2) for rng in generators], dtype=np.int64)
        years = traces = None
        if isinstance(self._years, int):
            years = tuple((drawn[:, 0] % self._years).tolist())
        elif self._years is not None:
            years = tuple(self._years[i] for i in drawn[:, 0] % len(self._years))
        if self._traces is not None:
            traces = tuple(self._traces[i] for i in drawn[:, 1] % len(self._traces))
        return Draw(years, traces)

    def drivers(self, draw: Draw) -> Drivers:
        """Inputs of a draw; the same object while the draws are the same."""
        if self._last is None or self._last[0] != draw:
            self._last = draw, self._reader.read(draw.years, draw.traces)
        return self._last[1]

    def checked(self, given: Any, num_envs: int) -> Draw:
        """The draw that a saved state names.

        Raises:
            SdcError: a draw that these options cannot give.
        """
        names = {"years", "traces"}
        if not isinstance(given, Mapping) or set(given) != names:
            raise SdcError("state: inputs are not valid; valid is what state_dict() gave")
        years, traces = given["years"], given["traces"]
        for name, values, valid in (
            ("years", years, range(self._years) if isinstance(self._years, int) else self._years),
            ("traces", traces, self._traces),
        ):
            if valid is None or values is None:
                good = valid is values
            else:
                listed = isinstance(values, list | tuple) and len(values) == num_envs
                good = listed and all(type(x) is type(valid[0]) and x in valid for x in values)
            if not good:
                raise SdcError(
                    f"state: {name} {shortened(values)}: not drawn by these environments"
                )
        return Draw(None if years is None else tuple(years), traces and tuple(traces))


def draws_inputs(options: EnvOptions) -> bool:
    """Whether episodes draw years or traces."""
    return options.years is not None or options.traces is not None


def draw_info(draw: Draw | None) -> dict[str, Any]:
    """Infos of a draw: ``year`` and ``trace``, (B,) each, as far as they are drawn."""
    info: dict[str, I64 | np.ndarray[Any, Any]] = {}
    if draw is not None and draw.years is not None:
        info["year"] = np.array(draw.years, dtype=np.int64)
    if draw is not None and draw.traces is not None:
        info["trace"] = np.array(draw.traces, dtype=object)
    return info
