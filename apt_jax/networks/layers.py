"""Dense layers and 3 x 3 convolutions by our matmul; the convolutions are made of slices and one matmul each.

`lax.conv` becomes a grouped convolution once every seed has its own kernel under `vmap`, which is slow on every backend
(20 seeds on a CPU: 133 ms against 29 ms).  A matmul becomes a batched matmul.
"""

from __future__ import annotations

from functools import partial
from math import prod
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from apt_jax.networks.matmul import matmul

KERNEL_SIZE = 3


def _dot_general(x: Float[Array, "*batch inputs"], w: Float[Array, "inputs outputs"], *_: Any, **__: Any) -> Array:
    """What `nn.Dense` asks of `lax.dot_general`: always the last axis by the first."""
    return matmul(x, w)


Dense = partial(nn.Dense, dot_general=_dot_general)
"""`flax.linen.Dense` by our matmul: [..., inputs] -> [..., features]."""


def same_padding(size: int, stride: int) -> tuple[int, int, int]:
    """Output length of a 'SAME' convolution, and the zeros that XLA puts before and after its input."""
    out = -(-size // stride)
    total = max((out - 1) * stride + KERNEL_SIZE - size, 0)
    return out, total // 2, total - total // 2


def row_patches(x: Float[Array, "*batch h w c"], stride: int) -> Float[Array, "*batch out_h patch"]:
    """The three whole input rows under each output row, side by side: patch = 3 * w * c."""
    *batch, height, width, channels = x.shape
    out, before, after = same_padding(height, stride)
    rows = x.reshape(*batch, height, width * channels)
    # On CPU some hundredths faster than `jnp.pad`, gradient included (experiments/NOTES.md, section 37).
    zeros = jnp.zeros((*batch, max(before, after), width * channels), x.dtype)
    rows = jnp.concatenate([zeros[..., :before, :], rows, zeros[..., :after, :]], axis=-2)
    last = stride * (out - 1) + 1
    return jnp.concatenate([rows[..., i : i + last : stride, :] for i in range(KERNEL_SIZE)], axis=-1)


def banded_kernel(kernel: Float[Array, "3 3 c_in c_out"], width: int, stride: int) -> Float[Array, "patch out_row"]:
    """The matrix that takes three input rows to one output row: [3 * w * c_in, out_w * c_out].

    Block column q holds the kernel moved to output column q; what sticks out over the border is cut off, which is the
    zero padding.
    """
    out, before, _ = same_padding(width, stride)
    starts = [stride * q - before for q in range(out)]
    keep = (0, 0, 0)
    zero = jnp.zeros((), kernel.dtype)
    moved = [lax.pad(kernel, zero, [keep, (start, width - KERNEL_SIZE - start, 0), keep, keep]) for start in starts]
    rows, _, c_in, c_out = kernel.shape
    return jnp.stack(moved, axis=3).reshape(rows * width * c_in, out * c_out)


class Conv(nn.Module):
    """3 x 3 'SAME' convolution, equal to `lax.conv_general_dilated`: [..., h, w, c] -> [..., ceil(h/s), ceil(w/s), features].

    Rows are sliced, columns are in the matrix: `width / 3` times the multiplications of nine slices per pixel, yet 10 %
    faster on boards this small, where the copying of slices and matmuls of 16 columns are what costs.

    Attributes:
      features: output channels.
      stride: of rows and columns.
      use_bias: False where a BatchNorm follows.
    """

    features: int
    stride: int = 1
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "*batch h w c"]) -> Float[Array, "*batch out_h out_w features"]:
        *batch, _, width, channels = x.shape
        shape = (KERNEL_SIZE**2 * channels, self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        matrix = banded_kernel(kernel.reshape(KERNEL_SIZE, KERNEL_SIZE, channels, self.features), width, self.stride)
        patches = row_patches(x, self.stride)
        out_height = patches.shape[-2]
        y = matmul(patches.reshape(prod(batch) * out_height, -1), matrix)
        if self.use_bias:
            bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
            # As wide as a row: added pixel by pixel it is not vectorised on CPU.
            y = y + jnp.concatenate([bias] * (y.shape[-1] // self.features))[None]
        return y.reshape(*batch, out_height, -1, self.features)


def subpixel_kernel(kernel: Float[Array, "c_in 3 3 c_out"]) -> Float[Array, "4*c_in 4*c_out"]:
    """The matrix from a pixel and its upper and left neighbours to the 2 x 2 output pixels in its place.

    Along one axis input i adds its tap k to output 2i + 2 - k.  So the even output of pixel p is tap 2 of p and tap 0 of
    p - 1; the odd one is tap 1 of p, and nothing of p - 1.  The taps reversed and one zero, (2, 1, 0, none), are that table
    of (p, p - 1) by (even, odd).
    """
    c_in, c_out = kernel.shape[0], kernel.shape[-1]
    table = jnp.pad(kernel[:, ::-1, ::-1], [(0, 0), (0, 1), (0, 1), (0, 0)])
    table = table.reshape(c_in, 2, 2, 2, 2, c_out)  # c_in, row source, row parity, column source, column parity, c_out
    return table.transpose(1, 3, 0, 2, 4, 5).reshape(4 * c_in, 4 * c_out)


class ConvTranspose(nn.Module):
    """3 x 3 transposed convolution of stride 2, 'SAME' as in `lax.conv_transpose`: [..., h, w, c] -> [..., 2h, 2w, features].

    One matmul gives each input pixel's 2 x 2 output pixels.  7 of its 16 blocks are zeros, yet it is 3 to 4 times faster,
    gradient included, than a matmul per tap whose results are then overlapped.  No bias: a BatchNorm follows.

    Attributes:
      features: output channels.
    """

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch h w c"]) -> Float[Array, "*batch 2*h 2*w features"]:
        *batch, height, width, channels = x.shape
        # An output pixel sums 9/4 taps on average: its fan-in is 9/4 times the channels.
        initializer = nn.initializers.variance_scaling(4 / 9, mode="fan_in", distribution="truncated_normal")
        kernel = self.param("kernel", initializer, (channels, KERNEL_SIZE**2 * self.features))
        matrix = subpixel_kernel(kernel.reshape(channels, KERNEL_SIZE, KERNEL_SIZE, self.features))

        padded = jnp.pad(x, [(0, 0)] * len(batch) + [(1, 0), (1, 0), (0, 0)])
        sources = [padded[..., 1 - i : height + 1 - i, 1 - j : width + 1 - j, :] for i in range(2) for j in range(2)]
        y = matmul(jnp.concatenate(sources, axis=-1).reshape(-1, 4 * channels), matrix)
        y = y.reshape(*batch, height, width, 2, 2, self.features).swapaxes(-4, -3)
        return y.reshape(*batch, 2 * height, 2 * width, self.features)
