"""Fail unless two wheels hold the same files.

python .ci/compare_wheels.py WHEEL WHEEL
"""

import sys
import zipfile


def differences(first: str, second: str) -> list[str]:
    """Names of files that only one of two wheels holds, or that differ."""
    with zipfile.ZipFile(first) as one, zipfile.ZipFile(second) as other:
        contents = [{name: each.read(name) for name in each.namelist()} for each in (one, other)]
    a, b = contents
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))


if __name__ == "__main__":
    if found := differences(*sys.argv[1:]):
        raise SystemExit(f"the wheels differ in: {', '.join(found)}")
