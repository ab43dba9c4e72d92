"""Compiled programs kept whole: a later start loads them, and neither traces nor lowers nor compiles.

JAX's own cache finds what XLA has made of a program only once it is traced and lowered again, which is two thirds of a start.
Here a program is found by what it is made of: the sources of apt_jax and envs, versions, settings, the machine, and the types
of its arguments.
"""

from __future__ import annotations

import dataclasses
import os
import pickle
import platform
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache.compilation_cache import reset_cache

import apt_jax
import envs
from apt_jax.turns import Turns
from experiments import runtime

SOURCES = tuple(Path(package.__path__[0]) for package in (apt_jax, envs))
"""Folders whose Python files decide what is computed, with what `Programs.of` is told."""

_FLAGS = ("XLA_FLAGS", "LIBTPU_INIT_ARGS")


class Programs:
    """Compiles, or loads what was compiled before.

    Attributes:
      loaded: how many did not have to be compiled.
      compiled: how many had to be.
    """

    def __init__(self, folder: Path | None = None, made_of: str = ""):
        """Those in `folder` that are made of the same; without a folder nothing is kept."""
        self.loaded = self.compiled = 0
        self._folder = folder
        self._made_of = made_of

    @classmethod
    def of(cls, *parts: object) -> Programs:
        """In JAX's cache directory, if there is one: those of `parts`, by their `repr`, for this machine as it is set up."""
        directory = jax.config.values["jax_compilation_cache_dir"]
        if not directory or not jax.config.values["jax_enable_compilation_cache"]:
            return cls()
        setting = (sorted(jax.config.values.items()), [os.environ.get(name) for name in _FLAGS])
        return cls(Path(directory) / "programs", repr((parts, digest(SOURCES), setting, machine(), runtime.versions())))

    def compile(self, name: str, function: Callable[..., Any], *args: Any) -> Callable[..., Any]:
        """What `function`, jitted, is for arguments of these types.

        Args:
          name: tells apart functions that are made of the same and have the same arguments.
        """
        return self.compile_all({name: function}, *args)[name]

    def compile_all(self, functions: Mapping[str, Callable[..., Any]], *args: Any) -> dict[str, Callable[..., Any]]:
        """What each of several functions of the same arguments is, by name: one is traced while another is compiled."""
        files = {name: self._file(name, args) for name in functions}
        programs: dict[str, Callable[..., Any]] = {}
        programs |= {name: kept for name, file in files.items() if file and (kept := _load(file, functions[name])) is not None}
        missing = [name for name in functions if name not in programs]
        self.loaded += len(programs)
        self.compiled += len(missing)

        with _without_cache() if self._folder and missing else nullcontext(), ThreadPoolExecutor() as pool:
            lowered = (cast(jax.stages.Wrapped, functions[name]).lower(*args) for name in missing)
            compiling = [pool.submit(one.compile) for one in lowered]
            programs |= {name: one.result() for name, one in zip(missing, compiling, strict=True)}
        for name in missing:
            if file := files[name]:
                _save(file, programs[name])
        return programs

    def _file(self, name: str, args: Sequence[Any]) -> Path | None:
        """Where a program is kept."""
        if self._folder is None:
            return None
        leaves, structure = jax.tree.flatten(args)
        key = repr((self._made_of, name, str(structure), [_type(leaf) for leaf in leaves]))
        return self._folder / f"{name}-{sha256(key.encode()).hexdigest()}"


def digest(folders: Sequence[Path]) -> str:
    """Changes with every Python file's name and content."""
    content = sha256()
    for folder in folders:
        for file in sorted(folder.rglob("*.py")):
            content.update(repr((str(file.relative_to(folder)), file.read_bytes())).encode())
    return content.hexdigest()


def machine() -> tuple[object, ...]:
    """What a program that runs here need not run on elsewhere, or not as well, with all devices that it should use."""
    info = Path("/proc/cpuinfo")
    cpu = info.read_text().split("\n\n")[0] if info.is_file() else platform.processor()
    features = [line for line in cpu.splitlines() if line.startswith(("model name", "flags", "Features"))]
    devices = jax.devices()
    versions = (devices[0].device_kind, devices[0].client.platform_version)
    numbers = [device.id for device in devices]
    return platform.machine(), features or cpu, runtime.cores(), versions, numbers, runtime.device_memory()


def _type(leaf: Any) -> tuple[object, ...]:
    """Shape, dtype, and which part is where: shardings that differ in words alone, as all do on one device, are the same."""
    sharding = getattr(leaf, "sharding", None)
    if sharding is None:
        return (jax.typeof(leaf),)
    where: dict[jax.Device, Any] = sharding.devices_indices_map(leaf.shape)
    parts = sorted((device.id, str(part)) for device, part in where.items())
    return jax.typeof(leaf), sharding.memory_kind, parts


def _ids(sharding: jax.sharding.Sharding) -> list[int]:
    devices: set[jax.Device] = sharding.device_set
    return sorted(device.id for device in devices)


@contextmanager
def _without_cache() -> Iterator[None]:
    """JAX's cache set aside: what XLA has loaded from there can run, but loads no second time once it was saved again."""
    jax.config.update("jax_enable_compilation_cache", False)
    reset_cache()  # it asks for the setting only once
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
        reset_cache()


def _save(file: Path, program: Callable[..., Any]) -> None:
    """Whole or not at all, whoever else writes it; a run goes on without.  Of lanes that take turns, what each turn calls."""
    compiled = cast(jax.stages.Compiled, program.function if isinstance(program, Turns) else program)
    own = file.with_name(f"{file.name}.{os.getpid()}")
    try:
        ids = _ids(jax.tree.leaves(compiled.output_shardings)[0])
        content = pickle.dumps((serialize_executable.serialize(compiled), ids))
        file.parent.mkdir(parents=True, exist_ok=True)
        own.write_bytes(zlib.compress(content, level=1))
        own.replace(file)
    except Exception as error:  # a full disk, or a device whose programs cannot be saved
        with suppress(OSError):
            own.unlink()
        warnings.warn(f"a compiled program could not be kept: {error}", stacklevel=2)


@cache
def _look_up_lapack() -> None:
    """JAX looks LAPACK's functions up when it lowers a call of one; a program that comes without lowering would call nothing.

    On CPU that ends the process.
    """
    square = jax.ShapeDtypeStruct((1, 1), np.float32)
    jax.jit(jnp.linalg.cholesky).trace(square).lower(lowering_platforms=("cpu",))


def _load(file: Path, function: Callable[..., Any]) -> Callable[..., Any] | None:
    """What `function` was compiled to; None if there is none, or none that can be used."""
    try:
        (serialized, in_tree, out_tree), ids = pickle.loads(zlib.decompress(file.read_bytes()))
        devices = [device for device in jax.devices() if device.id in ids]
        _look_up_lapack()
        compiled = serialize_executable.deserialize_and_load(serialized, in_tree, out_tree, execution_devices=devices)
        return dataclasses.replace(function, function=compiled) if isinstance(function, Turns) else compiled
    except OSError:
        return None
    except Exception as error:  # whatever a damaged file makes of itself
        warnings.warn(f"{file} cannot be loaded and is made anew: {error}", stacklevel=2)
        return None
