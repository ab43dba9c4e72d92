"""The paper's networks, built from specs (appendix "Network Architectures")."""

from apt_jax.networks.discriminator import Discriminator, pool, pool_probabilities
from apt_jax.networks.distillation import Distillation
from apt_jax.networks.dynamics import Dynamics
from apt_jax.networks.generator import Generator, vector_divergence
from apt_jax.networks.q_network import QNetwork
from apt_jax.networks.spectral import init_singular_vectors, spectral_normalize
from apt_jax.networks.value_network import ValueNetwork

__all__ = [
    "Discriminator",
    "Distillation",
    "Dynamics",
    "Generator",
    "QNetwork",
    "ValueNetwork",
    "init_singular_vectors",
    "pool",
    "pool_probabilities",
    "spectral_normalize",
    "vector_divergence",
]
