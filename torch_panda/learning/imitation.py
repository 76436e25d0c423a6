"""Imitation loss of the actor, which Nair et al. add to DDPG (arXiv 1709.10089)."""

from torch import Tensor

BC_WEIGHT = 20.0  # weight of imitation in the actor's loss


def imitation_loss(
    action: Tensor, demonstrated: Tensor, value: Tensor, demonstrated_value: Tensor
) -> Tensor:
    """Weighted squared distance from the demonstrated actions that the critic prefers.

    Demonstrated actions with a lower value than the policy's actions count as 0.

    Args:
        action: Actions of the policy, (n, action size).
        demonstrated: Demonstrated actions in the same states, (n, action size).
        value: Value of the policy's actions, (n, 1).
        demonstrated_value: Value of the demonstrated actions, (n, 1).
    """
    is_preferred = (demonstrated_value > value).detach()  # the Q filter
    return BC_WEIGHT * ((action - demonstrated).square() * is_preferred).mean()
