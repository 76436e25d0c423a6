"""Files of trained policies: their weights, and the numbers to build the networks."""

from dataclasses import asdict, fields
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torch_panda.learning import files
from torch_panda.learning.agents import Agent, Hyperparameters, find_agent
from torch_panda.learning.environments.spaces import Spaces
from torch_panda.learning.limits import check_choices
from torch_panda.policies import shipped_policies


class Policy(TensorDictModuleBase):
    """A trained policy, from ``observation`` and ``desired_goal`` to ``action``.

    It acts deterministically under every exploration type of torchrl, and computes no
    gradients. Batches may have any shape.

    Args:
        module: Module that writes ``action``, such as `Agent.policy`.
        env_id: Id of the environment that the policy was trained on.
        spaces: Sizes of observations, goals and actions.
    """

    def __init__(
        self, module: TensorDictModuleBase, env_id: str, spaces: Spaces
    ) -> None:
        super().__init__()
        self.in_keys = ["observation", "desired_goal"]
        self.out_keys = ["action"]  # type: ignore[misc]  # it has a setter
        self.module, self.env_id, self.spaces = module, env_id, spaces

    @dispatch  # also takes and returns tensors
    def forward(  # type: ignore[override]
        self, tensordict: TensorDictBase
    ) -> TensorDictBase:
        """Write an action for every observation and goal.

        Raises:
            ValueError: Observations or goals have another size than in the training.
        """
        state = tensordict.select(*self.in_keys)
        sizes = (self.spaces.observation_size, self.spaces.goal_size)
        for key, size in zip(self.in_keys, sizes, strict=True):
            if state[key].shape[-1] != size:
                raise ValueError(
                    f"the policy was trained on {self.env_id}, where {key} has size "
                    f"{size}, got {state[key].shape[-1]}: use it on a task with the "
                    "same spaces"
                )
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            action = self.module(state)["action"]
        return tensordict.set("action", action)


def _read_policy(path: Path) -> Policy:
    """Read a file of `save_policy` onto the CPU. Code in the file is not run.

    Raises:
        ValueError: There is no file, it holds no policy, or another version of
            torch_panda wrote it.
    """
    finite = ("hyperparameters", "policy")
    keys = ("env_id", ("spaces", "geometry"), *finite)
    content = files.read(path, "a policy", keys, finite=finite)
    try:
        check_choices(Hyperparameters, content["hyperparameters"])
        hp = Hyperparameters(**content["hyperparameters"])
        spaces = Spaces.from_dict(content["spaces"])
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{path} was saved by another version of torch_panda, which has other "
            f"options or describes environments by other entries: {error}"
        ) from None
    # New networks draw random weights.
    with torch.random.fork_rng(devices=[]), torch.device("cpu"):
        agent = find_agent(hp)(spaces, hp)
    try:
        for name, part in agent.policy_parts.items():
            part.load_state_dict(content["policy"][name])
    except (KeyError, RuntimeError):
        raise ValueError(
            f"{path} does not hold a policy, or is damaged: its weights do not fit its "
            "hyperparameters"
        ) from None
    return Policy(agent.policy, content["env_id"], spaces)


def save_policy(path: Path, agent: Agent, env_id: str) -> None:
    """Write the policy of an agent into a file that `load_policy` reads."""
    # `agent.hp` may be the options of a run. Leave out the fields that are not
    # hyperparameters.
    names = [field.name for field in fields(Hyperparameters)]
    hp = {name: getattr(agent.hp, name) for name in names}
    # The file holds the averaged weights alone, so a loaded agent has no average.
    hp.pop("ema_rate", None)
    content = {
        "env_id": env_id,
        "hyperparameters": hp,
        "spaces": asdict(agent.spaces),
        "policy": {
            name: part.state_dict() for name, part in agent.policy_parts.items()
        },
    }
    files.save(path, content)


def load_policy(id_or_path: str | Path) -> Policy:
    """Load a trained policy: one that torch_panda ships, or one of your own runs.

    Code in the file is not run. No extra of the package is needed.

    Args:
        id_or_path: Id of an environment whose policy ships with torch_panda, such as
            ``"PandaPush-v1"``; or the folder of a run; or a policy's file, such as
            checkpoint.pt in this folder.

    Returns:
        A TensorDictModule on the CPU, which acts deterministically and computes no
        gradients.

    Raises:
        ValueError: There is no such policy, or the file does not hold a policy.
    """
    shipped = shipped_policies()
    if isinstance(id_or_path, str) and id_or_path in shipped:
        path = shipped[id_or_path]
    else:
        path = Path(id_or_path)
    if not path.exists():
        raise ValueError(
            f"no policy {str(id_or_path)!r}: pass the folder of a run, a .pt file, or "
            f"one of the ids that have a policy, {', '.join(shipped)}"
        )
    return _read_policy(path / "checkpoint.pt" if path.is_dir() else path)
