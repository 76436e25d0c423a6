"""Train in an environment of Gymnasium-Robotics, from Python.

It needs the extra `fetch`. The command `python -m torch_panda train --env-id
FetchReach-v4 --import gymnasium_robotics` does the same, and writes a video.
"""

from dataclasses import replace
from pathlib import Path

import gymnasium_robotics  # noqa: F401  # registers its ids

from torch_panda.learning.evaluation import Evaluation, evaluate
from torch_panda.learning.options import default_args
from torch_panda.learning.training import Run

ENV_ID = "FetchReach-v4"
TOTAL_STEPS = 1_200


def main(out: Path) -> Evaluation:
    """Train with the recipe, and evaluate the policy."""
    args = replace(default_args("recipe", ENV_ID), total_steps=TOTAL_STEPS)
    run = Run(args, out)  # writes curve.csv, curve.png and checkpoint.pt
    run.train()
    run.close()
    return evaluate(run.agent.policy, ENV_ID, episodes=100)


if __name__ == "__main__":
    print(main(Path("fetch_reach")))
