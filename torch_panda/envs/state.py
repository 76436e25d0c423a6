"""Reading a start state that a user gives."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torch_panda.envs.history import ACTIONS, NUM_ACTIONS, START
from torch_panda.envs.variation import PHYSICS

QUATERNION_TOLERANCE = 1e-3
# Far beyond any scene. Where squares overflow, Bullet gives NaN.
_LARGEST = 1e6  # [m], [rad], [m/s], [rad/s]

# Where a robot and its objects are, and how fast; joints, where objects have them.
PHYSICAL = (
    "joint_position",
    "joint_velocity",
    "object_pose",
    "object_velocity",
    "object_joint_position",
    "object_joint_velocity",
)
STATE = (*PHYSICAL, "desired_goal", "step_count", *PHYSICS)
# What an exact state has beside them.
EXACT_KEYS = (*(START + key for key in STATE), ACTIONS, NUM_ACTIONS)


@dataclass
class GivenState:
    """A state to start from, of some environments.

    Attributes:
        values: entries of the state, (k, ...).
        start: where the actions begin, (k, ...); empty: there are none.
        actions: (k, most, action_dim) float32 in [-1, 1].
        num_actions: how many of them count, (k, 1) int64.
    """

    values: dict[str, Tensor]
    start: dict[str, Tensor] = field(default_factory=dict)
    actions: Tensor | None = None
    num_actions: Tensor | None = None

    def steps(
        self, envs: list[int], num_envs: int
    ) -> Iterator[tuple[Tensor, list[int], list[int]]]:
        """The actions, step by step.

        Args:
            envs: whose state it is, k of them.
            num_envs: number of all environments, n.

        Yields:
            The action, (n, action_dim); which environments take it; and which of them
            take no other.
        """
        if self.actions is None or self.num_actions is None:
            return
        counts = self.num_actions.flatten()
        rows = torch.tensor(envs, device="cpu")
        for index in range(int(counts.max())):
            acting = counts > index
            action = self.actions.new_zeros(num_envs, self.actions.shape[-1])
            action[rows[acting]] = self.actions[acting, index]
            last = rows[counts == index + 1]
            yield action, rows[acting].tolist(), last.tolist()

    def check_arrival(self, envs: list[int], state: dict[str, Tensor]) -> None:
        """Make sure that the actions have led to the state.

        Raises:
            ValueError: they have not.
        """
        for key, value in state.items():
            wrong = (value[envs] != self.values[key]).flatten(1).any(dim=1).nonzero()
            if len(wrong):
                raise ValueError(
                    f"the exact state of environment {envs[int(wrong[0])]} does not "
                    f"lead to its {key}: it was changed, or is of another environment; "
                    f"leave out its start and its actions to start from the rest"
                )


def means_state(entries: Mapping[str, Any] | None) -> bool:
    """Whether a reset's argument is a state to start from, though nobody has said so.

    What torchrl passes to an ordinary reset may have a ``desired_goal`` too, and from
    torchrl's `StepCounter` a ``step_count``, but it then has an ``achieved_goal``.

    Raises:
        ValueError: it holds a state and observations, so that it may mean either.
    """
    keys = set() if entries is None else set(entries.keys())
    observed = "achieved_goal" in keys
    if not keys.intersection(PHYSICAL):
        return "desired_goal" in keys and not observed
    if observed:
        raise ValueError(
            f"the tensordict holds observations and a state (one of "
            f"{', '.join(PHYSICAL)}): say set_state=True to start from it, "
            "set_state=False to start a new episode"
        )
    return True


def read_state(
    given: Mapping[str, Any],
    *,
    batch_shape: tuple[int, ...],
    like: dict[str, Tensor],
    envs: list[int],
    action_dim: int,
) -> GivenState:
    """Check the entries of a state, and return those that are there.

    Args:
        given: tensors of shape (*batch_shape, ...); other entries are ignored.
        batch_shape: of the environment.
        like: the environment's own state, (n, ...).
        envs: which environments are to start from it.
        action_dim: number of action entries.

    Returns:
        Entries of (len(envs), ...), in the dtypes of ``like``.

    Raises:
        ValueError: an entry has a wrong shape, is not finite or above 1e6, or holds no
            rotation; there is none beside ``step_count``, which torchrl's
            `StepCounter` has, too; or an exact state is not complete.
    """
    if not {*PHYSICAL, "desired_goal", *PHYSICS}.intersection(given.keys()):
        raise ValueError(
            f"set_state=True needs a state with some of {', '.join(like)}; none came. "
            "torchrl's TransformedEnv and ParallelEnv do not pass states on: reset "
            "env.base_env, or use SerialEnv"
        )

    def read(prefix: str = "") -> dict[str, Tensor]:
        return {
            key: _read(prefix + key, given[prefix + key], batch_shape, own, envs)
            for key, own in like.items()
            if given.get(prefix + key, None) is not None
        }

    state = GivenState(read())
    needed = {START + key for key in like} | {ACTIONS, NUM_ACTIONS}
    found = set(EXACT_KEYS).intersection(given.keys())
    if not found:
        return state
    if missing := (needed | like.keys()).difference(given.keys()):
        raise ValueError(
            f"an exact state needs all its entries, without {sorted(missing)}; leave "
            f"out {sorted(found)} to start from the rest"
        )
    n, most = len(next(iter(like.values()))), given[ACTIONS].shape[-2]
    actions = torch.zeros(n, most, action_dim, dtype=torch.float32, device="cpu")
    count = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
    state.start = read(START)
    state.actions = _read(ACTIONS, given[ACTIONS], batch_shape, actions, envs)
    check_rows(ACTIONS, state.actions.abs() <= 1, envs, "in [-1, 1]")
    state.num_actions = _read(NUM_ACTIONS, given[NUM_ACTIONS], batch_shape, count, envs)
    check_rows(NUM_ACTIONS, state.num_actions <= most, envs, f"at most {most}")
    return state


def check_rotations(name: str, pose: Tensor, envs: list[int]) -> None:
    """Make sure that poses, (k, ..., 7), hold unit quaternions.

    Raises:
        ValueError: one does not; it names ``name`` and the environment.
    """
    norm = torch.linalg.vector_norm(pose[..., 3:], dim=-1)
    is_unit = (norm - 1).abs() < QUATERNION_TOLERANCE
    check_rows(name, is_unit, envs, "a position and a unit quaternion")


def _read(
    key: str,
    value: Tensor,
    batch_shape: tuple[int, ...],
    own: Tensor,
    envs: list[int],
) -> Tensor:
    shape = (*batch_shape, *own.shape[1:])
    if tuple(value.shape) != shape:
        raise ValueError(f"{key} must have shape {shape}, got {tuple(value.shape)}")
    value = value.detach().to("cpu", own.dtype).reshape(own.shape)[envs]
    if value.is_floating_point():
        is_small = value.abs() <= _LARGEST  # false for NaN
        check_rows(key, is_small, envs, f"finite and at most {_LARGEST:g}")
    else:
        check_rows(key, value >= 0, envs, "at least 0")
    if key.endswith("object_pose"):
        check_rotations(key, value, envs)
    return value


def check_rows(key: str, is_right: Tensor, envs: list[int], wanted: str) -> None:
    """Make sure that entries of a state, (k, ...), are right.

    Raises:
        ValueError: one is not; it names ``key`` and the environment.
    """
    if not is_right.all():
        wrong = envs[int((~is_right).flatten(1).any(dim=1).nonzero()[0])]
        raise ValueError(f"{key} of environment {wrong} must be {wanted}")
