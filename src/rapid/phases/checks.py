"""What can be seen to be wrong with the settings before any work starts."""

import torch

from rapid.attacks import get_attack
from rapid.attacks.suite import expand
from rapid.config import Config
from rapid.config_io import validate
from rapid.config_learning import AdaptConfig
from rapid.data.collection import parse_shard
from rapid.engines import check_engine
from rapid.errors import RapidError
from rapid.scenarios import get_scenario
from rapid.teacher import check_teacher
from rapid.teacher.scripted import plan_actions, plan_for, read_plan
from rapid.tracking import check_tracking


def check(config: Config) -> None:
    """Look for everything that can be seen to be wrong before any work starts.

    Raises:
        RapidError: the first thing found.
    """
    validate(config)
    torch.set_num_threads(config.threads)
    try:
        torch.empty(0, device=config.device)
    except (RuntimeError, AssertionError) as error:
        raise RapidError(
            f"Device '{config.device}' cannot be used: {str(error).splitlines()[0].rstrip('.')}. Use --device cpu."
        ) from error
    lanes = get_scenario(config.scenario).lanes
    for spec in expand((*config.evaluate.attacks, *config.evaluate.teacher_attacks)):
        get_attack(spec, lanes)
    parse_shard(config.collect.shard)
    check_engine(config.collect.engine)
    check_tracking(config.tracking)
    shown_plan(config.adapt, config.adapt.scenario or config.scenario)
    check_teacher(config.teacher, lanes, config.scenario)


def shown_plan(settings: AdaptConfig, scenario: str) -> list[int]:
    """Return the plan that the policy is shown under attack, if it is to be shown any.

    Raises:
        RapidError: `blind` has none in this scenario and the settings name none, or none that can be read.
    """
    if not settings.adversary.guided:
        return []
    return plan_actions(read_plan(settings.adversary.plan) if settings.adversary.plan else plan_for(scenario))
