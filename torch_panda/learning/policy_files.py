"""Trained policies as files: weights, normaliser and how to build them."""

from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tensordict.nn import TensorDictModuleBase

from torch_panda import RobotTaskEnv
from torch_panda.learning import files
from torch_panda.learning.agents import Agent, Hyperparameters, make_agent


def save_policy(path: Path, agent: Agent, env_id: str) -> None:
    """Write what `load_policy` needs, plain tensors and numbers."""
    hp = {
        field.name: getattr(agent.hp, field.name) for field in fields(Hyperparameters)
    }
    policy = agent.policy.state_dict()
    files.save(path, {"env_id": env_id, "hyperparameters": hp, "policy": policy})


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What `save_policy` wrote, on the CPU.

    Args:
        path: of the file, or of the folder of a run.

    Raises:
        ValueError: there is no file, or it holds no policy.
    """
    if path.is_dir():
        path = path / "checkpoint.pt"
    keys = ("env_id", "hyperparameters", "policy")
    return files.read(path, "a policy", keys, map_location="cpu")


def load_agent(checkpoint: dict[str, Any], env: RobotTaskEnv) -> Agent:
    """A new agent with the policy of a checkpoint that `save_policy` wrote.

    Raises:
        ValueError: the environment's spaces are not those it was trained on, or
            another version wrote the checkpoint.
    """
    options = checkpoint["hyperparameters"]
    if unknown := options.keys() - {field.name for field in fields(Hyperparameters)}:
        raise ValueError(
            f"the policy was saved by another version, with options that this one does "
            f"not have: {', '.join(sorted(unknown))}"
        )
    for name, hint in get_type_hints(Hyperparameters).items():
        accepted = get_args(hint) if get_origin(hint) is Literal else ()
        if accepted and name in options and options[name] not in accepted:
            raise ValueError(
                f"the policy was saved by another version: {name} must be one of "
                f"{accepted}, got {options[name]!r}"
            )
    agent = make_agent(env, Hyperparameters(**options))
    try:
        agent.policy.load_state_dict(checkpoint["policy"])
    except RuntimeError:
        raise ValueError(
            f"the policy was trained on {checkpoint['env_id']}, whose spaces are not "
            "those of this environment"
        ) from None
    return agent


def load_policy(checkpoint: dict[str, Any], env: RobotTaskEnv) -> TensorDictModuleBase:
    """The policy of a checkpoint; raises as `load_agent`."""
    return load_agent(checkpoint, env).policy
