"""Why an exhibit comes out as it does beside the paper: what was measured or is said elsewhere, in a sentence or two.

Every sentence stands in docs/deviations.md, docs/results.md or docs/log with its numbers. Nothing is guessed here: what
nobody has looked into is `NOT_EXAMINED`.
"""

NOT_EXAMINED = "not examined"

REASONS = {
    "teacher-attack": "The teacher's facts are as exact as what it sees: it is above offline DQN up to 4 m of uniform "
    "or 2 m of Gaussian noise along the road, and below it beyond (docs/results.md).",
    "ratio:paper": "Five trainings are too few to tell the shares apart: all intervals of double DQN between 12.5 and "
    "50 % overlap. Why CQL is best with random data alone was not examined (docs/results.md).",
    "offline:paper": "With raw metres and hard target updates a training ends near a driver that brakes or near one "
    "that drives on until the crash, and a mean says how many of five did (docs/log/paper.md).",
    "attack:paper": "Trainings end in one of a few habits, those of DQN near a driver that brakes or near one that "
    "drives on until the crash. Offline DQN is above the paper, also under attack, because all five end near braking, "
    "which no lie about other cars concerns (docs/log/paper.md). Why attacks take more from RAPID than in the paper "
    "was not examined.",
    "routing:paper": "The router reads raw metres, so its softmax is sure of itself from the beginning: policy 1 has "
    "all of the weight and the adapter is never let in (docs/log/paper.md).",
    "architecture": "not examined; the paper's offline table prints for RAPID what its appendix prints for attentive "
    "DQN, in all nine cells, so what the conservative term adds is not clear from it (docs/deviations.md).",
    "j-robust": "not examined; the paper's curve stalls near 1.6 in lane-5, and a uniform policy over five actions has "
    "ln 5 = 1.609 (docs/deviations.md).",
    "prompt": "The paper's GPT-3.5 is replaced by an embedded model, and all facts that it is told are computed from "
    "the observation (docs/deviations.md).",
    "efficiency": "The paper's GPT-3.5 is replaced by an embedded model, so the seconds are of another teacher "
    "(docs/deviations.md).",
    "environment": "The dynamics are those of highway-v0 with the paper's table; one of its figures says highway-fast "
    "(docs/deviations.md).",
    "hyperparameters": "The paper prints learning rates for the baselines only; the recipe `paper` takes these as "
    "printed (docs/deviations.md).",
    "scores:strong": "On lane-4 and lane-5 a car that always brakes is above the paper's best already "
    "(docs/results.md). RAPID brakes first, lets the traffic pass and then speeds up (docs/log/results.md). With "
    "attacks of 0.1 only ignoring the observation is robust, and the clean policy pays for it (docs/deviations.md).",
    **dict.fromkeys(("online", "beta", "mixing-actions"), NOT_EXAMINED),
}
"""By an exhibit's id, or ID:RECIPE where the reason holds in one recipe only."""


def reason(identity: str, recipe: str) -> str:
    """Return why an exhibit comes out as it does in a recipe."""
    return REASONS.get(f"{identity}:{recipe}") or REASONS.get(identity, NOT_EXAMINED)
