"""Fits the polynomials of Slide's scripted expert to strikes of random strength.

    python -m torch_panda.experts.fit_strike

The script prints the coefficients for `slide.py`, for the physics of PandaSlide-v1.
"""

import torch
from torch import Tensor
from tqdm import tqdm

from torch_panda.experts.moves import unit
from torch_panda.experts.slide import DEVIATION, STRENGTH, strike, strike_terms
from torch_panda.registry import make

ENV_ID, NUM_ENVS, ROUNDS = "PandaSlide-v1", 64, 40
STEPS = 70  # steps after which every puck lies still
STRENGTHS = (0.4, 1.05)  # range of the random strengths
DISTANCES = (0.1, 0.95)  # range of distances for the fit [m]


def strike_at_random(seed: int) -> Tensor:
    """Strike once in every environment.

    Returns:
        A row for each strike, (strikes, 8): position of the puck (3 numbers), direction
        of the strike (2), distance that the puck slid in this direction [m], strength,
        and the angle between the direction and the puck's path [rad]. The angle is
        positive towards the side of the strike. Strikes that missed the puck, or sent
        it outside `DISTANCES`, are left out.
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
    is_usable = struck & (puck[:, 2:] > 0) & (along > low) & (along < high)
    rows = torch.cat((start, aim, along, strength, deviation), 1)
    return rows[is_usable.squeeze(1)].double()


def fit(terms: Tensor, values: Tensor) -> Tensor:
    """Fit a polynomial by least squares, with small weights for outliers.

    Args:
        terms: Values of the polynomial's terms, (strikes, terms).
        values: Values to fit, (strikes, 1).

    Returns:
        The coefficients, (terms,).
    """
    weight = torch.ones_like(values)
    for _ in range(10):
        root = weight.sqrt()
        solution = torch.linalg.lstsq(terms * root, values * root).solution
        weight = 1 / (1 + ((values - terms @ solution) / 0.02).square())
    return solution.squeeze(1)


def main() -> None:
    """Fit to four fifths of the strikes, test on the others, and print the result."""
    strikes = torch.cat([strike_at_random(seed) for seed in tqdm(range(ROUNDS))])
    start, aim, distance, strength, deviation = strikes.split((3, 2, 1, 1, 1), 1)
    test = torch.arange(len(strikes)) % 5 == 0
    # `effect`: how far an error of 1 in the value displaces the point where the puck
    # stops [m].
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
