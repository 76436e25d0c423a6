"""Options of ``train --offline``, and checks of their values."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch_panda.bullet import PhysicsName
from torch_panda.checks import check_device
from torch_panda.learning.agents import find_agent
from torch_panda.learning.hyperparameters import (
    Algo,
    Hyperparameters,
    Network,
    RelativeInputs,
)
from torch_panda.learning.limits import Discount, Finite, Positive, Seed, check_limits
from torch_panda.learning.logger import LoggerName, check_logger
from torch_panda.learning.user_modules import Imports

KINDS = ("noisy", "play", "random")  # kinds of `torch_panda.datasets.generate`


@dataclass
class OfflineArgs(Hyperparameters):
    """Options of offline training: algorithm, data, duration and folder."""

    algo: Algo = "gcivl"
    """algorithm: "gcbc", "gcivl", "gciql", "hiql", "qrl" or "crl\""""
    offline: bool = True
    """learn from a data set instead of an environment"""
    gamma: Discount | None = 0.99
    """discount factor of the values, also of the goal strategy "geometric" """
    network: Network = "gelu"
    """hidden layers"""
    relative_inputs: RelativeInputs = "fine"
    """additional inputs of the networks"""
    batch_size: Positive = 256
    """transitions per gradient step"""
    env_id: str = "PandaReach-v1"
    """id of the environment, shipped or registered by --import"""
    task_options: dict[str, Finite] = field(default_factory=dict)
    """arguments of the task to change, such as `clearance 0.0005`, in evaluations
    and generated data"""
    physics: PhysicsName = "exact"
    """how Bullet integrates in evaluations and generated data: "exact" as in panda-gym,
    or "fast" and coarser"""
    data: str = "noisy"
    """data to learn from: "noisy", "play" or "random" generates a data set, see
    `torch_panda.datasets.generate`, and keeps it in data.pt of the run's folder. Any
    other value is the path of a file of `record`, of the data.pt of another run, or of
    the folder of a data set"""
    transitions: Positive = 1_000_000
    """transitions to generate, rounded up to whole episodes"""
    total_steps: Positive = 100_000
    """gradient steps"""
    num_envs: Positive = 16
    """number of environments stepped in parallel while data are generated"""
    seed: Seed = 0
    """seed of the generated data, the networks and the sampling"""
    eval_interval: Positive = 10_000
    """gradient steps between evaluations"""
    out: Path | None = None
    """folder of the results; None means runs/<env-id>-<algo>-<data>-<seed>"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""
    resume: bool = False
    """continue the run in the folder. Only --out, --video, --import and --logger may
    differ from the options with which it was started, and --total-steps may be
    larger"""
    logger: LoggerName = "none"
    """also log each evaluation to TensorBoard (folder "tensorboard" of the run) or to
    Weights & Biases (project "torch_panda")"""
    device: str = "cpu"
    """device of the networks and the data"""
    video: bool = True
    """record a video of 4 episodes at the end"""

    @property
    def env_options(self) -> dict[str, Any]:
        """Arguments of `torch_panda.make` for all environments of the run."""
        return {"task_options": self.task_options, "physics": self.physics}


def check_offline(args: OfflineArgs) -> None:
    """Check options before data are generated.

    Raises:
        ValueError: An option is out of its limits, the data do not exist, or the
            algorithm does not learn offline or does not have the option.
    """
    check_limits(args)
    find_agent(args)
    if args.algo == "gcbc" and args.alpha is not None:
        raise ValueError("algo gcbc has no alpha: drop --alpha")
    check_device(args.device)
    check_logger(args.logger)
    if args.data not in KINDS and not Path(args.data).exists():
        raise ValueError(
            f"data must be one of {', '.join(KINDS)}, or a file or folder, got "
            f"{args.data!r}"
        )
