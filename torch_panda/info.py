"""Text of ``python -m torch_panda info``: versions, environments and extras."""

import os
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import torch

import torch_panda
from torch_panda.bullet import solver
from torch_panda.bullet.loop import load_library
from torch_panda.bullet.pool import num_cores
from torch_panda.extras import EXTRAS, install_command

_PACKAGES = (
    "torch_panda",
    "pybullet",
    "torch",
    "torchrl",
    "tensordict",
    "gymnasium",
    "numpy",
    "panda-gym",
    "stable-baselines3",
    "gymnasium-robotics",
)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages, or "not installed"."""
    numbers = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            numbers[package] = version(package)
        except PackageNotFoundError:
            numbers[package] = "not installed"
    return numbers


def environments() -> list[str]:
    """Ids, sizes and number of steps, a line for each robot, task and control type."""
    if _loop_problem():
        return ["none can be made, see missing"]
    families: dict[str, list[str]] = {}
    for env_id in torch_panda.ENV_IDS:
        families.setdefault(re.sub(r"(Dense)?-v\d+$", "", env_id), []).append(env_id)
    lines = []
    for family, ids in families.items():
        suffixes = ",".join(env_id.removeprefix(family) for env_id in ids)
        with torch_panda.make(ids[0]) as env:
            sizes = {
                key: env.observation_spec[key].shape[-1]
                for key in ("observation", "desired_goal")
            }
            lines.append(
                f"{family}{{{suffixes}}}: observation {sizes['observation']}, "
                f"goal {sizes['desired_goal']}, action {env.action_spec.shape[-1]} "
                f"in [-1, 1], {env.max_episode_steps} steps"
            )
    return lines


def extras() -> list[str]:
    """Purpose of each extra, and whether it is installed, a line for each."""
    lines = []
    for name, extra in EXTRAS.items():
        if find_spec(extra.modules[0]) is not None:
            state = "installed"
        elif sys.version_info < extra.oldest_python:
            state = "missing: needs Python {}.{}".format(*extra.oldest_python)
        elif name == "lerobot":  # it needs an older torch than the other extras
            state = f"missing: {install_command(name)}, in an environment of its own"
        else:
            state = f"missing: {install_command(name)}"
        lines.append(f"{name} ({extra.purpose}): {state}")
    return lines


def missing() -> list[str]:
    """Features that do not work here, with the reason or the fix, a line for each."""
    lines = []
    if problem := _loop_problem():
        lines.append(f"environments: {problem}")
    if find_spec("eglRenderer") is None:
        lines.append('renderer="egl": this build of pybullet lacks the EGL plugin')
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        lines.append(
            "open_window(): DISPLAY is not set; open_viewer() works without a display"
        )
    if not torch.cuda.is_available():
        lines.append("CUDA: training runs on the CPU; physics always does")
    return lines or ["nothing"]


def _loop_problem() -> str | None:
    """Why no environment can be made here; None if they can."""
    try:
        load_library()
    except ImportError as error:
        return str(error)
    return None


def describe() -> str:
    """Text of all sections."""
    sections = {
        "versions": [f"{name} {number}" for name, number in versions().items()],
        "threads": [
            "default: one per core that this process may use, here "
            f"{num_cores()} of {os.cpu_count()}, and at most one per environment"
        ],
        "solver": [str(solver.activate())],
        "extras": extras(),
        "missing": missing(),
        "environments": environments(),
    }
    return "\n".join(
        "\n".join((f"{title}:", *(f"  {line}" for line in lines)))
        for title, lines in sections.items()
    )
