"""The paper's networks: sizes, invariances, and behaviour under `vmap` over seeds."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax.networks import (
    Discriminator,
    Generator,
    QNetwork,
    ValueNetwork,
    init_singular_vectors,
    pool,
    pool_probabilities,
    spectral_normalize,
    vector_divergence,
)
from apt_jax.networks.encoders import observation_features, parameter_features
from apt_jax.networks.generator import OUTPUT_NORM
from apt_jax.specs import Grid, Spec, Table, Vector

NUM_ACTIONS = 4
NOISE_SIZE = 8
OBS_SPEC: Spec = {"agent": Vector(2, 0, 9, "uint8"), "view": Grid(7, 7, 3), "objects": Vector(10, -9, 9, "int8")}
PARAM_SPEC: Spec = {
    "tiles": Grid(8, 8, 3),
    "table": Grid(6, 4, 3),
    "places": Table(3, 24),
    "goal": Vector(2, 0.0, 9.0),
    "angle": Vector(1, -2.0, 1.0),
}


def random_obs(seed, lead=()):
    rng = np.random.default_rng(seed)
    return {
        "agent": jnp.asarray(rng.integers(0, 10, (*lead, 2)), jnp.uint8),
        "view": jnp.asarray(rng.integers(0, 3, (*lead, 7, 7)), jnp.uint8),
        "objects": jnp.asarray(rng.integers(-9, 10, (*lead, 10)), jnp.int8),
    }


def random_transition(seed, lead=()):
    rng = np.random.default_rng(seed)
    return {
        "obs": random_obs(seed, lead),
        "action": jnp.asarray(rng.integers(0, NUM_ACTIONS, lead), jnp.int32),
        "reward": jnp.asarray(rng.normal(size=lead), jnp.float32),
        "next_obs": random_obs(seed + 1, lead),
    }


def random_w(seed, lead=()):
    rng = np.random.default_rng(seed)
    shapes = {"tiles": (8, 8, 3), "table": (6, 4, 3), "places": (3, 24), "goal": (2,), "angle": (1,)}
    return {name: jnp.asarray(rng.uniform(size=(*lead, *shape)), jnp.float32) for name, shape in shapes.items()}


NETWORKS = {
    "q": (QNetwork(OBS_SPEC, NUM_ACTIONS), lambda seed, lead=(): {"obs": random_obs(seed, lead)}),
    "discriminator": (Discriminator(OBS_SPEC, NUM_ACTIONS), random_transition),
    "value": (ValueNetwork(PARAM_SPEC), lambda seed, lead=(): {"w": random_w(seed, lead)}),
}


def count(params):
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def dense(inputs, outputs):
    return (inputs + 1) * outputs


def encoder_size(*, vectors, grids):
    """Parameters of an encoder by the paper's layer sizes; a grid is (categories, cells left after two convolutions)."""
    stacks = sum(dense(9 * categories, 16) + dense(9 * 16, 16) + dense(16 * cells, 64) for categories, cells in grids)
    return stacks + sum(dense(size, 64) for size in vectors)


@functools.cache
def initial_params(name):
    network, inputs = NETWORKS[name]
    return jax.jit(lambda key: network.init(key, **inputs(0)))(jax.random.key(0))


OBS_ENCODER = encoder_size(vectors=[2, 10], grids=[(3, 4)])
PAPER_SIZES = {
    "q": OBS_ENCODER + dense(3 * 64, 128) + dense(128, NUM_ACTIONS),
    "discriminator": 2 * OBS_ENCODER
    + dense(3 * 64, 128)
    + dense(128, 1)
    + dense(NUM_ACTIONS, 64)
    + dense(1, 64)
    + dense(8 * 64, 128)
    + dense(128, 1),
    "value": encoder_size(vectors=[2, 1, 3 * 24], grids=[(3, 4), (3, 2)]) + dense(5 * 64, 128) + dense(128, 1),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_sizes_are_the_papers(name):
    network, inputs = NETWORKS[name]
    params = jax.eval_shape(lambda: network.init(jax.random.key(0), **inputs(0)))
    assert count(params) == PAPER_SIZES[name]


@pytest.mark.parametrize("name", NETWORKS)
def test_leading_axes(name):
    network, inputs = NETWORKS[name]
    batch = inputs(0, (2, 3))
    params = initial_params(name)
    apply = lambda batch: network.apply(params, **batch)  # noqa: E731
    together, one_by_one = jax.jit(lambda batch: (apply(batch), jax.vmap(jax.vmap(apply))(batch)))(batch)
    chex.assert_trees_all_close(together, one_by_one, atol=1e-5)


def test_outputs_differ_with_every_input():
    network, inputs = NETWORKS["discriminator"]
    batch, other = inputs(0), inputs(5)
    apply = jax.jit(lambda batch: network.apply(initial_params("discriminator"), **batch)[1])
    logit = apply(batch)
    for name in batch:
        changed = batch | {name: other[name] if name != "action" else (batch["action"] + 1) % NUM_ACTIONS}
        assert apply(changed) != logit, name


def test_discriminator_methods_agree_with_call():
    network, inputs = NETWORKS["discriminator"]
    batch = inputs(0, (5,))
    params = initial_params("discriminator")

    @jax.jit
    def both_ways(batch):
        init_logit = network.apply(params, batch["obs"], method="score_init")
        step_logit = network.apply(params, **batch, method="score_step")
        return (init_logit, step_logit), network.apply(params, **batch)

    chex.assert_trees_all_close(*both_ways(batch))


def test_features():
    obs = {"agent": jnp.array([9, 0], jnp.uint8), "view": jnp.full((7, 7), 2, jnp.uint8), "objects": jnp.full(10, -9, jnp.int8)}
    features = observation_features(OBS_SPEC, obs)
    np.testing.assert_array_equal(features["agent"], [1.0, 0.0])
    np.testing.assert_array_equal(features["view"], np.broadcast_to([0.0, 0.0, 1.0], (7, 7, 3)))
    np.testing.assert_array_equal(features["objects"], -np.ones(10))
    w = random_w(0)
    features = parameter_features(PARAM_SPEC, w)
    np.testing.assert_array_equal(features["tiles"], w["tiles"])
    np.testing.assert_allclose(features["goal"], w["goal"] / 9.0)
    np.testing.assert_allclose(features["angle"], w["angle"] / 2.0)
    np.testing.assert_array_equal(features["places"], w["places"].reshape(72))
    chosen = observation_features({"places": Table(2, 3)}, {"places": jnp.array([2, 0], jnp.uint8)})
    np.testing.assert_array_equal(chosen["places"], [0, 0, 1, 1, 0, 0])


def test_pool_weighs_the_initial_logit_as_one_of_all_encodings():
    init_logit = jnp.array([2.0, 2.0, 4.0])
    step_logits = jnp.array([[1.0, 3.0], [0.5, 1.5], [1.0, 1.0]])
    # (2 + 1 + 3) / 3;  (2 + 9 * 1) / 10;  (4 + 1) / 2
    np.testing.assert_allclose(pool(init_logit, step_logits, jnp.array([2, 9, 1])), [2.0, 1.1, 2.5], rtol=1e-6)


def test_pooled_probabilities_count_the_initial_one_half():
    logit = np.log([3.0, 1.0 / 3.0])  # probabilities of 3/4 and 1/4
    pooled = pool_probabilities(jnp.array([logit[0], 100.0]), jnp.array([[logit[0], logit[1]], [-100.0, -100.0]]))
    np.testing.assert_allclose(jax.nn.sigmoid(pooled), [0.5 * (0.75 + 0.5), 0.5], rtol=1e-6)
    assert np.isfinite(pool_probabilities(jnp.array([100.0]), jnp.array([[100.0]]))).all()


GENERATOR = Generator(PARAM_SPEC)


@jax.jit
def generate_train(variables, z):
    """The task parameters by the batch's statistics, and the moved running statistics."""
    return GENERATOR.apply(variables, z, train=True, mutable=["batch_stats"])


@jax.jit
def generate(variables, z):
    return GENERATOR.apply(variables, z, train=False)


@functools.cache
def noise_and_variables():
    z = jax.random.normal(jax.random.key(0), (64, NOISE_SIZE))
    return z, jax.jit(lambda key: GENERATOR.init(key, z, train=True))(jax.random.key(1))


@pytest.mark.parametrize("train", [True, False])
def test_generator_shapes_and_bounds(train):
    z, variables = noise_and_variables()
    w = generate_train(variables, 100.0 * z)[0] if train else generate(variables, 100.0 * z)
    chex.assert_shape([w["tiles"], w["table"]], [(64, 8, 8, 3), (64, 6, 4, 3)])
    chex.assert_shape([w["places"], w["goal"], w["angle"]], [(64, 3, 24), (64, 2), (64, 1)])
    chex.assert_tree_all_finite(w)
    for name in ("goal", "angle"):
        assert w[name].min() >= PARAM_SPEC[name].low
        assert w[name].max() <= PARAM_SPEC[name].high
    for name in ("tiles", "table", "places"):
        assert w[name].min() >= 0
        np.testing.assert_allclose(w[name].sum(-1), 1.0, rtol=1e-5)


def test_generator_sizes():
    _, variables = noise_and_variables()
    norm = 2  # scale and bias
    vectors = sum((64 + norm) * size for size in (2, 1))
    # The projection is normalised per unit, convolutions per channel, scores per cell and category.
    grids = sum(
        (64 + norm) * 16 * cells + 2 * (9 * 16 + norm) * 16 + 9 * 16 * 3 + norm * 3 * scores
        for cells, scores in ((4, 64), (2, 24))
    )
    # A table is made like a grid of rows by categories with one channel.
    table = (64 + norm) * 16 * 6 + 2 * (9 * 16 + norm) * 16 + 9 * 16 + norm * 3 * 24
    assert count(variables["params"]) == (NOISE_SIZE + norm) * 64 + vectors + grids + table


def test_blank_bias_gives_category_0_a_head_start():
    z, _ = noise_and_variables()
    generator = Generator(PARAM_SPEC, blank_bias=2.0)
    variables = jax.jit(lambda key: generator.init(key, z, train=True))(jax.random.key(1))
    w, _ = jax.jit(lambda z: generator.apply(variables, z, train=True, mutable=["batch_stats"]))(z)
    for name in ("tiles", "table"):
        blank = jnp.mean(jnp.argmax(w[name], axis=-1) == 0)
        assert 0.7 < blank < 0.95
    assert jnp.mean(jnp.argmax(w["places"], axis=-1) == 0) < 0.3  # no place is blank


def test_every_cell_differs_with_noise():
    """Regression: normalised over cells too, one board for every z met the normalisation."""
    z, variables = noise_and_variables()
    w, _ = generate_train(variables, z)
    for name in ("tiles", "table", "places"):
        assert (jnp.argmax(w[name], axis=-1).std(axis=0) > 0.5).all()


def test_generator_outputs_differ_with_noise():
    z, variables = noise_and_variables()
    w, _ = generate_train(variables, z)
    for block in jax.tree.leaves(w):
        assert block.std(axis=0).min() > 0.01


def test_generator_statistics_are_the_batchs_in_training_only():
    z, variables = noise_and_variables()
    other = z.at[1:].multiply(3.0)
    # Sample 0 is the same in both batches: in training it depends on its company, otherwise it does not.
    in_training = [generate_train(variables, batch)[0]["goal"][0] for batch in (z, other)]
    assert np.abs(in_training[0] - in_training[1]).max() > 0.01
    chex.assert_trees_all_close(generate(variables, z)["goal"][0], generate(variables, other)["goal"][0], atol=1e-6)
    # Without biases, the normalised outputs do not see the scale of the whole batch.
    chex.assert_trees_all_close(generate_train(variables, z)[0], generate_train(variables, 10.0 * z)[0], atol=1e-3)


def test_generator_running_statistics_converge():
    z, variables = noise_and_variables()
    for _ in range(150):
        w, moved = generate_train(variables, z)
        variables = variables | moved
    chex.assert_trees_all_close(generate(variables, z), w, atol=1e-3)


def test_vector_divergence_is_that_of_normal_distributions():
    """Against an integral on a fine grid; grids take no part."""
    biases, scales = np.array([2.0, -0.5]), np.array([0.3, -1.5])
    x = np.linspace(-30.0, 30.0, 600_001)[:, None]

    def log_density(x, mean, deviation):
        return -0.5 * ((x - mean) / deviation) ** 2 - np.log(deviation * np.sqrt(2.0 * np.pi))

    log_p, log_q = log_density(x, biases, np.abs(scales)), log_density(x, 0.0, 1.0)
    expected = np.trapezoid(np.exp(log_p) * (log_p - log_q), x, axis=0).sum()
    params = {"goal": {OUTPUT_NORM: {"bias": jnp.array(biases), "scale": jnp.array(scales)}}}
    spec = {"table": Grid(6, 4, 3), "goal": Vector(2, 0.0, 9.0)}
    np.testing.assert_allclose(vector_divergence(spec, params), expected, rtol=1e-5)
    fresh = jax.jit(lambda key: Generator(spec).init(key, jnp.zeros((2, NOISE_SIZE)), train=True)["params"])(jax.random.key(0))
    np.testing.assert_allclose(vector_divergence(spec, fresh), 0.0, atol=1e-6)


def test_spectral_normalize_covers_every_kernel_of_the_discriminator():
    params = initial_params("discriminator")["params"]
    u = jax.jit(init_singular_vectors)(jax.random.key(1), params)
    step = jax.jit(lambda u: spectral_normalize(params, u, bound=0.8))
    for _ in range(100):
        normalized, u = step(u)
    kernels = [leaf for leaf in jax.tree.leaves(normalized) if leaf.ndim > 1]
    assert len(kernels) == len(u) == 2 * 5 + 2 + 2 * 2
    for kernel in kernels:
        np.testing.assert_allclose(np.linalg.norm(kernel, ord=2), 0.8, rtol=0.02)


def test_spectral_normalize_leaves_kernels_within_the_bound_alone():
    params = initial_params("discriminator")["params"]
    u = jax.jit(init_singular_vectors)(jax.random.key(1), params)
    unbounded, _ = jax.jit(lambda u: spectral_normalize(params, u, bound=np.inf))(u)
    for before, after in zip(jax.tree.leaves(params), jax.tree.leaves(unbounded), strict=True):
        np.testing.assert_array_equal(before, after)


def loss_of(network, batch):
    return lambda params: sum(jnp.mean(jnp.square(y)) for y in jax.tree.leaves(network.apply(params, **batch)))


def generator_loss(generator, variables, z):
    w, _ = generator.apply(variables, z, train=True, mutable=["batch_stats"])
    return sum(jnp.mean(jnp.square(block)) for block in jax.tree.leaves(w))


def seed_losses():
    for name, (network, inputs) in NETWORKS.items():
        batch = inputs(0, (5,))
        yield name, lambda key, network=network, batch=batch: network.init(key, **batch), loss_of(network, batch)
    generator = Generator({"table": Grid(6, 4, 3), "goal": Vector(2, 0.0, 9.0)})
    z = jax.random.normal(jax.random.key(9), (5, NOISE_SIZE))
    yield "generator", lambda key: generator.init(key, z, train=True), lambda v: generator_loss(generator, v, z)


@pytest.mark.parametrize(("init", "loss"), [pytest.param(*rest, id=name) for name, *rest in seed_losses()])
def test_stacked_seeds(init, loss):
    """Seeds side by side give what each gives alone, by matmuls only."""
    keys = jax.random.split(jax.random.key(3), 2)
    stacked = jax.jit(jax.vmap(init))(keys)
    stacked_grads = jax.vmap(jax.grad(loss))
    assert "conv_general_dilated" not in str(jax.make_jaxpr(stacked_grads)(stacked))
    together = jax.jit(stacked_grads)(stacked)
    grads = jax.jit(jax.grad(loss))
    for i in range(2):
        alone = grads(jax.tree.map(lambda x, i=i: x[i], stacked))
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], together), alone, atol=1e-4, rtol=1e-3)
