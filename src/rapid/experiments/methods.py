"""Methods: what is compared, with the cells that make it. Its id is what a method is; its label is only shown."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rapid.experiments.cells import Driven, Driver
from rapid.experiments.learned import (
    Setting,
    adapted,
    distilled,
    from_scratch,
    guided,
    mixture_of_actions,
    mlp,
    mlp_by_ppo,
    monitored,
    on_rule_data,
    paper_data,
    rapid,
    robust,
    squeezed,
    the_teacher,
    without,
)


@dataclass(frozen=True)
class Method:
    """Something that is compared: an id that never changes, a label that may, and how its agent is made."""

    id: str
    label: str
    kind: Literal["floor", "teacher", "planner", "learned"]
    agent: Callable[[Setting], Driven]
    printed: str = ""
    """What the paper's tables call it."""
    looks: Literal["everything", "presence", "nothing"] = "everything"
    """At what of the observation it looks. Who looks at nothing drives the same under every attack; who reads who is
    present, rounded, the same under gradient attacks, which move presence by less than one half."""

    @property
    def trained(self) -> bool:
        """Whether it has training seeds."""
        return self.kind == "learned"

    def under(self, attack: str) -> str:
        """Return what to drive it under to know what it does under `attack`; empty if it cannot be attacked so.

        Gradient attacks need a network, and nobody attacks what a planner knows.
        """
        noise = attack in ("none", "uniform", "gaussian")
        if self.looks == "nothing" or (self.looks == "presence" and not noise):
            return "none"
        if self.kind in ("teacher", "planner") and attack != "none":
            return ""
        return attack if self.trained or noise else ""


def _driver(
    name: str,
    label: str,
    kind: Literal["floor", "teacher", "planner"] = "floor",
    looks: Literal["everything", "presence", "nothing"] = "everything",
) -> Method:
    return Method(name, label, kind, lambda setting: Driver(name), looks=looks)


FLOORS = (
    _driver("slower", "always slower", looks="nothing"),
    _driver("immune", "immune: slower while any car is seen", looks="presence"),
    _driver("blind", "blind: a fixed plan", looks="nothing"),
    _driver("random", "random", looks="nothing"),
    _driver("rule", "rule"),
)
TEACHER = Method("teacher", "teacher (LLM)", "teacher", lambda setting: the_teacher(setting.scale))
PLANNER = _driver("planner", "planner", "planner")


METHODS: dict[str, Method] = {
    method.id: method
    for method in (
        *FLOORS,
        TEACHER,
        PLANNER,
        Method("offline-dqn", "offline DQN", "learned", lambda s: mlp(s, "dqn", paper_data(s)), printed="Offline DQN"),
        Method("offline-ddqn", "offline DDQN", "learned", lambda s: mlp(s, "ddqn", paper_data(s))),
        Method("cql", "CQL", "learned", lambda s: mlp(s, "cql", paper_data(s))),
        Method("bc", "behaviour cloning", "learned", lambda s: mlp(s, "bc", paper_data(s))),
        Method("distilled", "RAPID after phase 2", "learned", lambda s: distilled(s, paper_data(s))),
        Method("online-dqn", "online DQN", "learned", lambda s: from_scratch(s, "dqn"), printed="Online DQN"),
        Method("online-ddqn", "online DDQN", "learned", lambda s: from_scratch(s, "ddqn")),
        Method("online-ppo", "online PPO", "learned", lambda s: from_scratch(s, "ppo")),
        Method(
            "rapid-without-robust",
            "RAPID without J_robust",
            "learned",
            lambda s: rapid(s, paper_data(s), beta=0.0),
            printed="RAPID without robust term",
        ),
        Method("rapid", "RAPID", "learned", lambda s: rapid(s, paper_data(s)), printed="RAPID"),
        Method("rapid-10k", "RAPID, 10K online", "learned", lambda s: rapid(s, paper_data(s), plan="careful")),
        Method("rapid-ppo", "RAPID, 300K + 700K PPO", "learned", lambda s: rapid(s, paper_data(s), plan="ppo")),
        Method(
            "rapid-robust",
            "RAPID, adapted under attack",
            "learned",
            robust,
        ),
        Method("rapid-guided", "RAPID, guided under attack", "learned", guided),
        Method("rapid-squeezed", "RAPID, squeezed features, under attack", "learned", squeezed),
        Method("rapid-monitored", "RAPID, monitored", "learned", monitored),
        Method("mlp-ppo", "MLP, 300K + 700K PPO", "learned", mlp_by_ppo),
        Method("online-ddqn-10k", "online DDQN, 10K", "learned", lambda s: from_scratch(s, "ddqn", "careful")),
        Method(
            "distilled-without-robust",
            "phase 2 without J_robust",
            "learned",
            lambda s: without(s, paper_data(s), robust_weight=0.0),
        ),
        Method(
            "distilled-without-cql",
            "phase 2 without CQL",
            "learned",
            lambda s: without(s, paper_data(s), conservative_weight=0.0),
        ),
        Method(
            "distilled-plain-dqn",
            "phase 2 by plain DQN",
            "learned",
            lambda s: without(s, paper_data(s), robust_weight=0.0, conservative_weight=0.0),
        ),
        Method("distilled-rule-data", "phase 2 on a rule's data", "learned", on_rule_data),
        Method(
            "rapid-10k-all",
            "RAPID, 10K, all weights trained",
            "learned",
            lambda s: adapted(s, paper_data(s), "careful", "all"),
        ),
        Method(
            "rapid-10k-scratch",
            "RAPID, 10K, from new weights",
            "learned",
            lambda s: adapted(s, paper_data(s), "careful", "scratch"),
        ),
        Method("mixture-of-actions", "mixture of actions", "learned", lambda s: mixture_of_actions(s, paper_data(s))),
    )
}
"""Methods by their ids."""
