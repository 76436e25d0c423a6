"""Draw how often policies succeed where objects are heavier or more slippery.

    python examples/robustness.py runs/push runs/push-randomized --out robustness.png

Each policy plays the same episodes in every cell of a grid of factors on the mass and
the lateral friction of the objects. To train one for it: train.py --randomize 3
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import torch
import tyro
from matplotlib.backend_bases import FigureCanvasBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torch_panda
from torch_panda import Randomization
from torch_panda.learning.files import prepare
from torch_panda.learning.limits import Positive, Seed, check_limits


@dataclass
class Args:
    """Which policies to compare, and on which grid."""

    runs: Annotated[list[Path], tyro.conf.Positional]
    """folders of runs, or policies (.pt)"""
    masses: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """factors on the mass of the objects"""
    frictions: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """factors on the lateral friction of the objects"""
    episodes: Positive = 20
    """number of episodes in each cell of the grid"""
    seed: Seed = 1_000
    """of the episodes"""
    out: Path = Path("robustness.png")
    """where to write the figure"""


def success_grid(
    env: torch_panda.RobotTaskEnv,
    policy: TensorDictModuleBase,
    factors: torch.Tensor,
    episodes: int,
) -> torch.Tensor:
    """How often a policy succeeds at the end of an episode, in each environment.

    Args:
        env: an environment of batch size [n], made with a `Randomization` of k factors.
        policy: the policy.
        factors: (n, k), which environment has which.
        episodes: number of episodes in each.

    Returns:
        (n,), from 0 to 1.
    """
    successes = torch.zeros(len(factors))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(episodes):
            env.reset()
            state = env.get_state()
            # All cells play the episodes of the first one.
            state = state[[0] * len(factors)]  # type: ignore[assignment]
            state["physics_parameters"] = factors.double()
            start = env.reset(state, set_state=True)
            played = env.rollout(
                env.max_episode_steps,
                policy,
                auto_reset=False,
                break_when_any_done=False,
                break_when_all_done=True,  # a -v3 episode ends at its first success
                tensordict=start,
            )
            successes += played["next", "success"][:, -1, 0].cpu()
    return successes / episodes


def check_format(path: Path) -> None:
    """Refuse what a figure cannot be written as; without a suffix it becomes a .png.

    Raises:
        ValueError: says what it can.
    """
    formats = FigureCanvasBase.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in formats:
        names = ", ".join(f".{name}" for name in sorted(formats))
        raise ValueError(f"out must end in one of {names}, got {path.name!r}")


def name_all(runs: list[Path]) -> list[str]:
    """What each is called: its own name, after its folder's where that repeats."""
    names = [run.stem if run.is_file() else run.name for run in runs]
    return [
        f"{run.absolute().parent.name}/{name}" if names.count(name) > 1 else name
        for run, name in zip(runs, names, strict=True)
    ]


def plot_grids(grids: list[tuple[str, torch.Tensor]], args: Args) -> None:
    """Draw success over mass and friction, a panel a policy."""
    figure, panels = plt.subplots(
        1,
        len(grids),
        figsize=(3.5 * len(grids) + 1, 3.5),
        layout="constrained",
        squeeze=False,
    )
    for axes, (name, grid) in zip(panels[0], grids, strict=True):
        image = axes.imshow(grid, origin="lower", vmin=0, vmax=1, cmap="viridis")
        axes.set_xticks(range(len(args.masses)), [f"{x:g}" for x in args.masses])
        axes.set_yticks(range(len(args.frictions)), [f"{x:g}" for x in args.frictions])
        axes.set(xlabel="mass", ylabel="friction", title=name)
        for row, column in torch.cartesian_prod(*map(torch.arange, grid.shape)):
            value = grid[row, column].item()
            color = "black" if value > 0.5 else "white"
            axes.text(column, row, f"{value:.0%}", ha="center", color=color)
    figure.colorbar(image, ax=panels[0], label="success")
    figure.savefig(args.out, dpi=120)
    plt.close(figure)


def main(args: Args) -> None:
    """Evaluate each policy on the grid, print the means and draw them."""
    check_limits(args)
    check_format(args.out)
    prepare(args.out)
    factors = torch.cartesian_prod(
        torch.tensor(args.frictions), torch.tensor(args.masses)
    )
    factors = factors.flip(1)  # mass first, as in physics_parameters
    ranges = [(float(column.min()), float(column.max())) for column in factors.T]
    randomize = Randomization(object_mass=ranges[0], object_friction=ranges[1])
    grids: list[tuple[str, torch.Tensor]] = []
    for run, name in zip(args.runs, name_all(args.runs), strict=True):
        policy = torch_panda.load_policy(run)
        with torch_panda.make(
            policy.env_id,
            num_envs=len(factors),
            seed=args.seed,
            randomize=randomize,
        ) as env:
            success = success_grid(env, policy, factors, args.episodes)
        grid = success.reshape(len(args.frictions), len(args.masses))
        grids.append((name, grid))
        print(f"{name}: {success.mean():.1%} over the grid, worst {success.min():.1%}")
    plot_grids(grids, args)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from None
