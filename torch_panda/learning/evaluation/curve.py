"""Success curve of a run: the evaluations of its agent."""

from pathlib import Path
from typing import Any

import torch
from torchrl.record.loggers import Logger

from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.agents import Agent
from torch_panda.learning.environments import GoalEnv, make_env
from torch_panda.learning.evaluation import (
    evaluate_episodes,
    evaluate_fixed_starts,
)
from torch_panda.learning.evaluation.fixed_tasks import evaluation_tasks
from torch_panda.learning.files.logger import close_logger
from torch_panda.learning.files.run_files import Checkpoint, Progress, write_results

EPISODES = 80  # episodes of each evaluation
NUM_ENVS = 16  # environments that run these episodes in parallel


class Curve:
    """The success curve of a run.

    Args:
        env_id: Id of the environment.
        agent: Agent whose policy is evaluated.
        out: Folder of the run.
        device: Device of the environments' outputs.
        logger: Also gets each row, under the names of the columns.
        env: Environments for the evaluations; None makes `NUM_ENVS` of the id.
        offline: Whether the agent learns offline. If so, steps are gradient steps, and
            the policy is also evaluated from the five `evaluation_tasks`.
        **env_options: Other arguments of `make_env`.
    """

    def __init__(
        self,
        env_id: str,
        agent: Agent,
        out: Path,
        *,
        device: str,
        logger: Logger | None = None,
        env: GoalEnv | None = None,
        offline: bool = False,
        **env_options: Any,  # noqa: ANN401 (options of `make`)
    ) -> None:
        self.env_id, self.agent, self.out = env_id, agent, out
        self.logger = logger
        self.xlabel = "gradient steps" if offline else "environment steps"
        self.tasks = evaluation_tasks(env_id) if offline else {}
        self.env = env or make_env(
            env_id, num_envs=NUM_ENVS, device=device, **env_options
        )

    def begin(self, checkpoint: Checkpoint) -> None:
        """Evaluate the policy of a new run.

        Raises:
            OSError: A file cannot be written.
        """
        if not checkpoint.progress.curve:
            # Save first, so that a run killed in this evaluation can be resumed.
            checkpoint.save()
            self.add(checkpoint.progress)
            checkpoint.save()

    def add(self, progress: Progress, losses: dict[str, float] | None = None) -> None:
        """Evaluate the policy, and add a row with the result to the curve.

        Args:
            progress: Progress of the run. The row is added to its attribute ``curve``.
            losses: Mean losses, which are further columns.

        Raises:
            OSError: A file cannot be written.
        """
        reseed(self.env)
        result = evaluate_episodes(self.env, self.agent.policy, EPISODES)
        row = {
            "step": progress.steps,
            "success": float(result.success.float().mean()),
            "ever_success": float(result.ever.float().mean()),
            "return": float(result.returns.mean()),
            "updates": self.agent.updates,
            "seconds": round(progress.seconds, 2),
        }
        if self.tasks:
            assert isinstance(self.env, RobotTaskEnv)
            fixed = evaluate_fixed_starts(
                self.env, self.agent.policy, EPISODES, self.tasks, seed=draw_seed()
            )
            row["fixed_success"] = fixed.success_rate
            row |= {name: task.success_rate for name, task in fixed.tasks.items()}
        progress.curve.append({**row, **(losses or {})})
        if self.logger is not None:
            for key, value in progress.curve[-1].items():
                if key != "step":
                    self.logger.log_scalar(key, value, step=progress.steps)
        write_results(
            self.out, progress.curve, self.agent, self.env_id, xlabel=self.xlabel
        )

    def close(self) -> None:
        """Close the environments and the logger."""
        self.env.close()
        if self.logger is not None:
            close_logger(self.logger)


def draw_seed() -> int:
    """Draw a seed from torch's global generator."""
    return int(torch.randint(2**62, ()))


def reseed(env: GoalEnv) -> None:
    """Seed the next episodes from torch's global generator.

    A run saves the state of this generator. So a resumed run has the same episodes.
    """
    env.set_seed(draw_seed())
