"""Errors a user can cause; every message names the place, the value and what would be valid."""

from __future__ import annotations


class SdcError(ValueError):
    """Base of all errors caused by input; the command line prints them without a traceback."""


class ConfigError(SdcError):
    """A configuration, preset or override is not valid."""


class DataError(SdcError):
    """A weather, carbon or workload file or series is not valid."""


class RuntimeStateError(SdcError):
    """The simulator was used in a state that cannot work (closed, forked, not reset)."""
