"""Reads and checks the state from which a reset starts."""

import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_panda.checks import check_rotations, check_rows
from torch_panda.envs.history import ACTIONS, NUM_ACTIONS, START
from torch_panda.envs.randomization import PHYSICS_KEYS

# Largest position, angle or velocity that a state may hold [m], [rad], [m/s], [rad/s].
# It is far larger than any number of a scene. Much larger numbers would make Bullet
# return NaN, because their squares overflow.
_LIMIT = 1e6

# Positions and velocities of the robot, the objects and the objects' joints.
BODY_KEYS = (
    "joint_position",
    "joint_velocity",
    "object_pose",
    "object_velocity",
    "object_joint_position",
    "object_joint_velocity",
)
# All entries that a plain state may have.
PLAIN_KEYS = (*BODY_KEYS, "desired_goal", "step_count", *PHYSICS_KEYS)
# Key under which `StateTransform` puts a whole state.
NESTED_STATE = "state"
# Entries that only an exact state has.
EXACT_KEYS = (*(START + key for key in PLAIN_KEYS), ACTIONS, NUM_ACTIONS)


class StartState(NamedTuple):
    """A state to start from, in k environments.

    Attributes:
        values: Entries of the state, (k, ...) by key.
        origin: State at the start of the episode, from which ``actions`` lead to
            ``values``, (k, ...) by key; empty unless the state is exact.
        actions: Actions since the start of the episode, (k, length, action_dim) float32
            in [-1, 1]; None unless the state is exact.
        num_actions: Number of actions of each row, (k, 1) int64; None unless the state
            is exact.
    """

    values: dict[str, Tensor]
    origin: dict[str, Tensor]
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
        """Check that repeating the actions led to the state in `values`.

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
                    f"the actions in the exact state of environment "
                    f"{envs[int(differs[0])]} do not lead to its {key}: the state was "
                    f"changed or comes from an environment with other physics; to "
                    f"start from its poses and velocities, leave out num_actions, "
                    f"actions and the entries that begin with start_"
                )


def is_state(entries: Mapping[str, Any] | None, observed_keys: Collection[str]) -> bool:
    """Whether a reset without ``set_state`` should start from its argument.

    A caller may also pass the last observations, so the keys have to show whether the
    argument is a state or observations. It is a state in two cases:

    * It has entries of `BODY_KEYS`, or a nested state under ``state``, where
      `StateTransform` puts it.
    * It has a ``desired_goal`` or entries of `PHYSICS_KEYS`, and no ``achieved_goal``.
      Observations always have an ``achieved_goal``.

    A ``step_count`` alone is not a state: torchrl's `StepCounter` writes it too.

    Args:
        entries: The argument of the reset.
        observed_keys: Keys that sensors observe. If the argument has an
            ``achieved_goal``, entries under these keys are observations and not parts
            of a state. For example, the sensor "joint_state" observes
            ``joint_position``.

    Raises:
        ValueError: The argument holds both a state and observations.
    """
    keys = set() if entries is None else set(entries.keys())
    is_observed = "achieved_goal" in keys
    if is_observed:
        keys -= set(observed_keys)
    if not has_nested_state(entries) and not keys.intersection(BODY_KEYS):
        return not is_observed and not keys.isdisjoint({"desired_goal", *PHYSICS_KEYS})
    if is_observed:
        raise ValueError(
            f"the tensordict holds observations and a state (one of "
            f"{', '.join(BODY_KEYS)}, {NESTED_STATE}): pass set_state=True to start "
            f"from the state, or set_state=False to start a new episode"
        )
    return True


def has_nested_state(entries: Mapping[str, Any] | None) -> bool:
    """Whether there is a state under the key ``state``.

    A tensor under this key is not a state, but an observation of a task or a sensor.
    """
    nested = None if entries is None else entries.get(NESTED_STATE, None)
    return nested is not None and not isinstance(nested, Tensor)


def unpack_state(entries: Mapping[str, Any]) -> Mapping[str, Any]:
    """The nested state under the key ``state``, or the entries if there is none."""
    return entries[NESTED_STATE] if has_nested_state(entries) else entries


def read_state(
    state: Mapping[str, Any],
    *,
    batch_shape: tuple[int, ...],
    present: dict[str, Tensor],
    envs: list[int],
    action_dim: int,
) -> StartState:
    """Check a state, and read the entries of the environments that start from it.

    Args:
        state: Tensors of shape (*batch_shape, ...). Entries under keys that are not
            part of a state are ignored.
        batch_shape: Batch shape of the environment.
        present: The present state of all environments, (n, ...) by key.
        envs: The environments that start from the state.
        action_dim: Size of an action.

    Returns:
        Entries of shape (len(envs), ...), in the dtypes of ``present``.

    Raises:
        ValueError: An entry has a wrong shape, or a number that is infinite, NaN or
            above 1e6 in magnitude; an object's quaternion is not a unit quaternion; an
            exact state lacks entries; or there is no state. A ``step_count`` alone is
            not a state, because torchrl's `StepCounter` writes it too.
    """
    if not {*BODY_KEYS, "desired_goal", *PHYSICS_KEYS}.intersection(state.keys()):
        accepted = [key for key in present if key != "step_count"]
        raise ValueError(
            f"set_state=True needs a state with some of {', '.join(accepted)}, got "
            "none; if a wrapper dropped it, put torch_panda.envs.StateTransform into "
            "the innermost TransformedEnv, and give the state under the key "
            f"{NESTED_STATE!r}"
        )

    def read(prefix: str = "") -> dict[str, Tensor]:
        return {
            key: _read_entry(prefix + key, state[prefix + key], batch_shape, now, envs)
            for key, now in present.items()
            if state.get(prefix + key, None) is not None
        }

    exact_keys = set(EXACT_KEYS).intersection(state.keys())
    if not exact_keys:
        return StartState(read(), origin={})
    required = {START + key for key in present} | {ACTIONS, NUM_ACTIONS}
    if missing := (required | present.keys()).difference(state.keys()):
        raise ValueError(
            f"an exact state needs all its entries, but {sorted(missing)} are missing; "
            f"leave out {sorted(exact_keys)} to start from the other entries"
        )
    n = len(next(iter(present.values())))
    length = math.prod(state[ACTIONS].shape[-2:-1])  # 1 if a dimension is missing
    values, origin = read(), read(START)
    like = torch.zeros(n, length, action_dim, dtype=torch.float32, device="cpu")
    actions = _read_entry(ACTIONS, state[ACTIONS], batch_shape, like, envs)
    check_rows(ACTIONS, actions.abs() <= 1, envs, "in [-1, 1]")
    like = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
    count = _read_entry(NUM_ACTIONS, state[NUM_ACTIONS], batch_shape, like, envs)
    check_rows(NUM_ACTIONS, count <= length, envs, f"at most {length}")
    return StartState(values, origin, actions, count)


def _read_entry(
    key: str,
    value: Tensor,
    batch_shape: tuple[int, ...],
    like: Tensor,
    envs: list[int],
) -> Tensor:
    """Check an entry of a state, (*batch_shape, ...); return (len(envs), ...).

    ``like`` is a tensor (n, ...) with the same last dimensions, and with the dtype of
    the result.
    """
    shape = (*batch_shape, *like.shape[1:])
    if tuple(value.shape) != shape:
        raise ValueError(f"{key} must have shape {shape}, got {tuple(value.shape)}")
    value = value.detach().to("cpu", like.dtype).reshape(like.shape)[envs]
    if value.is_floating_point():
        is_small = value.abs() <= _LIMIT  # false for NaN
        check_rows(key, is_small, envs, f"finite and at most {_LIMIT:g}")
    else:
        check_rows(key, value >= 0, envs, "at least 0")
    if key.endswith("object_pose"):  # also "start_object_pose"
        check_rotations(key, value, envs)
    return value
