"""Kernels compile on their first call, which may fall into any example of any test."""

from hypothesis import settings

settings.register_profile("kernels", deadline=None)
settings.load_profile("kernels")
