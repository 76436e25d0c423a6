"""Fits the strike of Slide's scripted expert to strikes of random strength.

    cd examples && python -m experts.fit_strike

It prints the numbers that `slide.py` has, for the physics of PandaSlide-v1.
"""

import torch
from torch import Tensor
from tqdm import tqdm

from torch_panda.experts.moves import unit
from torch_panda.experts.slide import DEVIATION, STRENGTH, strike, strike_terms
from torch_panda.registry import make

ENV_ID, NUM_ENVS, ROUNDS = "PandaSlide-v1", 64, 40
STEPS = 70  # until every puck lies still
STRENGTHS = (0.4, 1.05)
DISTANCES = (0.1, 0.95)  # [m], what the fit is for


def strike_at_random(seed: int) -> Tensor:
    """One strike an environment.

    Returns:
        Where the puck lay (3), the direction (2), how far it slid along it [m], the
        strength, and the angle by which it left the direction to the left, or, of
        strikes to the right, to the right [rad]: (strikes, 8). Strikes that missed or
        went too far are left out.
    """
    generator = torch.Generator().manual_seed(seed)
    low, high = STRENGTHS
    strength = low + (high - low) * torch.rand(NUM_ENVS, 1, generator=generator)
    struck = torch.zeros(NUM_ENVS, 1, dtype=torch.bool)
    with make(ENV_ID, num_envs=NUM_ENVS, seed=seed) as env:
        td = env.reset()
        start, aim = td["achieved_goal"], torch.zeros(NUM_ENVS, 2)
        for _ in range(STEPS):
            puck = td["achieved_goal"]
            direction = unit((td["desired_goal"] - puck)[:, :2])
            side = direction[:, 1:].sign()
            action, strikes = strike(td["observation"], puck, direction, side, strength)
            strikes = strikes & ~struck
            start, aim = (
                torch.where(strikes, new, old)
                for new, old in ((puck, start), (direction, aim))
            )
            action = torch.where(struck, 0.0, action)
            struck = struck | strikes
            td = env.step(td.set("action", action))["next"]  # type: ignore[assignment]
    puck = td["achieved_goal"]
    slid = (puck - start)[:, :2]
    along = (slid * aim).sum(1, keepdim=True)
    across = slid[:, 1:] * aim[:, :1] - slid[:, :1] * aim[:, 1:]
    deviation = across / along * aim[:, 1:].sign()
    low, high = DISTANCES
    used = struck & (puck[:, 2:] > 0) & (along > low) & (along < high)
    found = torch.cat((start, aim, along, strength, deviation), 1)
    return found[used.squeeze(1)].double()


def fit(terms: Tensor, values: Tensor) -> Tensor:
    """Least squares, with little weight for outliers: (terms,)."""
    weight = torch.ones_like(values)
    for _ in range(10):
        root = weight.sqrt()
        solution = torch.linalg.lstsq(terms * root, values * root).solution
        weight = 1 / (1 + ((values - terms @ solution) / 0.02).square())
    return solution.squeeze(1)


def main() -> None:
    """Strike, fit to four fifths of the strikes, test on the others, and print."""
    strikes = torch.cat([strike_at_random(seed) for seed in tqdm(range(ROUNDS))])
    start, aim, distance, strength, deviation = strikes.split((3, 2, 1, 1, 1), 1)
    test = torch.arange(len(strikes)) % 5 == 0
    # A strike that is stronger by 1 sends the puck about this much farther [m].
    for name, polynomial, values, effect in (
        ("STRENGTH", STRENGTH, strength, 2 * distance.sqrt() / 0.95),
        ("DEVIATION", DEVIATION, deviation, distance),
    ):
        terms = strike_terms(polynomial, start, distance, aim, aim[:, 1:].sign())
        solution = fit(terms[~test], values[~test])
        error = (values - terms @ solution[:, None]) * effect
        near = (error[test].abs() < 0.05).double().mean()
        numbers = [round(x, 4) for x in solution.tolist()]
        print(f"{name} =", dict(zip(polynomial, numbers, strict=True)))
        print(f"{near:.1%} of {int(test.sum())} other strikes within 5 cm")


if __name__ == "__main__":
    main()
