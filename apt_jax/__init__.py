"""A JAX-native, vectorised, end-to-end trainer for APT-Gen."""
