"""What is promised about the repository itself: its commands, its versions, its pins, and that an import costs nothing."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
PACKAGES = ("apt_jax", "envs", "experiments")


def names(requirements):
    """Normalised distribution names of requirement lines."""
    return {re.split(r"[<>=!~;\[ ]", line, maxsplit=1)[0].lower().replace("_", "-") for line in requirements}


def pins():
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def makefile_targets():
    return set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.MULTILINE))


def test_documented_make_commands_are_targets():
    for document in ("README.md", "CONTRIBUTING.md"):
        path = ROOT / document
        if path.exists():
            # As a command: in a code block's line or in backquotes.
            commands = re.findall(r"(?:^\$? *|`)make ([a-z]+)", path.read_text("utf-8"), flags=re.MULTILINE)
            assert set(commands) <= makefile_targets(), document


def test_readme_names_train_and_test():
    text = (ROOT / "README.md").read_text("utf-8")
    assert "make train" in text
    assert "make test" in text
    assert {"train", "test"} <= makefile_targets()


def test_ci_runs_make_test():
    script = ROOT / ".ci" / "run"
    assert "make test" in script.read_text("utf-8")
    assert script.stat().st_mode & 0o111


def test_versions_agree():
    version = PROJECT["version"]
    assert re.search(rf"^version: ['\"]?{re.escape(version)}['\"]?$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE)
    assert metadata.version(PROJECT["name"]) == version


def test_pins_are_plain_and_complete():
    """Nothing but name==version, so that any registry will do, and one for every direct dependency that `make` installs."""
    for pin in pins():
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", pin), pin
    extras = PROJECT["optional-dependencies"]
    wanted = names(PROJECT["dependencies"]) | names(extras["experiments"]) | names(extras["dev"])
    assert wanted <= names(pins())


def test_requirements_have_lower_bounds_and_only_mujoco_an_upper_one():
    extras = PROJECT["optional-dependencies"]
    for requirement in [*PROJECT["dependencies"], *extras["experiments"], *extras["dev"]]:
        assert ">=" in requirement, requirement
        assert ("<" in requirement) == requirement.startswith("mujoco"), requirement


def module_names():
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


IMPORT_ALL = """
import importlib, sys
import jax
optional, names = sys.argv[1].split(), sys.argv[2:]
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in optional:
            raise
    # JAX refuses this setting once a backend runs.
    try:
        jax.config.update("jax_num_cpu_devices", 3)
    except RuntimeError:
        sys.exit(f"importing {name} starts the JAX backend")
"""


def import_all(modules, cwd=ROOT):
    optional = " ".join(names(PROJECT["optional-dependencies"]["peers"]))
    command = [sys.executable, "-c", IMPORT_ALL, optional, *modules]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, check=False)


def test_no_import_starts_a_backend():
    """Every module imports, unless it needs a peer that is not installed, and leaves the choice of devices open."""
    result = import_all(module_names())
    assert result.returncode == 0, result.stderr


def test_planted_constant_that_starts_a_backend_is_found(tmp_path):
    (tmp_path / "eager.py").write_text("import jax.numpy as jnp\nZERO = jnp.zeros(())\n")
    result = import_all(["eager"], cwd=tmp_path)
    assert result.returncode == 1
    assert "importing eager starts the JAX backend" in result.stderr


@pytest.mark.parametrize("name", ["LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"])
def test_repository_keeps(name):
    assert (ROOT / name).stat().st_size > 0


def test_type_checker_reports_a_planted_fault(tmp_path):
    """The configuration of `make lint` is strict enough to see it."""
    (tmp_path / "planted.py").write_text(
        "def size(name: str) -> int:\n    return name\n\n\ndef untyped(name):\n    return name\n"
    )
    words = [
        "-m",
        "mypy",
        "--config-file",
        "pyproject.toml",
        "--cache-dir",
        str(tmp_path / "cache"),
        str(tmp_path / "planted.py"),
    ]
    result = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "[return-value]" in result.stdout
    assert "[no-untyped-def]" in result.stdout
