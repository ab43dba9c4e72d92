"""Applying a module without the union type that flax gives its result."""

from __future__ import annotations

from typing import Any

import flax.linen as nn


def apply(module: nn.Module, variables: Any, *args: Any, **kwargs: Any) -> Any:
    """`module.apply(variables, ...)`; its result is whatever the module's method returns."""
    return module.apply(variables, *args, **kwargs)
