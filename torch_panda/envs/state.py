"""Reads and checks the state from which a reset starts."""

from collections.abc import Collection, Mapping
from typing import Any

from torch import Tensor

from torch_panda.checks import check_rotations, check_rows
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
# Entries that only an exact state has; see `exact_states`.
START = "start_"  # prefix of the keys of the state at the start of the episode
ACTIONS = "actions"
NUM_ACTIONS = "num_actions"
EXACT_KEYS = {*(START + key for key in PLAIN_KEYS), ACTIONS, NUM_ACTIONS}


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
) -> dict[str, Tensor]:
    """Check a state, and read the entries of the environments that start from it.

    Args:
        state: Tensors of shape (*batch_shape, ...). Entries under keys that are not
            part of a plain state are ignored.
        batch_shape: Batch shape of the environment.
        present: The present state of all environments, (n, ...) by key.
        envs: The environments that start from the state.

    Returns:
        Entries of shape (len(envs), ...), in the dtypes of ``present``.

    Raises:
        ValueError: An entry has a wrong shape, or a number that is infinite, NaN or
            above 1e6 in magnitude; an object's quaternion is not a unit quaternion; or
            there is no state. A ``step_count`` alone is not a state, because torchrl's
            `StepCounter` writes it too.
    """
    if not {*BODY_KEYS, "desired_goal", *PHYSICS_KEYS}.intersection(state.keys()):
        accepted = [key for key in present if key != "step_count"]
        raise ValueError(
            f"set_state=True needs a state with some of {', '.join(accepted)}, got "
            "none; if a wrapper dropped it, put torch_panda.envs.StateTransform into "
            "the innermost TransformedEnv, and give the state under the key "
            f"{NESTED_STATE!r}"
        )
    return {
        key: read_entry(key, state[key], batch_shape, now, envs)
        for key, now in present.items()
        if state.get(key, None) is not None
    }


def read_entry(
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
