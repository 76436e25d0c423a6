"""Draw the picture of all tasks, at the end of an expert's episode.

python examples/gallery.py --out gallery.png
"""

from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw

import torch_panda
from experts import make_expert
from video import tile

TASKS = (
    *("Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip"),
    *("Drawer", "PegInsertion"),
)


@dataclass
class Args:
    """What to draw, and where."""

    step: int = 15
    """step of the episode that is drawn"""
    seed: int = 4
    """of the environments"""
    size: tuple[int, int] = (300, 400)
    """height and width of a cell [pixels]"""
    out: Path = Path("gallery.png")
    """picture to write"""


def main(args: Args) -> None:
    """Draw all tasks in one picture."""
    cells = []
    for task in TASKS:
        far = task == "Slide"  # its goals are
        camera = torch_panda.Camera(
            distance=1.3 if far else 0.85, target=(0.25 if far else 0.0, 0.0, 0.1)
        )
        env_id = f"Panda{task}-v1"
        with (
            torch_panda.make(env_id, num_envs=1, seed=args.seed) as env,
            torch.no_grad(),
        ):
            env.rollout(args.step, make_expert(env_id))
            pixels = env.render(camera=camera, size=args.size)[0].numpy()
        cell = Image.fromarray(pixels)
        ImageDraw.Draw(cell).text((10, 8), task, fill=(0, 0, 0), font_size=20)
        cells.append(np.asarray(cell))
    iio.imwrite(args.out, tile(cells))
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
