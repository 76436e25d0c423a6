"""Reading an action that a user gives."""

from torch import Tensor

from torch_panda.checks import all_finite


def read_action(action: object, shape: tuple[int, ...]) -> Tensor:
    """The clipped action on the CPU: (n, action_dim) float32.

    Args:
        action: (*batch_shape, action_dim), floating point.
        shape: that shape.

    Raises:
        ValueError: it has a wrong shape or is not finite.
        TypeError: it is not of floating point.
    """
    if not isinstance(action, Tensor):
        raise ValueError(f"the action must be a tensor of shape {shape}, got none")
    if tuple(action.shape) != shape:
        raise ValueError(
            f"the action must have shape {shape}, got {tuple(action.shape)}"
        )
    if not action.dtype.is_floating_point:
        raise TypeError(f"the action must be float32, got {action.dtype}")
    action = action.detach().to("cpu").reshape(-1, shape[-1])
    if not all_finite(action):
        env = int((~action.isfinite()).any(dim=1).nonzero()[0])
        raise ValueError(
            f"the action of environment {env} is not finite: {action[env].tolist()}"
        )
    # Clipped first: what is large in float64 would be infinite in float32.
    return action.clamp(-1.0, 1.0).float()
