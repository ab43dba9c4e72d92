"""Convolutions against XLA's own, spectral normalisation against the singular value decomposition."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from apt_jax.networks.layers import Conv, ConvTranspose
from apt_jax.networks.matmul import matmul
from apt_jax.networks.spectral import init_singular_vectors, spectral_normalize

# Each program runs a few times on small arrays, so compile fast rather than run fast.
jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})

DIMENSIONS = ("NHWC", "HWIO", "NHWC")


def assert_same_function(ours, reference, *args):
    """Equal values, and equal gradients of a sum whose terms have different weights."""

    def weighted(function):
        def loss(*args):
            y = function(*args)
            return jnp.sum(y * jnp.cos(jnp.arange(y.size, dtype=jnp.float32)).reshape(y.shape))

        return loss

    argnums = tuple(range(len(args)))
    run = jit(lambda *args: [(f(*args), jax.grad(weighted(f), argnums=argnums)(*args)) for f in (ours, reference)])
    (values, gradients), (expected_values, expected_gradients) = run(*args)
    chex.assert_trees_all_close(values, expected_values, atol=1e-5)
    chex.assert_trees_all_close(gradients, expected_gradients, atol=1e-4)


SHAPES = {"as it is": (6, 9, 8), "rows copied": (6, 16, 32), "gradient copied": (20, 48, 4)}
"""Rows, inputs and outputs of products whose weights' gradient is computed in different ways."""


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("batched", [(None, None), (None, 0), (0, None), (0, 0)])
def test_matmul_equals_the_operator(shape, batched):
    rows, inputs, outputs = shape
    sizes = (2, rows // 2, inputs), (inputs, outputs)
    batch = [() if axis is None else (3,) for axis in batched]
    keys = jax.random.split(jax.random.key(0))
    x, w = (jax.random.normal(key, n + size) for key, n, size in zip(keys, batch, sizes, strict=True))

    def over_batch(function):
        return function if batched == (None, None) else jax.vmap(function, in_axes=batched)

    assert_same_function(over_batch(matmul), over_batch(lambda x, w: jnp.einsum("abi,io->abo", x, w)), x, w)


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize(("height", "width"), [(7, 7), (6, 4), (1, 2)])
def test_conv_equals_lax(height, width, stride):
    x = jax.random.normal(jax.random.key(0), (2, height, width, 3))
    conv = Conv(5, stride=stride)
    params = conv.init(jax.random.key(1), x)["params"]
    params["bias"] = jnp.arange(5.0)
    chex.assert_shape(params["kernel"], (27, 5))

    def reference(params, x):
        kernel = params["kernel"].reshape(3, 3, 3, 5)
        y = lax.conv_general_dilated(x, kernel, (stride, stride), "SAME", dimension_numbers=DIMENSIONS)
        return y + params["bias"].reshape(1, 1, 1, 5)

    assert_same_function(lambda params, x: conv.apply({"params": params}, x), reference, params, x)


@pytest.mark.parametrize(("height", "width"), [(2, 1), (3, 5)])
def test_conv_transpose_equals_lax(height, width):
    x = jax.random.normal(jax.random.key(0), (2, height, width, 4))
    layer = ConvTranspose(5)
    params = layer.init(jax.random.key(1), x)

    def reference(params, x):
        kernel = params["params"]["kernel"].reshape(4, 3, 3, 5).transpose(1, 2, 0, 3)
        return lax.conv_transpose(x, kernel, (2, 2), "SAME", dimension_numbers=DIMENSIONS)

    assert layer.apply(params, x).shape == (2, 2 * height, 2 * width, 5)
    assert_same_function(layer.apply, reference, params, x)


@pytest.mark.parametrize("layer", [Conv(5, stride=2), Conv(5, stride=1, use_bias=False), ConvTranspose(5)])
def test_leading_axes(layer):
    x = jax.random.normal(jax.random.key(0), (2, 3, 6, 4, 3))
    params = layer.init(jax.random.key(1), x)
    apply = jit(layer.apply)
    y = apply(params, x)
    one_by_one = jnp.stack([jnp.stack([apply(params, image) for image in row]) for row in x])
    chex.assert_trees_all_close(y, one_by_one, atol=1e-6)


def test_initial_outputs_keep_the_scale_of_inputs():
    x = jax.random.normal(jax.random.key(0), (16, 16, 16, 16))
    for layer in (Conv(16, stride=1), Conv(16, stride=2), ConvTranspose(16)):
        y, _ = jit(layer.init_with_output)(jax.random.key(1), x)
        np.testing.assert_allclose(y.std(), 1.0, atol=0.1)


def tiny_params():
    keys = jax.random.split(jax.random.key(0), 3)
    kernels = [jax.random.normal(key, shape) for key, shape in zip(keys, [(27, 16), (10, 64), (128, 1)], strict=True)]
    return {
        "conv": {"kernel": kernels[0], "bias": jnp.ones(16)},
        "head": {"merge": {"kernel": kernels[1]}, "output": {"kernel": kernels[2], "bias": jnp.full(1, 2.0)}},
    }


def test_spectral_normalize_against_svd():
    params = tiny_params()
    u = init_singular_vectors(jax.random.key(1), params)
    assert set(u) == {"conv/kernel", "head/merge/kernel", "head/output/kernel"}
    step = jit(lambda u: spectral_normalize(params, u, bound=0.8))
    for _ in range(200):
        normalized, u = step(u)
    chex.assert_trees_all_equal_structs(normalized, params)
    for path in (("conv",), ("head", "merge"), ("head", "output")):
        before, after = params, normalized
        for name in path:
            before, after = before[name], after[name]
        sigma = np.linalg.svd(before["kernel"], compute_uv=False)[0]
        np.testing.assert_allclose(np.linalg.svd(after["kernel"], compute_uv=False)[0], 0.8, rtol=1e-4)
        np.testing.assert_allclose(after["kernel"], before["kernel"] * 0.8 / sigma, atol=1e-4)
    np.testing.assert_array_equal(normalized["conv"]["bias"], params["conv"]["bias"])


def test_spectral_gradient_is_that_of_the_exact_norm():
    kernel = jax.random.normal(jax.random.key(0), (6, 5))
    cotangent = jax.random.normal(jax.random.key(1), (6, 5))
    u = init_singular_vectors(jax.random.key(2), {"kernel": kernel})
    step = jit(lambda u: spectral_normalize({"kernel": kernel}, u, bound=1.0)[1])
    for _ in range(200):
        u = step(u)

    def ours(kernel):
        return jnp.sum(cotangent * spectral_normalize({"kernel": kernel}, u, bound=1.0)[0]["kernel"])

    def exact(kernel):
        return jnp.sum(cotangent * kernel / jnp.linalg.norm(kernel, ord=2))

    chex.assert_trees_all_close(jax.grad(ours)(kernel), jax.grad(exact)(kernel), atol=1e-4)
