"""What learns and how: settings of the network, of its losses and optimisers, and of both training phases.

The whole tree, in which they stand as `network`, `distill` and `adapt`, is :mod:`rapid.config`. This module imports
nothing heavy.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from rapid.bounds import (
    AboveZero,
    Amount,
    Bounds,
    Count,
    Depth,
    Positive,
    Rows,
    Share,
    ShareAboveZero,
    ShareBelowOne,
    Side,
    Width,
)
from rapid.scenarios import MAX_VEHICLES, MIN_VEHICLES, NUM_VEHICLES


@dataclass(frozen=True)
class NetworkConfig:
    """The Q-network (paper: section 3.3 and appendix "Network Implementation")."""

    kind: Literal["rapid", "attentive", "mlp", "mlp-mixture"] = "rapid"
    """`rapid` is the mixture of policies, `attentive` its single policy, `mlp` the baselines' 2x256 network,
    `mlp-mixture` the remark's mixture of the *actions* of MLPs."""
    num_policies: Depth = 2
    """N: policy 1 is distilled from the teacher, policies 2..N are online adapters."""
    top_k: Depth = 2
    """K: policies that are active for a vehicle; policy 1 always is, the others compete for K-1 places."""
    width: Width = 32
    """D: width of a token."""
    heads: Depth = 1
    """Attention heads."""
    layers: Depth = 1
    """L: transformer layers of a policy."""
    decoder_layers: Depth = 1
    """Transformer layers of the decoder; of its last only the token that is read is computed."""
    feedforward: Width = 64
    """Width of the feed-forward layers."""
    hidden: tuple[Width, ...] = (256, 256)
    """Hidden layers of the MLPs."""
    input: Literal["raw", "normalized", "ego", "near"] = "near"
    """What the network reads: the features as they are, scaled to +-1 by highway-env's own ranges, or
    ego-relative (positions and velocities of the others relative to the ego, scaled), or `near`: the same with three
    features more, which tell short distances apart and what closes in."""
    position: Literal["learned", "sinusoidal", "ego", "none"] = "ego"
    """What marks a token's place: an embedding per slot, a sinusoid, a mark on the ego's row only, or nothing."""
    action_token: Literal["prepend", "ego"] = "prepend"
    """Where the Q-values are read: an extra learned token, prepended, or the ego's row."""
    gate: Literal["linear", "tanh"] = "linear"
    """Zero gate: w1 = omega1, wi = g*omegai; or wi = tanh(g)*omegai, w1 = 1 - sum wi."""
    mask_absent: bool = True
    """Whether rows with presence 0 are hidden from attention, so that their contents never matter."""
    vehicles: Annotated[int, Bounds(MIN_VEHICLES, MAX_VEHICLES)] = NUM_VEHICLES
    """V: rows that it reads, the ego's and those of the nearest others. Of data with more it learns from the first;
    data with fewer is as if the rest of the road were empty."""
    mirror: bool = False
    """Average the Q-values with those of the mirrored road, left and right swapped back, which takes twice the time.
    For the reward `progress`, on as many lanes as it was trained on: the paper's reward pays more on the right."""
    memory: bool = False
    """Give it a memory of what a car knows by itself: the time, its own speed and lanes, dead-reckoned from its own
    actions, which no attack on observations moves. For networks of tokens that do not average with the mirror image."""
    squeeze: bool = False
    """With a memory: read only what an attack can hardly bend. That is where along the road and on which lane each
    other car is, and the ego's lane. The ego's place and speed are those it remembers."""
    shield: str = ""
    """Behind the Q-values, the interval filter (`rapid.safety`) that lets an action pass only if it is safe in every
    true state within this of what is seen: a radius such as 0.1, or metres and m/s such as 1m,0.5; nothing is none."""


@dataclass(frozen=True)
class RobustConfig:
    """The inner maximisation of the robust term (paper: equation 5), in features scaled to +-1."""

    norm: Literal["l2", "linf"] = "linf"
    """Norm of the ball."""
    radius: Amount = 0.01
    """Attack radius: 0.01 means 2 m in x, 0.04*lanes m in y and 0.8 m/s in both velocities. With the paper's 0.1, ten
    times that, only ignoring the observation is robust."""
    steps: Positive = 5
    """PGD steps."""
    step_size: AboveZero = 0.004
    """Length of a step."""
    random_start: bool = True
    """Start at a random point of the ball."""
    attack_presence: bool = False
    """Whether the presence feature may be perturbed too."""


@dataclass(frozen=True)
class LossConfig:
    """The training loss: TD + conservative + robust (paper: equations 2 to 5)."""

    discount: Share = 0.9
    """gamma"""
    n_step: Annotated[int, Bounds(1, 1000)] = 1
    """Rewards summed before bootstrapping; never across the end of an episode."""
    double: bool = True
    """Double DQN: the online network chooses the next action, the target network values it."""
    munchausen_weight: ShareBelowOne = 0.0
    """Above 0, Munchausen DQN (Vieillard et al., 2020): the target gets this share of temperature * log-probability of
    the action taken (at least -1), and is soft over the next actions; `double` then says nothing. It averages the
    errors of earlier estimates, which tells apart actions that earn nearly the same."""
    munchausen_temperature: AboveZero = 0.03
    """Temperature of the softmax over Q-values in that target; in units of the reward."""
    td_error: Literal["huber", "squared"] = "squared"
    """Squared as equation 2 prints it, or Huber with threshold 1 as d3rlpy has it. Huber counts a crash, an error of
    several units, for little more than a slip: it learns something near the median, where a crash is rare."""
    conservative_weight: Amount = 1.0
    """alpha: weight of logsumexp Q - Q(a)."""
    robust_weight: Amount = 0.1
    """beta: weight of the robust term."""
    robust_on: Literal["all", "teacher"] = "teacher"
    """Transitions that get the robust term."""
    robust_labels: Literal["hard", "soft"] = "hard"
    """The action taken, or the teacher's probabilities where they were recorded."""
    temperature: AboveZero = 1.0
    """T of the softmax over Q-values in the robust term."""
    robust: RobustConfig = field(default_factory=RobustConfig)
    """The inner attack."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Gradient steps, shared by both training phases."""

    algorithm: Literal["dqn", "bc"] = "dqn"
    """`dqn` minimises the loss above (DQN, DDQN and CQL are its settings); `bc` is behaviour cloning, of the
    transitions that `loss.robust_on` names."""
    learning_rate: AboveZero = 5e-4
    """Adam's step size."""
    gate_rate: AboveZero = 1.0
    """By what the step size of the zero gate is multiplied. A gate that stays small keeps the adapters out."""
    linear_decay: bool = True
    """Let the step size fall linearly to zero over the training."""
    batch_size: Annotated[int, Bounds(1, 1_000_000)] = 64
    """Transitions in a batch."""
    target_update: Positive = 1
    """Gradient steps between two updates of the target network."""
    target_rate: ShareAboveZero = 0.005
    """Share of the online weights taken over at an update; 1 is a hard update."""
    max_grad_norm: Amount = 10.0
    """Gradients are clipped to this norm; 0 is no clipping."""


@dataclass(frozen=True)
class DistillConfig:
    """Phase 2: offline distillation (paper: sections 3.2 and 4.3)."""

    iterations: Positive = 4_000
    """Gradient steps."""
    evaluate_every: Count = 1_000
    """Gradient steps between two evaluations; 0 is never."""
    loss: LossConfig = field(default_factory=LossConfig)
    """The loss of this phase."""
    optimizer: OptimizerConfig = field(default_factory=lambda: OptimizerConfig(learning_rate=1e-3))
    """The optimiser of this phase."""


@dataclass(frozen=True)
class PpoConfig:
    """The second part of phase 3: policy gradients on the return itself (PPO; :mod:`rapid.training.ppo`)."""

    steps: Count = 0
    """Environment steps after those of Q-learning, in whole rollouts; 0 leaves this part out."""
    num_envs: Side = 128
    """Worlds stepped at once."""
    rollout: Annotated[int, Bounds(1, 100_000)] = 30
    """Steps of every world between two updates of the policy; 30 is an episode."""
    epochs: Positive = 4
    """Passes over each rollout."""
    batch_size: Annotated[int, Bounds(2, 1_000_000)] = 512
    """Transitions in a minibatch."""
    temperature: AboveZero = 0.1
    """T of the policy that drives, softmax(Q / T); the greedy policy is what is measured."""
    discount: Share = 1.0
    """gamma. What is measured is the plain sum of rewards, and the critic knows when it ends."""
    trace: Share = 0.95
    """lambda of generalised advantage estimation."""
    clip: AboveZero = 0.2
    """How far the probability of an action may move from what it was when it was taken, as a share."""
    largest_kl: Amount = 0.0
    """Once a minibatch finds that the policy has moved so far from the one that drove, what is left of the passes over
    that rollout teaches the critic alone; 0 is no such limit."""
    crash_penalty: Amount = 2.0
    """What a crash costs more while learning than in the return. In the last second it costs next to nothing there."""
    progress_crash_penalty: Amount = 5.0
    """The same under the reward `progress`: where all speed is paid, 2 leaves more crashes than always-slower has."""
    entropy: Amount = 0.0
    """Weight of the policy's entropy, which is added to what is sought."""
    exploration: ShareBelowOne = 0.0
    """Share of the steps, at first, in which an action drawn by chance takes the place of the policy's; it falls to
    zero until half the steps are done. What pays only after several steps in a row is found so."""
    exploration_hold: Positive = 8
    """Such an action is held for 1 to so many steps."""
    critic_steps: Count = 38_400
    """Of the steps, the first ones, in which the critic alone learns."""
    learning_rate: AboveZero = 3e-4
    """Adam's step size for the policy; falls linearly to zero."""
    guide_rate: AboveZero = 1e-3
    """The same while the policy is shown what to do (`adapt.adversary.guided`)."""
    critic_rate: AboveZero = 1e-3
    """Adam's step size for the critic."""
    max_grad_norm: AboveZero = 0.5
    """The policy's gradients are clipped to this norm."""
    critic_max_grad_norm: AboveZero = 1.0
    """The critic's gradients are clipped to this norm."""
    attention: Literal["torch", "compiled"] = "torch"
    """Who computes the layers of transformers of up to 16 tokens while learning, attention and all: torch, or on a CPU
    RAPID's own compiled code, which is faster at it and rounds otherwise. Layers whose width or feed-forward width is
    no multiple of 16 are torch's in either case."""


@dataclass(frozen=True)
class AdversaryConfig:
    """Who lies to the policy while PPO learns (:mod:`rapid.training.machinery.adversary`); the critic has the truth.

    Each episode is under one of the mixture's attacks, or under none; sizes are in features scaled to +-1.
    """

    gradient_share: Share = 0.0
    """Share of the episodes under projected gradients."""
    near_share: Share = 0.5
    """At each step, so many of them climb from the truth, with steps that just reach the ball's edge, as the attacks
    that are measured do; the others climb from a random point of the ball."""
    spared_share: Share = 0.0
    """At each step, so many of them leave the ego's own row alone. A memory notices lies about the ego, and would trust
    everything else."""
    targeted_share: Share = 0.5
    """Of those, the share in which each step drives the policy towards an action drawn by chance; the others drive it
    away from what it would do."""
    noise_share: Share = 0.0
    """Share of the episodes under uniform noise."""
    radius: AboveZero = 0.1
    """Of the gradient attacks' ball (L-infinity)."""
    steps: Positive = 5
    """Gradient steps."""
    step_size: AboveZero = 0.04
    """Length of a gradient step from a random point."""
    noise: AboveZero = 0.2
    """The noise lies within so much of the truth."""
    begin: ShareBelowOne = 0.0
    """Share of PPO's steps before the first attack, in which the policy learns what pays."""
    ramp: Share = 0.0
    """Share of PPO's steps after that over which radius and noise grow to their size; without a guide alone."""
    guided: Share = 0.0
    """Share of PPO's steps, from the first attack on, in which the policy does not try what pays but is shown what to
    do: under attack what a plan says, otherwise what it did before (:mod:`rapid.training.machinery.guide`)."""
    plan: str = ""
    """That plan, as of the driver `blind`, such as 13,2,8; nothing is blind's own in the scenario."""

    def guided_rollouts(self, planned: int) -> range:
        """Return in which of so many rollouts the policy is shown what to do."""
        return range(round(self.begin * planned), round((self.begin + self.guided) * planned) if self.guided else 0)


@dataclass(frozen=True)
class AdaptConfig:
    """Phase 3: online adaptation (paper: section 4.4)."""

    steps: Count = 10_000
    """Environment steps of Q-learning, all worlds together; 0 leaves it out."""
    num_envs: Side = 10
    """Worlds stepped at once; 1 is the paper's setting."""
    updates_per_step: AboveZero = 0.2
    """Gradient steps per environment step."""
    scenario: str = ""
    """Target scenario; empty is the one that the agent was distilled in."""
    buffer_size: Rows = 100_000
    """Capacity of the replay buffer."""
    learning_starts: Count = 500
    """Environment steps before the first gradient step."""
    exploration_start: Share = 0.1
    """epsilon of epsilon-greedy at the first step; the paper's 1 forgets for a while what was distilled."""
    exploration_end: Share = 0.02
    """epsilon after the schedule."""
    exploration_share: Share = 0.2
    """Share of the steps over which epsilon falls."""
    exploration_hold: Positive = 1
    """A random action is held for 1 to so many steps, and begun so rarely that epsilon stays the share of steps that
    explore; 1 is plain epsilon-greedy."""
    offline_share: ShareBelowOne = 0.5
    """Share of each batch taken from the offline data; whatever `loss.n_step`, over one step."""
    train: Literal["adapter", "all", "scratch"] = "adapter"
    """`adapter` is the method: policy 1 frozen. `all` fine-tunes every weight. `scratch` starts from new weights."""
    freeze_decoder: bool = False
    """Also freeze the action decoder."""
    vehicles: Annotated[int, Bounds(0, MAX_VEHICLES)] = 0
    """Set `network.vehicles` from this phase on, whatever the data has, to see farther; 0 leaves it as it is. At least
    what it was, for a network of tokens that masks absent rows and has no position learned for each."""
    mirror: bool = False
    """Set `network.mirror` from this phase on; without this an agent keeps what it has."""
    memory: bool = False
    """Set `network.memory` from PPO on; without this an agent keeps what it has."""
    squeeze: bool = False
    """Set `network.squeeze` from PPO on, beside a memory; without this an agent keeps what it has."""
    shield: str = ""
    """Set `network.shield` from this phase on, so that the policy learns behind the filter; nothing leaves it as it
    is."""
    evaluate_every: Count = 1_000
    """Environment steps between two evaluations; 0 is never."""
    loss: LossConfig = field(default_factory=lambda: LossConfig(conservative_weight=0.2, robust_weight=0.0, n_step=3))
    """The loss of this phase. A little of the conservative term keeps values that were learned offline from being
    unlearned faster than driving can correct them."""
    optimizer: OptimizerConfig = field(default_factory=lambda: OptimizerConfig(learning_rate=3e-4, gate_rate=20.0))
    """The optimiser of this phase."""
    ppo: PpoConfig = field(default_factory=PpoConfig)
    """What follows the Q-learning."""
    adversary: AdversaryConfig = field(default_factory=AdversaryConfig)
    """Under which attacks PPO drives."""
