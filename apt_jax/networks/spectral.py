"""Spectral normalisation (Miyato et al. 2018, SN-GAN) as a pure function on a network's parameters.

The linen modules stay plain: normalise the parameters, then apply.  Every kernel here is a matrix [inputs, outputs], also
that of `layers.Conv` ([9 * c_in, c_out], the matrix that SN-GAN normalises).
"""

from __future__ import annotations

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict, unflatten_dict
from jax import lax
from jaxtyping import Array, Float, Key

Variables: TypeAlias = dict[str, Any]
SingularVectors: TypeAlias = dict[str, Float[Array, " inputs"]]
"""Left singular vector estimate of each kernel, by the kernel's path; part of the caller's state."""

_SEPARATOR = "/"
_EPSILON = 1e-12


def _unit(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """`x` at length 1; a zero vector stays zero."""
    return x / (jnp.linalg.norm(x) + _EPSILON)


def init_singular_vectors(key: Key[Array, ""], params: Variables) -> SingularVectors:
    """A random unit vector per kernel (every two-dimensional leaf) of `params`; consumes `key`."""
    kernels = {path: leaf for path, leaf in flatten_dict(params, sep=_SEPARATOR).items() if leaf.ndim == 2}
    keys = jax.random.split(key, len(kernels))
    return {
        path: _unit(jax.random.normal(key_kernel, (kernel.shape[0],)))
        for key_kernel, (path, kernel) in zip(keys, kernels.items(), strict=True)
    }


def spectral_norm(
    kernel: Float[Array, "inputs outputs"], u: Float[Array, " inputs"]
) -> tuple[Float[Array, ""], Float[Array, " inputs"]]:
    """The largest singular value after one power iteration from `u`, and the next `u`.

    The gradient reaches the kernel through sigma = u^T W v with u and v held constant (SN-GAN, eq. 11).
    """
    v = _unit(u @ lax.stop_gradient(kernel))
    image = kernel @ v
    u = _unit(lax.stop_gradient(image))
    return u @ image, u


def spectral_normalize(
    params: Variables, u: SingularVectors, *, bound: float | Float[Array, ""]
) -> tuple[Variables, SingularVectors]:
    """Scales every kernel of spectral norm above `bound` (> 0) down to it; biases pass unchanged.

    Also moves `u` by one power iteration.
    """
    leaves = flatten_dict(params, sep=_SEPARATOR)
    new_u = {}
    for path, vector in u.items():
        sigma, new_u[path] = spectral_norm(leaves[path], vector)
        leaves[path] = leaves[path] / jnp.maximum(1.0, sigma / bound)  # an infinite bound leaves value and gradient alone
    return unflatten_dict(leaves, sep=_SEPARATOR), new_u
