"""Manipulation: the paper's table of blocks on which cans are pushed to a goal, simulated with MJX."""

from envs.manipulation.space import Space

__all__ = ["Space"]
