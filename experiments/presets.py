"""Where config and hparams start from, by preset, task space and method."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

from apt_jax.config import PRESETS, Config, HParams
from apt_jax.registry import look_up

Preset = Literal["paper", "fast"]

GAMMA: Mapping[str, float] = {"manipulation": 0.85, "manipulation_sawyer": 0.85}
"""Spaces with a discount of their own, whatever the preset.

None of Manipulation's 15 pushes costs anything: at 0.99 the way and a detour differ by less than a network can tell.
"""

TUNED: Mapping[tuple[str, str], Mapping[str, float]] = {
    ("grid_world", "dqn"): {"gamma": 0.998},
    ("grid_world", "random"): {"gamma": 0.998},
    ("grid_world", "rnd"): {"rnd_scale": 0.1},
    ("grid_world", "icm"): {"icm_scale": 0.0003},
    ("grid_world", "ride"): {"ride_scale": 0.003},
    ("manipulation", "dqn"): {"gamma": 0.92},
    ("manipulation", "random"): {"gamma": 0.92},
    ("manipulation", "alp_gmm"): {"alp_random_share": 0.5},
    ("manipulation", "goal_gan"): {"goal_noise": 0.1},
    ("manipulation", "rnd"): {"gamma": 0.92, "rnd_scale": 0.1},
    ("manipulation", "icm"): {"icm_scale": 0.003},
    ("manipulation", "ride"): {"ride_scale": 0.03},
}
"""Baselines that learn better with other hyper-parameters than preset fast has for all, by space and method.

Found on target A of each space by the searches of experiments/NOTES.md, sections 20, 28 and 30; APT-Gen keeps one setting for
every target.
"""


def starting_point(preset: Preset, space: str, method: str) -> tuple[Config, HParams]:
    """The preset for a method, with the space's own discount (`GAMMA`) and, for preset fast, what was tuned for it (`TUNED`).

    Args:
      preset: a name in `PRESETS`.
      space: a task space's name, not the space itself; unknown ones have nothing of their own.
      method: a method's full name, as in "rnd" or "apt_gen+rnd", which has nothing of "rnd"'s; unknown ones have nothing tuned.

    Returns:
      The preset's `Config` with that method, and the hyper-parameters, a number each.

    Raises:
      ValueError: an unknown preset.
    """
    config, hparams = look_up(PRESETS, preset, "preset")
    own = {"gamma": GAMMA[space]} if space in GAMMA else {}
    tuned = TUNED.get((space, method), {}) if preset == "fast" else {}
    return dataclasses.replace(config, method=method), dataclasses.replace(hparams, **{**own, **tuned})
