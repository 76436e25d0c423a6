"""Reads and checks the state from which a reset starts."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torch_panda.checks import check_rotations, check_rows
from torch_panda.envs.history import ACTIONS, NUM_ACTIONS, START
from torch_panda.envs.randomization import PHYSICS

# Largest position, angle or velocity that a state may hold [m], [rad], [m/s], [rad/s].
# It is far beyond any scene. Bullet returns NaN where squares overflow.
_LIMIT = 1e6

# Positions and velocities of the robot, the objects and the objects' joints.
PHYSICAL = (
    "joint_position",
    "joint_velocity",
    "object_pose",
    "object_velocity",
    "object_joint_position",
    "object_joint_velocity",
)
STATE = (*PHYSICAL, "desired_goal", "step_count", *PHYSICS)
# Key under which `StateTransform` carries a whole state.
STATE_KEY = "state"
# Entries that only an exact state has.
EXACT_KEYS = (*(START + key for key in STATE), ACTIONS, NUM_ACTIONS)


@dataclass
class StartState:
    """A state to start from, in k environments.

    Attributes:
        values: Entries of the state, (k, ...) by key.
        start: Of an exact state, the start of the episode, (k, ...) by key; else empty.
        actions: Of an exact state, the actions since, (k, length, action_dim) float32
            in [-1, 1].
        num_actions: Of an exact state, the number of actions of each row, (k, 1) int64.
    """

    values: dict[str, Tensor]
    start: dict[str, Tensor] = field(default_factory=dict)
    actions: Tensor | None = None
    num_actions: Tensor | None = None

    def steps(
        self, envs: list[int], num_envs: int
    ) -> Iterator[tuple[Tensor, list[int], list[int]]]:
        """Iterate over the actions of an exact state, step by step.

        Args:
            envs: The environments of the k rows.
            num_envs: Number of all environments, n.

        Yields:
            The actions, (n, action_dim); the environments that take them; and the
            environments for which this step is the last.
        """
        if self.actions is None or self.num_actions is None:
            return
        counts = self.num_actions.flatten()
        rows = torch.tensor(envs, device="cpu")
        for index in range(int(counts.max())):
            is_acting = counts > index
            action = self.actions.new_zeros(num_envs, self.actions.shape[-1])
            action[rows[is_acting]] = self.actions[is_acting, index]
            last = rows[counts == index + 1]
            yield action, rows[is_acting].tolist(), last.tolist()

    def check_arrival(self, envs: list[int], state: dict[str, Tensor]) -> None:
        """Check that repeating the actions led to this state.

        Args:
            envs: The environments of the k rows.
            state: The present state of all environments, (n, ...) by key.

        Raises:
            ValueError: An entry differs.
        """
        for key, value in state.items():
            differs = (value[envs] != self.values[key]).flatten(1).any(dim=1).nonzero()
            if len(differs):
                raise ValueError(
                    f"the exact state of environment {envs[int(differs[0])]} does not "
                    f"lead to its {key}: the state was changed or belongs to another "
                    f"environment; leave out its start and its actions to start from "
                    f"the other entries"
                )


def is_state(
    entries: Mapping[str, Any] | None, observed_keys: Collection[str] = ()
) -> bool:
    """Whether the argument of a reset is a state, if ``set_state`` is not given.

    The tensordict of an ordinary reset may hold a ``desired_goal`` too, and torchrl's
    `StepCounter` writes a ``step_count`` into it. It then holds an ``achieved_goal``,
    and entries of a state that the environment observes (the sensor "joint_state").
    A state may also lie under the key ``state``, where `StateTransform` puts it.

    Args:
        entries: The argument of the reset.
        observed_keys: Keys of sensors, which are observations beside an
            ``achieved_goal``.

    Raises:
        ValueError: The argument holds a state and observations.
    """
    keys = set() if entries is None else set(entries.keys())
    is_observed = "achieved_goal" in keys
    if is_observed:
        keys -= set(observed_keys)
    is_nested = entries is not None and unpack_state(entries) is not entries
    if not is_nested and not keys.intersection(PHYSICAL):
        return "desired_goal" in keys and not is_observed
    if is_observed:
        raise ValueError(
            f"the tensordict holds observations and a state (one of "
            f"{', '.join(PHYSICAL)}, {STATE_KEY}): say set_state=True to start from "
            f"it, set_state=False to start a new episode"
        )
    return True


def unpack_state(entries: Mapping[str, Any]) -> Mapping[str, Any]:
    """The state under the key ``state``, or else the entries themselves.

    A tensor under this key is an observation of a task or sensor.
    """
    nested = entries.get(STATE_KEY, None)
    return entries if nested is None or isinstance(nested, Tensor) else nested


def read_state(
    state: Mapping[str, Any],
    *,
    batch_shape: tuple[int, ...],
    present: dict[str, Tensor],
    envs: list[int],
    action_dim: int,
) -> StartState:
    """Check a state and convert its entries to those of the environment.

    Args:
        state: Tensors of shape (*batch_shape, ...). Other entries are ignored.
        batch_shape: Batch shape of the environment.
        present: The present state of all environments, (n, ...) by key.
        envs: The environments that start from the state.
        action_dim: Number of action entries.

    Returns:
        Entries of shape (len(envs), ...), in the dtypes of ``present``.

    Raises:
        ValueError: An entry has a wrong shape, is not finite, is above 1e6, or is not a
            rotation; no entry of a state is present beside ``step_count``, which
            torchrl's `StepCounter` has too; or an exact state lacks entries.
    """
    if not {*PHYSICAL, "desired_goal", *PHYSICS}.intersection(state.keys()):
        raise ValueError(
            f"set_state=True needs a state with some of {', '.join(present)}; none "
            "arrived. torchrl's TransformedEnv and ParallelEnv do not pass states on: "
            "reset env.base_env, or add torch_panda.envs.StateTransform and give the "
            f"state under the key {STATE_KEY!r}"
        )

    def read(prefix: str = "") -> dict[str, Tensor]:
        return {
            key: _read_entry(prefix + key, state[prefix + key], batch_shape, own, envs)
            for key, own in present.items()
            if state.get(prefix + key, None) is not None
        }

    start_state = StartState(read())
    exact_keys = set(EXACT_KEYS).intersection(state.keys())
    if not exact_keys:
        return start_state
    required = {START + key for key in present} | {ACTIONS, NUM_ACTIONS}
    if missing := (required | present.keys()).difference(state.keys()):
        raise ValueError(
            f"an exact state needs all its entries, but {sorted(missing)} are missing; "
            f"leave out {sorted(exact_keys)} to start from the other entries"
        )
    n, length = len(next(iter(present.values()))), state[ACTIONS].shape[-2]
    actions = torch.zeros(n, length, action_dim, dtype=torch.float32, device="cpu")
    count = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
    start_state.start = read(START)
    actions = _read_entry(ACTIONS, state[ACTIONS], batch_shape, actions, envs)
    check_rows(ACTIONS, actions.abs() <= 1, envs, "in [-1, 1]")
    count = _read_entry(NUM_ACTIONS, state[NUM_ACTIONS], batch_shape, count, envs)
    check_rows(NUM_ACTIONS, count <= length, envs, f"at most {length}")
    start_state.actions, start_state.num_actions = actions, count
    return start_state


def _read_entry(
    key: str,
    value: Tensor,
    batch_shape: tuple[int, ...],
    present: Tensor,
    envs: list[int],
) -> Tensor:
    """Check an entry of a state, (*batch_shape, ...); return (len(envs), ...)."""
    shape = (*batch_shape, *present.shape[1:])
    if tuple(value.shape) != shape:
        raise ValueError(f"{key} must have shape {shape}, got {tuple(value.shape)}")
    value = value.detach().to("cpu", present.dtype).reshape(present.shape)[envs]
    if value.is_floating_point():
        is_small = value.abs() <= _LIMIT  # false for NaN
        check_rows(key, is_small, envs, f"finite and at most {_LIMIT:g}")
    else:
        check_rows(key, value >= 0, envs, "at least 0")
    if key.endswith("object_pose"):
        check_rotations(key, value, envs)
    return value
