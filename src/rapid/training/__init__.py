"""Phases 2 and 3: offline distillation and online adaptation."""

from rapid.training.offline import distill
from rapid.training.online import adapt
from rapid.training.ppo import adapt_by_ppo

__all__ = ["adapt", "adapt_by_ppo", "distill"]
