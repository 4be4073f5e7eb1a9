"""The algorithms by name."""

from __future__ import annotations

from sdc_taichi.learning.off_policy import OffPolicyDefinition
from sdc_taichi.learning.on_policy import OnPolicyDefinition

ON_POLICY: dict[str, OnPolicyDefinition] = {
    "ppo": OnPolicyDefinition(critic="observation", reward="own", sequential=False, clips=True),
    "ippo": OnPolicyDefinition(critic="observation", reward="own", sequential=False, clips=True),
    "mappo": OnPolicyDefinition(critic="state", reward="team", sequential=False, clips=True),
    "happo": OnPolicyDefinition(critic="state", reward="team", sequential=True, clips=True),
    "haa2c": OnPolicyDefinition(critic="state", reward="team", sequential=True, clips=False),
}
"""Algorithms that learn from the steps that their policies have just made."""
OFF_POLICY: dict[str, OffPolicyDefinition] = {
    "had3qn": OffPolicyDefinition(critics=1, soft=False),
    "hasac": OffPolicyDefinition(critics=2, soft=True),
}
"""Algorithms that learn from all steps that a replay holds."""
