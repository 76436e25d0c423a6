"""LeRobot's format, version 3: tables of frames, and pictures as videos.

A frame holds the observation before an action, the action, and its reward and flags.
The format has no place for the observation after an episode's last action.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv

STATE = "observation.state"
# The achieved goal, then the desired goal. Policies of LeRobot read it in addition to
# STATE.
GOALS = "observation.environment_state"
PICTURE = "observation.images.scene"


class Writer:
    """Writes episodes as they come.

    Args:
        folder: Folder to create.
        env_id: Id of the environment that is recorded.
        env: The environment; it must observe ``pixels``.
        kind: Not used, because the format does not store the kind of data.

    Raises:
        ValueError: The folder exists already.
        OSError: The folder cannot be created.
    """

    def __init__(self, folder: Path, env_id: str, env: RobotTaskEnv, kind: str) -> None:
        if folder.exists():
            raise ValueError(f"the folder {folder} exists already: choose another one")
        folder.parent.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        task = type(env.task)
        # The instruction of all frames: the first line of the task's docstring.
        self.instruction = (task.__doc__ or task.__name__).partition("\n")[0]
        # An unfinished data set has another name, so Ctrl-C leaves no broken one.
        self.unfinished = folder.with_name(folder.name + ".new")
        shutil.rmtree(self.unfinished, ignore_errors=True)
        self.dataset = LeRobotDataset.create(
            repo_id=f"torch_panda/{env_id}",
            fps=env.render_fps,
            features=features(env),
            root=self.unfinished,
            robot_type=type(env.robot).__name__.lower(),
        )

    def add(self, episode: TensorDictBase, seed: int) -> None:
        """Write an episode; the column ``seed`` repeats its seed."""
        goals = torch.cat((episode["achieved_goal"], episode["desired_goal"]), -1)
        columns = {
            STATE: episode["observation"],
            GOALS: goals,
            PICTURE: episode["pixels"],
            "action": episode["action"],
            "next.reward": episode["next", "reward"],
            "next.success": episode["next", "success"],
            "next.terminated": episode["next", "terminated"],
            "next.done": episode["next", "done"],
            "seed": torch.full((len(episode), 1), seed),
        }
        for step in range(len(episode)):
            frame = {key: values[step].numpy() for key, values in columns.items()}
            self.dataset.add_frame(frame | {"task": self.instruction})
        self.dataset.save_episode()

    def close(self) -> str:
        """Finish the data set."""
        self.dataset.finalize()
        os.replace(self.unfinished, self.folder)
        return f"{self.folder}: LeRobotDataset({self.dataset.repo_id!r}, root=...)"


def features(env: RobotTaskEnv) -> dict[str, dict[str, object]]:
    """Columns of the data set of an environment, with their types and shapes."""
    sizes = {
        STATE: env.observation_spec["observation"].shape[-1],
        GOALS: 2 * env.task.goal_dim,
        "action": env.action_spec.shape[-1],
        "next.reward": 1,
    }
    result: dict[str, dict[str, object]] = {
        key: {"dtype": "float32", "shape": (size,), "names": None}
        for key, size in sizes.items()
    }
    for key in ("next.success", "next.terminated", "next.done"):
        result[key] = {"dtype": "bool", "shape": (1,), "names": None}
    result["seed"] = {"dtype": "int64", "shape": (1,), "names": None}
    result[PICTURE] = {
        "dtype": "video",
        "shape": tuple(env.observation_spec["pixels"].shape[-3:]),
        "names": ["height", "width", "channels"],
    }
    return result


def read(path: Path) -> TensorDict:
    """Read the transitions of a data set's folder, without pictures.

    The observation after an episode's last action was not stored, so the last
    transition is left out and the one before it becomes the end of the episode.
    """
    dataset = LeRobotDataset(f"torch_panda/{path.name}", root=path)
    table = dataset.hf_dataset.with_format("numpy")[:]

    def column(key: str, dtype: torch.dtype) -> torch.Tensor:
        values = torch.as_tensor(np.stack(table[key]))
        return values.reshape(len(values), -1).to(dtype)

    achieved, desired = column(GOALS, torch.float32).chunk(2, dim=-1)
    episode_ids = column("episode_index", torch.int64).squeeze(-1)
    # Keep the transitions whose next frame belongs to the same episode.
    kept = episode_ids[:-1] == episode_ids[1:]
    observed = {
        "observation": column(STATE, torch.float32),
        "achieved_goal": achieved,
        "desired_goal": desired,
    }
    data = {
        "action": column("action", torch.float32)[:-1],
        ("collector", "traj_ids"): episode_ids[:-1],
        ("next", "reward"): column("next.reward", torch.float32)[:-1],
        ("next", "terminated"): column("next.terminated", torch.bool)[:-1],
    }
    for key, values in observed.items():
        data[key], data["next", key] = values[:-1], values[1:]
    # The goal of a step, even if the next step pursues another one.
    data["next", "desired_goal"] = data["desired_goal"]
    transitions: TensorDict
    transitions = TensorDict(data, [len(kept)])[kept]  # type: ignore[assignment]
    episode_ids = transitions["collector", "traj_ids"]
    last = episode_ids != episode_ids.roll(-1)
    last[-1] = True
    transitions["next", "done"] = last.unsqueeze(-1)
    return transitions


def read_env_id(path: Path) -> None:
    """Return None, because the format does not store the id of the environment."""
