"""The evaluations of a run: a curve that is written, drawn and saved at every point."""

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

EPISODES = 80  # of an evaluation, all fresh
NUM_ENVS = 16  # that play them


class Curve:
    """Evaluates an agent.

    Args:
        env_id: the task.
        agent: whose policy is evaluated.
        out: the folder of curve.csv, curve.png and checkpoint.pt.
        device: of the environments.
    """

    def __init__(self, env_id: str, agent: Agent, out: Path, *, device: str) -> None:
        self.env_id, self.agent, self.out = env_id, agent, out
        self.env = make(env_id, num_envs=NUM_ENVS, device=device)

    def add(self, progress: Progress, losses: dict[str, float] | None = None) -> None:
        """Evaluate, add a row to the run's curve, write and draw it."""
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
        """Free the environments."""
        self.env.close()


def reseed(env: RobotTaskEnv) -> None:
    """Make the next episodes follow from torch's random state, which runs save."""
    env.set_seed(int(torch.randint(2**62, ())))
