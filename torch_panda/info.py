"""``python -m torch_panda info``: what is installed, and what it offers."""

import os
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import torch

import torch_panda
from torch_panda.bullet import solver
from torch_panda.bullet.native import loop_name, loop_problem
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


def num_cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS
        return os.cpu_count() or 1


def versions() -> dict[str, str]:
    """Versions of Python and of the packages; "not installed" where there is none."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def environments() -> list[str]:
    """A line for each robot, task and control: ids, spaces and length of episodes."""
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


def renderers() -> list[str]:
    """What pictures could be drawn with: parts of pybullet's wheel."""
    egl = "found" if find_spec("eglRenderer") else "not found"
    return ["TinyRenderer (CPU): in pybullet", f"OpenGL (EGL plugin): {egl}"]


def extras() -> list[str]:
    """A line for each extra: its purpose, and whether it is installed."""
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
    """What does not work here although it is installed, and what would help."""
    lines = []
    if problem := loop_problem():
        lines.append(f"the native loop: {problem}")
    if find_spec("eglRenderer") is None:
        lines.append('renderer="egl": this build of pybullet is without it')
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        lines.append("open_window(): there is no DISPLAY; open_viewer() needs none")
    if not torch.cuda.is_available():
        lines.append("CUDA: trainings run on the CPU, as does physics in any case")
    return lines or ["nothing"]


def stepping() -> str:
    """Which loop steps the environments."""
    if loop_name() == "native":
        return "native: in threads of C"
    return "ctypes: in threads of Python, slower; a C compiler at installation helps"


def describe() -> str:
    """All of it, as text."""
    threads = f"{num_cores()} of {os.cpu_count()} cores usable; default: one a core"
    sections = {
        "versions": [f"{name} {number}" for name, number in versions().items()],
        "threads": [f"{threads}, at most one an environment"],
        "stepping": [stepping()],
        "solver": [str(solver.activate())],
        "renderers": renderers(),
        "extras": extras(),
        "missing": missing(),
        "environments": environments(),
    }
    return "\n".join(
        "\n".join((f"{title}:", *(f"  {line}" for line in lines)))
        for title, lines in sections.items()
    )
