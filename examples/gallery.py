"""Draw the animation of the README: the shipped policies solve all tasks.

python examples/gallery.py gallery.webp
"""

import sys
from pathlib import Path

import torch
from PIL import Image, ImageDraw

import torch_panda
from torch_panda import Camera

# The seed of an episode that succeeds, and a view of where it happens.
SCENES = {
    "Reach": (1, Camera((0.0, 0.02, 0.14), 0.72, 50, -22, fov=50)),
    "Push": (1, Camera((-0.03, 0.04, 0.1), 0.72, 55, -30, fov=50)),
    "Slide": (3, Camera((0.14, 0.0, 0.08), 0.9, 40, -30, fov=50)),
    "PickAndPlace": (4, Camera((0.03, -0.04, 0.16), 0.72, 55, -22, fov=50)),
    "Stack": (1, Camera((-0.03, 0.04, 0.11), 0.72, 55, -28, fov=50)),
    "Flip": (1, Camera((0.0, 0.0, 0.08), 0.55, 60, -25, fov=50)),
    "Drawer": (1, Camera((0.04, 0.09, 0.08), 0.75, -40, -33, fov=50)),
    "PegInsertion": (1, Camera((-0.03, 0.03, 0.08), 0.6, 50, -38, fov=50)),
}
COLUMNS = 4
NUM_FRAMES = 26  # a frame every second step; Stack, with 100 steps, every fourth
FRAME_TIME = 80  # of two steps [ms]
FIRST_FRAME_TIME = 800  # shows the goals before the arms hide some of them [ms]
LAST_FRAME_TIME = 3_000  # [ms]
CELL = (300, 240)  # width and height [pixels]
BORDER = 5  # [pixels]
GREEN = (30, 160, 70)


def draw(env: torch_panda.RobotTaskEnv, name: str, success: bool) -> Image.Image:
    """A picture of the scene with the task's name, framed in green on success."""
    size = 2 * CELL[1], 2 * CELL[0]  # drawn twice as large against jagged edges
    pixels = env.render(0, camera=SCENES[name][1], size=size)
    cell = Image.fromarray(pixels.numpy()).resize(CELL, Image.Resampling.LANCZOS)
    pen = ImageDraw.Draw(cell)
    width, height = CELL
    pen.text((12, 9), name, "black", font_size=20, stroke_width=3, stroke_fill="white")
    outline = GREEN if success else "white"
    pen.rectangle((0, 0, width - 1, height - 1), outline=outline, width=BORDER)
    if success:
        tick = [(width - 36, 24), (width - 28, 32), (width - 14, 14)]
        pen.line(tick, fill=GREEN, width=5, joint="curve")
    return cell


def play(name: str) -> list[Image.Image]:
    """Pictures of an episode that succeeds, from its start to its end.

    Raises:
        ValueError: The episode of this seed ends without success.
    """
    env_id = f"Panda{name}-v1"
    policy = torch_panda.load_policy(env_id)
    seed, _ = SCENES[name]
    cells = []
    with torch_panda.make(env_id, num_envs=1, seed=seed) as env:
        stride = env.max_episode_steps // (NUM_FRAMES - 1)
        td = env.reset()
        for step in range(env.max_episode_steps + 1):
            if step % stride == 0:
                cells.append(draw(env, name, bool(td["success"])))
            if step < env.max_episode_steps:
                td = env.step(policy(td))["next"]  # type: ignore[assignment]
    if not bool(td["success"]):
        raise ValueError(f"{name} fails with seed {seed}: choose another seed")
    return cells


def main(path: Path) -> None:
    """Write the animation."""
    rows = -(-len(SCENES) // COLUMNS)
    size = COLUMNS * CELL[0], rows * CELL[1]
    frames = [Image.new("RGB", size, "white") for _ in range(NUM_FRAMES)]
    for index, name in enumerate(SCENES):
        row, column = divmod(index, COLUMNS)
        for frame, cell in zip(frames, play(name), strict=True):
            frame.paste(cell, (column * CELL[0], row * CELL[1]))
    times = [FIRST_FRAME_TIME, *[FRAME_TIME] * (NUM_FRAMES - 2), LAST_FRAME_TIME]
    first, *others = frames
    first.save(
        path, save_all=True, append_images=others, duration=times, loop=0, quality=85
    )
    print(f"wrote {path}")


if __name__ == "__main__":
    with torch.no_grad():
        main(Path(sys.argv[1]))
