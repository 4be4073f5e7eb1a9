"""Fields that a sweep varies: listed values, values at even steps, and ranges to draw from."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any, Literal

import numpy as np

from sdc_taichi.config import DataCenterConfig, load_yaml
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.number_text import parse_number

Kind = Literal["int64", "float64", "bool", "text"]
"""Type of a column of values."""
_BLOCK = 1024
"""Points of a Sobol sequence that are drawn at a time; a power of two keeps it balanced."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A field of the configuration and all values that it takes."""

    field: str
    """Dotted path of the field."""
    values: tuple[Any, ...]
    """The values, plain as in a YAML file."""

    @property
    def kind(self) -> Kind:
        """Type of a column of the values."""
        return kind_of(self.values)

    def with_value(self, value: Any) -> Grid:
        """The grid with one more value at its end, unless it has that value."""
        return self if value in self.values else replace(self, values=(*self.values, value))


@dataclass(frozen=True, slots=True)
class Range:
    """A field of the configuration and the range that samples of it are drawn from evenly."""

    field: str
    """Dotted path of the field."""
    low: float
    """Least value."""
    high: float
    """Largest value."""
    is_whole: bool
    """Whether whole numbers are drawn, both ends among them."""

    @property
    def kind(self) -> Kind:
        """Type of a column of the samples."""
        return "int64" if self.is_whole else "float64"

    def at(self, share: float) -> float:
        """The value at a share of the range, 0..1 without the 1."""
        if self.is_whole:
            return int(self.low) + int(share * (int(self.high) - int(self.low) + 1))
        return self.low + share * (self.high - self.low)


Varied = Grid | Range
"""A field that a sweep varies."""


def kind_of(values: Sequence[Any]) -> Kind:
    """Type of a column of plain values: text if they are of different types."""
    if all(isinstance(value, bool) for value in values):
        return "bool"
    if all(_is_number(value) and isinstance(value, int) for value in values):
        return "int64"
    is_numeric = all(value is None or _is_number(value) for value in values)
    return "float64" if is_numeric else "text"


def parse_vary(text: str, config: DataCenterConfig, most: int) -> Varied:
    """A field and its values from a text such as ``hvac.setpoint.initial_c=16:26:1``.

    Values are a list ``A,B,C``, numbers ``START:STOP:STEP`` of which STOP may be the last, or a
    range ``LOW..HIGH`` that samples are drawn from. Those of a field that holds a fraction are
    fractions, whatever their text.

    Args:
        text: the text.
        config: the configuration whose field is varied.
        most: most values of a grid.

    Raises:
        ConfigError: naming the text and what is valid.
    """
    path, sign, listed = (part.strip() for part in text.partition("="))
    where = f"vary {shortened(text)}"
    if not sign or not path or not listed:
        raise ConfigError(
            f"{where}: valid is FIELD=A,B,C, FIELD=START:STOP:STEP or FIELD=LOW..HIGH"
        )
    if "." not in path:
        raise ConfigError(f"{where}: valid is a field of a section, such as site.location")
    default = value_at(config, path)
    ends = [_number(part) for part in listed.split("..")]
    if len(ends) == 2 and None not in ends:
        return _range(path, listed, default, where)
    steps = listed.split(":")
    if len(steps) in (2, 3) and _number(steps[0]) is not None:
        return Grid(path, _fractions(_steps(steps, most, where), default))
    try:
        values = load_yaml(f"[{listed}]")
        keys = [json.dumps(value, sort_keys=True, allow_nan=False) for value in values]
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{where}: no list of YAML values ({error})") from None
    if not values:
        raise ConfigError(f"{where}: no values; valid is one or more")
    seen: set[str] = set()
    for value, key in zip(values, keys, strict=True):
        if key in seen:
            raise ConfigError(f"{where}: {shortened(value)} is given twice; valid is each once")
        seen.add(key)
    return Grid(path, _fractions(values, default))


def value_at(config: DataCenterConfig, path: str) -> Any:
    """Plain value of a config at a dotted path; None if there is none."""
    value: Any = config.model_dump(mode="json", include={path.partition(".")[0]})
    for key in path.split("."):
        if isinstance(value, Mapping):
            value = value.get(key)
        elif isinstance(value, list) and key.isdecimal() and int(key) < len(value):
            value = value[int(key)]
        else:
            return None
    return value


def draw(ranges: Sequence[Range], samples: int, seed: int) -> Iterator[tuple[float, ...]]:
    """Samples of some ranges together, evenly spread over all of them.

    They are points of a scrambled Sobol sequence (Owen 1998, "Scrambling Sobol' and
    Niederreiter-Xing points"), so that the first of many samples are those of fewer.

    Args:
        ranges: the ranges.
        samples: number of samples.
        seed: of the scrambling.

    Yields:
        A value for each of the ranges.
    """
    from scipy.stats import qmc

    if not ranges:
        yield ()
        return
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    sequence = qmc.Sobol(len(ranges), scramble=True, seed=generator)
    for first in range(0, samples, _BLOCK):
        for point in sequence.random(_BLOCK)[: samples - first]:
            yield tuple(one.at(share) for one, share in zip(ranges, point.tolist(), strict=True))


def combination_text(fields: Iterable[str], values: Iterable[Any]) -> str:
    """Fields and their values as a text, such as ``hvac.setpoint.initial_c=24, site.seed=3``."""
    pairs = zip(fields, values, strict=True)
    return ", ".join(f"{field}={value_text(value)}" for field, value in pairs)


def value_text(value: Any) -> str:
    """A plain value as a text that reads back equal."""
    return value if isinstance(value, str) else json.dumps(value)


def _range(path: str, ends: str, default: Any, where: str) -> Range:
    """The range of a text ``LOW..HIGH``, both of which are numbers."""
    low, high = (parse_number(part) for part in ends.split(".."))
    if not low < high:
        raise ConfigError(f"{where}: the range is empty; valid is LOW..HIGH with LOW below HIGH")
    is_whole = _is_number(default) and isinstance(default, int)
    if is_whole and not (low.is_integer() and high.is_integer()):
        raise ConfigError(f"{where}: {path} is a whole number; valid are whole LOW and HIGH")
    return Range(path, low, high, is_whole)


def _steps(parts: Sequence[str], most: int, where: str) -> list[float]:
    """Numbers from START to STOP by STEP, exact as decimals are."""
    valid = "valid is START:STOP:STEP with START not above STOP, and STEP above 0"
    if len(parts) != 3 or None in map(_number, parts):
        raise ConfigError(f"{where}: {valid}")
    start, stop, step = (Decimal(part.strip()) for part in parts)
    if step <= 0 or stop < start:
        what = f"step {step}" if step <= 0 else "no values"
        raise ConfigError(f"{where}: {what}; {valid}")
    count = (stop - start) / step
    if count >= most:
        raise ConfigError(f"{where}: {count + 1:,.0f} values; valid are at most {most:,}")
    numbers = [start + i * step for i in range(int(count) + 1)]
    if any(re.search(r"[.eE]", part) for part in parts):
        return [float(number) for number in numbers]
    return [int(number) for number in numbers]


def _number(text: str) -> float | None:
    """The number that a text holds; None if it is none."""
    try:
        return parse_number(text)
    except ValueError:
        return None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _fractions(values: Sequence[Any], default: Any) -> tuple[Any, ...]:
    """Values as fractions if all are numbers, and one of them or what the field holds is one."""
    is_fraction = any(isinstance(value, float) for value in (*values, default))
    if is_fraction and all(map(_is_number, values)):
        return tuple(map(float, values))
    return tuple(values)
