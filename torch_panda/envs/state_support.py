"""Refuses states that torchrl's wrappers would drop on their way to an environment."""

import sys
from dataclasses import dataclass

from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv

from torch_panda.envs.state import BODY_KEYS, NESTED_STATE, unpack_state

# The function in which torchrl asks whether a reset may start from a state.
_RESOLVE_CODE = EnvBase._resolve_set_state.__code__


@dataclass(frozen=True)
class StateSupport:
    """The answer to whether resets may start from a state: true, or an error.

    `TransformedEnv`, `SerialEnv` and `ParallelEnv` take over this answer from the
    environment that they wrap, also from a worker in another process. torchrl tests its
    truth in every reset of a wrapper, before it sends the state off. The truth
    therefore depends on the reset: a state that would not arrive raises an error here.
    torchrl does not pass the arguments of the reset, so they are read from the calling
    function.

    Attributes:
        observed: Entries that the environment observes under keys of a state.
    """

    observed: frozenset[str]

    def __bool__(self) -> bool:
        """Whether torchrl should treat this reset as one that may have a state.

        Raises:
            ValueError: The reset has a state that would not arrive.
        """
        frame = sys._getframe(1)
        while frame.f_code.co_name == "_supports_set_state" and frame.f_back:
            frame = frame.f_back
        if frame.f_code is not _RESOLVE_CODE:
            return True
        names = "self", "set_state", "tensordict", "select_reset_only"
        env, set_state, entries, only_mask = (frame.f_locals[name] for name in names)
        if set_state is False or only_mask:
            return True  # torchrl ignores the state
        if not isinstance(env, (TransformedEnv, SerialEnv, ParallelEnv)):
            return True
        has_nested = entries is not None and unpack_state(entries) is not entries
        arrives = has_nested and NESTED_STATE in set(env.state_spec.keys())
        if isinstance(env, SerialEnv):
            # It passes all entries on, and the environments of its workers check them.
            return bool(set_state or arrives)
        keys = set() if entries is None else set(entries.keys())
        has_state = has_nested or keys & set(BODY_KEYS) - self.observed
        if not arrives and (set_state or has_state):
            name = type(env).__name__
            raise ValueError(
                f"the state would not reach the environment, because torchrl's {name} "
                f"passes on only what its state_spec names: add "
                "torch_panda.envs.StateTransform to the environment (of each worker), "
                f"and give the state under the key {NESTED_STATE!r}, as in "
                f"reset(TensorDict({{{NESTED_STATE!r}: state}}, env.batch_size), "
                "set_state=True)"
            )
        # Without a state of ours, torchrl would take a `StepCounter`'s count for one.
        return arrives
