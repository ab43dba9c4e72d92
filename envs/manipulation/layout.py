"""Tables as text: rows of blocks or cells, then a line for every can, obstacle and setting, with lengths in centimetres.

F...FF                              four rows of six blocks: F flat, . pit, # roadblock; the first is next to the robot
FFFFFF                              (or 24 rows of 36 cells of 2.5 cm: F surface, . hole)
FFFFFF
F...FF
can 13.8 31.3                       x from the left, y from the robot's edge; the first can is the target, up to three
box 45 20 30 12 8 90                centre x and y, length, width, height, angle in degrees
cylinder 20 50 6 15                 centre x and y, radius, height
goal 70 21                          the goal's centre; this one if left out
range 10                            r2, 10 to 60
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple, NoReturn

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from envs.manipulation.placement import GOAL, MAX_RANGE, MIN_RANGE, centers, ground_of
from envs.manipulation.table import (
    ABSENT,
    BLOCK,
    CAN_RADIUS,
    CANS,
    CELLS,
    COLUMNS,
    FLAT,
    OBSTACLES,
    PIT,
    ROADBLOCK,
    ROADBLOCK_HEIGHT,
    ROWS,
    SIZE,
    Obstacles,
    Task,
    distances,
    on_ground,
)

CHARACTERS = {"F": FLAT, ".": PIT, "#": ROADBLOCK}

NUMBERS = {"can": 2, "box": 6, "cylinder": 4, "goal": 2, "range": 1}
"""How many numbers follow each word."""


class Entry(NamedTuple):
    """A line that begins with a word: where it stands and the numbers on it."""

    line: int
    word: str
    values: tuple[float, ...]


class Box(NamedTuple):
    """One of `Obstacles`, in metres."""

    center: tuple[float, float]
    half: tuple[float, float]
    axis: tuple[float, float]
    rounding: float
    height: float


def parse_table(text: str) -> Task:
    """The task that a text describes.  Blank lines are ignored; messages count them, as an editor does.

    Raises:
      ValueError: with line and column (both from 1) of an unknown word or character, of what is no number, too many or
        out of range; if a can does not stand on the surface, or within an obstacle or another can; or if the first can, the
        range or rows are missing.
    """
    lines = [(number, line.rstrip()) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    rows = [(number, line) for number, line in lines if line.split()[0] not in NUMBERS]
    entries = [_entry(number, line) for number, line in lines if line.split()[0] in NUMBERS]
    surface = _surface(rows)
    obstacles = _obstacles(surface, entries)
    ground = np.asarray(ground_of(jnp.asarray(surface)) if surface.shape == (COLUMNS, ROWS) else surface != PIT)

    found = [entry for entry in entries if entry.word == "can"]
    if not found:
        raise ValueError("no 'can' in the table")
    if len(found) > CANS:
        _refuse(found[CANS].line, 1, f"a fourth 'can', allowed are {CANS}")
    cans = np.full((CANS, 2), ABSENT, np.float32)
    for index, entry in enumerate(found):
        cans[index] = np.array(entry.values) / 100
        _check_stands(entry.line, cans[: index + 1], ground, obstacles)

    goal = _single(entries, "goal")
    if goal:
        for axis, value, side in zip("xy", goal.values, SIZE, strict=True):
            if not 0 <= value <= 100 * side:
                _refuse(goal.line, 6, f"the goal's {axis} must be 0 to {100 * side:g}, got {value:g}")
    goal_range = _single(entries, "range")
    if goal_range is None:
        raise ValueError("no 'range' in the table")
    if not MIN_RANGE <= goal_range.values[0] / 100 <= MAX_RANGE:
        _refuse(goal_range.line, 7, f"range must be {MIN_RANGE * 100:g} to {MAX_RANGE * 100:g}, got {goal_range.values[0]:g}")
    return Task(
        ground=jnp.asarray(ground),
        obstacles=obstacles,
        cans=jnp.asarray(cans),
        present=jnp.arange(CANS) < len(found),
        goal=jnp.array(np.array(goal.values) / 100 if goal else GOAL, jnp.float32),
        goal_range=jnp.float32(goal_range.values[0] / 100),
    )


def _refuse(line: int, column: int, message: str) -> NoReturn:
    raise ValueError(f"line {line}, column {column}: {message}")


def _entry(number: int, line: str) -> Entry:
    """The numbers after a line's word."""
    word, *rest = re.finditer(r"\S+", line)
    values = []
    for match in rest:
        try:
            value = float(match[0])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            _refuse(number, match.start() + 1, f"{match[0]!r} is no number")
        values.append(value)
    if len(values) != NUMBERS[word[0]]:
        _refuse(number, word.start() + 1, f"{word[0]!r} takes {NUMBERS[word[0]]} numbers, got {len(values)}")
    return Entry(number, word[0], tuple(values))


def _surface(rows: list[tuple[int, str]]) -> np.ndarray:
    """Categories of blocks [6, 4] or cells [36, 24]."""
    words = ", ".join(NUMBERS)
    for number, line in rows:
        for column, character in enumerate(line, start=1):
            if character not in CHARACTERS:
                _refuse(
                    number, column, f"unknown character {character!r}, allowed are {''.join(CHARACTERS)} and the words {words}"
                )
    widths = {COLUMNS: ROWS, COLUMNS * CELLS: ROWS * CELLS}
    for number, line in rows:
        if len(line) not in widths or len(line) != len(rows[0][1]):
            _refuse(
                number, 1, f"{len(line)} columns, expected {COLUMNS} blocks or {COLUMNS * CELLS} cells, the same in all rows"
            )
        if len(line) != COLUMNS and "#" in line:
            _refuse(number, line.index("#") + 1, "a cell cannot be a roadblock, write 'box' or 'cylinder' instead")
    if not rows or len(rows) != widths[len(rows[0][1])]:
        raise ValueError(f"{len(rows)} rows, expected {ROWS} of blocks or {ROWS * CELLS} of cells")
    return np.array([[CHARACTERS[character] for character in line] for _, line in rows]).T


def _obstacles(surface: np.ndarray, entries: list[Entry]) -> Obstacles:
    """Roadblocks, boxes and cylinders, and nothing to fill up."""
    boxes = []
    if surface.shape == (COLUMNS, ROWS):
        side = BLOCK / 2
        for x, y in centers()[surface.reshape(-1) == ROADBLOCK].tolist():
            boxes.append(Box((x, y), (side, side), (1.0, 0.0), 0.0, ROADBLOCK_HEIGHT))
    for line, word, values in entries:
        if word not in ("box", "cylinder"):
            continue
        size = values[2:5] if word == "box" else values[2:]
        if min(size) <= 0:
            _refuse(line, 1, f"sizes of a {word!r} must be above 0, got {min(size):g}")
        if len(boxes) == OBSTACLES:
            _refuse(line, 1, f"more than {OBSTACLES} obstacles, roadblocks included")
        x, y, *rest = (value / 100 for value in values)
        if word == "cylinder":
            boxes.append(Box((x, y), (0.0, 0.0), (1.0, 0.0), rest[0], rest[1]))
        else:
            angle = math.radians(values[5])
            boxes.append(Box((x, y), (rest[0] / 2, rest[1] / 2), (math.cos(angle), math.sin(angle)), 0.0, rest[2]))
    boxes += [Box((0.0, 0.0), (0.0, 0.0), (1.0, 0.0), 0.0, 0.0)] * (OBSTACLES - len(boxes))
    return Obstacles(*(jnp.array(field, jnp.float32) for field in zip(*boxes, strict=True)))


def _single(entries: list[Entry], word: str) -> Entry | None:
    """The entry of a word that may occur once."""
    found = [entry for entry in entries if entry.word == word]
    if len(found) > 1:
        _refuse(found[1].line, 1, f"a second {word!r}")
    return found[0] if found else None


def _check_stands(line: int, cans: np.ndarray, ground: Bool[np.ndarray, "36 24"], obstacles: Obstacles) -> None:
    """Raises ValueError unless the last of `cans` stands on the surface, clear of everything before it."""
    place = jnp.asarray(cans[-1])
    if not on_ground(jnp.asarray(ground), place[None])[0]:
        _refuse(line, 5, "the can's centre is not on the surface")
    if jnp.min(distances(obstacles, place)) < CAN_RADIUS:
        _refuse(line, 5, f"the can, of radius {CAN_RADIUS * 100:g}, stands in an obstacle")
    if any(np.linalg.norm(other - cans[-1]) < 2 * CAN_RADIUS for other in cans[:-1]):
        _refuse(line, 5, f"the can, of radius {CAN_RADIUS * 100:g}, stands in another can")
