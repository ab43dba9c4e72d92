"""An import only ever points down: experiments -> envs -> apt_jax, and inside apt_jax from a layer to a lower one.

The table is the architecture.  A unit is a module of `apt_jax` or one of its sub-packages; units of one layer do not know
each other, modules of one sub-package may.  A unit that the table does not name is a failure: a new one is given its place.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

LAYERS: tuple[frozenset[str], ...] = (
    frozenset({"descent", "draws", "registry", "specs"}),
    frozenset({"config", "task_space"}),
    frozenset({"losses", "networks", "replay"}),
    frozenset({"checks", "learner", "plugin"}),
    frozenset({"bonuses", "curricula"}),
    frozenset({"evaluation", "methods", "workers"}),
    frozenset({"trainer"}),
    frozenset({"turns"}),
    frozenset({"checkpoint", "lanes"}),
    frozenset({"__init__"}),  # the package's own face
)
ENVS_MAY_IMPORT = frozenset({"draws", "registry", "specs", "task_space"})
OURS = frozenset({"apt_jax", "envs", "experiments"})


def layer_of(unit: str) -> int | None:
    """The number of a unit's layer, 0 at the bottom; None if the table does not name it."""
    return next((number for number, units in enumerate(LAYERS) if unit in units), None)


def imports(source: str, module: str, is_package: bool = False) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything a source imports, also inside functions and type-checking blocks."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                parts = parts[: len(parts) - node.level + is_package]
                base = ".".join([*parts, base] if base else parts)
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def unit_of(name: str) -> str:
    """The unit of `apt_jax` that an imported name belongs to; the package itself is `__init__`."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def faults(source: str, module: str, is_package: bool = False) -> list[str]:
    """What is wrong with the imports of one module of apt_jax or envs, a line each."""
    package = module.split(".")[0]
    unit = unit_of(module)
    own_layer = layer_of(unit)
    found = []
    if package == "apt_jax" and own_layer is None:
        found.append(f"{module}: the table of layers does not name {unit!r}")
    for line, name in imports(source, module, is_package):
        target = name.split(".")[0]
        if target not in OURS:
            continue
        where = f"{module}:{line} imports {name}"
        if package == "apt_jax":
            if target != "apt_jax":
                found.append(f"{where}: the trainer knows task spaces by protocol only")
            elif unit_of(name) != unit and own_layer is not None:
                layer = layer_of(unit_of(name))
                if layer is None or layer >= own_layer:
                    found.append(f"{where}: not in a lower layer")
        elif target == "experiments" or (target == "apt_jax" and unit_of(name) not in ENVS_MAY_IMPORT):
            found.append(f"{where}: task spaces may import {sorted(ENVS_MAY_IMPORT)} of apt_jax only")
    return found


def modules(package: str) -> Iterator[tuple[Path, str, bool]]:
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        yield path, ".".join(parts[:-1] if is_package else parts), is_package


@pytest.mark.parametrize("package", ["apt_jax", "envs"])
def test_imports_point_down(package):
    found = [f for path, module, is_package in modules(package) for f in faults(path.read_text("utf-8"), module, is_package)]
    assert not found, "\n".join(found)


def test_every_package_is_covered():
    """A script of experiments/ may import everything; nothing else is a package of ours."""
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages == OURS


def test_table_names_nothing_else():
    assert {unit_of(module) for _, module, _ in modules("apt_jax")} == {name for layer in LAYERS for name in layer}


def test_table_names_a_unit_once():
    names = [name for layer in LAYERS for name in layer]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("apt_jax.replay", "from apt_jax.trainer import Trainer"),
        ("apt_jax.replay", "from apt_jax import trainer"),
        ("apt_jax.replay", "import apt_jax.trainer as t"),
        ("apt_jax.replay", "from .trainer import Trainer"),
        ("apt_jax.replay", "def late():\n    import apt_jax.learner"),
        ("apt_jax.replay", "import apt_jax"),
        ("apt_jax.replay", "from apt_jax.losses import td_target"),
        ("apt_jax.learner", "from apt_jax.curricula.apt_gen import apt_gen"),
        ("apt_jax.networks.generator", "from ..learner import update"),
        ("apt_jax.trainer", "import envs.grid_world"),
        ("apt_jax.lanes", "from experiments import train"),
        ("apt_jax.unheard_of", "import jax"),
        ("apt_jax.trainer", "from apt_jax.unheard_of import anything"),
        ("envs.grid_world.space", "from apt_jax.trainer import Trainer"),
        ("envs.grid_world.space", "import apt_jax"),
        ("envs.grid_world.space", "import experiments.train"),
    ],
)
def test_planted_upward_import_is_found(module, source):
    assert len(faults(source, module)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("apt_jax.trainer", "from apt_jax import learner, replay\nfrom apt_jax.networks import QNetwork"),
        ("apt_jax.networks.generator", "from .blocks import Block\nfrom apt_jax.specs import Spec"),
        ("envs.grid_world.space", "from apt_jax.specs import Grid\nfrom envs.grid_world.maze import solve\nimport jax"),
    ],
)
def test_downward_import_passes(module, source):
    assert faults(source, module) == []


def test_relative_import_in_a_package_file_starts_at_the_package():
    assert list(imports("from .base import Curriculum", "apt_jax.curricula", is_package=True)) == [
        (1, "apt_jax.curricula.base.Curriculum")
    ]
