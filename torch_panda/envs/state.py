"""Reading a start state that a user gives."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

_QUATERNION_TOLERANCE = 1e-3
# Far beyond any scene. Where squares overflow, Bullet gives NaN.
_LARGEST = 1e6  # [m], [rad], [m/s], [rad/s]


def read_state(
    tensordict: TensorDictBase | None, *, like: dict[str, Tensor], envs: list[int]
) -> dict[str, Tensor]:
    """Check the state entries of a tensordict, and return those that are there.

    Args:
        tensordict: of the environment's batch size; other entries are ignored.
        like: the environment's own state, (n, ...).
        envs: which environments are to start from it.

    Returns:
        Entries of (len(envs), ...), in the dtypes of ``like``.

    Raises:
        ValueError: an entry has a wrong shape, is not finite or above 1e6, or holds no
            rotation; or there is none beside ``step_count``, which torchrl's
            `StepCounter` has, too.
    """
    physical = like.keys() - {"step_count"}
    if tensordict is None or physical.isdisjoint(tensordict.keys()):
        raise ValueError(
            f"set_state=True needs a state with some of {', '.join(like)}; none came. "
            "torchrl's TransformedEnv and ParallelEnv do not pass states on: reset "
            "env.base_env, or use SerialEnv"
        )
    state = {}
    for key, own in like.items():
        value = tensordict.get(key, None)
        if value is None:
            continue
        shape = (*tensordict.batch_size, *own.shape[1:])
        if tuple(value.shape) != shape:
            raise ValueError(f"{key} must have shape {shape}, got {tuple(value.shape)}")
        value = value.detach().to("cpu", own.dtype).reshape(own.shape)[envs]
        if value.is_floating_point():
            is_small = value.abs() <= _LARGEST  # false for NaN
            _check_rows(key, is_small, envs, f"finite and at most {_LARGEST:g}")
        if key == "object_pose":
            norm = torch.linalg.vector_norm(value[..., 3:], dim=-1)
            is_unit = (norm - 1).abs() < _QUATERNION_TOLERANCE
            _check_rows(key, is_unit, envs, "a position and a unit quaternion")
        if key == "step_count":
            _check_rows(key, value >= 0, envs, "at least 0")
        state[key] = value
    return state


def _check_rows(key: str, is_right: Tensor, envs: list[int], wanted: str) -> None:
    wrong = (~is_right).flatten(1).any(dim=1).nonzero()
    if len(wrong):
        raise ValueError(f"{key} of environment {envs[int(wrong[0])]} must be {wanted}")
