"""Tasks as 8 x 8 text layouts: one line per interior row, one character per tile.

`.` floor, `#` wall, `L` lava, `A` agent, `G` goal, `Y` and `B` yellow and blue door, `y` and `b` their keys.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from envs.grid_world.board import EMPTY, INTERIOR, LAVA, OBJECTS, START, WALL, Task, make_task

AGENT = "A"
OBJECT_CHARACTERS = "GYByb"
"""One character per object, in the order of `Task.objects`."""

TILE_CHARACTERS = {".": EMPTY, "#": WALL, "L": LAVA}
ALLOWED = ".AG#LYByb"


def parse_layout(text: str) -> Task:
    """The task of a layout.

    Blank lines and trailing blanks are ignored; messages count them, as an editor does.

    Raises:
      ValueError: on a wrong character or a wrong number of rows or columns, unless exactly one `A` is there, on the
        upper-left tile, and exactly one `G`, or if a door or key occurs twice.  Lines and columns count from 1.
    """
    rows = [(number, line.rstrip()) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    _check_size(rows)
    found = _locate(rows)
    interior = np.array([[TILE_CHARACTERS.get(character, EMPTY) for character in line] for _, line in rows], np.uint8)
    objects = np.zeros((OBJECTS, 2), np.int32)
    for index, character in enumerate(OBJECT_CHARACTERS):
        if character in found:
            objects[index] = found[character]
    present = np.array([character in found for character in OBJECT_CHARACTERS])
    return make_task(jnp.asarray(interior), jnp.asarray(objects), jnp.asarray(present))


def format_layout(task: Task) -> str:
    """The layout of a task as it starts, without a final newline; `parse_layout` reads it back if it has a goal.

    A task that starts on its goal shows `G` in place of `A`, which no layout can express.
    """
    names = {category: character for character, category in TILE_CHARACTERS.items()}
    board = [[names[int(tile)] for tile in row] for row in np.asarray(task.tiles)]
    board[START[0]][START[1]] = AGENT
    for character, (row, column), present in zip(
        OBJECT_CHARACTERS, np.asarray(task.objects), np.asarray(task.present), strict=True
    ):
        if present:
            board[row][column] = character
    return "\n".join("".join(row[1:-1]) for row in board[1:-1])


def _check_size(rows: list[tuple[int, str]]) -> None:
    """Raises ValueError unless `rows` (line number, line) are 8 lines of 8 allowed characters."""
    for number, line in rows:
        for column, character in enumerate(line, start=1):
            if character not in ALLOWED:
                raise ValueError(f"line {number}, column {column}: unknown character {character!r}, allowed are {ALLOWED}")
        if len(line) != INTERIOR:
            raise ValueError(f"line {number}: {len(line)} columns, expected {INTERIOR}")
    if len(rows) != INTERIOR:
        raise ValueError(f"{len(rows)} rows, expected {INTERIOR}")


def _locate(rows: list[tuple[int, str]]) -> dict[str, tuple[int, int]]:
    """Board position of the agent and of each object in the layout; raises ValueError on a misplaced, second or missing one."""
    found: dict[str, tuple[int, int]] = {}
    for row, (number, line) in enumerate(rows, start=1):
        for column, character in enumerate(line, start=1):
            if character in TILE_CHARACTERS:
                continue
            if character in found:
                raise ValueError(f"line {number}, column {column}: a second {character!r}")
            if character == AGENT and (row, column) != START:
                raise ValueError(f"line {number}, column {column}: {AGENT!r} must stand on the upper-left tile")
            found[character] = (row, column)
    for required in (AGENT, OBJECT_CHARACTERS[0]):
        if required not in found:
            raise ValueError(f"no {required!r} in the layout")
    return found
