"""What has to be set before JAX starts its backend, and what a run records about it."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

import jax

_PACKAGES = ("apt-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")
_MIN_COMPILE_SECONDS = 1.0
"""Programs that compile faster are not worth a file in the cache."""


def setup(cpu_devices: int | None = None) -> None:
    """Splits the CPU into devices and turns the persistent compilation cache on; call before the first array.

    Args:
      cpu_devices: devices the host CPU counts as, by default one per core this process may use.
    """
    jax.config.update("jax_num_cpu_devices", cpu_devices or cores())
    if not jax.config.values["jax_compilation_cache_dir"]:  # JAX itself reads JAX_COMPILATION_CACHE_DIR
        jax.config.update("jax_compilation_cache_dir", str(_cache_root() / "apt_jax" / "compiled"))
    jax.config.update("jax_default_matmul_precision", "highest")  # accelerators would round float32 inputs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _MIN_COMPILE_SECONDS)


def host() -> jax.Device:
    """The CPU as a device; where `JAX_PLATFORMS` leaves it out, the first device."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return jax.local_devices()[0]


def device_memory() -> int | None:
    """Bytes that this process may use of a device's memory; None where the host's is used, as on CPU."""
    return (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")


def describe() -> dict[str, object]:
    """Versions, device and commit, for a run's summary."""
    devices = jax.devices()
    return {
        "python": platform.python_version(),
        "packages": versions(_PACKAGES),
        "device_kind": devices[0].device_kind,
        "devices": len(devices),
        "processes": jax.process_count(),
        "git_commit": git_commit(),
    }


def git_commit() -> str | None:
    """The commit that runs, with "-dirty" where the code differs from it; texts and results make no difference.

    None if git does not know this file, as where the project is installed below another one's checkout.
    """
    git = ["git", "-C", str(Path(__file__).parent.parent)]
    code = [".", ":(exclude)*.md", ":(exclude)experiments/results"]
    try:
        _, commit, changes = (
            subprocess.run([*git, *words], capture_output=True, text=True, check=True).stdout.strip()
            for words in (
                ("ls-files", "--error-unmatch", __file__),
                ("rev-parse", "HEAD"),
                ("status", "--porcelain", "--", *code),
            )
        )
    except (OSError, subprocess.CalledProcessError):  # no git, or not a checkout
        return None
    return f"{commit}-dirty" if changes else commit


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cache_root() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def versions(packages: Sequence[str] = _PACKAGES) -> dict[str, str | None]:
    """The installed version of each package, None of one that is missing, by default of those that a run depends on."""

    def version(package: str) -> str | None:
        try:
            return metadata.version(package)
        except metadata.PackageNotFoundError:
            return None

    return {package: version(package) for package in packages}
