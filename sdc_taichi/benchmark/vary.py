"""Configuration fields that a sweep varies: lists of values, equally spaced values, and ranges."""

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
"""Number of Sobol points drawn at a time; a power of two, so that the points are balanced."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A configuration field with the list of its values in a sweep."""

    field: str
    """Dotted path of the field."""
    values: tuple[Any, ...]
    """Values of the field, as in a YAML file."""

    @property
    def kind(self) -> Kind:
        """Type of a table column with the values."""
        return kind_of(self.values)

    def with_value(self, value: Any) -> Grid:
        """Return the grid with one more value at its end, unless the grid contains the value."""
        return self if value in self.values else replace(self, values=(*self.values, value))


@dataclass(frozen=True, slots=True)
class Range:
    """A configuration field with the range from which its values are drawn uniformly."""

    field: str
    """Dotted path of the field."""
    low: float
    """Minimum value."""
    high: float
    """Maximum value."""
    is_whole: bool
    """True if only whole numbers are drawn, including both ends."""

    @property
    def kind(self) -> Kind:
        """Type of a table column with the samples."""
        return "int64" if self.is_whole else "float64"

    def at(self, share: float) -> float:
        """Return the value at a relative position in the range, at least 0 and less than 1."""
        if self.is_whole:
            return int(self.low) + int(share * (int(self.high) - int(self.low) + 1))
        return self.low + share * (self.high - self.low)


Varied = Grid | Range
"""A field that a sweep varies."""


def kind_of(values: Sequence[Any]) -> Kind:
    """Return the type of a table column of plain values; text if the types differ."""
    if all(isinstance(value, bool) for value in values):
        return "bool"
    if all(_is_number(value) and isinstance(value, int) for value in values):
        return "int64"
    is_numeric = all(value is None or _is_number(value) for value in values)
    return "float64" if is_numeric else "text"


def parse_vary(text: str, config: DataCenterConfig, most: int) -> Varied:
    """Parse a field and its values from a text such as ``hvac.setpoint.initial_c=16:26:1``.

    Values are a list ``A,B,C``, numbers ``START:STOP:STEP`` (up to and including STOP),
    or a range ``LOW..HIGH`` from which samples are drawn. Numbers become floats if the field holds
    a float.

    Args:
        text: the text.
        config: the configuration whose field is varied.
        most: maximum number of values in a list.

    Raises:
        ConfigError: the text is not valid; the message names it and what is valid.
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
    """Return the plain value of a configuration at a dotted path; None if it does not exist."""
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
    """Draw low-discrepancy samples from the product of several ranges.

    The samples are points of a scrambled Sobol sequence (Owen 1998, "Scrambling Sobol' and
    Niederreiter-Xing points"). A larger number of samples extends the sequence of a smaller number.

    Args:
        ranges: the ranges.
        samples: number of samples.
        seed: seed of the scrambling.

    Yields:
        A tuple with a value from each range.
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
    """Return fields and values as text, such as ``hvac.setpoint.initial_c=24, site.seed=3``."""
    pairs = zip(fields, values, strict=True)
    return ", ".join(f"{field}={value_text(value)}" for field, value in pairs)


def value_text(value: Any) -> str:
    """Return a plain value as text, from which an equal value can be parsed."""
    return value if isinstance(value, str) else json.dumps(value)


def _range(path: str, ends: str, default: Any, where: str) -> Range:
    """Parse the range ``LOW..HIGH``; both ends must be numbers."""
    low, high = (parse_number(part) for part in ends.split(".."))
    if not low < high:
        raise ConfigError(f"{where}: the range is empty; valid is LOW..HIGH with LOW below HIGH")
    is_whole = _is_number(default) and isinstance(default, int)
    if is_whole and not (low.is_integer() and high.is_integer()):
        raise ConfigError(f"{where}: {path} is a whole number; valid are whole LOW and HIGH")
    return Range(path, low, high, is_whole)


def _steps(parts: Sequence[str], most: int, where: str) -> list[float]:
    """Return the numbers from START to STOP by STEP, without rounding errors of decimal steps."""
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
    """Parse a number; None if the text is not a number."""
    try:
        return parse_number(text)
    except ValueError:
        return None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _fractions(values: Sequence[Any], default: Any) -> tuple[Any, ...]:
    """Convert numbers to floats if one of them, or the value in the field, is a float."""
    is_fraction = any(isinstance(value, float) for value in (*values, default))
    if is_fraction and all(map(_is_number, values)):
        return tuple(map(float, values))
    return tuple(values)
