"""Videos of a policy in several environments side by side.

Each environment has a cell of the picture, whose border is green while its goal is
reached. Markers of goals are translucent.
"""

from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import torch
from PIL import Image, ImageDraw
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import step_mdp
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torch_panda.learning.environments import GoalEnv
from torch_panda.learning.files import prepare

CELL = (240, 320)  # height and width of a cell [pixels]
BORDER = 4  # width of a cell's frame [pixels]
GREEN, GREY = (40, 170, 70), (120, 120, 120)


def record(env: GoalEnv, policy: TensorDictModuleBase, path: Path) -> None:
    """Write one episode of each environment into a video, in real time.

    Args:
        env: Batch of environments.
        policy: Policy that writes ``action``. It acts without exploration noise.
        path: An .mp4 or .gif file.

    Raises:
        ValueError: The name of the file does not end in .mp4 or .gif.
        OSError: The file cannot be written.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"a video's name must end in .mp4 or .gif, got {path.name!r}")
    prepare(path)
    frames = [
        draw(env, state, step)
        for step, state in enumerate(
            tqdm(play(env, policy), total=env.max_episode_steps + 1, unit="frame")
        )
    ]
    fps = env.render_fps
    options = (
        {"loop": 0, "duration": 1000 / fps} if path.suffix == ".gif" else {"fps": fps}
    )
    iio.imwrite(path, np.stack(frames), **options)


def play(env: GoalEnv, policy: TensorDictModuleBase) -> Iterator[TensorDictBase]:
    """Run one episode, and yield its first state and the state after every step."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        yield state
        for _ in range(env.max_episode_steps):
            state = step_mdp(env.step(policy(state)))
            yield state


def draw(env: GoalEnv, state: TensorDictBase, step: int) -> npt.NDArray[np.uint8]:
    """Draw all environments into one picture, (height, width, 3)."""
    cells = []
    for pixels, success in zip(env.render(size=CELL), state["success"], strict=True):
        cell = Image.fromarray(pixels.cpu().numpy())
        pen = ImageDraw.Draw(cell)
        color = GREEN if success else GREY
        pen.rectangle((0, 0, CELL[1] - 1, CELL[0] - 1), outline=color, width=BORDER)
        text = f"step {step}" + ("  success" if success else "")
        pen.text((2 * BORDER, 2 * BORDER), text, fill=color)
        cells.append(np.asarray(cell))
    return tile(cells)


def tile(cells: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """Join pictures of one size into a grid with about as many rows as columns."""
    num_columns = int(np.ceil(np.sqrt(len(cells))))
    num_rows = int(np.ceil(len(cells) / num_columns))
    empty = np.full_like(cells[0], 255)
    cells = cells + [empty] * (num_rows * num_columns - len(cells))
    rows = [
        np.hstack(cells[row * num_columns : (row + 1) * num_columns])
        for row in range(num_rows)
    ]
    return np.vstack(rows)
