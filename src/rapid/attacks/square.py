"""Random search for a bad observation, without gradients: where it finds more than they do, these are masked.

After Andriushchenko et al. (2020), "Square Attack: a query-efficient black-box adversarial attack via random search".
An observation is a table of vehicles and not a picture, so instead of a square a set of its numbers is moved at once,
each to one end of the ball: of all that may move a share that falls from 80 % to one number.
"""

import torch
from torch import Tensor

from rapid.attacks.draws import Source, uniform
from rapid.attacks.search import Aim, Ball, Values

FIRST_SHARE = 0.8
"""Share of the numbers that the first changes move."""


@torch.no_grad()
def squares(values: Values, obs_BVF: Tensor, aim: Aim, ball: Ball, queries: int, source: Source) -> Tensor:
    """Return the observation with the largest loss among `queries` points of the box, and the true one.

    Args:
        values: Q-values of raw observations; they are only asked for.
        obs_BVF: the true observations, metres and m/s.
        aim: the loss, for each observation.
        ball: what may be shown; its norm is `linf`.
        queries: points tried for each observation.
        source: of what is drawn.
    """
    radius = float(ball.project(torch.full_like(obs_BVF[:1], ball.radius)).amax())
    shown_BVF, offset_BVF = obs_BVF.clone(), torch.zeros_like(obs_BVF)
    best_B = aim(values(obs_BVF))
    for query in range(queries):
        # Two numbers for each feature: whether it moves, and where to.
        drawn_BVF2 = uniform((*obs_BVF.shape, 2), source, obs_BVF.device)
        moves_BVF = drawn_BVF2[..., 0] < max(FIRST_SHARE * (1 - query / queries) ** 2, 1 / obs_BVF[0].numel())
        tried_BVF = torch.where(moves_BVF, (drawn_BVF2[..., 1] - 0.5).sign() * radius, offset_BVF)
        seen_BVF = ball.at(obs_BVF, tried_BVF)
        loss_B = aim(values(seen_BVF))
        better_B = loss_B > best_B
        shown_BVF[better_B], offset_BVF[better_B] = seen_BVF[better_B], tried_BVF[better_B]
        best_B = torch.where(better_B, loss_B, best_B)
    return shown_BVF
