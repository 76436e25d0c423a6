"""Draw the tasks: a picture, an animation, or policies step by step.

python examples/gallery.py --out gallery.png
python examples/gallery.py --out gallery.gif --size 150 200
python examples/gallery.py --policies examples/policies/*.pt --out policies.png
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import tyro
from PIL import Image, ImageDraw
from tensordict.nn import TensorDictModuleBase

import torch_panda
from torch_panda.experts import make_expert
from torch_panda.learning.files import prepare
from torch_panda.learning.limits import Limit, Positive, Seed, check_limits
from torch_panda.learning.video import FPS, play, tile

TASKS = (
    *("Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip"),
    *("Drawer", "PegInsertion"),
)
NEAR = torch_panda.Camera(distance=1.0, yaw=60, pitch=-25, target=(-0.2, 0.0, 0.23))
# Slide's goals are out of reach.
FAR = torch_panda.Camera(distance=1.5, yaw=50, pitch=-25, target=(0.05, 0.0, 0.12))
STEPS = 50  # of an episode
COLUMNS = (0, 4, 8, 14, 24)  # steps of a policy that are drawn

Picture = npt.NDArray[np.uint8]


@dataclass
class Args:
    """What to draw, and where."""

    policies: tuple[Path, ...] = ()
    """checkpoints to draw step by step, a row each; none: all tasks, by the experts"""
    step: Annotated[int, Limit(f"from 0 to {STEPS}", lambda x: 0 <= x <= STEPS)] = 15
    """of all tasks, the step of the episode that is drawn; an animation has all"""
    seed: Seed = 4
    """of the environments"""
    size: tuple[Positive, Positive] = (300, 400)
    """height and width of a cell [pixels]"""
    out: Path = Path("gallery.png")
    """picture (.png) or animation (.gif) to write"""


def draw(
    env_id: str,
    policy: TensorDictModuleBase,
    steps: int,
    *,
    seed: int,
    size: tuple[int, int],
) -> list[Picture]:
    """An episode's pictures (height, width, 3) from its start on, with its name.

    Args:
        env_id: the task.
        policy: what acts.
        steps: how many.
        seed: of the environment.
        size: height and width [pixels].
    """
    name = env_id.removeprefix("Panda").partition("-")[0]
    cells = []
    with torch_panda.make(env_id, num_envs=1, seed=seed) as env:
        for step, _ in zip(range(steps + 1), play(env, policy), strict=False):
            camera = FAR if name == "Slide" else NEAR
            cell = Image.fromarray(env.render(0, camera=camera, size=size).numpy())
            pen = ImageDraw.Draw(cell)
            pen.text((8, 6), name, fill=(0, 0, 0), font_size=size[0] // 15)
            pen.text((8, size[0] - 18), f"step {step}", fill=(90, 90, 90))
            cells.append(np.asarray(cell))
    return cells


def write(path: Path, pictures: list[Picture]) -> None:
    """Write one picture, or an animation, in 256 colours: a third of the size."""
    images = [Image.fromarray(picture).quantize(256) for picture in pictures]
    if path.suffix == ".gif":
        images[0].save(
            path,
            save_all=True,
            append_images=images[1:],
            duration=2000 // FPS,
            loop=0,
        )
    else:
        images[0].save(path, optimize=True)


def main(args: Args) -> None:
    """Draw what was asked for."""
    options: dict[str, Any] = {"seed": args.seed, "size": args.size}
    try:
        check_limits(args)
        if args.out.suffix not in (".png", ".gif"):
            raise ValueError(f"out must end in .png or .gif, got {args.out.name!r}")
        prepare(args.out)
        if args.policies:
            rows = [
                np.hstack([cells[step] for step in COLUMNS])
                for policy in map(torch_panda.load_policy, args.policies)
                for cells in [draw(policy.env_id, policy, max(COLUMNS), **options)]
            ]
            pictures = [np.vstack(rows)]
        else:
            animated = args.out.suffix == ".gif"
            steps = STEPS if animated else args.step
            episodes = [
                draw(env_id, make_expert(env_id), steps, **options)
                for env_id in (f"Panda{task}-v1" for task in TASKS)
            ]
            # Every other step, in real time.
            shown = range(0, steps + 1, 2) if animated else (steps,)
            pictures = [tile([cells[step] for cells in episodes]) for step in shown]
        write(args.out, pictures)
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from None
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
