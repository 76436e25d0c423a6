"""Extras of the package and the optional libraries that they install."""

from pathlib import Path
from typing import NamedTuple

_ROOT = Path(__file__).resolve().parents[1]  # of a clone


class Extra(NamedTuple):
    """An extra of the package; pyproject.toml lists the versions of its libraries.

    Attributes:
        purpose: Commands or features that need the extra.
        modules: Modules that the extra installs. If the first one is installed, the
            extra counts as installed.
        oldest_python: Oldest version of Python for which its libraries exist.
    """

    purpose: str
    modules: tuple[str, ...]
    oldest_python: tuple[int, int] = (3, 10)


EXTRAS = {
    "learning": Extra(
        "train, evaluate, record, watch, plot",
        ("tyro", "tqdm", "matplotlib", "imageio", "imageio_ffmpeg", "PIL", "filelock"),
    ),
    "viewer": Extra(
        "env.open_viewer() and watch --web", ("yourdfpy", "viser", "trimesh")
    ),
    "minari": Extra("data sets in Minari's format", ("minari", "h5py"), (3, 11)),
    "lerobot": Extra("data sets in LeRobot's format", ("lerobot",), (3, 12)),
    "tensorboard": Extra("train --logger tensorboard", ("tensorboard",)),
    "wandb": Extra("train --logger wandb", ("wandb",)),
    "ray": Extra("training on several machines", ("ray",)),
    "fetch": Extra(
        "training in Fetch and others of Gymnasium-Robotics",
        ("gymnasium_robotics", "mujoco"),
    ),
    "bench": Extra(
        "the other environments of bench",
        ("panda_gym", "stable_baselines3", "envpool"),
    ),
}


def install_command(extra: str) -> str:
    """The shell command that installs an extra.

    If the package is in a clone, the command installs it from there again, because
    pip's index may hold another version.
    """
    if not (_ROOT / "pyproject.toml").exists():
        return f"pip install 'torch_panda[{extra}]'"
    root = "." if Path.cwd() == _ROOT else _ROOT
    return f"pip install -e '{root}[{extra}]'"


def explain_missing(error: ModuleNotFoundError) -> str | None:
    """Say which extra installs a missing module; None if no extra does."""
    module = (error.name or "").partition(".")[0]
    for name, extra in EXTRAS.items():
        if module in extra.modules:
            return (
                f"{module} is not installed; it comes with the extra {name!r}: "
                f"{install_command(name)}"
            )
    return None
