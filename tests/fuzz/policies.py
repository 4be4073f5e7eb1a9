"""Files of policies: damaged, of other arrays, or with another description in the header."""

from __future__ import annotations

import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from fuzz import damage
from fuzz.case import Scratch
from fuzz.run_folders import changed_json
from policies import interface, policy
from sdc_taichi import build_fleet, load_config, make_controller
from sdc_taichi.learning.policy import WEIGHTS, Policy
from sdc_taichi.sim.fleet import Fleet

OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"actions": "continuous", "agents": ("agent_dc",)},
    {"observations": "sustaindc", "agents": ("agent_ls", "agent_bat")},
)


def policies(scratch: Scratch) -> None:
    """Read a policy, and let it act on observations of ones."""
    content = _content(scratch, policy_file(int(scratch.rng.integers(len(OPTIONS)))))
    scratch.write(WEIGHTS, content)
    scratch.named.append(str(scratch.folder))
    read = Policy.load(scratch.folder)
    actions = read.actions(
        {a: np.ones((2, read.interface.width(a)), np.float32) for a in read.interface.agents}
    )
    for values in actions.values():
        assert np.all(np.isfinite(values))
    make_controller(f"policy:{scratch.folder}", _fleet())


@cache
def policy_file(number: int) -> bytes:
    """The file of a policy."""
    with tempfile.TemporaryDirectory() as folder:
        policy(interface(**OPTIONS[number])).save(Path(folder))
        return (Path(folder) / WEIGHTS).read_bytes()


@cache
def _fleet() -> Fleet:
    return build_fleet(load_config("tiny"))


def _content(scratch: Scratch, content: bytes) -> bytes:
    """A file that differs from that of a policy in most cases."""
    rng = scratch.rng
    how = int(rng.integers(6))
    if how == 0:
        return content
    if how == 1:
        return damage.damaged_bytes(rng, content)
    arrays = load(content)
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    text = header["__metadata__"]["policy"]
    if how < 5:
        return save(arrays, {"policy": changed_json(scratch, text.encode()).decode()})
    name = scratch.pick(sorted(arrays))
    odd = (np.zeros(0, np.float32), np.zeros((3, 3)), np.full(3, np.nan), np.arange(4), None)
    given = scratch.pick(odd)
    if given is None:
        del arrays[name]
    else:
        arrays[name if scratch.chance(0.7) else "other"] = given
    return save(arrays, {"policy": text})
