"""Which numbers the scripts accept: checked before a run starts, not hours into it."""

from collections.abc import Callable
from math import inf

from agents import NUM_QUANTILES

# What must hold, in words and as a test, and the options for which it must.
LIMITS: dict[str, tuple[Callable[[float], bool], tuple[str, ...]]] = {
    "positive": (
        lambda x: x > 0,
        (
            *("episodes", "eval_episodes", "eval_interval", "save_interval"),
            *("steps_per_batch", "batch_size", "buffer_size"),
            *("num_envs", "num_threads", "torch_threads", "hidden_size"),
            *("num_workers", "cpus_per_worker"),
        ),
    ),
    "from 0 to 2**64 - 1": (lambda x: 0 <= x < 2**64, ("seed",)),
    "above 0 and finite": (lambda x: 0 < x < inf, ("learning_rate", "alpha")),
    "finite": (lambda x: -inf < x < inf, ("goal_height",)),
    "at least 0 and finite": (
        lambda x: 0 <= x < inf,
        (
            *("total_steps", "pretrain_updates", "updates_per_step"),
            *("action_l2", "bc_weight"),
            *("noise_eps", "policy_noise", "shift", "fine_inputs"),
        ),
    ),
    "from 0 to 1": (
        lambda x: 0 <= x <= 1,
        (
            *("her_ratio", "demo_her_ratio", "keep_unmoved", "start_at_object"),
            *("random_eps", "max_random_eps"),
        ),
    ),
    "from 0 to below 1": (lambda x: 0 <= x < 1, ("demo_ratio",)),
    "above 0 and at most 1": (lambda x: 0 < x <= 1, ("gamma", "tau")),
    f"from 0 to {NUM_QUANTILES - 1}": (
        lambda x: 0 <= x < NUM_QUANTILES,
        ("drop_quantiles",),
    ),
}


def check_limits(args: object) -> None:
    """Check a script's options, those that it has and that are not None.

    Raises:
        ValueError: one is outside of what is accepted.
    """
    options = vars(args)
    for what, (holds, names) in LIMITS.items():
        for name in names:
            value = options.get(name)
            if value is not None and not holds(value):
                raise ValueError(f"{name} must be {what}, got {value}")
