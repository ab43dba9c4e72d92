"""Grid-World once more, in plain Python and straight from its description: the yardstick for the JAX version.

Deliberately shares no code, no data layout and no names of constants with `envs.grid_world`.  Tests take its word for the
rules, and the PyTorch fixture (`_torch_apt_gen`) trains on it, as on any environment written in Python.
"""

from __future__ import annotations

import math
from typing import TypeAlias

Place: TypeAlias = tuple[int, int]
"""Row and column on the 10 x 10 board."""


class PythonGridWorld:
    """One task and its running episode: a dict from (row, column) to a word, and one from a thing's name to its place."""

    def __init__(self, scores: list[list[list[float]]], xy: list[float]) -> None:
        """`scores` is an 8 x 8 x 3 nested list of tile scores, `xy` a list of 10 numbers in [0, 10]."""
        self.board: dict[Place, str] = {}
        for row in range(10):
            for column in range(10):
                if row in (0, 9) or column in (0, 9):
                    self.board[row, column] = "wall"
                else:
                    three = scores[row - 1][column - 1]
                    self.board[row, column] = ["empty", "wall", "lava"][three.index(max(three))]
        self.board[1, 1] = "empty"

        self.things: dict[str, Place] = {}
        for number, name in enumerate(["goal", "yellow door", "blue door", "yellow key", "blue key"]):
            down, right = (min(9, max(0, math.floor(xy[2 * number + axis]))) for axis in (0, 1))
            place = (down, right)
            if 0 in place or 9 in place or place in self.things.values():
                continue
            if place == (1, 1) and name != "goal":
                continue
            self.things[name] = place
            self.board[place] = "empty"
        self.begin()

    def begin(self) -> None:
        """Starts a new episode of the same task."""
        self.agent: Place = (1, 1)
        self.left = dict(self.things)
        self.age = 0

    def observation(self) -> dict[str, list[int] | list[list[int]]]:
        """What the agent sees: its place, a 7 x 7 view of codes around it, and where the things are from it."""
        row, column = self.agent
        code = {"empty": 0, "wall": 1, "lava": 2}
        view = []
        for r in range(row - 3, row + 4):
            view.append([code[self.board.get((r, c), "wall")] for c in range(column - 3, column + 4)])
        objects = []
        for name in ["goal", "yellow door", "blue door", "yellow key", "blue key"]:
            place = self.left.get(name, self.agent)
            objects += [place[0] - row, place[1] - column]
        return {"agent": [row, column], "view": view, "objects": objects}

    def step(self, action: int) -> tuple[str, float, bool, bool]:
        """Returns (event, reward, terminated, truncated); `event` names what happened."""
        self.age += 1
        event, reward, terminated = self._act(action)
        return event, reward, terminated, not terminated and self.age == 50

    def _act(self, action: int) -> tuple[str, float, bool]:
        if self.left.get("goal") == self.agent:
            return "started on goal", -1.0, True
        row, column = self.agent
        if action == 0:
            target = (row - 1, column)
        elif action == 1:
            target = (row, column + 1)
        elif action == 2:
            target = (row + 1, column)
        else:
            target = (row, column - 1)

        if self.board[target] == "wall":
            return "wall", -0.001 - 0.001, False
        if self.board[target] == "lava":
            return "lava", -0.5 - 0.001, True
        for name, place in list(self.left.items()):
            if place != target:
                continue
            if name == "goal":
                self.agent = target
                return "goal", 1.0 - 0.001, True
            if name.endswith("door"):
                return "closed door", -0.5 - 0.001, True
            colour = name.split()[0]
            self.agent = target
            del self.left[name]
            opened = self.left.pop(f"{colour} door", None)
            return ("key opens door" if opened else "key without door"), -0.001, False
        was_door = any(name.endswith("door") and place == target for name, place in self.things.items())
        self.agent = target
        return ("through open door" if was_door else "move"), -0.001, False
