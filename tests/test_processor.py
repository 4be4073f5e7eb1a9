"""What results depend on beside inputs: recorded, and left out of what tells simulators apart."""

from __future__ import annotations

import platform
from dataclasses import replace
from pathlib import Path

from sdc_taichi import Drivers, Simulator, drivers_from_arrays, load_config
from sdc_taichi.run.description import processor_features
from sdc_taichi.sim.drivers import FleetSeries


def test_features_of_the_processor_are_told() -> None:
    found = processor_features()
    assert list(found) == ["architecture", "processor", "numpy-simd", "openblas", "libc"]
    assert found["architecture"] == platform.machine()
    assert all(found.values())
    assert found == processor_features()


def test_vector_extensions_are_those_that_linux_tells(tmp_path: Path) -> None:
    file = tmp_path / "cpuinfo"
    for text, expected in (
        ("processor : 0\nflags\t\t: fpu avx2 sse4_2 avx\n\nflags\t\t: fpu\n", "sse4_2 avx avx2"),
        ("Features\t: fp asimd evtstrm\n", "asimd"),
        ("flags : fpu\n", "none"),
        ("model name : flags\n", "unknown"),
    ):
        file.write_text(text)
        assert processor_features(file)["processor"] == expected
    assert processor_features(tmp_path / "none")["processor"] == "unknown"


def test_last_bits_of_inputs_do_not_tell_simulators_apart() -> None:
    config = load_config("tiny")

    def fingerprint(drivers: Drivers) -> str:
        with Simulator(config, drivers=drivers) as sim:
            return sim.fingerprint()

    def with_wet_bulb(factor: float) -> Drivers:
        series = drivers.wet_bulb_c
        changed = FleetSeries(series.values * factor, series.offsets, series.lengths)
        return replace(drivers, wet_bulb_c=changed)

    drivers = drivers_from_arrays([20.3] * 8, [15.7] * 8, [300.0] * 8, [0.5] * 8)
    assert fingerprint(with_wet_bulb(1 + 4e-16)) == fingerprint(drivers)
    assert fingerprint(with_wet_bulb(1 + 1e-6)) != fingerprint(drivers)
