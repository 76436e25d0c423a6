"""One gradient step of an agent, compared with losses that a test calculates."""

from typing import NamedTuple

import torch
from torch import nn

from torch_panda.learning.environments.spaces import Spaces

# Small spaces without a task, so that tests need no physics.
SPACES = Spaces(
    observation_size=5,
    goal_size=2,
    action_size=3,
    num_envs=2,
    max_episode_steps=50,
    has_free_gripper=False,
    has_sparse_reward=True,
    geometry=None,
    action_scale=0.05,
    moves_joints=False,
)
ADAM_EPS = 1e-8


class Expected(NamedTuple):
    """A loss, the parameters that it trains, and their learning rate."""

    loss: torch.Tensor
    trained: list[torch.Tensor]
    learning_rate: float


def parameters_of(*networks):
    """The parameters of these networks, in one list."""
    return [p for network in networks for p in network.parameters()]


def disperse(network, scale, bias=0):
    """Make the outputs of a network differ a lot between inputs."""
    layers = [m for m in network.modules() if isinstance(m, nn.Linear)]
    for layer in layers:
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    with torch.no_grad():
        layers[-1].weight *= scale
    nn.init.constant_(layers[-1].bias, bias)


@torch.no_grad()
def disturb(parameters):
    """Change parameters, such as those of target networks that are copies."""
    for p in parameters:
        p.add_(0.02 * torch.randn_like(p))


def fill_normalizer(agent):
    """Give the normaliser statistics that change its inputs."""
    observation = 0.5 + 2 * torch.randn(100, SPACES.observation_size)
    agent.normalizer.update(observation, -1 + 3 * torch.randn(100, SPACES.goal_size))


def check_step(agent, step, expected, targets=((), ()), tau=0.0):
    """Take an agent's first gradient step, and compare its effect with `expected`.

    Args:
        agent: The agent.
        step: Takes the step and returns the losses by name.
        expected: An `Expected` for each name. Gradients of parameters that several
            losses train are added.
        targets: Parameters of the target networks, and of their networks.
        tau: Weight of the networks when the target networks are updated.
    """
    parameters = dict(agent.named_parameters())
    gradients, rates = {}, {}
    for loss, trained, rate in expected.values():
        for p, gradient in zip(
            trained, torch.autograd.grad(loss, trained, retain_graph=True), strict=True
        ):
            gradients[p] = gradients.get(p, 0) + gradient
            rates[p] = rate
    moved, online = targets
    moved_before = [p.detach().clone() for p in moved]
    before = {name: p.detach().clone() for name, p in parameters.items()}
    for p in gradients:
        p.grad = torch.full_like(p, 7.0)  # of an earlier step

    losses = step()

    assert losses.keys() == expected.keys()
    for name, loss in losses.items():
        assert not loss.requires_grad
        torch.testing.assert_close(loss, expected[name].loss.detach(), msg=name)
    for name, p in parameters.items():
        if p in gradients:
            scale = float(gradients[p].abs().max())
            assert scale > 0, name
            close = {"rtol": 1e-3, "atol": 1e-4 * scale}
            torch.testing.assert_close(p.grad, gradients[p], **close)
            # In its first step, Adam divides each gradient by its magnitude.
            change = -rates[p] * p.grad / (p.grad.abs() + ADAM_EPS)
            difference = p.detach() - before[name]
            torch.testing.assert_close(difference, change, rtol=1e-3, atol=2e-6)
        elif not any(p is x for x in moved):
            assert torch.equal(p, before[name]), name
    expected_targets = [
        (1 - tau) * p + tau * q for p, q in zip(moved_before, online, strict=True)
    ]
    torch.testing.assert_close([*moved], expected_targets)
