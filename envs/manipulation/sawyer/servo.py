"""What the motors make of a course of the joints, in MuJoCo and in MJX alike."""

from __future__ import annotations

from typing import Any

Array = Any
"""Of numpy or of JAX."""


def wanted(off: Array, speed_off: Array, accelerations: Array, rate: float) -> Array:
    """Accelerations [7] that keep joints on their course, in rad/s^2; what they are off decays critically damped.

    Args:
      off, speed_off: what positions [7] and speeds [7] lack, in radians and rad/s.
      accelerations: of the course [7].
      rate: of the decay, in 1/s; less than one per time step.
    """
    return accelerations + 2 * rate * speed_off + rate**2 * off
