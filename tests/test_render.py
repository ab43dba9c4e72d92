"""Pictures of Grid-World, judged by the colours of their tiles, and GIFs read back from disk."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import envs
from envs.rendering import save_gif

SIZE = 16
BLACK, GREY, ORANGE = (0, 0, 0), (100, 100, 100), (255, 128, 0)
RED, GREEN, BLUE, YELLOW = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)

SPACE = envs.make("grid_world")
MAP = """
AyY.....
bB......
#L......
........
........
........
........
.......G
"""


def tile(picture: np.ndarray, row: int, column: int) -> np.ndarray:
    return picture[row * SIZE : (row + 1) * SIZE, column * SIZE : (column + 1) * SIZE]


def share(pixels: np.ndarray, color: tuple[int, int, int]) -> float:
    """Share of the pixels that have exactly this colour."""
    return float((pixels == np.array(color)).all(axis=-1).mean())


def after(actions, task):
    state, _ = SPACE.reset(jax.random.key(0), task)
    for action in actions:
        state = SPACE.step(state, jnp.int32(action), task).state
    return state


@pytest.fixture(scope="module")
def task():
    return SPACE.parse_target(MAP)


@pytest.fixture(scope="module")
def picture(task):
    return SPACE.render(task, tile_size=SIZE)


@pytest.mark.parametrize("size", [1, 8, 32])
def test_size(task, size):
    picture = SPACE.render(task, tile_size=size)
    assert picture.shape == (10 * size, 10 * size, 3)
    assert picture.dtype == np.uint8


@pytest.mark.parametrize(
    ("place", "color", "least"),
    [
        ((0, 0), GREY, 1.0),
        ((9, 4), GREY, 1.0),
        ((3, 1), GREY, 1.0),
        ((3, 2), ORANGE, 0.5),
        ((8, 8), GREEN, 1.0),
        ((5, 5), BLACK, 0.8),
        ((1, 1), RED, 0.15),
        ((1, 2), YELLOW, 0.05),
        ((1, 3), YELLOW, 0.1),
        ((2, 1), BLUE, 0.05),
        ((2, 2), BLUE, 0.1),
    ],
)
def test_tiles_have_their_colour(picture, place, color, least):
    assert share(tile(picture, *place), color) >= least


def test_kinds_of_tile_differ(picture):
    places = [(0, 0), (1, 1), (1, 2), (1, 3), (1, 4), (2, 1), (2, 2), (3, 2), (8, 8)]
    assert len({tile(picture, *place).tobytes() for place in places}) == len(places)


def test_floor_has_a_thin_grid(picture):
    floor = tile(picture, 5, 5).astype(int).sum(axis=-1)
    assert (floor[0] > 0).all()
    assert (floor[:, 0] > 0).all()
    assert (floor[2:, 2:] == 0).all()


def test_a_taken_key_and_its_door_are_floor(task, picture):
    later = SPACE.render(task, after([1, 3], task), tile_size=SIZE)  # onto the yellow key and back
    floor = tile(picture, 5, 5)
    np.testing.assert_array_equal(tile(later, 1, 2), floor)
    np.testing.assert_array_equal(tile(later, 1, 3), floor)
    np.testing.assert_array_equal(tile(later, 2, 1), tile(picture, 2, 1))
    np.testing.assert_array_equal(tile(later, 2, 2), tile(picture, 2, 2))


def test_the_agent_moves(task, picture):
    later = SPACE.render(task, after([1], task), tile_size=SIZE)
    np.testing.assert_array_equal(tile(later, 1, 2), tile(picture, 1, 1))
    np.testing.assert_array_equal(tile(later, 1, 1), tile(picture, 5, 5))


def test_the_agent_on_the_goal_stands_on_green():
    task = SPACE.parse_target(MAP.replace("AyY", "AG.").replace(".G\n", "..\n"))
    on_goal = tile(SPACE.render(task, after([1], task), tile_size=SIZE), 1, 2)
    assert share(on_goal, RED) > 0.15
    assert share(on_goal, GREEN) > 0.3


def test_pictures_do_not_share_memory_with_the_sprites(task, picture):
    SPACE.render(task, tile_size=SIZE)[:] = 0
    np.testing.assert_array_equal(SPACE.render(task, tile_size=SIZE), picture)


def test_a_tile_size_of_zero_is_refused(task):
    with pytest.raises(ValueError, match="tile_size"):
        SPACE.render(task, tile_size=0)


def test_gif_reads_back(tmp_path, task):
    frames = [SPACE.render(task, after([1] * n, task), tile_size=SIZE) for n in range(4)]
    save_gif(tmp_path / "episode.gif", frames, fps=10)
    with Image.open(tmp_path / "episode.gif") as gif:
        assert gif.n_frames == 4
        assert gif.info["loop"] == 0
        for index, frame in enumerate(frames):
            gif.seek(index)
            assert gif.info["duration"] == 100
            np.testing.assert_array_equal(np.asarray(gif.convert("RGB")), frame)


@pytest.mark.parametrize(
    ("frames", "fps", "message"), [([], 5, "at least one frame"), ([np.zeros((4, 4, 3), np.uint8)], 0, "fps")]
)
def test_bad_gifs_are_refused(tmp_path, frames, fps, message):
    with pytest.raises(ValueError, match=message):
        save_gif(tmp_path / "bad.gif", frames, fps)
    assert not (tmp_path / "bad.gif").exists()
