"""Plug-in with a method per target of Grid-World that climbs its ladder.

python -m experiments.train --plugins experiments.ladder_methods --method ladder_B --target B --run-dir DIR
"""

from __future__ import annotations

from functools import partial

from apt_jax.curricula import CURRICULA
from envs.grid_world import Space
from experiments import ladder

for _name in Space.targets:
    CURRICULA[f"ladder_{_name}"] = partial(ladder.make, target=_name)
