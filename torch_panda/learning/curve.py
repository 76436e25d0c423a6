"""Evaluates the agent of a run, and writes and draws its success curve."""

import csv
import io
from pathlib import Path

import torch

from torch_panda.envs import RobotTaskEnv
from torch_panda.learning import files
from torch_panda.learning.agents import Agent
from torch_panda.learning.checkpoint import Progress
from torch_panda.learning.evaluation import evaluate_in
from torch_panda.learning.plots import plot_curve
from torch_panda.learning.policy_files import save_policy
from torch_panda.registry import make

EPISODES = 80  # episodes of each evaluation
NUM_ENVS = 16  # environments that play them in parallel


class Curve:
    """The success curve of a run.

    Args:
        env_id: Id of the environment.
        agent: Agent whose policy is evaluated.
        out: Folder of curve.csv, curve.png and checkpoint.pt.
        device: Device of the environments' outputs.
    """

    def __init__(self, env_id: str, agent: Agent, out: Path, *, device: str) -> None:
        self.env_id, self.agent, self.out = env_id, agent, out
        self.env = make(env_id, num_envs=NUM_ENVS, device=device)

    def add(self, progress: Progress, losses: dict[str, float] | None = None) -> None:
        """Evaluate the policy, add a row to the curve, and write and draw the curve.

        Args:
            progress: Progress of the run, whose curve gets the row.
            losses: Mean losses since the last evaluation, further columns of the row.

        Raises:
            OSError: A file cannot be written.
        """
        reseed(self.env)
        result = evaluate_in(self.env, self.agent.policy, EPISODES)
        row = {
            "step": progress.steps,
            "success": float(result.success.float().mean()),
            "ever_success": float(result.ever.float().mean()),
            "return": float(result.returns.mean()),
            "updates": self.agent.updates,
            "seconds": round(progress.seconds, 2),
        }
        progress.curve.append({**row, **(losses or {})})
        fields = {key: None for row in progress.curve for key in row}
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, fieldnames=list(fields))
        writer.writeheader()
        writer.writerows(progress.curve)
        files.save_text(self.out / "curve.csv", text.getvalue())
        plot_curve(progress.curve, self.env_id, self.out / "curve.png")
        save_policy(self.out / "checkpoint.pt", self.agent, self.env_id)

    def close(self) -> None:
        """Close the environments."""
        self.env.close()


def reseed(env: RobotTaskEnv) -> None:
    """Seed the next episodes from torch's global generator, which runs save."""
    env.set_seed(int(torch.randint(2**62, ())))
