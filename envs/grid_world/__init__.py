"""Grid-World: the paper's 10 x 10 mazes with walls, lava, keys and doors."""

from envs.grid_world.space import Space

__all__ = ["Space"]
