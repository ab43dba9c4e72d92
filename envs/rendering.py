"""Writing pictures of episodes to disk, for every task space."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def save_gif(path: str | Path, frames: Iterable[UInt8[np.ndarray, "height width 3"]], fps: float) -> None:
    """Writes RGB `frames` of one size as an endless GIF at `fps` frames per second; overwrites `path`.

    GIF counts time in hundredths of a second, so above 100 frames per second viewers play it slower than asked.

    Raises:
      ValueError: if there is no frame or `fps` is not positive.
    """
    if fps <= 0:
        raise ValueError(f"fps must be positive, got {fps}")
    images = [_at_most_256_colors(Image.fromarray(np.asarray(frame))) for frame in frames]
    if not images:
        raise ValueError("a GIF needs at least one frame")
    milliseconds = max(10, round(1000 / fps))
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0)


def _at_most_256_colors(image: Image.Image) -> Image.Image:
    """The image, reduced to colours that GIF can hold so that small things keep theirs; Pillow's own choice fades them."""
    return image if image.getcolors(256) else image.quantize(method=Image.Quantize.FASTOCTREE)
