"""Phases 2 and 3: offline distillation and online adaptation."""

from rapid.training.offline import distill
from rapid.training.online import adapt

__all__ = ["adapt", "distill"]
